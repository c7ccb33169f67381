"""`World`: a planner's model of the arm and what is known to stand around it, in which motions are checked."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import mujoco
import numpy as np

from arm5dof.arm import Arm
from arm5dof.errors import UserError
from arm5dof.grasp.bins import Bin
from arm5dof.grasp.gripper import SITE, Gripper
from arm5dof.grasp.perception import SeenObject
from arm5dof.vision.camera import Camera
from arm5dof.vision.objects import CATALOGUE, CatalogueObject
from arm5dof.vision.synthetic.scenes import MAX_RADIUS, MIN_RADIUS

STEP = 0.04
"""How finely motions are checked: the largest turn of a joint between one pose and the next, radians."""
REST_POSES = 400
"""Among so many random poses the one is taken that hides least from the camera."""
MARGINS = (0.02, 0.03)
"""How much nearer to the arm's axis and further from it than objects lie the camera should see the table, metres."""
ARM, OTHERS = 1, 2


@dataclass(frozen=True, eq=False)
class Held:
    """An object in the gripper."""

    kind: CatalogueObject
    joints: np.ndarray
    """Where the arm was when it took it, upright, (dof,), radians."""


class World:
    """The arm, the table, bins, and objects as upright cylinders.

    Args:
        arm: The arm, from a file, with a gripper.
        bins: What stands on the table.
        objects: What was seen there, with positions.
        held: What the gripper holds, which goes where that goes.
    """

    def __init__(
        self, arm: Arm, bins: Iterable[Bin] = (), objects: Sequence[SeenObject] = (), held: Held | None = None
    ) -> None:
        if arm.mj_spec is None:
            raise UserError("the planner needs the arm's MJCF file, not its compiled model alone")
        spec = arm.mj_spec.copy()
        spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        if held is not None:
            _add_held(spec, arm, held)
        for geom in spec.geoms:
            geom.contype, geom.conaffinity, geom.margin, geom.gap = ARM, 0, 0, 0
        around = [spec.worldbody.add_geom(name="known table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[2, 2, 0.1])]
        for one in bins:
            around += one.add_to(spec)
        radius = {one.name: one.radius for one in CATALOGUE}
        height = {one.name: one.half_height for one in CATALOGUE}
        for i, seen in enumerate(objects):
            assert seen.position is not None
            size = [radius[seen.name], height[seen.name], 0]
            kind = mujoco.mjtGeom.mjGEOM_CYLINDER
            around.append(spec.worldbody.add_geom(name=f"known object {i}", type=kind, size=size, pos=seen.position))
        for geom in around:
            geom.contype, geom.conaffinity = 0, ARM
        self.model = spec.compile()
        self.arm, self.gripper = arm, Gripper.of(self.model)
        self._objects = [self.model.geom(f"known object {i}").id for i in range(len(objects))]
        self._data = mujoco.MjData(self.model)
        # What of the arm stands on the table for good touches it in every pose.
        fixed = self.model.body_weldid[self.model.geom_bodyid] == 0
        self.model.geom_contype[fixed] = 0

    def clear(self, path: np.ndarray, opening: float, without: int | None = None, allowed: float = 0.0) -> bool:
        """Whether the arm hits nothing on a path.

        Args:
            path: Joint positions (k, dof), radians, between which joints move in straight lines.
            opening: Of the gripper, metres.
            without: Number of an object that may be touched.
            allowed: How deep it may cut into what it meets, metres.
        """
        return all(self._clear(q, opening, without, allowed) for q in dense(path))

    def rest(self, camera: Camera, radii: tuple[float, float] = (MIN_RADIUS, MAX_RADIUS)) -> np.ndarray:
        """A pose out of the camera's way, (dof,), radians: of random poses that hit nothing the one that hides least of
        the table where objects are, and among those the one nearest the middle of the joints' ranges. The same for the
        same arm, camera and radii: how near and how far from the arm's axis objects lie, metres."""
        rng = np.random.default_rng(0)
        origin = np.asarray(camera.position, float)
        near, far = radii[0] - MARGINS[0], radii[1] + MARGINS[1]
        radius, azimuth = np.meshgrid(np.linspace(near, far, 5), np.deg2rad(np.linspace(-110, 110, 23)))
        points = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.full_like(radius, 0.02)], -1)
        ways = (points.reshape(-1, 3) - origin) / np.linalg.norm(points.reshape(-1, 3) - origin, axis=1)[:, None]
        best, least = self.arm.home, (np.inf, np.inf)
        for _ in range(REST_POSES):
            q = rng.uniform(self.arm.lower, self.arm.upper)
            if not self._clear(q, 0.0, None, 0.0):
                continue
            mujoco.mj_forward(self.model, self._data)
            hidden = self._hidden(origin, ways)
            middle = float(np.abs(2 * (q - self.arm.lower) / (self.arm.upper - self.arm.lower) - 1).max())
            if (hidden, middle) < least:
                best, least = q, (hidden, middle)
        return best

    def _hidden(self, origin: np.ndarray, ways: np.ndarray) -> int:
        """How many lines of sight the arm is in the way of."""
        n = len(ways)
        geom, distance = np.full(n, -1, np.int32), np.empty(n)
        mujoco.mj_multiRay(self.model, self._data, origin, ways.ravel(), None, 1, -1, geom, distance, None, n, 2.0)
        return int((self.model.geom_contype[geom[geom >= 0]] == ARM).sum())

    def _clear(self, q: np.ndarray, opening: float, without: int | None, allowed: float) -> bool:
        data = self._data
        data.qpos[self.arm.qpos] = q
        data.qpos[self.gripper.qpos] = self.gripper.fingers(opening)
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_comPos(self.model, data)
        mujoco.mj_collision(self.model, data)
        deep = data.contact.dist < -allowed
        if without is not None:
            deep &= ~(data.contact.geom == self._objects[without]).any(1)
        return not deep.any()


def _add_held(spec: mujoco.MjSpec, arm: Arm, held: Held) -> None:
    """Add what is held to the body of the gripper's site, as an upright cylinder at the time it was taken."""
    model, site = arm.mj_model, arm.mj_model.site(SITE).id
    data = mujoco.MjData(model)
    data.qpos[arm.qpos] = held.joints
    mujoco.mj_kinematics(model, data)
    hand = model.site_bodyid[site]
    to_hand, quaternion = data.xmat[hand].reshape(3, 3).T, np.empty(4)
    mujoco.mju_quatZ2Vec(quaternion, to_hand[:, 2].copy())
    spec.site(SITE).parent.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[held.kind.radius, held.kind.half_height, 0],
        pos=to_hand @ (data.site_xpos[site] - data.xpos[hand]),
        quat=quaternion,
    )


def dense(path: np.ndarray) -> np.ndarray:
    """A path (k, dof) with poses between, no joint moving more than `STEP` from one to the next."""
    pieces = [path[:1]]
    for start, end in pairwise(path):
        count = max(1, int(np.ceil(np.abs(end - start).max() / STEP)))
        pieces.append(start + (end - start) * np.arange(1, count + 1)[:, None] / count)
    return np.concatenate(pieces)
