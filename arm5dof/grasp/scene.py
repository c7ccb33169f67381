"""Tabletop scenes with contacts: the detector's random scenes, in which objects have mass and are held by friction.

A scene looks as `random_scene` draws it, but for the bins; what differs is what the eye cannot see. The paper lying on
the table is thinner than a contact is deep and stays a picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np

from arm5dof.arm import Arm, load_arm
from arm5dof.errors import UserError
from arm5dof.grasp.gripper import SITE, Gripper
from arm5dof.vision.camera import Camera
from arm5dof.vision.objects import CLASS_NAMES
from arm5dof.vision.synthetic.samples import HEIGHT, WIDTH
from arm5dof.vision.synthetic.scene_builder import CAMERA
from arm5dof.vision.synthetic.scenes import (
    MAX_OBJECTS,
    MAX_RADIUS,
    MIN_RADIUS,
    PlacedObject,
    Placement,
    Scene,
    Style,
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
"""What moves slower is at rest, m/s and rad/s."""

FAR_ROW, NEAR_ROW = 0.86, 0.52
"""Distances of the bins from the arm's axis, as shares of that of the furthest objects: the tool can point straight down
in both rows, even from above a bin's wall."""
BIN_AZIMUTHS = ((FAR_ROW, 121), (FAR_ROW, 143), (NEAR_ROW, 139), (FAR_ROW, 165))
"""Row and azimuth to either side of the x axis, degrees, best first. Objects lie within 100 degrees and no bin comes
nearer to one than a finger is thick; the arm turns to what is behind it without passing over the objects again."""
BIN_HALF, BIN_WALL, BIN_HEIGHT = 0.035, 0.002, 0.02
"""Half the outer width, thickness and height of a bin's walls, metres: the longest object fits in whichever way it is
turned, and fingers 6 mm below its center stay above the walls."""


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
class Bin:
    """A low open box on the table."""

    name: str
    position: np.ndarray
    """Of its middle on the table, (2,), metres, base frame."""
    yaw: float
    """About z, radians."""

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Whether points (n, 3), metres, base frame, are inside its walls and below their rims, (n,) bool."""
        along = np.array([np.cos(self.yaw), np.sin(self.yaw)])
        local = (points[:, :2] - self.position) @ np.stack([along, [-along[1], along[0]]], -1)
        return (np.abs(local).max(-1) < BIN_HALF - BIN_WALL) & (points[:, 2] < BIN_HEIGHT + 0.005)


@dataclass(frozen=True, eq=False)
class TabletopScene(Scene):
    """A scene that can be stepped. What it says about its objects is the ground truth, for scoring alone."""

    arm: Arm
    """Its end effector is the site between the fingers."""
    gripper: Gripper
    camera: Camera
    """As calibrated, which is where it stands unless it was moved since."""
    bins: dict[str, Bin]
    start: np.ndarray = field(repr=False)
    """The objects' positions before anything moved, (n, 3), metres."""

    def object_poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions (n, 3), metres, and rotations (n, 3, 3) of the objects' frames in the base frame, now."""
        qpos = self.data.qpos[self._joints(self.model.jnt_qposadr)[:, None] + np.arange(7)]
        rotations = np.empty((len(qpos), 9))
        for rotation, quaternion in zip(rotations, qpos[:, 3:], strict=True):
            mujoco.mju_quat2Mat(rotation, quaternion)
        return qpos[:, :3], rotations.reshape(-1, 3, 3)

    def lifted(self, height: float = 0.05) -> np.ndarray:
        """Which objects are so much higher now, metres, than before anything moved, (n,) bool."""
        return self.object_poses()[0][:, 2] - self.start[:, 2] >= height

    def resting(self) -> np.ndarray:
        """Which objects are at rest, (n,) bool."""
        qvel = self.data.qvel[self._joints(self.model.jnt_dofadr)[:, None] + np.arange(6)]
        return np.abs(qvel).max(-1, initial=0) < STILL

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
    arm: str | Path | mujoco.MjSpec = "arm5.xml",
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
        arm: MJCF of an arm with a gripper and the site `grasp` between its fingers.
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
        UserError: The seed is negative, there is no such style, too many bins, or the arm has no gripper.
    """
    loaded = load_arm(arm, SITE)
    assert loaded.mj_spec is not None  # It comes from MJCF.
    spec = loaded.mj_spec.copy()
    Gripper.of(loaded.mj_model)
    fingers = {loaded.mj_model.geom(g).id for g in Gripper.of(loaded.mj_model).geoms}
    friction = np.array(FRICTION) * disturbance.friction
    _make_solid(spec.geoms, ARM_BIT, 0, friction)
    for g in fingers:
        spec.geoms[g].condim = 4

    layout = random_layout(seed, style, spec, count, radii, objects)
    builder, spec = layout.builder, layout.builder.spec
    _set_options(spec)
    # The table that is seen is a box, against which the sides of a ring make many contacts more.
    table = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[2, 2, 0.1], group=3)
    _make_solid([table], 0, ARM_BIT | OBJECT_BIT, friction)
    placed_bins = _place_bins(spec, bins, radii[1], friction)
    density = DENSITY * disturbance.mass
    for i in range(len(layout.objects)):
        _make_movable(spec.body(f"object {i}"), density, friction)
    for i, (position, radius) in enumerate(layout.distractors):
        body = spec.body(f"distractor {i}")
        apart = all(
            np.hypot(*(position[:2] - one.position)) > radius + BIN_HALF * np.sqrt(2) for one in placed_bins.values()
        )
        if distractors and apart:
            _make_movable(body, density, friction)
        else:
            spec.delete(body)

    model = builder.compile()
    model.light_diffuse *= disturbance.light
    model.light_specular *= disturbance.light
    for name in ("ambient", "diffuse", "specular"):
        getattr(model.vis.headlight, name)[:] *= disturbance.light
    data = mujoco.MjData(model)
    data.qpos[: len(layout.pose)] = layout.pose
    whole, gripper = load_arm(model, SITE), Gripper.of(model)
    if start is not None:
        data.qpos[whole.qpos] = start
    mujoco.mj_forward(model, data)
    rng = np.random.default_rng([0, *np.atleast_1d(seed)])
    while start is None and _arm_touches(model, data):
        data.qpos[whole.qpos] = rng.uniform(whole.lower, whole.upper)
        mujoco.mj_forward(model, data)
    data.ctrl[whole.actuators] = whole.servo[:, 0] * data.qpos[whole.qpos] + whole.servo[:, 1]
    data.ctrl[gripper.actuators] = gripper.to_ctrl(data.qpos[gripper.qpos])
    calibrated = Camera.from_mujoco(model, CAMERA, WIDTH, HEIGHT, data)
    _move_camera(model, disturbance)
    mujoco.mj_forward(model, data)
    placed = tuple(
        PlacedObject(
            one.class_id, one.position, one.yaw, np.flatnonzero(model.geom_bodyid == model.body(f"object {i}").id)
        )
        for i, one in enumerate(layout.objects)
    )
    positions = np.array([one.position for one in placed]).reshape(-1, 3)
    return TabletopScene(model, data, placed, whole, gripper, calibrated, placed_bins, positions)


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
        rolls = geom.type not in (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER)
        geom.condim = 6 if rolls else 4


def _place_bins(spec: mujoco.MjSpec, names: Sequence[str], radius: float, friction: np.ndarray) -> dict[str, Bin]:
    places = [(row, side * azimuth) for row, azimuth in BIN_AZIMUTHS for side in (1, -1)]
    if len(names) > len(places):
        raise UserError(f"{len(names)} bins: there is room for {len(places)}")
    if len(set(names)) < len(names):
        raise UserError(f"two bins of the same name: {', '.join(names)}")
    bins = {}
    for name, (row, azimuth) in zip(names, places, strict=False):
        yaw = float(np.deg2rad(azimuth))
        one = Bin(name, row * radius * np.array([np.cos(yaw), np.sin(yaw)]), yaw)
        body = spec.worldbody.add_body(
            name=f"bin {name}", pos=[*one.position, 0], quat=[np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
        )
        middle, rgba = BIN_HALF - BIN_WALL / 2, [0.55, 0.57, 0.6, 1]
        box = mujoco.mjtGeom.mjGEOM_BOX
        floor = BIN_HALF - BIN_WALL
        body.add_geom(type=box, size=[floor, floor, 0.0015], rgba=rgba, contype=0, conaffinity=0)
        for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            size = [BIN_WALL / 2 if x else BIN_HALF, BIN_WALL / 2 if y else BIN_HALF, BIN_HEIGHT / 2]
            wall = body.add_geom(type=box, size=size, pos=[x * middle, y * middle, BIN_HEIGHT / 2], rgba=rgba)
            _make_solid([wall], 0, ARM_BIT | OBJECT_BIT, friction)
        bins[name] = one
    return bins


def _arm_touches(model: mujoco.MjModel, data: mujoco.MjData) -> bool:
    return bool((model.geom_contype[data.contact.geom] == ARM_BIT).any())


def _move_camera(model: mujoco.MjModel, disturbance: Disturbance) -> None:
    camera = model.camera(CAMERA).id
    model.cam_pos[camera] += disturbance.camera_shift
    angle = float(np.linalg.norm(disturbance.camera_turn))
    if angle:
        turn, turned = np.empty(4), np.empty(4)
        mujoco.mju_axisAngle2Quat(turn, np.array(disturbance.camera_turn) / angle, angle)
        mujoco.mju_mulQuat(turned, turn, model.cam_quat[camera])
        model.cam_quat[camera] = turned
