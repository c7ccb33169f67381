"""Tabletop scenes with contacts: the detector's random scenes, in which objects have mass and are held by friction.

A scene looks as `random_scene` draws it, but for the bins. Paper on the table is only seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np

from arm5dof.arm import Arm, load_arm
from arm5dof.errors import UserError
from arm5dof.grasp.bins import HALF, Bin, arrange
from arm5dof.grasp.gripper import SITE, Gripper
from arm5dof.vision.camera import Camera
from arm5dof.vision.objects import CLASS_NAMES
from arm5dof.vision.synthetic.samples import HEIGHT, WIDTH
from arm5dof.vision.synthetic.scene_builder import CAMERA
from arm5dof.vision.synthetic.scenes import (
    MAX_OBJECTS,
    MAX_RADIUS,
    MIN_RADIUS,
    Placement,
    Scene,
    Style,
    placed_objects,
    random_layout,
)

TIME_STEP = 0.002
"""Seconds."""
FRICTION = (0.8, 0.005, 0.0002)
"""Coulomb's coefficient; then against spinning and rolling, metres: two thirds of the radius of a finger pad's contact,
and what a ball of wood or plastic has on a table."""
SOLREF, SOLIMP = (2 * TIME_STEP, 1.0), (0.95, 0.99, 0.0003, 0.5, 2.0)
"""Contacts as hard as the time step allows: MuJoCo's own are made for heavier objects, and let fingers 4 mm into a ball
of 8 g, from which a grip creeps."""
DENSITY = 600.0
"""Of objects and distractors, kg/m^3: wood."""
ARM_BIT, OBJECT_BIT = 1, 2
"""The arm collides with all but itself, objects with all, table and bins with what moves."""
STILL = 0.01
"""A joint that moves slower is at rest, m/s and rad/s."""
MOMENTS, STILL_OBJECT = 0.2, (0.001, 0.01)
"""An object rests if in so many seconds it moves and turns less fast than that, m/s and rad/s, on average."""


@dataclass(frozen=True)
class Disturbance:
    """How a scene differs from what its camera's calibration and the objects' catalogue say."""

    friction: float = 1.0
    """Factor on the friction of every contact."""
    mass: float = 1.0
    """Factor on the mass of objects and distractors."""
    light: float = 1.0
    """Factor on the light of all lamps."""
    camera_shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """By how much the camera has moved since it was calibrated, metres, base frame."""
    camera_turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """And turned: a rotation vector, radians, base frame."""


UNDISTURBED = Disturbance()


@dataclass(frozen=True, eq=False)
class TabletopScene(Scene):
    """A scene that can be stepped. What it says about its objects is the ground truth, for scoring alone."""

    arm: Arm
    """Its end effector is the site between the fingers."""
    gripper: Gripper
    """Which the arm carries."""
    camera: Camera
    """As calibrated, which is where it stands unless it was moved since."""
    bins: dict[str, Bin]
    """By name."""
    start: np.ndarray = field(repr=False)
    """The objects' positions before anything moved, (n, 3), metres."""

    def object_poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions (n, 3), metres, and rotations (n, 3, 3) of the objects' frames in the base frame, now."""
        return self._poses(self.data)

    def _poses(self, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
        qpos = data.qpos[self._joints(self.model.jnt_qposadr)[:, None] + np.arange(7)]
        rotations = np.empty((len(qpos), 9))
        for rotation, quaternion in zip(rotations, qpos[:, 3:], strict=True):
            mujoco.mju_quat2Mat(rotation, quaternion)
        return qpos[:, :3], rotations.reshape(-1, 3, 3)

    def lifted(self, height: float = 0.05) -> np.ndarray:
        """Which objects are so much higher now, metres, than before anything moved, (n,) bool."""
        return self.object_poses()[0][:, 2] - self.start[:, 2] >= height

    def resting(self) -> np.ndarray:
        """Which objects are at rest, (n,) bool: those that hardly move in the next moments, since contacts tremble."""
        later, before = copy(self.data), self.object_poses()
        mujoco.mj_step(self.model, later, round(MOMENTS / self.model.opt.timestep))
        after = self._poses(later)
        moved = np.linalg.norm(after[0] - before[0], axis=-1)
        turned = np.linalg.norm(after[1] - before[1], axis=(-2, -1)) / np.sqrt(2)  # For small angles.
        return (moved < MOMENTS * STILL_OBJECT[0]) & (turned < MOMENTS * STILL_OBJECT[1])

    def in_bin(self, name: str) -> np.ndarray:
        """Which objects are at rest in a bin, (n,) bool.

        Raises:
            UserError: There is no such bin.
        """
        if name not in self.bins:
            raise UserError(f"no bin {name!r}: there are {', '.join(self.bins) or 'none'}")
        return self.bins[name].contains(self.object_poses()[0]) & self.resting()

    def _joints(self, addresses: np.ndarray) -> np.ndarray:
        bodies = self.model.geom_bodyid[[placed.geoms[0] for placed in self.objects]] if self.objects else []
        return addresses[self.model.body_jntadr[bodies]] if len(bodies) else np.empty(0, int)


def tabletop_scene(
    seed: int | tuple[int, ...],
    style: Style = "evaluation",
    *,
    arm: str | Path = "arm5.xml",
    count: tuple[int, int] = (3, MAX_OBJECTS),
    radii: tuple[float, float] = (MIN_RADIUS, MAX_RADIUS),
    objects: Sequence[Placement] | None = None,
    distractors: bool = True,
    bins: Sequence[str] = CLASS_NAMES,
    start: np.ndarray | None = None,
    disturbance: Disturbance = UNDISTURBED,
) -> TabletopScene:
    """Build a random scene that can be stepped. The same arguments give the same bits.

    Args:
        seed: 0 or more; a tuple, such as (run, number), is a seed too.
        style: Its textures and lights.
        arm: MJCF file of an arm, the user's or one that ships, with a gripper and the site `grasp` between its fingers.
        count: The least and the greatest number of objects; fewer where there is no room.
        radii: How near and how far from the arm's axis they lie, metres.
        objects: The objects themselves, in place of random ones.
        distractors: Whether what is not in the catalogue lies there too. It can be pushed as objects can.
        bins: Names of the bins, at most eight. What would stand in a bin is left out.
        start: Where the arm's joints start, (dof,), radians; None for the random scene's pose, or another random one
            if that touches something. The fingers start at random.
        disturbance: How the scene differs from what is known of it.

    Returns:
        The scene, the arm and fingers at rest.

    Raises:
        UserError: The seed is negative, there is no such style, too many bins, the radii are none, or the arm has no
            gripper.
    """
    if not 0 < radii[0] <= radii[1] < np.inf:
        raise UserError(
            f"objects {radii[0]:g} to {radii[1]:g} m from the arm's axis: give two radii above 0, near first"
        )
    friction = np.array(FRICTION) * disturbance.friction
    layout = random_layout(seed, style, _solid_arm(arm, friction), count, radii, objects)
    spec = layout.builder.spec
    _set_options(spec)
    # The table that is seen is a box, against which the sides of a ring make many contacts more.
    table = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[2, 2, 0.1], group=3)
    placed_bins = arrange(bins, radii[1])
    walls = [wall for one in placed_bins.values() for wall in one.add_to(spec)]
    _make_solid([table, *walls], 0, ARM_BIT | OBJECT_BIT, friction)
    for i in range(len(layout.objects)):
        _make_movable(spec.body(f"object {i}"), DENSITY * disturbance.mass, friction)
    for i, (position, radius) in enumerate(layout.distractors):
        in_the_way = any(
            np.hypot(*(position[:2] - one.position)) < radius + np.sqrt(2) * HALF for one in placed_bins.values()
        )
        if distractors and not in_the_way:
            _make_movable(spec.body(f"distractor {i}"), DENSITY * disturbance.mass, friction)
        else:
            spec.delete(spec.body(f"distractor {i}"))

    model = layout.builder.compile()
    calibrated = Camera.from_mujoco(model, CAMERA, WIDTH, HEIGHT)
    _disturb(model, disturbance)
    data = mujoco.MjData(model)  # From here on, what never moves is not looked at again.
    whole, gripper = load_arm(model, SITE), Gripper.of(model)
    data.qpos[: len(layout.pose)] = layout.pose  # The arm's bodies come first.
    _start(data, whole, gripper, start, np.random.default_rng(np.atleast_1d(seed)))
    placed = placed_objects(model, layout.objects)
    positions = np.array([one.position for one in placed]).reshape(-1, 3)
    return TabletopScene(model, data, placed, whole, gripper, calibrated, placed_bins, positions)


