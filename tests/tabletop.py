"""Cameras over a table, calibrated and posed with noise as real ones are."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from arm5dof.vision import uncertainty
from arm5dof.vision.boards import Checkerboard, Corners
from arm5dof.vision.calibrate import View, board_pose, fit
from arm5dof.vision.camera import Camera

WIDTH, HEIGHT = 640, 480
BOARD = Checkerboard(9, 6, 0.025)
LENS = np.array([[533, 0, 342.0], [0, 532, 233], [0, 0, 1]]), np.array([-0.26, 0.04, 1.5e-3, -2e-4, 0.12])

BOARD_TO_BASE = np.eye(4)
BOARD_TO_BASE[:3, :3] = np.diag([1, -1, -1])
BOARD_TO_BASE[:3, 3] = 0.05, 0.06, 0


def pose(rotation, position):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, position
    return matrix


def over_the_table(rng, low=35, high=85):
    """A camera's pose (4, 4), 0.6 to 0.9 m from the middle of the table, so many degrees above it, a little rolled."""
    height, around = np.deg2rad(rng.uniform(low, high)), rng.uniform(0, 2 * np.pi)
    away = np.array([np.cos(height) * np.cos(around), np.cos(height) * np.sin(around), np.sin(height)])
    x = np.cross(-away, [0, 0, 1])
    x /= np.linalg.norm(x)
    level = np.stack([x, np.cross(-away, x), -away], axis=1)
    roll = Rotation.from_euler("z", rng.uniform(-0.3, 0.3)).as_matrix()
    return pose(level @ roll, [0.15, 0, 0] + rng.uniform(0.6, 0.9) * away)


def camera_at(matrix, lens=LENS):
    return Camera(*lens, matrix[:3, :3], matrix[:3, 3], WIDTH, HEIGHT)


def corners(rng, board, noise=0.2):
    """The board's corners as the true lens shows them, off by `noise` pixels."""
    pixels, _ = cv2.projectPoints(BOARD.points, cv2.Rodrigues(board[:3, :3])[0], board[:3, 3], *LENS)
    return Corners(BOARD.points, (pixels[:, 0] + noise * rng.normal(size=(54, 2))).astype(np.float32))


def calibrated(rng):
    """A camera with LENS, calibrated from 13 views of a board."""
    views = []
    while len(views) < 13:
        turn = Rotation.from_rotvec(np.deg2rad(rng.uniform(-35, 35, 3))).as_matrix()
        board = pose(turn, [*rng.uniform(-0.08, 0.08, 2), rng.uniform(0.35, 0.6)]) @ pose(np.eye(3), [-0.1, -0.0625, 0])
        seen = corners(rng, board)
        if (seen.pixels > 5).all() and (seen.pixels < [WIDTH - 6, HEIGHT - 6]).all():
            views.append(View(str(len(views)), seen))
    camera, seen = fit(views, (WIDTH, HEIGHT)).camera, [view.corners for view in views]
    return uncertainty.with_intrinsics(camera, seen, [board_pose(camera, c) for c in seen])


def calibrated_and_posed(rng):
    """A camera over the table, and what one knows of it: calibrated from 13 views, posed from a board on the table."""
    true, camera = over_the_table(rng), calibrated(rng)
    seen = corners(rng, np.linalg.inv(true) @ BOARD_TO_BASE)
    noise = uncertainty.board_noise(camera, seen, board_pose(camera, seen))
    found = uncertainty.with_pose(camera, lambda c: BOARD_TO_BASE @ np.linalg.inv(board_pose(c, seen)), noise)
    return camera_at(true), found
