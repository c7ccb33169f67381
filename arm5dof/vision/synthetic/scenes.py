"""Random tabletop scenes: the arm in some pose, objects of the catalogue, and distractors, under random light.

A scene is a model of its own, compiled in milliseconds, so nothing of one can linger in the next, and everything in it
follows from its seed. The world frame is the arm's base, z up; the table's top is z = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal, get_args

import mujoco
import numpy as np

from arm5dof.errors import UserError
from arm5dof.runtime import files
from arm5dof.vision.objects import CATALOGUE, CatalogueObject
from arm5dof.vision.synthetic import textures
from arm5dof.vision.synthetic.scene_builder import CAMERA, SECOND, SceneBuilder, distractor

Style = Literal["training", "evaluation"]
"""Which textures and lights: the two have no texture and no kind of lamp in common."""

MIN_RADIUS, MAX_RADIUS = 0.10, 0.25
"""Where objects lie: distances from the arm's axis, metres."""
MAX_AZIMUTH = np.deg2rad(100)
"""And how far around it to either side of the x axis, radians."""
GAP = 0.006
"""Between one object and the next, metres."""
MAX_OBJECTS = 6
"""In a scene, without the distractors."""


@dataclass(frozen=True, eq=False)
class Placement:
    """Where an object of the catalogue lies."""

    class_id: int
    """Its index in the catalogue."""
    position: np.ndarray
    """Of its center in the base frame, (3,), metres."""
    yaw: float
    """About z, radians."""

    @property
    def catalogue_object(self) -> CatalogueObject:
        """What it is."""
        return CATALOGUE[self.class_id]


@dataclass(frozen=True, eq=False)
class PlacedObject(Placement):
    """An object of the catalogue in a scene."""

    geoms: np.ndarray
    """Ids of its geoms, (n,)."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A model with the cameras `camera` and `second camera`, its data after `mj_forward`, and the objects in it."""

    model: mujoco.MjModel
    data: mujoco.MjData
    objects: tuple[PlacedObject, ...]


@dataclass(frozen=True, eq=False)
class Layout:
    """A scene before it is compiled. Its bodies are called `object 0`, `object 1` and so on, and `distractor 0` and so
    on."""

    builder: SceneBuilder
    pose: np.ndarray
    """Joint positions of the arm and of whatever it carries, (nq,)."""
    objects: tuple[Placement, ...]
    distractors: tuple[tuple[np.ndarray, float], ...]
    """Their centers (3,) and radii, metres."""


def random_scene(seed: int | tuple[int, ...], style: Style = "training") -> Scene:
    """Build a random scene. The same seed and style give the same bits.

    Args:
        seed: 0 or more; a tuple, such as (run, number), is a seed too.
        style: Its textures and lights.

    Returns:
        The scene. The objects are bodies called `object 0`, `object 1` and so on.

    Raises:
        UserError: The seed is negative, or there is no such style.
    """
    layout = random_layout(seed, style)
    model = layout.builder.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = layout.pose
    mujoco.mj_forward(model, data)
    return Scene(model, data, placed_objects(model, layout.objects))


def placed_objects(model: mujoco.MjModel, placements: Sequence[Placement]) -> tuple[PlacedObject, ...]:
    """The objects of a layout in the model that was compiled from it."""
    bodies = [model.body(f"object {i}").id for i in range(len(placements))]
    return tuple(
        PlacedObject(one.class_id, one.position, one.yaw, np.flatnonzero(model.geom_bodyid == body))
        for one, body in zip(placements, bodies, strict=True)
    )


def random_layout(
    seed: int | tuple[int, ...],
    style: Style = "training",
    arm: mujoco.MjSpec | None = None,
    count: tuple[int, int] = (0, MAX_OBJECTS),
    radii: tuple[float, float] = (MIN_RADIUS, MAX_RADIUS),
    objects: Sequence[Placement] | None = None,
) -> Layout:
    """Draw a random scene. The same arguments give the same bits.

    Args:
        seed: As `random_scene` has it.
        style: Its textures and lights.
        arm: The arm, which is not changed; None for the paper's.
        count: The least and the greatest number of objects; fewer where there is no room.
        radii: How near and how far from the arm's axis they lie, metres.
        objects: The objects themselves, in place of random ones.

    Raises:
        UserError: The seed is negative, or there is no such style.
    """
    if style not in get_args(Style):
        raise UserError(f"no style {style!r}: there are {' and '.join(get_args(Style))}")
    if np.min(seed) < 0:
        raise UserError(f"a scene's seed is 0 or more, not {seed}")
    rng = np.random.default_rng([get_args(Style).index(style), *np.atleast_1d(seed)])
    spec = _arm_spec().copy() if arm is None else _with_view(arm.copy())
    builder = SceneBuilder(spec, rng, textures.TRAINING if style == "training" else textures.EVALUATION)
    pose, obstacles = _arm_pose(rng, _arm_model() if arm is None else arm.copy().compile())
    builder.paint_arm()
    builder.room()
    if objects is None:
        placed = _place_objects(builder, obstacles, count, radii)
    else:
        placed = list(objects)
        for i, one in enumerate(placed):
            _add_object(builder, one, i)
    distractors = _place_distractors(
        builder, obstacles, [(one.position, one.catalogue_object.radius) for one in placed]
    )
    builder.paper()
    builder.lamps(distant=style == "evaluation")
    scale = max(1.0, radii[1] / MAX_RADIUS)
    builder.camera(CAMERA, scale)
    builder.camera(SECOND, scale)
    return Layout(builder, pose, tuple(placed), tuple(distractors))


