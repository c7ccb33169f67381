"""A fisheye camera, and photographs of a board drawn through it by OpenCV."""

from __future__ import annotations

import functools
from pathlib import Path

import cv2
import numpy as np
from helpers.photographs import draw

from arm5dof.vision.calibration.checkerboard import Checkerboard
from arm5dof.vision.camera import Camera

FISHEYE = Camera(
    matrix=np.array([[420, 0, 401.5], [0, 421, 297.5], [0, 0, 1.0]]),
    distortion=np.array([0.02, -0.01, 0.004, -0.001]),
    rotation=np.eye(3),
    position=np.zeros(3),
    width=800,
    height=600,
    has_extrinsics=False,
    lens="fisheye",
)

WIDE = FISHEYE.replace(matrix=FISHEYE.matrix * [[0.6, 1, 1], [1, 0.6, 1], [1, 1, 1]])
"""70 degrees from the optical axis to the left and right."""

BOARD = Checkerboard(9, 6, 0.02)


@functools.cache
def rays(focal: float) -> np.ndarray:
    """Where pixels of a camera, and those between them, look on the plane at depth 1, (h, w, 2)."""
    camera = next(each for each in (FISHEYE, WIDE) if each.matrix[0, 0] == focal)
    u, v = (np.arange(2 * n) / 2 - 0.25 for n in (camera.width, camera.height))
    pixels = np.stack(np.meshgrid(u, v), -1)
    exact = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-9)
    return cv2.fisheye.undistortPoints(pixels.reshape(-1, 1, 2), *camera.opencv, criteria=exact).reshape(pixels.shape)


def photograph(camera: Camera, pose: np.ndarray) -> np.ndarray:
    """What a fisheye camera sees of the board at a pose (4, 4) in its frame."""
    drawing, metres_per_pixel, origin = draw(BOARD)
    homography = np.linalg.inv(np.c_[pose[:3, :2], pose[:3, 3]])
    place = rays(camera.matrix[0, 0]) @ homography[:, :2].T + homography[:, 2]
    in_front = place[..., 2:] > 0  # The depth of what is seen, inverted.
    place = np.where(in_front, place[..., :2] / place[..., 2:] / metres_per_pixel + origin, -1e6).astype(np.float32)
    image = cv2.remap(drawing, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderValue=200)
    return cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)


def photographs(folder: Path, camera: Camera, count: int, widest: float = 50) -> list[Path]:
    """Photographs of the whole board up to so many degrees from the optical axis, all over the image."""
    rng, paths = np.random.default_rng(0), list[Path]()
    while len(paths) < count:
        away, around = np.deg2rad(widest) * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
        side = np.array([np.cos(around), np.sin(around), 0])
        facing, _ = cv2.Rodrigues(away * np.cross([0, 0, 1], side))
        tilt, _ = cv2.Rodrigues(np.array([*rng.uniform(-0.7, 0.7, 2), rng.uniform(-1, 1)]))
        pose = np.eye(4)
        pose[:3, :3] = facing @ tilt
        pose[:3, 3] = rng.uniform(0.14, 0.25) * facing[:, 2] - pose[:3, :3] @ [0.08, 0.05, 0]
        corners = BOARD.points + [[[x, y, 0]] for x in (-0.04, 0.04) for y in (-0.04, 0.04)]
        local = corners.reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]
        if local[:, 2].min() < 0.01:
            continue
        pixels, _ = cv2.fisheye.projectPoints(local[:, None], np.zeros(3), np.zeros(3), *camera.opencv)
        if (pixels > 5).all() and (pixels < [camera.width - 6, camera.height - 6]).all():
            paths.append(folder / f"{len(paths)}.png")
            cv2.imwrite(str(paths[-1]), photograph(camera, pose))
    return paths