def _solid_arm(source: str | Path, friction: np.ndarray) -> mujoco.MjSpec:
    """An arm that collides; refused if it has no gripper."""
    arm = load_arm(source, SITE)
    assert arm.mj_spec is not None  # It comes from a file.
    spec = arm.mj_spec.copy()
    _make_solid(spec.geoms, ARM_BIT, 0, friction)
    for g in Gripper.of(arm.mj_model).geoms:
        spec.geoms[g].condim = 4
    return spec


def _set_options(spec: mujoco.MjSpec) -> None:
    option = spec.option
    option.timestep, option.cone, option.impratio = TIME_STEP, mujoco.mjtCone.mjCONE_ELLIPTIC, 10
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.disableflags &= ~(int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT) | int(mujoco.mjtDisableBit.mjDSBL_CONTACT))
    option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)  # What nothing touches costs nothing.


def _make_solid(geoms: Sequence[mujoco.MjsGeom], contype: int, conaffinity: int, friction: np.ndarray) -> None:
    for geom in geoms:
        geom.contype, geom.conaffinity, geom.condim, geom.priority = contype, conaffinity, 3, 0
        geom.friction, geom.solref, geom.solimp, geom.solmix, geom.margin, geom.gap = friction, SOLREF, SOLIMP, 1, 0, 0


