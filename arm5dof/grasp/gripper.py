"""`Gripper`: the two fingers that an MJCF model carries beyond its `grasp` site."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import mujoco
import numpy as np

from arm5dof.arm.actuators import position_actuator, servo_line
from arm5dof.arm.chain import SLIDE, joint_name
from arm5dof.errors import UserError
from arm5dof.vision.objects import CatalogueObject

SITE = "grasp"
"""Name of the site between the fingers, where an object is held."""


@dataclass(frozen=True, eq=False)
class Gripper:
    """Two fingers that slide towards each other and away, each moved by a position actuator."""

    joints: np.ndarray
    """Joint ids, (2,)."""
    qpos: np.ndarray
    """Where the joints stand in `qpos`, (2,)."""
    dofs: np.ndarray
    """Where they stand in `qvel`, (2,)."""
    actuators: np.ndarray
    """Ids of their actuators, (2,)."""
    servo: np.ndarray
    """Slope and offset of the control that holds a finger in a position, (2, 2), as `Arm.servo`."""
    geoms: np.ndarray
    """Ids of the fingers' geoms, (n,)."""
    axis: np.ndarray
    """Along which the fingers open, a unit vector in the frame of the site, (3,)."""
    sign: float
    """1 if a finger's position grows as the gripper opens, -1 if it shrinks."""
    offset: float
    """The opening where both joints are 0, metres."""
    limits: tuple[float, float]
    """The least and the greatest opening, metres."""

    @classmethod
    def of(cls, model: mujoco.MjModel, site: str = SITE) -> Gripper:
        """Find a model's gripper: the slides of the bodies that the body with the site carries.

        Args:
            model: Any model with a gripper, and whatever else.
            site: Name of the site between the fingers.

        Raises:
            UserError: There is no such site, or what it carries is not two opposite, limited fingers with a position
                actuator each.
        """
        site_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, site)
        if site_id < 0:
            raise UserError(f"the model has no site {site!r}: put one between the fingers of its gripper")
        hand = model.site_bodyid[site_id]
        carried = [b for b in range(model.nbody) if b != hand and _carries(model, hand, b)]
        joints = np.array([j for j in range(model.njnt) if model.jnt_bodyid[j] in carried], int)
        if len(joints) != 2 or (model.jnt_type[joints] != SLIDE).any() or not model.jnt_limited[joints].all():
            raise UserError(
                f"the body with the site {site!r} carries {len(joints)} joints: a gripper has two fingers on it, each "
                "on a slide with a range"
            )
        actuators = np.array([position_actuator(model, j) for j in joints])
        if (actuators < 0).any():
            name = joint_name(model, joints[int(actuators.argmin())])
            raise UserError(f"finger {name!r} has no position actuator: give it one")
        data = mujoco.MjData(model)
        data.qpos[:] = model.qpos0
        qpos = model.jnt_qposadr[joints]
        data.qpos[qpos] = 0
        mujoco.mj_kinematics(model, data)
        axis, other = data.xaxis[joints]
        if axis @ other > -0.999:
            raise UserError("the gripper's fingers do not slide in opposite directions: turn the axis of one around")
        fingers = [[b for b in carried if _carries(model, body, b)] for body in model.jnt_bodyid[joints]]
        geoms = [np.flatnonzero(np.isin(model.geom_bodyid, bodies)) for bodies in fingers]
        if not all(len(ids) for ids in geoms):
            raise UserError("a finger of the gripper has no geom: nothing could be held with it")
        (low, high), (other_low, other_high) = (_extent(model, data, ids, axis) for ids in geoms)
        ahead = low + high > other_low + other_high
        sign, offset = (1.0, low - other_high) if ahead else (-1.0, other_low - high)
        ends = offset + sign * model.jnt_range[joints].sum(0)
        return cls(
            joints=joints,
            qpos=qpos,
            dofs=model.jnt_dofadr[joints],
            actuators=actuators,
            servo=np.array([servo_line(model, a) for a in actuators]),
            geoms=np.concatenate(geoms),
            axis=data.site_xmat[site_id].reshape(3, 3).T @ axis,
            sign=sign,
            offset=float(offset),
            limits=(float(ends.min()), float(ends.max())),
        )

    def opening(self, fingers: np.ndarray) -> float:
        """Distance between the fingers, metres, at joint positions (2,)."""
        return float(self.offset + self.sign * fingers.sum())

    def fingers(self, opening: float) -> np.ndarray:
        """Joint positions (2,) of an opening, both fingers as far out as each other; beyond their limits if it is."""
        return np.full(2, self.sign * (opening - self.offset) / 2)

    def to_ctrl(self, fingers: np.ndarray) -> np.ndarray:
        """What to tell the actuators, (2,), so that the fingers come to rest at joint positions (2,)."""
        return self.servo[:, 0] * fingers + self.servo[:, 1]


@cache
def least_width(kind: CatalogueObject) -> float:
    """The least distance between fingers that hold an object from two sides, metres: through its center, level."""
    spec = mujoco.MjSpec()
    for part in kind.parts:
        size = [*part.size, *[0.0] * (3 - len(part.size))]
        spec.worldbody.add_geom(type=part.kind, size=size, pos=part.position, quat=part.quaternion)
    model = spec.compile()
    data, geom = mujoco.MjData(model), np.empty(1, np.int32)
    mujoco.mj_forward(model, data)
    angles = np.deg2rad(np.arange(180))
    ways = np.stack([np.cos(angles), np.sin(angles), np.zeros(180)], 1)
    outside = 2 * kind.radius
    return 2 * (outside - max(mujoco.mj_ray(model, data, outside * u, -u, None, 1, -1, geom) for u in ways))


def _carries(model: mujoco.MjModel, body: int, other: int) -> bool:
    """Whether a body is another, or carries it."""
    while other > body:
        other = model.body_parentid[other]
    return other == body


def _extent(model: mujoco.MjModel, data: mujoco.MjData, geoms: np.ndarray, axis: np.ndarray) -> tuple[float, float]:
    """From where to where geoms reach along an axis (3,), metres."""
    rotations = data.geom_xmat[geoms].reshape(-1, 3, 3)
    centers, halves = model.geom_aabb[geoms, :3], model.geom_aabb[geoms, 3:]
    middles = (data.geom_xpos[geoms] + np.einsum("nij,nj->ni", rotations, centers)) @ axis
    reaches = (np.abs(axis @ rotations) * halves).sum(-1)
    return float((middles - reaches).min()), float((middles + reaches).max())
