"""What calibration would tell of a simulated camera, were it real: cameras that are known only so well.

The board is photographed from 13 sides, as the paper's camera was, then once on the table; nothing is drawn, corners
are found as far from where they are as in good photographs.
"""

from __future__ import annotations

import cv2
import numpy as np

from arm5dof.vision.calibration import covariance as uncertainty
from arm5dof.vision.calibration.boards import Checkerboard, Corners
from arm5dof.vision.calibration.extrinsics import from_corners
from arm5dof.vision.calibration.intrinsics import View, board_pose, fit
from arm5dof.vision.camera import Camera

VIEWS = 13
BOARD = Checkerboard(9, 6, 0.025)
NOISE = 0.2
"""Standard deviation of a corner along each axis, pixels: more than the 0.13 that the sample photographs show."""
TILT = np.deg2rad(35)
"""How far the board is turned about each axis, at most."""
PLACED = 5e-4, np.deg2rad(0.1)
"""How well one knows where the board on the table lies: standard deviations along and about each axis, m and rad."""

MIDDLE = np.array([-0.1, -0.0625, 0.0])
"""What takes the board's origin to its middle, metres."""


def rehearse(camera: Camera, rng: np.random.Generator) -> Camera:
    """What one would know of a camera (posed, without errors) after calibrating it and finding its pose from a board on
    the table, with the covariance that one would state."""
    known = calibrated(camera, rng)
    lying = _pose(np.diag([1.0, -1.0, -1.0]), np.array([0.15, 0.0, 0.0])) @ _pose(np.eye(3), MIDDLE)
    turn, shift = PLACED[1] * rng.normal(size=3), PLACED[0] * rng.normal(size=3)
    true = lying @ _pose(cv2.Rodrigues(turn)[0], shift)
    seen = _corners(camera, np.linalg.inv(_pose(np.asarray(camera.rotation), np.asarray(camera.position))) @ true, rng)
    return from_corners(known, seen, lying, PLACED)


def calibrated(camera: Camera, rng: np.random.Generator) -> Camera:
    """The intrinsics alone. Views in which not all of the board is in the picture are not taken."""
    size, views = (camera.width, camera.height), list[View]()
    nearest = 0.25 * np.max(np.diag(camera.matrix)[:2] / size)
    while len(views) < VIEWS:
        turn, _ = cv2.Rodrigues(rng.uniform(-TILT, TILT, 3))
        away = rng.uniform(nearest, 1.6 * nearest)
        aside = rng.uniform(-0.5, 0.5, 2) * away * np.array(size) / np.diag(camera.matrix)[:2]
        seen = _corners(camera, _pose(turn, np.array([*aside, away])) @ _pose(np.eye(3), MIDDLE), rng)
        if (seen.pixels > 5).all() and (seen.pixels < np.array(size) - 6).all():
            views.append(View(str(len(views)), seen))
    known, corners = fit(views, size).camera, [view.corners for view in views]
    return uncertainty.with_intrinsics(known, corners, [board_pose(known, each) for each in corners])


def _corners(camera: Camera, board: np.ndarray, rng: np.random.Generator) -> Corners:
    """The corners of a board at the pose `board` (4, 4) in the camera's frame."""
    turn, _ = cv2.Rodrigues(board[:3, :3])
    lens = np.asarray(camera.matrix, float), np.asarray(camera.distortion, float)
    pixels, _ = cv2.projectPoints(BOARD.points, turn, board[:3, 3], *lens)
    noise = NOISE * rng.normal(size=(len(BOARD.points), 2))
    return Corners(BOARD.points, (pixels[:, 0] + noise).astype(np.float32))


def _pose(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, position
    return matrix
