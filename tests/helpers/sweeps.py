"""A task that is learnt in a second, and sweeps of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

TASK = '''
import os
import signal

import jax
import jax.numpy as jnp

from arm5dof import Task
from arm5dof.envs import State
from arm5dof.settings import settings, static


@settings
class PushConfig:
    """A point on a line."""

    episode_length: int = static(default=8)
    """Steps in an episode."""
    trouble: str = static(default="")
    """raise or kill: what the environment does when it is checked."""


class Push(Task):
    """Push a point to 0."""

    Config = PushConfig
    action_size = 1

    def check(self):
        if self.config.trouble == "raise":
            raise RuntimeError("no such luck")
        if self.config.trouble == "kill":
            os.kill(os.getpid(), signal.SIGKILL)

    def reset(self, key):
        return self._state(jax.random.uniform(key, (1,), minval=-1.0, maxval=1.0))

    def step(self, state, action):
        return self._state(state.data + 0.3 * action)

    def _state(self, x):
        return State(x, {"state": x, "privileged_state": x}, -jnp.abs(x[0]), jnp.zeros(()), {}, {})
'''

EXPERIMENT = """
[env]
task = "toy_push:Push"

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
    """An experiment of a task of one's own, and the module of that task beside it."""
    (folder / "toy_push.py").write_text(TASK)
    (folder / "toy.toml").write_text(EXPERIMENT)
    return folder / "toy.toml"


def same(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A table without what no two sweeps have in common: how long they took."""
    return [{name: value for name, value in row.items() if name not in ("seconds", "revision")} for row in rows]
