"""Toy environments whose right answers are known, in the spirit of rejax's."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from arm5dof.envs import State
from arm5dof.envs.base import Observation

Next = tuple[jax.Array, jax.Array | float, jax.Array | float]
"""The next observation, the reward, and whether the episode has ended for good."""


class Toy:
    """One action. What the actor sees, the critic sees too."""

    action_size = 1

    def first(self, key: jax.Array) -> jax.Array:
        """The first observation, a vector."""
        raise NotImplementedError

    def next(self, seen: jax.Array, action: jax.Array) -> Next:
        """What follows an action."""
        raise NotImplementedError

    def reset(self, key: jax.Array) -> State:
        seen, zero = self.first(key), jnp.zeros(())
        return State(seen, _both(seen), zero, zero, {}, {})

    def step(self, state: State, action: jax.Array) -> State:
        seen, reward, done = self.next(state.data, action[0])
        return state.replace(
            data=seen, obs=_both(seen), reward=jnp.asarray(reward, float), done=jnp.asarray(done, float)
        )


def _both(seen: jax.Array) -> Observation:
    return {"state": seen, "privileged_state": seen}


class Bandit(Toy):
    """One step, reward -(a - s)^2. Right answer: a = s; Q(s, a) is the reward, whatever the discount."""

    def first(self, key: jax.Array) -> jax.Array:
        return jax.random.uniform(key, (1,), minval=-0.8, maxval=0.8)

    def next(self, seen: jax.Array, action: jax.Array) -> Next:
        return seen, -((action - seen[0]) ** 2), 1.0


class Loan(Toy):
    """Two steps: the first action a costs a^2 and pays 2 a back in the second, whose action is of no account.

    Right answer: a = gamma, of value gamma^2; without looking ahead it would be 0. Observations are (step, a).
    """

    def first(self, key: jax.Array) -> jax.Array:
        return jnp.zeros(2)

    def next(self, seen: jax.Array, action: jax.Array) -> Next:
        late, borrowed = seen
        borrowed = jnp.where(late > 0, borrowed, action)
        return jnp.stack([jnp.ones(()), borrowed]), jnp.where(late > 0, 2 * borrowed, -(action**2)), late


class Salary(Toy):
    """Reward 1 at every step, for ever if `years` is None, else `years` steps. The observation is the share of time
    served, always 0 where time has no end.

    Right answer: Q = 1 / (1 - gamma) for ever, however early a time limit cuts episodes off; with k steps left
    (1 - gamma^k) / (1 - gamma).
    """

    def __init__(self, years: int | None = None) -> None:
        self.years = years

    def first(self, key: jax.Array) -> jax.Array:
        return jnp.zeros(1)

    def next(self, seen: jax.Array, action: jax.Array) -> Next:
        if self.years is None:
            return seen, 1.0, 0.0
        served = seen + 1 / self.years
        return served, 1.0, served[0] > 1 - 1e-3


class Walk(Toy):
    """A walk to the right in whole steps from a random start in [0, 1): observations tell episodes and steps apart.
    Ends for good where it passes `end`; becomes NaN, or the given poison, where it passes `cliff`."""

    def __init__(self, end: float = jnp.inf, cliff: float = jnp.inf, poison: float = jnp.nan) -> None:
        self.end, self.cliff, self.poison = end, cliff, poison

    def first(self, key: jax.Array) -> jax.Array:
        return jax.random.uniform(key, (1,))

    def next(self, seen: jax.Array, action: jax.Array) -> Next:
        position = seen + 1
        fallen = jnp.where(position > self.cliff, self.poison, position)
        return fallen, fallen[0], position[0] > self.end
