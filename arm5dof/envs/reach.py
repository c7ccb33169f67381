"""Reach: bring the end effector to a point. The paper's task (sections 4.2 and 5.2)."""

from __future__ import annotations

from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import mujoco
from annotated_types import Ge

from arm5dof.arm import Arm
from arm5dof.envs.base import Observation, State
from arm5dof.envs.physics import Physics
from arm5dof.errors import UserError
from arm5dof.settings import settings, static


@settings
class ReachConfig:
    """The task."""

    arm: str = static(default="reach.xml")
    """MJCF file with the arm: a path, or the name of one that ships with the package."""
    site: str = static(default="ee")
    """The end effector: a site in that file."""
    dynamics: Literal["servo", "kinematic"] = static(default="servo")
    """servo: an action is the position actuators' target and MJX physics moves the arm there; kinematic: an action
    is the pose itself, the paper's setting."""
    observation: Literal["goal", "paper", "full"] = static(default="goal")
    """What the actor sees. goal: the target alone; paper: every joint's position and its offset from the target;
    full: the paper's, joint angles and velocities, end effector and target."""
    episode_length: Annotated[int, Ge(1)] = static(default=160)
    """Control steps in an episode; its end is a truncation."""
    substeps: Annotated[int, Ge(1)] = static(default=5)
    """Physics steps in a control step (servo): long enough for the servos to settle to within 1 %."""


class Reach:
    """The reaching environment: pure `reset(key)` and `step(state, action)`, no batch axis.

    Observations are dimensionless: points are relative to the arm's origin in units of its reach, joint positions in
    units of half their range ([-1, 1]). The critic's `privileged_state` is the paper's: joint angles, end-effector
    position, target. The reward is Eq. 7, minus the distance between end effector and target in metres.

    The paper gives the actor "the distance between the joints and the object". Scalar distances leave open on which
    side of the arm's plane the object is, so the offsets are given as vectors here.
    """

    def __init__(self, arm: Arm, config: ReachConfig) -> None:
        self.arm = arm
        self.config = config
        if config.dynamics == "servo" and (arm.actuators < 0).any():
            name = arm.mj_model.joint(int(arm.joints[(arm.actuators < 0).argmax()])).name
            raise UserError(
                f"joint {name!r} has no position actuator: add one to the MJCF, or train with --dynamics kinematic"
            )
        self._origin = arm.origin
        body = mujoco.mj_name2id(arm.mj_model, mujoco.mjtObj.mjOBJ_BODY, "target")
        self._marker = int(arm.mj_model.body_mocapid[body]) if body >= 0 else -1

    @property
    def identity(self) -> tuple[object, ...] | None:
        """All that the environment's functions depend on but their source; None where that is not ours."""
        return (self.arm.mj_model, self.arm.site, self.config) if type(self) is Reach else None

    def check(self) -> None:
        """Raises `UserError` if MJX is to simulate the arm and cannot."""
        if self.config.dynamics == "servo":
            _ = self.arm.mjx_model

    @property
    def action_size(self) -> int:
        return self.arm.dof

    def reset(self, key: jax.Array) -> State:
        """A random pose and a fresh, reachable goal: forward kinematics of another random pose."""
        pose, other = self.arm.sample(key, (2,))
        return self.start(pose, self.arm.forward(other))

    def sample_goal(self, key: jax.Array) -> jax.Array:
        """A reachable point, (3,) metres: the end effector of joint positions drawn uniformly inside the limits."""
        return self.arm.forward(self.arm.sample(key))

    def start(self, q: jax.Array, goal: jax.Array) -> State:
        """The state at rest in pose `q` (dof,) with goal (3,) in metres."""
        data = Physics.at_rest(self.arm.mj_model)
        data = data.replace(qpos=data.qpos.at[self.arm.qpos].set(q))
        if self._marker >= 0:
            data = data.replace(mocap_pos=data.mocap_pos.at[self._marker].set(goal))
        obs, distance = self._observe(data, goal)
        zero = jnp.zeros(())
        return State(data, obs, zero, zero, {"distance": distance}, {"goal": goal})

    def step(self, state: State, action: jax.Array) -> State:
        """One control step. `action` is (dof,) in [-1, 1], mapped to joint targets inside the limits."""
        target = self.arm.to_joints(jnp.clip(action, -1, 1))
        data, goal = state.data, state.info["goal"]
        if self.config.dynamics == "servo":
            data = data.replace(ctrl=data.ctrl.at[self.arm.actuators].set(self.arm.to_ctrl(target)))
            data = jax.lax.fori_loop(0, self.config.substeps, lambda _, d: d.step(self.arm.mjx_model), data)
        else:
            data = data.replace(qpos=data.qpos.at[self.arm.qpos].set(target))
        obs, distance = self._observe(data, goal)
        return state.replace(data=data, obs=obs, reward=-distance, metrics={**state.metrics, "distance": distance})

    def achieved(self, obs: Observation) -> jax.Array:
        """Where the end effector is, (3,) metres."""
        return obs["privileged_state"][self.arm.dof : self.arm.dof + 3] * self.arm.reach + self._origin

    def relabel(self, obs: Observation, goal: jax.Array) -> Observation:
        """The observation that the same pose gives for another goal, (3,) metres."""
        target, state, n = self._scaled(goal), obs["state"], self.arm.dof
        if self.config.observation == "goal":
            state = target
        else:
            offsets = target - state[: 3 * n].reshape(n, 3)
            state = state.at[3 * n : 6 * n].set(offsets.ravel())
            state = state.at[-3:].set(target) if self.config.observation == "full" else state
        return {"state": state, "privileged_state": obs["privileged_state"].at[-3:].set(target)}

    def goal_reward(self, achieved: jax.Array, goal: jax.Array) -> jax.Array:
        """Eq. 7: minus the distance, metres."""
        return -jnp.linalg.norm(achieved - goal)

    def outcome(self, obs: Observation, action: jax.Array) -> jax.Array:
        """The paper's critic inputs: joint angles (the actor's answer), the end-effector position they lead to, and
        the target; and the offset between the two points."""
        end_effector = self._scaled(self.arm.forward(self.arm.to_joints(action)))
        target = obs["privileged_state"][-3:]
        return jnp.concatenate([action, end_effector, target, end_effector - target])

    def _observe(self, data: Physics, goal: jax.Array) -> tuple[Observation, jax.Array]:
        """The observation, and the distance between end effector and goal in metres."""
        pose = data.qpos[self.arm.qpos]
        position = self.arm.forward(pose)
        q, end_effector, target = self.arm.to_action(pose), self._scaled(position), self._scaled(goal)
        state = target
        if self.config.observation != "goal":
            joints = self._scaled(self.arm.joint_positions(pose))
            state = jnp.concatenate([joints.ravel(), (target - joints).ravel()])
        if self.config.observation == "full":
            moved = data.qvel[self.arm.dofs] * self.arm.mj_model.opt.timestep * self.config.substeps
            state = jnp.concatenate([state, q, moved, end_effector, target])
        obs = {"state": state, "privileged_state": jnp.concatenate([q, end_effector, target])}
        return obs, jnp.linalg.norm(position - goal)

    def _scaled(self, points: jax.Array) -> jax.Array:
        return (points - self._origin) / self.arm.reach
