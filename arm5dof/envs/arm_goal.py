"""What all tasks of bringing an arm's end effector somewhere share: dynamics, observations, accuracy.

A task says what a goal is (`forward`, `encode`, `decode`), how far one is from another (`errors`, `goal_reward`,
`correct`) and how people state one (`goal_inputs`, `goals`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from annotated_types import Ge

from arm5dof.arm import Arm, load_arm
from arm5dof.envs.base import Act, Goal, Observation, State, Task
from arm5dof.envs.inverse_kinematics import choose, solve
from arm5dof.envs.metrics import Error
from arm5dof.envs.physics import Physics
from arm5dof.errors import UserError
from arm5dof.settings import settings, static

PROBES = 500
"""Goals by which a policy is watched while it learns."""


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
    """servo: an action is the position actuators' target and MJX physics moves the arm there; kinematic: an action
    is the pose itself, the paper's setting."""
    episode_length: Annotated[int, Ge(1)] = static(default=160)
    """Control steps in an episode; its end is a truncation."""
    substeps: Annotated[int, Ge(1)] = static(default=5)
    """Physics steps in a control step (servo): long enough for the servos to settle to within 1 %."""
    correction: Literal["target", "jacobian"] = static(default="target", may_change=True)
    """How answers are corrected. target: the policy is asked again, for a goal shifted by the error; jacobian: damped
    least squares from the policy's answer, which also finds the nearest that the joint limits allow."""
    branches: Annotated[int, Ge(1)] = static(default=1, may_change=True)
    """How many of the policy's candidate answers are corrected, its preferred ones first; the best counts."""
    restarts: Annotated[int, Ge(0)] = static(default=0, may_change=True)
    """From how many random poses damped least squares starts beside, for goals that no answer came near (jacobian)."""
    refinements: Annotated[int, Ge(0)] = static(default=10, may_change=True)
    """How often the target is corrected for the `refined` and the `episode` figure of an evaluation."""


class ArmGoalEnv(Task):
    """A `ForwardModel`: pure `reset(key)` and `step(state, action)`, no batch axis.

    Observations are dimensionless: points are relative to the arm's origin in units of its reach, joint positions in
    units of half their range ([-1, 1]), and for joints without limits cosines, then sines. The actor sees the goal; the
    critic's `privileged_state` is the paper's: joint angles, what is achieved, the goal.
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
        self.arm = arm = loaded
        if config.dynamics == "servo" and (arm.actuators < 0).any():
            lacking = [repr(name) for name, a in zip(arm.joint_names, arm.actuators, strict=True) if a < 0]
            drivers = sorted({d for d, a in zip(arm.actuation, arm.actuators, strict=True) if a < 0})
            raise UserError(
                f"joint {', '.join(lacking)} has no position actuator (but {', '.join(drivers)}): add one to the MJCF, "
                'or choose dynamics = "kinematic"'
            )
        endless = np.array(arm.continuous)
        self._limited, self._endless = np.flatnonzero(~endless), np.flatnonzero(endless)
        self._origin = arm.origin
        body = mujoco.mj_name2id(arm.mj_model, mujoco.mjtObj.mjOBJ_BODY, "target")
        self._marker = int(arm.mj_model.body_mocapid[body]) if body >= 0 else -1

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
        if self.config.dynamics == "servo":
            Physics.check(self.arm.mj_model, self.arm.mjx_model)

    @property
    def about(self) -> str:
        """See `Task`: the arm."""
        return self.arm.table().text()

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
        data, goal = state.data, state.info["goal"]
        if self.config.dynamics == "servo":
            data = data.replace(ctrl=data.ctrl.at[self.arm.actuators].set(self.arm.to_ctrl(target)))
            data = jax.lax.fori_loop(0, self.config.substeps, lambda _, d: d.step(self.arm.mjx_model), data)
        else:
            data = data.replace(qpos=data.qpos.at[self.arm.qpos].set(target))
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
    def continuous(self) -> tuple[bool, ...]:
        return self.arm.continuous

    @property
    def branches(self) -> int:
        """See `ForwardModel`."""
        return self.config.branches

    @property
    def restarts(self) -> int:
        """See `ForwardModel`."""
        return self.config.restarts

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

    # Accuracy.

    def evaluate(self, act: Act, key: jax.Array, n: int) -> dict[str, jax.Array]:
        """Errors on `n` unseen goals, (n,) each, of three kinds:

        - `one_shot`: one answer of the policy, by forward kinematics;
        - `refined`: the same with closed-loop target correction (`solve`);
        - `episode`: the last step of an episode from a random pose, in the environment, corrected in its first steps by
          the error that the arm then shows. Infinite where physics blew up.

        By the name of the kind for the first component of the errors, followed by that of the component for others;
        and `initial`, the errors before the first step.
        """
        goal_key, pose_key = jax.random.split(key)
        goals = jax.vmap(self.sample_goal)(jax.random.split(goal_key, n))
        state = jax.vmap(self.start)(self.arm.sample(pose_key, (n,)), goals)
        kinds = {
            "one_shot": solve(self, act, goals, 0).answer.errors,
            "refined": solve(self, act, goals, self.config.refinements).answer.errors,
            "episode": self._episode(act, state, goals),
            "initial": state.metrics,
        }
        return {
            kind if i == 0 else f"{kind}_{component}": errors[component]
            for kind, errors in kinds.items()
            for i, component in enumerate(self.components)
        }

    def watch(self, act: Act, key: jax.Array) -> dict[str, jax.Array]:
        """Mean errors of one answer to a few hundred goals, `policy_<component>`."""
        goals = jax.vmap(self.sample_goal)(jax.random.split(key, PROBES))
        return {f"policy_{name}": values.mean() for name, values in solve(self, act, goals, 0).answer.errors.items()}

    def _episode(self, act: Act, state: State, goals: Goal) -> dict[str, jax.Array]:
        branch = act.branch(state.obs)

        def step(now: CorrectionState, correcting: jax.Array) -> tuple[CorrectionState, None]:
            asked = choose(jnp.broadcast_to(correcting, now.reward.shape), now.asked, now.best)
            obs = jax.vmap(self.replace_goal)(now.state.obs, asked)
            state = jax.vmap(self.step)(now.state, act(obs, branch))
            better = correcting & (state.reward > now.reward)
            return CorrectionState(
                state=state,
                asked=jax.vmap(self.correct)(asked, jax.vmap(self.achieved)(state.obs), goals),
                best=choose(better, asked, now.best),
                reward=jnp.where(better, state.reward, now.reward),
            ), None

        correcting = jnp.arange(self.episode_length) <= self.config.refinements
        start = CorrectionState(state, goals, goals, jnp.full(len(state.reward), -jnp.inf))
        final, _ = jax.lax.scan(step, start, correcting)
        return {name: jnp.where(jnp.isfinite(values), values, jnp.inf) for name, values in final.state.metrics.items()}

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


class CorrectionState(NamedTuple):
    """Episodes under way: the goal to ask for next, the one that led closest so far, and the reward there."""

    state: State
    asked: Goal
    best: Goal
    reward: jax.Array