@dataclass(frozen=True, eq=False)
class _Obstacles:
    """Oriented boxes around the arm's geoms, in the base frame."""

    centers: np.ndarray
    """(n, 3), metres."""
    axes: np.ndarray
    """In columns, (n, 3, 3)."""
    halves: np.ndarray
    """Half sizes, (n, 3), metres."""

    def distance(self, point: np.ndarray) -> float:
        """From a point (3,) to the nearest of them, metres."""
        local = np.einsum("ni,nij->nj", point - self.centers, self.axes)
        return float(np.linalg.norm(np.maximum(np.abs(local) - self.halves, 0), axis=-1).min())

    def lowest(self) -> np.ndarray:
        """The lowest z of each, (n,), metres."""
        return self.centers[:, 2] - (np.abs(self.axes[:, 2]) * self.halves).sum(-1)


def _place_objects(
    builder: SceneBuilder, obstacles: _Obstacles, count: tuple[int, int], radii: tuple[float, float]
) -> list[Placement]:
    """Objects apart from each other and from the arm."""
    rng = builder.rng
    placed: list[Placement] = []
    for _ in range(rng.integers(count[0], count[1] + 1)):
        class_id = int(rng.integers(len(CATALOGUE)))
        one = CATALOGUE[class_id]
        for _ in range(30):
            radius = np.sqrt(rng.uniform(radii[0] ** 2, radii[1] ** 2))
            azimuth = rng.uniform(-MAX_AZIMUTH, MAX_AZIMUTH)
            position = np.array([radius * np.cos(azimuth), radius * np.sin(azimuth), one.half_height])
            taken = [(other.position, other.catalogue_object.radius) for other in placed]
            if _free(position, one.radius, taken, obstacles):
                placed.append(Placement(class_id, position, float(rng.uniform(-np.pi, np.pi))))
                _add_object(builder, placed[-1], len(placed) - 1)
                break
    return placed


def _add_object(builder: SceneBuilder, placed: Placement, number: int) -> None:
    one = placed.catalogue_object
    builder.body(placed.position, placed.yaw, one.parts, builder.paint(one.hue), f"object {number}")


def _place_distractors(
    builder: SceneBuilder, obstacles: _Obstacles, objects: list[tuple[np.ndarray, float]]
) -> list[tuple[np.ndarray, float]]:
    """Solid shapes that the detector must not mistake for objects: their centers and radii, as of the objects."""
    rng = builder.rng
    placed: list[tuple[np.ndarray, float]] = []
    for _ in range(rng.integers(0, 6)):
        parts, half_height, radius, hue = distractor(rng)
        position = np.array([*rng.uniform([-0.25, -0.4], [0.4, 0.4]), half_height])
        if _free(position, radius, objects + placed, obstacles):
            yaw = rng.uniform(-np.pi, np.pi)
            builder.body(position, yaw, parts, builder.paint(hue), f"distractor {len(placed)}")
            placed.append((position, radius))
    return placed


def _free(position: np.ndarray, radius: float, taken: list[tuple[np.ndarray, float]], obstacles: _Obstacles) -> bool:
    """Whether something of that radius, metres, can stand there."""
    apart = all(np.linalg.norm((other - position)[:2]) > radius + r + GAP for other, r in taken)
    return apart and obstacles.distance(position) > max(radius, position[2]) + GAP


@cache
def _arm_spec() -> mujoco.MjSpec:
    return _with_view(mujoco.MjSpec.from_file(str(files.find("mjcf", "arm5.xml"))))


def _with_view(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """The same spec, told how it is rendered."""
    spec.visual.quality.shadowsize = 2048
    spec.visual.quality.numslices, spec.visual.quality.numstacks, spec.visual.quality.numquads = 24, 12, 8
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
    spec.visual.map.znear, spec.visual.map.zfar = 0.02, 20
    spec.stat.extent, spec.stat.center = 1.0, [0.1, 0, 0.1]
    return spec


@cache
def _arm_model() -> mujoco.MjModel:
    return _arm_spec().copy().compile()


def _arm_pose(rng: np.random.Generator, model: mujoco.MjModel) -> tuple[np.ndarray, _Obstacles]:
    """Joint positions (nq,) that keep the arm off the table, and the space that it then takes."""
    data = mujoco.MjData(model)
    moving = model.body_weldid[model.geom_bodyid] > 0
    while True:
        data.qpos[:] = rng.uniform(*model.jnt_range.T)
        mujoco.mj_kinematics(model, data)
        axes = data.geom_xmat.reshape(-1, 3, 3)
        centers = data.geom_xpos + np.einsum("nij,nj->ni", axes, model.geom_aabb[:, :3])
        obstacles = _Obstacles(centers, axes.copy(), model.geom_aabb[:, 3:])
        if obstacles.lowest()[moving].min() > 0.003:
            return data.qpos.copy(), obstacles
