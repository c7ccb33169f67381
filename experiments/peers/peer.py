"""Train one peer and write its learning curve.

    python experiments/peers/peer.py sbx-TD3 --out curve.csv [--seed 0] [--minutes 20] [--transitions 1e7]
                                             [--set learning_rate=1e-3 num_envs=32 ...]

Runs in the peers' own environment (`requirements.txt`); `--set` changes any of the settings below.
"""

from __future__ import annotations

import argparse
import ast
import importlib
from pathlib import Path

# What was tried, and what it was worth (`tune.py` tries more). The first trials were short ones on a busy machine.
# - An action is judged at once, so the discount is 0 for all.
# - Observations are the goal alone: the pose before an action has no bearing on what comes of it.
# - The task in plain NumPy, all environments in one batch, costs next to nothing beside the updates.
# - Cost of an update (sbx): width 256 costs three times 128, batch 256 four times 64; small ones learn faster by clock.
# - gelu learns faster than relu; three layers of 128; one update for each transition.
# - DDPG: step size 1e-3 before 3e-3. SAC needs a small entropy coefficient.
# - Hindsight, with goals from the same episode: half as many updates again or fewer for the same accuracy, then
#   accuracy goes up and down, which is what the falling step size is for. DDPG ends at 94.6 % if it falls within
#   100,000 updates, at 86.9 to 95.5 % within 140,000 (three minutes), at 94.1 to 96.3 % within 200,000.
# - XLA without its fusion emitters, as ours: no difference for sbx, slower for rejax; they keep jax's own choice.
SBX = {
    "learning_rate": 1e-3,
    "gamma": 0.0,
    "batch_size": 64,
    "gradient_steps": 64,
    "num_envs": 64,
    "actor": [128, 128, 128],
    "critic": [128, 128, 128],
    "activation": "gelu",
    "layer_norm": False,
    "learning_starts": 6400,
    "buffer_size": 1_000_000,
    "decay_updates": 200_000,
    "hindsight": 1,
}
REJAX = {
    "learning_rate": 1e-3,
    "gamma": 0.0,
    "batch_size": 64,
    "num_epochs": 64,
    "num_envs": 64,
    "layers": (128, 128, 128),
    "activation": "gelu",
    "fill_buffer": 6400,
    "buffer_size": 16_384,  # Sampling takes time in proportion.
    "reward_scale": 1.0,
    "iterations_per_call": 20,
}
SETTINGS = {
    "sbx-DDPG": {**SBX, "qf_learning_rate": None, "noise": 0.5},
    "sbx-TD3": {**SBX, "noise": 0.5, "policy_delay": 2},
    "sbx-SAC": {**SBX, "ent_coef": "auto_0.001"},
    "rejax-TD3": {**REJAX, "exploration_noise": 0.3, "policy_delay": 1},
    "rejax-SAC": {**REJAX, "reward_scale": 100.0},
    "brax-SAC": {
        "learning_rate": 1e-3,
        "discounting": 0.0,
        "batch_size": 64,
        "grad_updates_per_step": 64,
        "num_envs": 64,
        "reward_scaling": 1000.0,
        "min_replay_size": 6400,
        "max_replay_size": 262_144,
        "layers": (128, 128, 128),
        "activation": "gelu",
        "evaluate_every": 1280,
    },
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=SETTINGS)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=20)
    parser.add_argument("--transitions", type=float, default=1e7)
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="change settings")
    arguments = parser.parse_args()
    settings = dict(SETTINGS[arguments.name])
    for pair in arguments.set:
        name, text = pair.split("=", 1)
        if name not in settings:
            parser.error(f"{arguments.name} has no setting {name!r}: it has {', '.join(settings)}")
        settings[name] = text if isinstance(settings[name], str) else ast.literal_eval(text)

    from task import Record  # Imports that take time come after the arguments are known to be right.

    library, algorithm = arguments.name.split("-")
    record = Record(arguments.out, arguments.minutes, arguments.transitions)
    importlib.import_module(f"with_{library}").train(algorithm, settings, arguments.seed, record)
    record.finish()


if __name__ == "__main__":
    main()
