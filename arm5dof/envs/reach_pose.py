"""Reach pose: bring the end effector to a point, and point it or turn it as wanted."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from annotated_types import Gt
from jax import export

from arm5dof.arm import se3
from arm5dof.envs.accuracy import AT_LIMIT
from arm5dof.envs.arm_goal import ArmGoalConfig, ArmGoalEnv
from arm5dof.envs.base import Act, vectors
from arm5dof.envs.metrics import Error, Metric, Share
from arm5dof.envs.physics import Physics
from arm5dof.errors import UserError
from arm5dof.settings import settings, static

AXES = {sign + name: (-1 if sign else 1) * np.eye(3)[i] for sign in ("", "-") for i, name in enumerate("xyz")}

ANGLE = Error("deg", 180 / np.pi, (0.5, 1, 3, 10))

WITHIN = {"one_shot": (5, 3), "refined": (1, 0.5), "episode": (5, 3)}
"""Millimetres and degrees that count together, by kind of accuracy."""


@settings
class ReachPoseConfig(ArmGoalConfig):
    """The task of bringing the end effector to a pose."""

    orientation: Literal["approach", "rotation"] = static(default="approach")
    """approach: which way the tool points, all that an arm of five joints can be asked for; rotation: all of it, for
    six joints and more."""
    tool_axis: Literal["x", "y", "z", "-x", "-y", "-z"] = static(default="z")
    """The axis of the end-effector site that is the tool's (approach)."""
    observation: Literal["cartesian", "cylindrical"] = static(default="cartesian")
    """How the policy sees a goal. cartesian: as it is; cylindrical: its azimuth about the vertical axis through the
    arm's origin, and the goal turned back by that: if the first joint turns about it, the other joints need no more."""
    metres_per_radian: Annotated[float, Gt(0)] = static(default=0.1)
    """What distance an angle is worth in the reward: 0.1 weighs a millimetre like 0.57 degrees."""


class PoseGoal(NamedTuple):
    """A point and one or three directions there, which the tool's axis, or the site's three axes, should have."""

    position: jax.Array
    """(3,) metres in the world frame."""
    directions: jax.Array
    """(1, 3) or (3, 3), unit vectors in the world frame."""


export.register_namedtuple_serialization(PoseGoal, serialized_name="arm5dof.PoseGoal")  # See `inverse_kinematics`.


