"""Cameras over a table, calibrated and posed with noise as real ones are, and MuJoCo's word for what they see; objects
on the table, their detections and their boxes."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import jax
import mujoco
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from arm5dof.vision.calibration.boards import Corners
from arm5dof.vision.calibration.checkerboard import Checkerboard
from arm5dof.vision.calibration.covariance import add_intrinsics_covariance
from arm5dof.vision.calibration.extrinsics import from_corners
from arm5dof.vision.calibration.fit import fit
from arm5dof.vision.calibration.views import BoardView, board_pose
from arm5dof.vision.camera import Camera
from arm5dof.vision.detections import Detections
from arm5dof.vision.localization.solids import FORMS, Solid, solid_box

WIDTH, HEIGHT = 640, 480
BOARD = Checkerboard(9, 6, 0.025)
LENS = np.array([[533, 0, 342.0], [0, 532, 233], [0, 0, 1]]), np.array([-0.26, 0.04, 1.5e-3, -2e-4, 0.12])

BOARD_TO_BASE = np.eye(4)
BOARD_TO_BASE[:3, :3] = np.diag([1, -1, -1])
BOARD_TO_BASE[:3, 3] = 0.05, 0.06, 0


def pose(rotation: np.ndarray, position: np.ndarray | Sequence[float]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, position
    return matrix


def over_the_table(rng: np.random.Generator, low: float = 35, high: float = 85) -> np.ndarray:
    """A camera's pose (4, 4), 0.6 to 0.9 m from the center of the table, so many degrees above it, a little rolled."""
    height, around = np.deg2rad(rng.uniform(low, high)), rng.uniform(0, 2 * np.pi)
    away = np.array([np.cos(height) * np.cos(around), np.cos(height) * np.sin(around), np.sin(height)])
    x = np.cross(-away, [0, 0, 1])
    x /= np.linalg.norm(x)
    level = np.stack([x, np.cross(-away, x), -away], axis=1)
    roll = Rotation.from_euler("z", rng.uniform(-0.3, 0.3)).as_matrix()
    return pose(level @ roll, [0.15, 0, 0] + rng.uniform(0.6, 0.9) * away)


def camera_at(matrix: np.ndarray, lens: tuple[np.ndarray, np.ndarray] = LENS) -> Camera:
    return Camera(*lens, matrix[:3, :3], matrix[:3, 3], WIDTH, HEIGHT)


def corners(
    rng: np.random.Generator, board: np.ndarray, noise: float = 0.2, lens: tuple[np.ndarray, np.ndarray] = LENS
) -> Corners:
    """The board's corners as a lens shows them, off by `noise` pixels."""
    pixels, _ = cv2.projectPoints(BOARD.points, cv2.Rodrigues(board[:3, :3])[0], board[:3, 3], *lens)
    return Corners(BOARD.points, (pixels[:, 0] + noise * rng.normal(size=(54, 2))).astype(np.float32))


def calibrated(rng: np.random.Generator) -> Camera:
    """A camera with LENS, calibrated from 13 views of a board."""
    views: list[BoardView] = []
    while len(views) < 13:
        turn = Rotation.from_rotvec(np.deg2rad(rng.uniform(-35, 35, 3))).as_matrix()
        board = pose(turn, [*rng.uniform(-0.08, 0.08, 2), rng.uniform(0.35, 0.6)]) @ pose(np.eye(3), [-0.1, -0.0625, 0])
        seen = corners(rng, board)
        if (seen.pixels > 5).all() and (seen.pixels < [WIDTH - 6, HEIGHT - 6]).all():
            views.append(BoardView(str(len(views)), seen))
    camera, found = fit(views, (WIDTH, HEIGHT)).camera, [view.corners for view in views]
    return add_intrinsics_covariance(camera, found, [board_pose(camera, c) for c in found])


def calibrated_and_posed(rng: np.random.Generator) -> tuple[Camera, Camera]:
    """A camera over the table, and what one knows of it: calibrated from 13 views, posed from a board on the table."""
    true, camera = over_the_table(rng), calibrated(rng)
    seen = corners(rng, np.linalg.inv(true) @ BOARD_TO_BASE)
    return camera_at(true), from_corners(camera, seen, BOARD_TO_BASE)


ROUND = np.linspace(0, 2 * np.pi, 40, endpoint=False)
CONE = np.vstack([np.c_[0.02 * np.cos(ROUND), 0.02 * np.sin(ROUND), -0.02 + 0 * ROUND], [0, 0, 0.02]])
PYRAMID = np.array([[0.02 * i, 0.02 * j, -0.02] for i in (-1, 1) for j in (-1, 1)] + [[0, 0, 0.02]])

OBJECTS = {
    "cube": ('type="box" size=".015 .015 .015"', Solid(0.015)),
    "brick": ('type="box" size=".03 .015 .015"', Solid(0.015)),
    "tower": ('type="box" size=".01 .01 .03"', Solid(0.03)),
    "can": ('type="cylinder" size=".02 .03"', Solid(0.03)),
    "coin": ('type="cylinder" size=".015 .005"', Solid(0.005)),
    "ball": ('type="sphere" size=".018"', Solid(0.018, "ball")),
    "egg": ('type="ellipsoid" size=".02 .014 .016"', Solid(0.016, "ball")),
    "cone": ('type="mesh" mesh="cone"', Solid(0.02, "cone")),
    "pyramid": ('type="mesh" mesh="pyramid"', Solid(0.02, "cone")),
}
"""How MuJoCo makes them, and what is known of them."""

