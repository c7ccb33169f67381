"""`Arm`: any serial arm in MJCF, whatever its number of joints, and where its joint positions lead."""

from __future__ import annotations

import copy
from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from arm5dof.arm.actuators import actuation
from arm5dof.arm.chain import Link, joint_name
from arm5dof.arm.trigonometry import cos_sin
from arm5dof.arm.workspace import measure_reach
from arm5dof.errors import UserError
from arm5dof.runtime.tables import Table

if TYPE_CHECKING:
    from mujoco import mjx

Joints = list[list[jax.Array]]
"""Positions of the joints one by one, their cosines and their sines, (...) each."""


class Pose(NamedTuple):
    """A frame in another: position (..., 3) in metres, rotation (..., 3, 3) whose columns are the frame's axes."""

    position: jax.Array
    rotation: jax.Array


@dataclass(frozen=True, eq=False, repr=False)
class Arm:
    """A serial arm. Angles in radians (slides in metres), positions in metres in the world frame.

    Joint vectors `q` have shape (dof,), in order from base to tip; batches are made with `jax.vmap`.

    >>> from arm5dof import load_arm
    >>> arm = load_arm("reach.xml")
    >>> arm.joint_names
    ('theta_1', 'theta_2', 'theta_3', 'theta_4', 'theta_5')
    >>> [round(1e3 * float(x)) for x in arm.forward(arm.home)]  # millimetres
    [0, -30, 310]
    """

    mj_model: mujoco.MjModel
    mj_spec: mujoco.MjSpec | None
    """What the model was compiled from; None if only the compiled model is at hand."""
    joints: np.ndarray
    """Joint ids, (dof,)."""
    qpos: np.ndarray
    """Where the joints stand in `qpos`, (dof,)."""
    dofs: np.ndarray
    """Where they stand in `qvel`, (dof,)."""
    actuators: np.ndarray
    """Ids of the joints' position actuators, (dof,); -1 where a joint has none."""
    servo: np.ndarray
    """Slope and offset of the control that holds a joint in a position, (dof, 2): gears and gains are not all 1."""
    site: int
    """Id of the end-effector site."""
    lower: np.ndarray
    upper: np.ndarray
    """Between what joint positions are asked for, (dof,): the joints' `stops`, but one turn where they allow more."""
    stops: np.ndarray
    """Joint limits, (dof, 2), narrowed to what the position actuators can be told; infinite where there are none."""
    turns: tuple[bool, ...]
    """Which joints are hinges that can make more than a turn, whose position is an angle modulo a turn, (dof,)."""
    chain: tuple[Link, ...]
    """What stands between the joints, (dof + 1,): the last leads from the last joint to the site."""
    reach: float
    """An upper bound on the distance between the first joint and the end effector, metres: the scale in which networks
    see points. How far it is really is `measured_reach`."""
    why_site: str
    """Why this site is the end effector, if none was named; else empty."""
    held: tuple[str, ...]
    """Names of the joints that were taken out to hold the base."""

    def __getstate__(self) -> dict[str, Any]:
        """For pickle and copies, which have the compiled model alone: nothing keeps a model's description whole."""
        return {**{f.name: getattr(self, f.name) for f in fields(self)}, "mj_spec": None}

    @cached_property
    def free_model(self) -> mujoco.MjModel:
        """The model with contacts off, which cost time and memory: an arm on its way to a point has none to make."""
        model = copy.copy(self.mj_model)
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        return model

    @cached_property
    def mjx_model(self) -> mjx.Model:
        """`free_model` as MJX has it. Raises `UserError` if it has something that MJX cannot simulate."""
        from arm5dof.runtime.mjx import mjx  # Half a second to import, and nothing but servo dynamics needs it.

        try:
            with jax.ensure_compile_time_eval():  # It may be wanted first while a program is traced.
                return mjx.put_model(self.free_model)
        except Exception as error:  # NotImplementedError mostly, or whatever MJX's own code runs into.
            change = 'give such geoms contype="0" conaffinity="0"' if "collisions" in str(error) else "change it"
            raise UserError(f"MJX cannot simulate this model ({error}): {change}, or use kinematic dynamics") from None

    @property
    def dof(self) -> int:
        """Number of joints."""
        return len(self.joints)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, (dof,); `joint_<id>` where the MJCF gives none."""
        return tuple(joint_name(self.mj_model, int(j)) for j in self.joints)

    @property
    def slides(self) -> tuple[bool, ...]:
        """Which joints are slides, whose positions are metres, (dof,)."""
        return tuple(link.slides for link in self.chain[:-1])

    @property
    def home(self) -> np.ndarray:
        """The middle of every joint's range, (dof,)."""
        return (self.lower + self.upper) / 2

    @property
    def origin(self) -> np.ndarray:
        """The first joint's anchor in the world frame, (3,)."""
        return self._at_rest().xanchor[self.joints[0]].copy()

    @property
    def base(self) -> tuple[str, np.ndarray, np.ndarray]:
        """The body on which the first joint stands: its name, and its position (3,) in metres and rotation (3, 3) in
        the world frame."""
        body = self.mj_model.body_parentid[self.mj_model.jnt_bodyid[self.joints[0]]]
        data = self._at_rest()
        return self.mj_model.body(body).name, data.xpos[body].copy(), data.xmat[body].reshape(3, 3).copy()

    @cached_property
    def measured_reach(self) -> float:
        """The furthest that the end effector gets from `origin`, metres, by search over the joints' ranges."""
        return measure_reach(self.chain, self.lower, self.upper)

    @property
    def actuation(self) -> tuple[str, ...]:
        """What drives each joint, (dof,): `position`, `velocity`, `motor`, `intvelocity`, ..., `none`."""
        return tuple(actuation(self.mj_model, int(j)) for j in self.joints)

    def forward(self, q: jax.Array) -> jax.Array:
        """Position of the end-effector site, (..., 3), at joint positions `q` (..., dof). Differentiable."""
        return self._point(self._joints(q), self.dof)

    def pose(self, q: jax.Array) -> Pose:
        """Position (..., 3) and rotation (..., 3, 3) of the end-effector site at joint positions `q` (..., dof).
        Differentiable."""
        joints = self._joints(q)
        x, y = (self._direction(joints, np.eye(3)[i]) for i in range(2))
        return Pose(self._point(joints, self.dof), jnp.stack([x, y, jnp.cross(x, y)], axis=-1))

    def axis(self, q: jax.Array, axis: np.ndarray) -> jax.Array:
        """The direction, (..., 3), in which a unit vector (3,) of the end-effector site's frame points at joint
        positions `q` (..., dof). Differentiable."""
        return self._direction(self._joints(q), axis)

    def joint_positions(self, q: jax.Array) -> jax.Array:
        """Where the joints are, (..., dof, 3), at joint positions `q` (..., dof); a slide's joint is where it slides
        from."""
        joints = self._joints(q)
        return jnp.stack([self._point(joints, k) for k in range(self.dof)], axis=-2)

    def _at_rest(self) -> mujoco.MjData:
        data = mujoco.MjData(self.mj_model)
        mujoco.mj_kinematics(self.mj_model, data)
        return data

    def _check(self, name: str, values: Any) -> None:
        """Raise `UserError` if an array's last axis does not have a number for each joint."""
        if np.shape(values)[-1:] != (self.dof,):
            raise UserError(f"{name} takes a number for each of {self.dof} joints, not shape {np.shape(values)}")

    def _joints(self, q: jax.Array) -> Joints:
        self._check("q", q)
        # The gradient of a split is one concatenation, that of indexing a sum of padded arrays.
        q = jnp.asarray(q)
        split = lambda x: [v[..., 0] for v in jax.lax.split(x, (1,) * self.dof, axis=x.ndim - 1)]
        return [split(x) for x in (q, *cos_sin(q))]

    def _point(self, joints: Joints, behind: int) -> jax.Array:
        """The point behind the first so many joints, (..., 3).

        The same function of the same MJCF as `mjx.kinematics`, carried out on one point alone, from tip to base and
        component by component: the critic calls it in every update, where carrying every body along is wasted, and
        `mjx.kinematics` takes seconds to compile.
        """
        values, cosines, sines = joints
        x, y, z = (jnp.full_like(values[0], c) for c in self.chain[behind].offset)
        for k in reversed(range(behind)):
            link = self.chain[k]
            if link.slides:
                z = z + values[k]
            else:
                c, s = cosines[k], sines[k]
                x, y = c * x - s * y, s * x + c * y
            point = (x, y, z)
            x, y, z = (_row(*constants, point) for constants in zip(link.rotation, link.offset, strict=True))
        return jnp.stack([x, y, z], axis=-1)

    def _direction(self, joints: Joints, axis: np.ndarray) -> jax.Array:
        """A direction fixed to the site's frame as the world has it, (..., 3), as `_point` carries a point."""
        values, cosines, sines = joints
        x, y, z = (jnp.full_like(values[0], c) for c in self.chain[-1].rotation @ axis)
        for k in reversed(range(self.dof)):
            if not self.chain[k].slides:
                c, s = cosines[k], sines[k]
                x, y = c * x - s * y, s * x + c * y
            vector = (x, y, z)
            x, y, z = (_row(row, 0.0, vector) for row in self.chain[k].rotation)
        return jnp.stack([x, y, z], axis=-1)

    def to_joints(self, action: jax.Array) -> jax.Array:
        """Map actions in [-1, 1] to joint positions inside the limits; (..., dof) to (..., dof)."""
        self._check("action", action)
        return self.home + action * (self.upper - self.lower) / 2

    def to_ctrl(self, q: jax.Array) -> jax.Array:
        """What to tell the position actuators so that the joints come to rest at `q`; (..., dof) to (..., dof)."""
        self._check("q", q)
        return self.servo[:, 0] * q + self.servo[:, 1]

    def to_action(self, q: jax.Array) -> jax.Array:
        """The inverse of `to_joints`."""
        self._check("q", q)
        return (q - self.home) * 2 / (self.upper - self.lower)

    def sample(self, key: jax.Array, shape: tuple[int, ...] = ()) -> jax.Array:
        """Joint positions drawn uniformly inside the limits, shape + (dof,), float32."""
        return self.to_joints(jax.random.uniform(key, (*shape, self.dof), minval=-1.0, maxval=1.0))

    def table(self) -> Table:
        """The end effector, the reach, and the joints with their limits and what drives them."""
        rows = []
        for name, slides, endless, limits, driver in zip(
            self.joint_names,
            self.slides,
            np.isinf(self.stops).any(-1),
            np.where(np.isinf(self.stops).any(-1, keepdims=True), np.stack([self.lower, self.upper], 1), self.stops),
            self.actuation,
            strict=True,
        ):
            kind = "slide" if slides else "continuous" if endless else "hinge"
            low, high = limits * (1e3 if slides else 180 / np.pi)
            rows.append((name, kind, f"{low:.1f}", f"{high:.1f}", "mm" if slides else "deg", driver))
        end = f"end effector {self.mj_model.site(self.site).name!r}" + (f" ({self.why_site})" if self.why_site else "")
        held = f", {', '.join(self.held)} held" if self.held else ""
        point = lambda p: f"({', '.join(f'{round(float(v), 4) + 0.0:g}' for v in p)}) m"
        title = f"Arm of {self.dof} joints{held}, {end}, reach {self.measured_reach:.3f} m from {point(self.origin)}"
        base, position, rotation = self.base
        angle = np.degrees(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1)))
        if angle > 0.1 or np.abs(position).max() > 1e-4:
            turned = f", turned by {angle:.0f} degrees," if angle > 0.1 else ""
            title += f"; its base {base!r} stands at {point(position)}{turned} in the world frame, that of all goals"
        return Table(title, ("joint", "kind", "from", "to", "unit", "actuator"), rows)

    def __repr__(self) -> str:
        return self.table().text()

    def _repr_html_(self) -> str:
        return self.table().html()


def _row(rotation: np.ndarray, offset: float, point: tuple[jax.Array, ...]) -> jax.Array:
    """One component of a transformed point; terms that are zero for this arm are left out of the program."""
    terms = [float(r) * p for r, p in zip(rotation, point, strict=True) if r]
    return sum(terms[1:], start=terms[0] + float(offset))
