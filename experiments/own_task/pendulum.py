"""A task of one's own, in one file outside the package: Gymnasium's pendulum, to be swung up and held there.

arm5dof train pendulum.toml
"""

from typing import ClassVar

import jax
import jax.numpy as jnp

from arm5dof import Task
from arm5dof.envs import State
from arm5dof.settings import settings, static

MAX_SPEED, MAX_TORQUE, DT = 8.0, 2.0, 0.05


@settings
class PendulumConfig:
    """Constants are those of Gymnasium's `Pendulum-v1`."""

    gravity: float = static(default=10.0)
    """m/s^2."""
    episode_length: int = static(default=200)
    """Steps in an episode."""


class Pendulum(Task):
    """Angles in radians, 0 upright. The reward is minus angle^2, speed^2 / 10 and torque^2 / 1000."""

    Config: ClassVar[type] = PendulumConfig
    action_size = 1

    def reset(self, key: jax.Array) -> State:
        """Any angle, and a small speed."""
        limits = jnp.array([jnp.pi, 1.0])
        angle_and_speed = jax.random.uniform(key, (2,), minval=-limits, maxval=limits)
        zero = jnp.zeros(())
        return State(angle_and_speed, self._observe(angle_and_speed), zero, zero, {}, {})

    def step(self, state: State, action: jax.Array) -> State:
        """A twentieth of a second."""
        angle, speed = state.data
        torque = MAX_TORQUE * jnp.clip(action[0], -1, 1)
        wrapped = (angle + jnp.pi) % (2 * jnp.pi) - jnp.pi
        reward = -(wrapped**2 + 0.1 * speed**2 + 0.001 * torque**2)
        speed = speed + (1.5 * self.config.gravity * jnp.sin(angle) + 3.0 * torque) * DT
        speed = jnp.clip(speed, -MAX_SPEED, MAX_SPEED)
        data = jnp.stack([angle + speed * DT, speed])
        return state.replace(data=data, obs=self._observe(data), reward=reward)

    def _observe(self, data: jax.Array) -> dict[str, jax.Array]:
        seen = jnp.stack([jnp.cos(data[0]), jnp.sin(data[0]), data[1] / MAX_SPEED])
        return {"state": seen, "privileged_state": seen}