class ReachPose(ArmGoalEnv):
    """A goal is a `PoseGoal`. The reward is minus the length of `residual`, metres: about that of (distance,
    metres_per_radian x angle), and linear in what networks see of two poses but for the length."""

    Config: ClassVar[type] = ReachPoseConfig
    config: ReachPoseConfig
    components: ClassVar[dict[str, Error]] = {"distance": Error(), "angle": ANGLE}
    metrics: ClassVar[dict[str, Metric]] = {
        **dict.fromkeys(("one_shot", "refined", "episode", "policy_distance"), Error()),
        **dict.fromkeys(("one_shot_angle", "refined_angle", "episode_angle", "policy_angle"), ANGLE),
        **{f"{kind}_within": Share(f"within {mm:g} mm and {deg:g} deg") for kind, (mm, deg) in WITHIN.items()},
        "at_limit": AT_LIMIT,
    }

    @property
    def headline(self) -> str:
        return f"{super().headline}_within"

    @property
    def goal_inputs(self) -> dict[str, tuple[str, ...]]:
        """See `ForwardModel`."""
        more = {"approach": ("ax", "ay", "az")} if self._points else {"quaternion": ("qw", "qx", "qy", "qz")}
        return {"target": ("x", "y", "z"), **more}

    def goals(self, **inputs: np.ndarray) -> PoseGoal:
        """See `ForwardModel`: points (n, 3) in metres, and approach axes (n, 3) of any length, or unit quaternions
        (n, 4) in the order w, x, y, z."""
        target, turn = (vectors(name, inputs[name], parts) for name, parts in self.goal_inputs.items())
        length = np.linalg.norm(turn, axis=1, keepdims=True)
        if self._points and (length < 1e-9).any():
            raise UserError("approach 0 0 0 points nowhere: give the direction in which the tool is to point")
        if not self._points and (np.abs(length - 1) > 1e-2).any():
            raise UserError(f"quaternion {turn[np.abs(length - 1).argmax()].tolist()} is no unit quaternion W X Y Z")
        unit = jnp.asarray(turn / length, jnp.float32)
        directions = unit[:, None] if self._points else jnp.moveaxis(se3.from_quaternion(unit), -1, -2)
        return PoseGoal(jnp.asarray(target, jnp.float32), directions)

    def forward(self, q: jax.Array) -> PoseGoal:
        """The end effector's position and directions."""
        axes = [AXES[self.config.tool_axis]] if self._points else [AXES[name] for name in "xyz"]
        return PoseGoal(self.arm.forward(q), jnp.stack([self.arm.axis(q, axis) for axis in axes]))

    def position(self, goal: PoseGoal) -> jax.Array:
        return goal.position

    def encode(self, goal: PoseGoal) -> jax.Array:
        """The position relative to the arm's origin in units of its reach, and the directions."""
        return jnp.concatenate([self._scaled(goal.position), goal.directions.ravel()])

    def actor_state(self, before: jax.Array, target: jax.Array) -> jax.Array:
        if self.config.observation == "cartesian":
            return target
        rows = target.reshape(-1, 3)
        radius = jnp.hypot(rows[0, 0], rows[0, 1])
        # On the axis itself every azimuth is as good.
        cosine, sine = jnp.where(radius > 1e-6, rows[0, :2] / jnp.maximum(radius, 1e-6), jnp.array([1.0, 0.0]))
        back = jnp.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
        turned = (rows @ back).ravel()
        return jnp.concatenate([jnp.stack([jnp.arctan2(sine, cosine) / jnp.pi, cosine, sine, radius]), turned[2:]])

    def _actor_observation(self, data: Physics, q: jax.Array, there: jax.Array, target: jax.Array) -> jax.Array:
        return self.actor_state(target, target)

    def decode(self, vector: jax.Array) -> PoseGoal:
        return PoseGoal(self._unscaled(vector[:3]), vector[3:].reshape(-1, 3))

    def errors(self, achieved: PoseGoal, goal: PoseGoal) -> dict[str, jax.Array]:
        """The distance in metres and the angle in radians."""
        if self._points:
            angle = se3.angle_between(achieved.directions[0], goal.directions[0])
        else:
            angle = se3.rotation_angle(achieved.directions.T, goal.directions.T)
        return {"distance": jnp.linalg.norm(achieved.position - goal.position), "angle": angle}

    def goal_reward(self, achieved: PoseGoal, goal: PoseGoal, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        """See the class. It never ends an episode."""
        return -jnp.linalg.norm(self.residual(achieved, goal)), jnp.zeros(())

    def residual(self, achieved: PoseGoal, goal: PoseGoal) -> jax.Array:
        """The shift, and how far the tips of all directions lie apart, `metres_per_radian` long; of a rotation half of
        their squares, since each angle moves two of the three axes."""
        turn = (achieved.directions - goal.directions).ravel() / (1 if self._points else 2**0.5)
        return jnp.concatenate([achieved.position - goal.position, self.config.metres_per_radian * turn])

    def correct(self, asked: PoseGoal, achieved: PoseGoal, goal: PoseGoal) -> PoseGoal:
        """Shifted by the error of the position, and turned by that of the directions."""
        if self._points:
            directions = se3.carry_direction(asked.directions, achieved.directions, goal.directions)
        else:
            directions = (goal.directions.T @ achieved.directions @ asked.directions.T).T
        return PoseGoal(asked.position + goal.position - achieved.position, directions)

    def evaluate(self, act: Act, key: jax.Array, n: int) -> dict[str, jax.Array]:
        """As for every such task, and which goals are met in both position and direction."""
        found = super().evaluate(act, key, n)
        met = {
            f"{kind}_within": (found[kind] <= mm / 1e3) & (found[f"{kind}_angle"] <= jnp.deg2rad(deg))
            for kind, (mm, deg) in WITHIN.items()
        }
        return {**found, **met}

    @property
    def _points(self) -> bool:
        return self.config.orientation == "approach"
