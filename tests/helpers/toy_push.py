"""A task that is learnt in a second, and makes trouble if it is asked to."""

from __future__ import annotations

import os
import signal

import jax
import jax.numpy as jnp

from arm5dof.envs import State, Task
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

    def check(self) -> None:
        if self.config.trouble == "raise":
            raise RuntimeError("no such luck")
        if self.config.trouble == "kill":
            os.kill(os.getpid(), signal.SIGKILL)

    def reset(self, key: jax.Array) -> State:
        return self._state(jax.random.uniform(key, (1,), minval=-1.0, maxval=1.0))

    def step(self, state: State, action: jax.Array) -> State:
        return self._state(state.data + 0.3 * action)

    def _state(self, x: jax.Array) -> State:
        return State(x, {"state": x, "privileged_state": x}, -jnp.abs(x[0]), jnp.zeros(()), {}, {})
