"""What all tasks of bringing an arm's end effector somewhere share: dynamics, observations, accuracy.

A task says what a goal is (`forward`, `encode`, `decode`), how far one is from another (`errors`, `goal_reward`,
`correct`) and how people state one (`goal_inputs`, `goals`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from annotated_types import Ge, Le

from arm5dof.arm import Arm, load_arm
from arm5dof.arm.computed_servos import with_servos
from arm5dof.arm.servos import Servos
from arm5dof.envs import accuracy
from arm5dof.envs.base import Act, Goal, Observation, State, Task
from arm5dof.envs.metrics import Error
from arm5dof.envs.physics import Physics
from arm5dof.errors import UserError
from arm5dof.settings import settings, static


@settings
class ArmGoalConfig:
    """Settings of every task of bringing an arm's end effector somewhere."""

    arm: str = static(default="reach.xml")
    """MJCF or URDF file with the arm: a path, or the name of one that ships with the package."""
    site: str = static(default="")
    """The end effector: a site in that file, or a place on a body or geom, "hand 0 0 0.1" (metres, in its frame).
    Empty: the site ee, else what is named most like a tool, else the last link."""
    base: str = static(default="")
    """A body of that file that is held still, with all that carries it: of an arm on a mobile or free base."""
    dynamics: Literal["servo", "kinematic"] = static(default="servo")
    """servo: an action is the position actuators' target and physics moves the arm there; kinematic: an action is the
    pose itself, the paper's setting."""
    servo: Literal["auto", "model"] = static(default="auto")
    """auto: joints that the model gives no position actuator (torque motors, nothing) get one that is computed from
    the arm's inertia, critically damped; model: such arms are refused (servo dynamics)."""
    episode_length: Annotated[int, Ge(1)] = static(default=160)
    """Control steps in an episode; its end is a truncation."""
    substeps: Annotated[int, Ge(1)] = static(default=5)
    """Physics steps in a control step (servo), which MJX simulates if the servos settle in so many. Slower servos are
    taken to have settled by the end of a control step, and `episode` is measured in C MuJoCo, whose steps are long
    enough for the arm to come to rest."""
    correction: Literal["target", "jacobian"] = static(default="target", may_change=True)
    """How answers are corrected. target: the policy is asked again, for a goal shifted by the error; jacobian: damped
    least squares from the policy's answer, which also finds the nearest that the joint limits allow."""
    branches: Annotated[int, Ge(1)] = static(default=1, may_change=True)
    """How many of the policy's candidate answers are corrected, those that come nearest first; the best counts."""
    restarts: Annotated[int, Ge(0), Le(1000)] = static(default=0, may_change=True)
    """From how many random poses damped least squares starts beside, for goals that no answer came near (jacobian)."""
    refinements: Annotated[int, Ge(0), Le(10_000)] = static(default=10, may_change=True)
    """How often the target is corrected for the `refined` and the `episode` figure of an evaluation."""


