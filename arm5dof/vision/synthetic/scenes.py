"""Random tabletop scenes: the arm in some pose, things of the catalogue, and much else, under random light.

A scene is a model of its own, compiled in milliseconds, so nothing of one can linger in the next, and everything in it
follows from its seed. The world frame is the arm's base, z up; the table's top is z = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal, get_args

import mujoco
import numpy as np

from arm5dof.errors import UserError
from arm5dof.runtime import files
from arm5dof.vision.objects import CATALOGUE, Thing
from arm5dof.vision.synthetic import textures as patterns
from arm5dof.vision.synthetic.scene_builder import CAMERA, SECOND, Builder, other_shape

Style = Literal["training", "evaluation"]
"""Which textures and lights: the two have no pattern and no kind of lamp in common."""

NEAREST, FARTHEST = 0.10, 0.25
"""Where things lie: metres from the arm's axis."""
AROUND = np.deg2rad(100)
"""And how far round it to either side of the x axis."""
GAP = 0.006
"""Between one thing and the next, metres."""
MOST_THINGS = 6


@dataclass(frozen=True, eq=False)
class Placed:
    """A thing in a scene."""

    class_id: int
    position: np.ndarray
    """Of its middle in the base frame, (3,), metres."""
    yaw: float
    geoms: np.ndarray
    """Ids of its geoms, (n,)."""

    @property
    def thing(self) -> Thing:
        return CATALOGUE[self.class_id]


@dataclass(frozen=True, eq=False)
class Scene:
    """A model with the cameras `camera` and `second camera`, its data after `mj_forward`, and the things in it."""

    model: mujoco.MjModel
    data: mujoco.MjData
    things: tuple[Placed, ...]


def random_scene(seed: int | tuple[int, ...], style: Style = "training") -> Scene:
    """The scene of a seed, 0 or more; a tuple, such as (run, number), is a seed too. The same seed gives the same bits.

    The things are bodies called `thing 0`, `thing 1` and so on. Raises `UserError` for a negative seed or an unknown
    style.
    """
    if style not in get_args(Style):
        raise UserError(f"no style {style!r}: there are {' and '.join(get_args(Style))}")
    if np.min(seed) < 0:
        raise UserError(f"a scene's seed is 0 or more, not {seed}")
    rng = np.random.default_rng([get_args(Style).index(style), *np.atleast_1d(seed)])
    builder = Builder(_arm_spec().copy(), rng, patterns.TRAINING if style == "training" else patterns.EVALUATION)
    pose, obstacles = _arm_pose(rng)
    builder.paint_arm()
    builder.room()
    things = _place_things(builder, obstacles)
    _place_others(builder, obstacles, [(position, CATALOGUE[i].radius) for i, position, _ in things])
    builder.paper()
    builder.lamps(distant=style == "evaluation")
    builder.camera(CAMERA)
    builder.camera(SECOND)

    model = builder.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = pose
    mujoco.mj_forward(model, data)
    placed = (
        Placed(*thing, np.flatnonzero(model.geom_bodyid == model.body(f"thing {i}").id))
        for i, thing in enumerate(things)
    )
    return Scene(model, data, tuple(placed))


@dataclass(frozen=True, eq=False)
class _Obstacles:
    """Oriented boxes round the arm's geoms: centres (n, 3), axes (n, 3, 3), half sizes (n, 3)."""

    centres: np.ndarray
    axes: np.ndarray
    halves: np.ndarray

    def distance(self, point: np.ndarray) -> float:
        """From a point (3,) to the nearest of them."""
        local = np.einsum("ni,nij->nj", point - self.centres, self.axes)
        return float(np.linalg.norm(np.maximum(np.abs(local) - self.halves, 0), axis=-1).min())

    def lowest(self) -> np.ndarray:
        """How low each reaches, (n,)."""
        return self.centres[:, 2] - (np.abs(self.axes[:, 2]) * self.halves).sum(-1)


def _place_things(builder: Builder, obstacles: _Obstacles) -> list[tuple[int, np.ndarray, float]]:
    """Up to six things, apart from each other and from the arm: class ids, positions and yaws."""
    rng = builder.rng
    lying: list[tuple[int, np.ndarray, float]] = []
    for _ in range(rng.integers(0, MOST_THINGS + 1)):
        class_id = int(rng.integers(len(CATALOGUE)))
        thing = CATALOGUE[class_id]
        for _ in range(30):
            radius, angle = np.sqrt(rng.uniform(NEAREST**2, FARTHEST**2)), rng.uniform(-AROUND, AROUND)
            position = np.array([radius * np.cos(angle), radius * np.sin(angle), thing.half_height])
            others = [(other, CATALOGUE[i].radius) for i, other, _ in lying]
            if _free(position, thing.radius, others, obstacles):
                yaw = float(rng.uniform(-np.pi, np.pi))
                builder.body(position, yaw, thing.parts, builder.paint(thing.hue), f"thing {len(lying)}")
                lying.append((class_id, position, yaw))
                break
    return lying


def _place_others(builder: Builder, obstacles: _Obstacles, taken: list[tuple[np.ndarray, float]]) -> None:
    """Solid shapes that the detector must not mistake for things."""
    rng = builder.rng
    for _ in range(rng.integers(0, 6)):
        parts, half_height, radius, hue = other_shape(rng)
        position = np.array([*rng.uniform([-0.25, -0.4], [0.4, 0.4]), half_height])
        if _free(position, radius, taken, obstacles):
            builder.body(position, rng.uniform(-np.pi, np.pi), parts, builder.paint(hue))
            taken.append((position, radius))


def _free(position: np.ndarray, radius: float, taken: list[tuple[np.ndarray, float]], obstacles: _Obstacles) -> bool:
    """Whether something of that radius can stand there."""
    apart = all(np.linalg.norm((other - position)[:2]) > radius + r + GAP for other, r in taken)
    return apart and obstacles.distance(position) > max(radius, position[2]) + GAP


@cache
def _arm_spec() -> mujoco.MjSpec:
    spec = mujoco.MjSpec.from_file(str(files.find("mjcf", "arm5.xml")))
    spec.visual.quality.shadowsize = 2048
    spec.visual.quality.numslices, spec.visual.quality.numstacks, spec.visual.quality.numquads = 24, 12, 8
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
    spec.visual.map.znear, spec.visual.map.zfar = 0.02, 20
    spec.stat.extent, spec.stat.center = 1.0, [0.1, 0, 0.1]
    return spec


@cache
def _arm_model() -> mujoco.MjModel:
    return _arm_spec().copy().compile()


def _arm_pose(rng: np.random.Generator) -> tuple[np.ndarray, _Obstacles]:
    """Joint positions (nq,) that keep the arm off the table, and the space that it then takes."""
    model = _arm_model()
    data = mujoco.MjData(model)
    moving = model.body_weldid[model.geom_bodyid] > 0
    while True:
        data.qpos[:] = rng.uniform(*model.jnt_range.T)
        mujoco.mj_kinematics(model, data)
        axes = data.geom_xmat.reshape(-1, 3, 3)
        centres = data.geom_xpos + np.einsum("nij,nj->ni", axes, model.geom_aabb[:, :3])
        obstacles = _Obstacles(centres, axes.copy(), model.geom_aabb[:, 3:])
        if obstacles.lowest()[moving].min() > 0.003:
            return data.qpos.copy(), obstacles