SOLIDS = {name: solid for name, (_, solid) in OBJECTS.items()}


def numbers(array: ArrayLike) -> str:
    return " ".join(f"{v:.9g}" for v in np.ravel(array))


def table(
    rng: np.random.Generator, names: Sequence[str], camera_poses: Sequence[np.ndarray]
) -> tuple[mujoco.MjModel, mujoco.MjData, np.ndarray]:
    """Objects standing on a table, turned at random, and cameras: MuJoCo's model and data, and the centers (n, 3)."""
    places: list[np.ndarray] = []
    while len(places) < len(names):
        place = np.array([rng.uniform(0.04, 0.28), rng.uniform(-0.14, 0.14)])
        if all(np.linalg.norm(place - other) > 0.1 for other in places):
            places.append(place)
    centers = np.array([[*place, SOLIDS[name].half_height] for place, name in zip(places, names, strict=True)])
    bodies = "".join(
        f'<body pos="{numbers(center)}" euler="0 0 {rng.uniform(0, 360)}"><geom name="{i}" {OBJECTS[name][0]}/></body>'
        for i, (center, name) in enumerate(zip(centers, names, strict=True))
    )
    cameras = "".join(
        f'<camera name="{i}" pos="{numbers(m[:3, 3])}" xyaxes="{numbers([m[:3, 0], -m[:3, 1]])}" fovy="48.5"/>'
        for i, m in enumerate(camera_poses)
    )
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><asset><mesh name="cone" vertex="{numbers(CONE)}" inertia="convex"/>
        <mesh name="pyramid" vertex="{numbers(PYRAMID)}" inertia="convex"/></asset>
        <worldbody><geom name="table" type="plane" size="2 2 .1"/>{cameras}{bodies}</worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data, centers


def cast(model: mujoco.MjModel, data: mujoco.MjData, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """What MuJoCo's rays hit in each pixel: geom ids (h, w) and depths (h, w)."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    plane = np.stack([u, v, np.ones_like(u)], -1).reshape(-1, 3) @ np.linalg.inv(camera.matrix).T
    length = np.linalg.norm(plane, axis=1)
    rays = (plane / length[:, None]) @ camera.rotation.T
    ids, distance = np.full(len(rays), -1, np.int32), np.zeros(len(rays))
    mujoco.mj_multiRay(
        model, data, camera.position, rays.ravel(), None, 1, -1, ids, distance, None, len(rays), mujoco.mjMAXVAL
    )
    shape = camera.height, camera.width
    return ids.reshape(shape), np.where(ids < 0, np.inf, distance / length).reshape(shape)


def boxes(model: mujoco.MjModel, ids: np.ndarray, count: int) -> np.ndarray:
    """The boxes (n, 4) around the objects in a segmentation (h, w)."""
    found = []
    for i in range(count):
        rows, columns = np.nonzero(ids == model.geom(str(i)).id)
        found.append([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
    return np.array(found, float)


NAMES = tuple(SOLIDS)


def detections(boxes: np.ndarray, names: Sequence[str]) -> Detections:
    """In the order given: the first is the most confident."""
    ids = np.array([NAMES.index(name) for name in names], int)
    return Detections(boxes, np.linspace(0.9, 0.5, len(ids)), ids, NAMES)


many_boxes = jax.jit(jax.vmap(solid_box, (None, 0, 0, 0, 0, None)))


def ideal_boxes(
    camera: Camera,
    centers: np.ndarray,
    radii: np.ndarray,
    names: Sequence[str],
    half_heights: Sequence[float] | np.ndarray | None = None,
    skew: float = 0.0,
) -> np.ndarray:
    """The boxes (n, 4) of solids of known width."""
    if half_heights is None:
        half_heights = [SOLIDS[name].half_height for name in names]
    forms = np.array([FORMS[SOLIDS[name].form] for name in names])
    return np.asarray(many_boxes(camera, centers, radii, np.array(half_heights), forms, skew))


def box_around(camera: Camera, points: np.ndarray) -> np.ndarray:
    """The box (4,) around points (n, 3) of the base frame, as OpenCV projects them."""
    rotation, position = np.asarray(camera.rotation), np.asarray(camera.position)
    turn, _ = cv2.Rodrigues(rotation.T)
    lens = np.asarray(camera.matrix), np.asarray(camera.distortion)
    pixels, _ = cv2.projectPoints(points, turn, -rotation.T @ position, *lens)
    return np.concatenate([pixels[:, 0].min(0), pixels[:, 0].max(0)]) + 0.5


def on_the_table(rng: np.random.Generator, names: Sequence[str]) -> np.ndarray:
    places = np.c_[rng.uniform(0.05, 0.28, len(names)), rng.uniform(-0.12, 0.12, len(names))]
    return np.c_[places, [SOLIDS[name].half_height for name in names]]


def random_lens(rng: np.random.Generator, coefficients: int) -> tuple[np.ndarray, np.ndarray]:
    """Distortion such as lenses have: the corners of the image move by up to some 60 pixels."""
    scale = np.array([0.25, 0.08, 2e-3, 2e-3, 0.03, 0.1, 0.03, 0.01])[:coefficients]
    focal = rng.uniform(450, 700)
    matrix = np.array([[focal, 0, rng.uniform(300, 340)], [0, focal * rng.uniform(0.95, 1.05), 240], [0, 0, 1]])
    return matrix, scale * rng.uniform(-1, 1, coefficients)
