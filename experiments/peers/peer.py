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

SBX = {
    "learning_rate": 1e-3,
    "gamma": 0.0,
    "batch_size": 256,
    "gradient_steps": 32,
    "num_envs": 64,
    "actor": [256, 256],
    "critic": [256, 256],
    "activation": "relu",
    "layer_norm": False,
    "learning_starts": 1000,
    "buffer_size": 1_000_000,
    "decay_updates": 0,
    "hindsight": 0,
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
    "buffer_size": 16_384,
    "reward_scale": 1.0,
    "iterations_per_call": 50,
}
SETTINGS = {
    "sbx-DDPG": {**SBX, "qf_learning_rate": None, "noise": 0.3},
    "sbx-TD3": {**SBX, "noise": 0.3},
    "sbx-SAC": {**SBX, "ent_coef": "auto_0.01"},
    "rejax-TD3": {**REJAX, "exploration_noise": 0.3, "policy_delay": 1},
    "rejax-SAC": REJAX,
    "brax-SAC": {
        "learning_rate": 1e-3,
        "discounting": 0.0,
        "batch_size": 64,
        "grad_updates_per_step": 64,
        "num_envs": 64,
        "reward_scaling": 100.0,
        "min_replay_size": 6400,
        "max_replay_size": 262_144,
        "layers": (128, 128, 128),
        "activation": "gelu",
        "evaluate_every": 3200,
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
