"""Reach: bring the end effector to a point. The paper's task (sections 4.2 and 5.2)."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np

from arm5dof.envs.accuracy import AT_LIMIT
from arm5dof.envs.arm_goal import ArmGoalConfig, ArmGoalEnv
from arm5dof.envs.base import vectors
from arm5dof.envs.metrics import Error, Metric
from arm5dof.envs.physics import Physics
from arm5dof.settings import settings, static


@settings
class ReachConfig(ArmGoalConfig):
    """The task of bringing the end effector to a point."""

    observation: Literal["goal", "paper", "full"] = static(default="goal")
    """What the actor sees. goal: the target alone; paper: every joint's position and its offset from the target;
    full: the paper's, joint angles and velocities, end effector and target."""


class Reach(ArmGoalEnv):
    """A goal is a point, (3,) metres in the world frame. The reward is Eq. 7, minus the distance between end effector
    and target in metres.

    The paper gives the actor "the distance between the joints and the object". Scalar distances leave open on which
    side of the arm's plane the object is, so the offsets are given as vectors here.
    """

    Config: ClassVar[type] = ReachConfig
    config: ReachConfig
    components: ClassVar[dict[str, Error]] = {"distance": Error()}
    metrics: ClassVar[dict[str, Metric]] = {
        **dict.fromkeys(("one_shot", "refined", "episode", "policy_distance"), Error()),
        "at_limit": AT_LIMIT,
    }

    @property
    def goal_inputs(self) -> dict[str, tuple[str, ...]]:
        """See `ForwardModel`."""
        return {"target": ("x", "y", "z")}

    def goals(self, **inputs: np.ndarray) -> jax.Array:
        """See `ForwardModel`: points, (n, 3) metres."""
        return jnp.asarray(vectors("target", inputs["target"], self.goal_inputs["target"]), jnp.float32)

    def forward(self, q: jax.Array) -> jax.Array:
        """The end effector's position."""
        return self.arm.forward(q)

    def position(self, goal: jax.Array) -> jax.Array:
        return goal

    def encode(self, goal: jax.Array) -> jax.Array:
        """Relative to the arm's origin, in units of its reach."""
        return self._scaled(goal)

    def decode(self, vector: jax.Array) -> jax.Array:
        return self._unscaled(vector)

    def errors(self, achieved: jax.Array, goal: jax.Array) -> dict[str, jax.Array]:
        """The distance, metres."""
        return {"distance": jnp.linalg.norm(achieved - goal)}

    def goal_reward(self, achieved: jax.Array, goal: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Eq. 7: minus the distance, metres. It never ends an episode."""
        return -self.errors(achieved, goal)["distance"], jnp.zeros(())

    def residual(self, achieved: jax.Array, goal: jax.Array) -> jax.Array:
        return achieved - goal

    def correct(self, asked: jax.Array, achieved: jax.Array, goal: jax.Array) -> jax.Array:
        """Shifted by the error."""
        return asked + goal - achieved

    def actor_state(self, before: jax.Array, target: jax.Array) -> jax.Array:
        n = self.arm.dof
        if self.config.observation == "goal":
            return target
        offsets = target - before[: 3 * n].reshape(n, 3)
        state = before.at[3 * n : 6 * n].set(offsets.ravel())
        return state.at[-3:].set(target) if self.config.observation == "full" else state

    def _actor_observation(self, data: Physics, q: jax.Array, there: jax.Array, target: jax.Array) -> Any:
        if self.config.observation == "goal":
            return target
        joints = self._scaled(self.arm.joint_positions(data.qpos[self.arm.qpos]))
        state = jnp.concatenate([joints.ravel(), (target - joints).ravel()])
        if self.config.observation == "full":
            moved = data.qvel[self.arm.dofs] * self.arm.mj_model.opt.timestep * self.config.substeps
            state = jnp.concatenate([state, q, moved, there, target])
        return state
