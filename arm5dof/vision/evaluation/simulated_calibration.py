"""Simulated calibration: a simulated camera as it would be known if it were real and had been calibrated.

The board is photographed from 13 sides, as the paper's camera was, then once on the table; nothing is drawn, corners
are found as far from where they are as in good photographs.
"""

from __future__ import annotations

import cv2
import numpy as np

from arm5dof.vision.calibration.boards import Corners
from arm5dof.vision.calibration.checkerboard import Checkerboard
from arm5dof.vision.calibration.covariance import add_intrinsics_covariance
from arm5dof.vision.calibration.extrinsics import from_corners
from arm5dof.vision.calibration.fit import fit
from arm5dof.vision.calibration.poses import pose_matrix
from arm5dof.vision.calibration.views import BoardView, board_pose
from arm5dof.vision.camera import Camera

VIEWS = 13
BOARD = Checkerboard(9, 6, 0.025)
CORNER_STD = 0.2
"""Standard deviation of a corner along each axis, pixels: more than the 0.13 that the sample photographs show."""
MAX_TILT = np.deg2rad(35)
"""How far the board is turned about each axis, at most."""
PLACEMENT_STD = 5e-4, np.deg2rad(0.1)
"""How well one knows where the board on the table lies: standard deviations along and about each axis, metres and
radians."""

CENTER = np.array([-0.1, -0.0625, 0.0])
"""What takes the board's origin to its center, metres."""


def simulate_calibration(camera: Camera, rng: np.random.Generator) -> Camera:
    """Calibrate a simulated camera, then find its pose from a board on the table.

    Args:
        camera: The true camera, with extrinsics.
        rng: Where the views and their errors come from.

    Returns:
        The camera as it would then be known, with the covariance that calibration would state.
    """
    known = simulate_intrinsics(camera, rng)
    lying = pose_matrix(np.diag([1.0, -1.0, -1.0]), np.array([0.15, 0.0, 0.0])) @ pose_matrix(np.eye(3), CENTER)
    turn, shift = PLACEMENT_STD[1] * rng.normal(size=3), PLACEMENT_STD[0] * rng.normal(size=3)
    true = lying @ pose_matrix(cv2.Rodrigues(turn)[0], shift)
    seen = _corners(
        camera, np.linalg.inv(pose_matrix(np.asarray(camera.rotation), np.asarray(camera.position))) @ true, rng
    )
    return from_corners(known, seen, lying, PLACEMENT_STD)


def simulate_intrinsics(camera: Camera, rng: np.random.Generator) -> Camera:
    """The same without the pose. Views in which not all of the board is in the image are not taken."""
    size, views = (camera.width, camera.height), list[BoardView]()
    nearest = 0.25 * np.max(np.diag(camera.matrix)[:2] / size)
    while len(views) < VIEWS:
        turn, _ = cv2.Rodrigues(rng.uniform(-MAX_TILT, MAX_TILT, 3))
        away = rng.uniform(nearest, 1.6 * nearest)
        aside = rng.uniform(-0.5, 0.5, 2) * away * np.array(size) / np.diag(camera.matrix)[:2]
        seen = _corners(camera, pose_matrix(turn, np.array([*aside, away])) @ pose_matrix(np.eye(3), CENTER), rng)
        if (seen.pixels > 5).all() and (seen.pixels < np.array(size) - 6).all():
            views.append(BoardView(str(len(views)), seen))
    known, corners = fit(views, size).camera, [view.corners for view in views]
    return add_intrinsics_covariance(known, corners, [board_pose(known, each) for each in corners])


def _corners(camera: Camera, board: np.ndarray, rng: np.random.Generator) -> Corners:
    """The corners of a board at the pose `board` (4, 4) in the camera's frame."""
    turn, _ = cv2.Rodrigues(board[:3, :3])
    pixels = camera.model.project(BOARD.points, turn, board[:3, 3], camera.opencv).pixels
    noise = CORNER_STD * rng.normal(size=(len(BOARD.points), 2))
    return Corners(BOARD.points, (pixels + noise).astype(np.float32))
