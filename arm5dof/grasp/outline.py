"""How large an object of a class looks from where the camera is: what looks otherwise is of another class."""

from __future__ import annotations

from functools import cache

import mujoco
import numpy as np

from arm5dof.vision.camera import Camera
from arm5dof.vision.objects import BOX, CATALOGUE, CLASS_NAMES, CYLINDER, Part

YAWS = 12
"""Half a turn in so many steps: objects are point-symmetric."""
ROUND = 60
"""Points on a sphere; a quarter of them on each rim of a cylinder."""


def size_misfit(name: str, xyxy: np.ndarray, position: np.ndarray, camera: Camera) -> float:
    """How much wider, narrower, higher or lower a box is than one around an object of a class at a place would be.

    Args:
        name: Of the class.
        xyxy: Edges of the box, (4,), pixels.
        position: Of the object's center, upright, (3,), metres, base frame.
        camera: What took the image.

    Returns:
        The logarithm of the ratio of the sizes, without its sign: the larger of both directions, at the yaw that
        explains the box best.
    """
    to_camera = np.asarray(camera.rotation, float).T
    local = (_surface(CLASS_NAMES.index(name)) + position - np.asarray(camera.position, float)) @ to_camera.T
    pixels = camera.model.project(local.reshape(-1, 3), np.zeros(3), np.zeros(3), camera.opencv).pixels
    expected = np.ptp(pixels.reshape(*local.shape[:2], 2), axis=1)
    found = np.asarray(xyxy[2:], float) - xyxy[:2]
    return float(np.abs(np.log(found / expected)).max(1).min())


@cache
def _surface(index: int) -> np.ndarray:
    """Points on the surface of a class's object, turned by each yaw, (YAWS, n, 3), metres."""
    points = np.concatenate([_points(part) for part in CATALOGUE[index].parts])
    angles = np.pi * np.arange(YAWS) / YAWS
    c, s, zero, one = np.cos(angles), np.sin(angles), np.zeros(YAWS), np.ones(YAWS)
    turns = np.stack([np.stack(row, -1) for row in ((c, -s, zero), (s, c, zero), (zero, zero, one))], 1)
    return np.einsum("yij,nj->yni", turns, points)


def _points(part: Part) -> np.ndarray:
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, part.quaternion)
    return _upright(part) @ rotation.reshape(3, 3).T + part.position


def _upright(part: Part) -> np.ndarray:
    if part.kind == BOX:
        return np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T * part.size
    if part.kind == CYLINDER:
        angles = np.linspace(0, 2 * np.pi, ROUND // 4, endpoint=False)
        rim = part.size[0] * np.stack([np.cos(angles), np.sin(angles)], 1)
        return np.concatenate([np.insert(rim, 2, z, axis=1) for z in (-part.size[1], part.size[1])])
    k: np.ndarray = np.arange(ROUND) + 0.5  # Fibonacci's lattice.
    height, angles = 1 - 2 * k / ROUND, np.pi * (1 + 5**0.5) * k
    ring = np.sqrt(1 - height**2)
    return part.size[0] * np.stack([ring * np.cos(angles), ring * np.sin(angles), height], 1)
