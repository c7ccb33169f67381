"""Many environments as one: `vmap`, time limit, automatic reset, and a guard against physics that blows up."""

from __future__ import annotations

from typing import TypeVar

import jax
import jax.numpy as jnp

from arm5dof.envs.base import Env, State
from arm5dof.runtime import forks

T = TypeVar("T")


class VectorEnv:
    """A batch of environments that reset themselves. All arrays have the batch as their first axis.

    After `step`, `state.obs` is where the next action is due: the first observation of a new episode wherever one
    ended. What the step led to is kept in `info`:

    - `next_obs`: the observation reached, also at the end of an episode. Learn from this one.
    - `truncation`: 1.0 where the time limit ended the episode (bootstrap through it). `done` is 1.0 at the end of an
      episode for whatever reason, as in Brax.
    - `nonfinite`: 1.0 where the step led to NaN or infinity. That environment was reset, reward and observations are
      finite stand-ins, and nothing should be learnt from the step.
    """

    def __init__(self, env: Env, episode_length: int) -> None:
        self.env = env
        self.episode_length = episode_length

    def reset(self, keys: jax.Array) -> State:
        """Start one environment for each key."""
        forks.check()
        return jax.vmap(self._reset)(keys)

    def step(self, state: State, action: jax.Array) -> State:
        """Step all environments with actions (batch, action_size)."""
        forks.check()
        return jax.vmap(self._step)(state, action)

    def _reset(self, key: jax.Array) -> State:
        key, reset_key = jax.random.split(key)
        state = self.env.reset(reset_key)
        zero = jnp.zeros(())
        bookkeeping = {"key": key, "steps": jnp.zeros((), jnp.int32), "truncation": zero, "nonfinite": zero}
        return state.replace(info={**state.info, **bookkeeping, "next_obs": state.obs})

    def _step(self, state: State, action: jax.Array) -> State:
        # `done` is ours by now: at an episode's end it says so, and an environment that never ends would keep it.
        reached = self.env.step(state.replace(done=jnp.zeros_like(state.done)), action)
        finite = jnp.array(True)
        for leaf in jax.tree.leaves((reached.obs, reached.reward)):
            finite &= jnp.isfinite(leaf).all()
        steps = state.info["steps"] + 1
        terminated = reached.done > 0
        truncated = (steps >= self.episode_length) & ~terminated & finite
        over = terminated | truncated | ~finite

        fresh = self._reset(state.info["key"])
        continued = reached.replace(info={**state.info, **reached.info, "steps": steps})
        new = _where(over, fresh, continued)
        return new.replace(
            reward=jnp.where(finite, reached.reward, 0.0),
            done=over.astype(jnp.float32),
            metrics=_where(finite, reached.metrics, fresh.metrics),
            info={
                **new.info,
                "next_obs": _where(finite, reached.obs, fresh.obs),
                "truncation": truncated.astype(jnp.float32),
                "nonfinite": 1.0 - finite.astype(jnp.float32),
            },
        )


def _where(condition: jax.Array, left: T, right: T) -> T:
    """Choose between two pytrees, leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), left, right)