class ArmGoalEnv(Task):
    """A `ForwardModel`: pure `reset(key)` and `step(state, action)`, no batch axis.

    Observations are dimensionless: points are relative to the arm's origin in units of its reach, joint positions in
    units of half their range ([-1, 1]), and for joints that can make more than a turn cosines, then sines. The actor
    sees the goal; the critic's `privileged_state` is the paper's: joint angles, what is achieved, the goal.
    """

    config: ArmGoalConfig

    def __init__(self, config: Any, arm: Arm | mujoco.MjModel | None = None) -> None:
        """
        Args:
            config: The task's settings.
            arm: The arm, or the compiled model that holds it, instead of the file that the settings name.

        Raises:
            UserError: There is no such arm, or a joint has no position actuator and the dynamics need one.
        """
        super().__init__(config)
        loaded = arm if isinstance(arm, Arm) else load_arm(config.arm if arm is None else arm, config.site, config.base)
        self.arm = loaded
        self._servos: Servos | None = None
        self._notes: list[str] = []
        if config.dynamics == "servo":
            self._find_servos()
        arm = self.arm
        endless = np.array(arm.turns)
        self._limited, self._endless = np.flatnonzero(~endless), np.flatnonzero(endless)
        self._origin = arm.origin
        body = mujoco.mj_name2id(arm.mj_model, mujoco.mjtObj.mjOBJ_BODY, "target")
        self._marker = int(arm.mj_model.body_mocapid[body]) if body >= 0 else -1

    def _find_servos(self) -> None:
        """Give joints that lack them computed servos, and find out how long servos take: `_servos` are slow ones."""
        driven = zip(self.arm.joint_names, self.arm.actuation, self.arm.actuators, strict=True)
        lacking = [(name, driver) for name, driver, a in driven if a < 0]
        if lacking:
            names, drivers = ", ".join(repr(name) for name, _ in lacking), ", ".join(sorted({d for _, d in lacking}))
            if self.config.servo == "model":
                raise UserError(
                    f"joint {names} has no position actuator (but {drivers}): add one to the MJCF, choose "
                    'servo = "auto", which computes one, or dynamics = "kinematic"'
                )
            self.arm = with_servos(self.arm)
            self._notes.append(f"servos computed for {names} (driven by {drivers}), critically damped")
        servos = Servos(self.arm)
        if servos.settle_steps is not None and servos.settle_steps <= self.config.substeps:
            return
        self._servos = servos
        if (seconds := servos.rest_seconds) is None:
            self._notes.append("the servos do not bring the arm to rest: expect little of the episode figure")
        elif math.isnan(seconds):
            raise UserError(
                f"the physics of the servos blows up at its time step of {self.arm.mj_model.opt.timestep:g} s: "
                'choose a smaller <option timestep="..."/>, weaker servos, or dynamics = "kinematic"'
            )
        else:
            self._notes.append(
                f"the servos bring the arm to rest {seconds:.2f} s after a move, more than a control step: the policy "
                "learns where they bring it, and the episode figure is measured in C MuJoCo, of one target in "
                f"{accuracy.SPARED}"
            )

    # What a goal is: for each task to say.

    components: ClassVar[Mapping[str, Error]]

    @property
    def goal_inputs(self) -> Mapping[str, tuple[str, ...]]:
        """See `ForwardModel`."""
        raise NotImplementedError

    def goals(self, **inputs: np.ndarray) -> Goal:
        """See `ForwardModel`."""
        raise NotImplementedError

    def forward(self, q: jax.Array) -> Goal:
        """Where joint positions (dof,) lead."""
        raise NotImplementedError

    def position(self, goal: Goal) -> jax.Array:
        """The point of a goal, (3,) metres in the world frame."""
        raise NotImplementedError

    def encode(self, goal: Goal) -> jax.Array:
        """A goal as networks see it, a dimensionless vector."""
        raise NotImplementedError

    def decode(self, vector: jax.Array) -> Goal:
        """The inverse of `encode`."""
        raise NotImplementedError

    def errors(self, achieved: Goal, goal: Goal) -> dict[str, jax.Array]:
        """See `ForwardModel`."""
        raise NotImplementedError

    def goal_reward(self, achieved: Goal, goal: Goal, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        """See `GoalEnv`."""
        raise NotImplementedError

    def residual(self, achieved: Goal, goal: Goal) -> jax.Array:
        """See `ForwardModel`."""
        raise NotImplementedError

    def correct(self, asked: Goal, achieved: Goal, goal: Goal) -> Goal:
        """See `ForwardModel`."""
        raise NotImplementedError

    # The environment.

    @property
    def action_size(self) -> int:
        return self.arm.dof

    @property
    def headline(self) -> str:
        """The episode where the servos move the arm, one answer where they do not."""
        return "episode" if self.config.dynamics == "servo" else "one_shot"

    @property
    def fingerprint(self) -> tuple[object, ...] | None:
        """See `Task`; None for a class that is not the package's own, whose source is not known to it."""
        ours = type(self).__module__.startswith("arm5dof.")
        return (type(self).__qualname__, self.arm.mj_model, self.arm.site, self.config) if ours else None

    @property
    def mj_model(self) -> mujoco.MjModel:
        """The compiled model, for a run to keep."""
        return self.arm.mj_model

    @property
    def mj_spec(self) -> mujoco.MjSpec | None:
        """What it was compiled from."""
        return self.arm.mj_spec

    def check(self) -> None:
        """Raise `UserError` if MJX is to simulate the arm and cannot."""
        if self._simulates:
            Physics.check(self.arm.mj_model, self.arm.mjx_model)

    @property
    def about(self) -> str:
        """See `Task`: the arm."""
        return "\n".join([self.arm.table().text(), *self._notes])

    def reset(self, key: jax.Array) -> State:
        """A random pose and a fresh, reachable goal: forward kinematics of another random pose."""
        pose, other = self.arm.sample(key, (2,))
        return self.start(pose, self.forward(other))

    def sample_goal(self, key: jax.Array) -> Goal:
        """A reachable goal: forward kinematics of joint positions drawn uniformly inside the limits."""
        return self.forward(self.arm.sample(key))

    def start(self, q: jax.Array, goal: Goal) -> State:
        """The state at rest in pose `q` (dof,) with a goal."""
        data = Physics.at_rest(self.arm.mj_model)
        data = data.replace(qpos=data.qpos.at[self.arm.qpos].set(q))
        if self._marker >= 0:
            data = data.replace(mocap_pos=data.mocap_pos.at[self._marker].set(self.position(goal)))
        obs, achieved = self._observe(data, goal)
        zero = jnp.zeros(())
        return State(data, obs, zero, zero, self.errors(achieved, goal), {"goal": goal})

    def step(self, state: State, action: jax.Array) -> State:
        """One control step. `action` is (dof,) in [-1, 1], mapped to joint targets inside the limits."""
        action = jnp.clip(action, -1, 1)
        target = self.arm.to_joints(action)
        data = state.data
        if self._simulates:
            data = data.replace(ctrl=data.ctrl.at[self.arm.actuators].set(self.arm.to_ctrl(target)))
            data = jax.lax.fori_loop(0, self.config.substeps, lambda _, d: d.step(self.arm.mjx_model), data)
        else:
            data = data.replace(qpos=data.qpos.at[self.arm.qpos].set(target))
        return self.arrived(state, data, action)

    @property
    def _simulates(self) -> bool:
        """Whether MJX simulates every step."""
        return self.config.dynamics == "servo" and self._servos is None

    def arrived(self, state: State, data: Physics, action: jax.Array) -> State:
        """The state after an action that led from a state to some physics."""
        goal = state.info["goal"]
        obs, achieved = self._observe(data, goal)
        reward, done = self.goal_reward(achieved, goal, action)
        metrics = {**state.metrics, **self.errors(achieved, goal)}
        return state.replace(data=data, obs=obs, reward=reward, done=done, metrics=metrics)

    def achieved(self, obs: Observation) -> Goal:
        """What the end effector has reached."""
        n = self.arm.dof + len(self._endless)
        size = (len(obs["privileged_state"]) - n) // 2
        return self.decode(obs["privileged_state"][n : n + size])

    def replace_goal(self, obs: Observation, goal: Goal) -> Observation:
        """The observation that the same pose gives for another goal."""
        target, seen = self.encode(goal), obs["privileged_state"]
        privileged = seen.at[-len(target) :].set(target)
        return {"state": self.actor_state(obs["state"], target), "privileged_state": privileged}

    def actor_state(self, before: jax.Array, target: jax.Array) -> jax.Array:
        """What the actor sees once the goal is `target`, as `encode` gives it."""
        return target

    # The forward model.

    @property
    def joint_names(self) -> tuple[str, ...]:
        return self.arm.joint_names

    @property
    def correction(self) -> Literal["target", "jacobian"]:
        """See `ForwardModel`."""
        return self.config.correction

    @property
    def slides(self) -> tuple[bool, ...]:
        return self.arm.slides

    @property
    def turns(self) -> tuple[bool, ...]:
        return self.arm.turns

    @property
    def stops(self) -> np.ndarray:
        return self.arm.stops

    @property
    def branches(self) -> int:
        """See `ForwardModel`."""
        return self.config.branches

    @property
    def restarts(self) -> int:
        """See `ForwardModel`."""
        return self.config.restarts

    @property
    def reward_unit(self) -> float:
        """See `ForwardModel`: the arm's reach."""
        return float(self.arm.reach)

    @property
    def workspace(self) -> str:
        origin = ", ".join(f"{v:g}" for v in self.arm.origin)
        return f"the arm reaches {self.arm.measured_reach:.3f} m from ({origin}) m"

    def question(self, goal: Goal) -> Observation:
        """See `ForwardModel`: asked from the arm's home pose."""
        return self.start(jnp.asarray(self.arm.home, jnp.float32), goal).obs

    def joints(self, action: jax.Array) -> jax.Array:
        """See `ForwardModel`."""
        return self.arm.to_joints(action)

    def outcome(self, action: jax.Array) -> Goal:
        """See `ForwardModel`."""
        return self.forward(self.arm.to_joints(action))

    def critic_input(self, obs: Observation, action: jax.Array) -> jax.Array:
        """The paper's critic inputs: joint angles (the actor's answer), what they lead to, and the goal; and the
        difference between the two."""
        achieved = self.encode(self.outcome(action))
        target = obs["privileged_state"][-len(achieved) :]
        return jnp.concatenate([self._seen(action), achieved, target, achieved - target])

    # Accuracy: see `accuracy`.

    def evaluate(self, act: Act, key: jax.Array, n: int) -> dict[str, jax.Array]:
        return accuracy.evaluate(self, self._servos, act, key, n)

    def watch(self, act: Act, key: jax.Array) -> dict[str, jax.Array]:
        return accuracy.watch(self, act, key)

    def failure(self, results: Mapping[str, Any]) -> str:
        return accuracy.failure(self, results)

    def _observe(self, data: Physics, goal: Goal) -> tuple[Observation, Goal]:
        """The observation, and what the end effector has reached."""
        pose = data.qpos[self.arm.qpos]
        achieved = self.forward(pose)
        q, there, target = self._seen(self.arm.to_action(pose)), self.encode(achieved), self.encode(goal)
        obs = {
            "state": self._actor_observation(data, q, there, target),
            "privileged_state": jnp.concatenate([q, there, target]),
        }
        return obs, achieved

    def _actor_observation(self, data: Physics, q: jax.Array, there: jax.Array, target: jax.Array) -> jax.Array:
        """What the actor sees: of the physics, of scaled joint positions, and of what is achieved and wanted."""
        return target

    def _seen(self, action: jax.Array) -> jax.Array:
        """Joint positions as networks see them, from those in units of half their range: a turn further is the same."""
        if not len(self._endless):
            return action
        angle = jnp.pi * action[self._endless]
        return jnp.concatenate([action[self._limited], jnp.cos(angle), jnp.sin(angle)])

    def _scaled(self, points: jax.Array) -> jax.Array:
        """Points (..., 3) relative to the arm's origin, in units of its reach."""
        return (points - self._origin) / self.arm.reach

    def _unscaled(self, points: jax.Array) -> jax.Array:
        return points * self.arm.reach + self._origin
