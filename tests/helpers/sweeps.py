"""Sweeps of a task that is learnt in a second."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

EXPERIMENT = """
[env]
task = "helpers.toy_push:Push"

[train]
episodes = 8
num_envs = 2
epoch_steps = 4
evaluate_every = 4
checkpoint_every = 4

[ddpg]
batch_size = 8
updates_per_step = 2
actor_width = 8
actor_depth = 1
critic_width = 8
critic_depth = 1
replay_capacity = 128

[evaluate]
targets = 16
interim_targets = 16
"""


def toy(folder: Path) -> Path:
    """An experiment of a task of one's own."""
    (folder / "toy.toml").write_text(EXPERIMENT)
    return folder / "toy.toml"


def environment() -> dict[str, str]:
    """For processes that are to find that task."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


def same(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A table without what no two sweeps have in common: how long they took."""
    return [{name: value for name, value in row.items() if name not in ("seconds", "revision")} for row in rows]
