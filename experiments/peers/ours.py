"""Our trainer in the comparison: the learning curve of `kinematic.toml` with a small budget, as a CSV file.

    python experiments/peers/ours.py --out curve.csv [--seed 0] [--episodes 25] [--set heads=2 ...]

The noise and the step sizes fall over the whole budget, so the budget is part of the recipe.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from task import Record

from arm5dof import load_config
from arm5dof.runtime import xla
from arm5dof.training import loop


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", type=int, default=25)
    parser.add_argument("--num-envs", type=int, default=25)
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="other settings of arm5dof train")
    arguments = parser.parse_args()
    xla.enable_compilation_cache()
    budget = {name: str(getattr(arguments, name)) for name in ("seed", "episodes", "num_envs")}
    every = {"evaluate_every": budget["num_envs"], "checkpoint_every": budget["num_envs"]}
    overrides = dict(pair.split("=", 1) for pair in arguments.set)
    trainer = loop.make_trainer(load_config("kinematic.toml", **budget, **every, **overrides))

    record = Record(arguments.out, minutes=60, transitions=trainer.total_steps * arguments.num_envs)
    trainer.start()
    over = False
    while not over:
        trainer.advance()
        policy = trainer.policy()
        answer = lambda goals, policy=policy: policy.env.arm.to_action(policy.solve(goals).q)
        over = record.measure(trainer.counters.env_steps, answer)
    record.finish()


if __name__ == "__main__":
    main()