def _make_movable(body: mujoco.MjsBody, density: float, friction: np.ndarray) -> None:
    """Give a body mass and contacts."""
    body.add_freejoint()
    _make_solid(body.geoms, OBJECT_BIT, ARM_BIT | OBJECT_BIT, friction)
    for geom in body.geoms:
        geom.density = density
        rolls = geom.type != mujoco.mjtGeom.mjGEOM_BOX
        geom.condim = 6 if rolls else 4


def _start(data: mujoco.MjData, arm: Arm, gripper: Gripper, start: np.ndarray | None, rng: np.random.Generator) -> None:
    """Put the arm where it starts, and tell its actuators to hold it there."""
    model = data.model
    if start is not None:
        data.qpos[arm.qpos] = start
    mujoco.mj_forward(model, data)
    while start is None and (model.geom_contype[data.contact.geom] == ARM_BIT).any():
        data.qpos[arm.qpos] = rng.uniform(arm.lower, arm.upper)
        mujoco.mj_forward(model, data)
    data.ctrl[arm.actuators] = arm.servo[:, 0] * data.qpos[arm.qpos] + arm.servo[:, 1]
    data.ctrl[gripper.actuators] = gripper.to_ctrl(data.qpos[gripper.qpos])


def _disturb(model: mujoco.MjModel, disturbance: Disturbance) -> None:
    """Change the light, and where the camera stands."""
    head = model.vis.headlight
    for light in (
        model.light_ambient,
        model.light_diffuse,
        model.light_specular,
        head.ambient,
        head.diffuse,
        head.specular,
    ):
        light *= disturbance.light
    camera = model.camera(CAMERA).id
    model.cam_pos[camera] += disturbance.camera_shift
    angle = float(np.linalg.norm(disturbance.camera_turn))
    if angle:
        turn, before = np.empty(4), model.cam_quat[camera].copy()
        mujoco.mju_axisAngle2Quat(turn, np.array(disturbance.camera_turn) / angle, angle)
        mujoco.mju_mulQuat(model.cam_quat[camera], turn, before)
