"""What an environment is: `State` and the protocols that trainers know."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import jax
from flax import struct

Observation = dict[str, jax.Array]
"""`state` is what the actor sees, `privileged_state` what the critic sees besides the action; both are vectors."""


class State(struct.PyTreeNode):
    """One environment's state, with the fields that MuJoCo Playground uses."""

    data: Any
    obs: Observation
    reward: jax.Array
    done: jax.Array
    """1.0 if the episode has ended for good (no bootstrapping beyond it), else 0.0."""
    metrics: dict[str, jax.Array]
    info: dict[str, Any]


class Env(Protocol):
    """A pure environment without a batch axis. Actions are vectors in [-1, 1].

    `step` sets `done` if the episode has ended for good, and keeps the entries of `info` that it does not know.
    """

    @property
    def action_size(self) -> int: ...

    def reset(self, key: jax.Array) -> State: ...

    def step(self, state: State, action: jax.Array) -> State: ...


@runtime_checkable
class GoalEnv(Protocol):
    """An environment whose reward depends on a goal, a point, in a known way, so that goals can be exchanged in
    hindsight and the outcome of an action foreseen. Vectors without a batch axis, as everywhere. The goal of an
    episode, (3,) metres, is kept in `info["goal"]`."""

    @property
    def action_size(self) -> int: ...

    def reset(self, key: jax.Array) -> State: ...

    def step(self, state: State, action: jax.Array) -> State: ...

    def achieved(self, obs: Observation) -> jax.Array:
        """The point that this observation has reached, (3,) metres."""
        ...

    def relabel(self, obs: Observation, goal: jax.Array) -> Observation:
        """The same observation, had the goal been another."""
        ...

    def goal_reward(self, achieved: jax.Array, goal: jax.Array) -> jax.Array:
        """The reward for having reached a point when `goal` was asked for."""
        ...

    def outcome(self, obs: Observation, action: jax.Array) -> jax.Array:
        """What the critic is shown of an action: where it leads by the robot's own model, beside the goal."""
        ...
