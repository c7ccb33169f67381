"""What one photograph tells of a camera's pose, with errors of corners that hang together as real ones do."""

import cv2
import numpy as np
import pytest
from helpers.tabletop import BOARD
from hypothesis import given
from hypothesis import strategies as st

from arm5dof.vision.calibration.boards import Corners
from arm5dof.vision.calibration.corner_noise import corner_covariance
from arm5dof.vision.calibration.covariance import linearize, pose_covariance
from arm5dof.vision.calibration.fit import fit
from arm5dof.vision.calibration.views import board_pose, find_views

APART = np.linalg.norm(BOARD.points[:, None] - BOARD.points[None], axis=-1) / BOARD.square
PLACE = BOARD.points[:, :2] / BOARD.square - [4, 2.5]


@pytest.fixture(scope="module")
def calibrated(photographs):
    views = find_views(photographs, BOARD)
    return fit(views.found, views.size).camera, [view.corners for view in views.found]


def by_pose(camera, corners):
    """Residuals and their derivative by the board's pose that fits best."""
    residual, jacobian = linearize(camera, corners, board_pose(camera, corners))
    return residual, jacobian[:, -6:]


@pytest.mark.parametrize(
    "half", [PLACE[:, 0] < 0.1, PLACE[:, 1] < 0, PLACE.sum(1) < 0.1], ids=["left", "top", "corner"]
)
def test_poses_by_halves_of_a_real_board_differ_as_stated(calibrated, half):
    """As if corners were independent they differ by two standard deviations where it should be one."""
    camera, seen = calibrated
    as_stated, independent = [], []
    for corners in seen:
        residual, jacobian = by_pose(camera, corners)
        parts = [Corners(corners.points[some], corners.pixels[some]) for some in (half, ~half)]
        one, other = (np.linalg.inv(board_pose(camera, part)) for part in parts)
        move = np.linalg.inv(one) @ other
        off = np.concatenate([cv2.Rodrigues(move[:3, :3])[0].ravel(), move[:3, 3]])
        effect = np.zeros((6, len(residual)))
        for part, some, sign in zip(parts, (half, ~half), (-1, 1), strict=True):
            effect[:, np.repeat(some, 2)] = sign * np.linalg.pinv(by_pose(camera, part)[1])
        for covariance, found in (
            (corner_covariance(corners.points, residual, jacobian), as_stated),
            (np.eye(len(residual)) * (residual @ residual) / (len(residual) - 6), independent),
        ):
            found.append(off @ np.linalg.solve(effect @ covariance @ effect.T, off) / 6)
    assert 0.8 < np.sqrt(np.mean(as_stated)) < 1.3
    assert np.sqrt(np.mean(independent)) > 1.8


def test_a_real_photograph_says_less_than_independent_corners_would(calibrated):
    camera, seen = calibrated
    ratios = []
    for corners in seen:
        board = board_pose(camera, corners)
        ours, independent = (pose_covariance(camera, corners, board, alone) for alone in (False, True))
        ratios.append(np.sqrt(np.diag(ours) / np.diag(independent)).mean())
    assert min(ratios) > 1.5 and max(ratios) < 5 and 2.5 < np.mean(ratios) < 3.5


@pytest.mark.parametrize("length", [0.0, 2.0])
def test_poses_are_off_as_stated_whether_or_not_errors_correlate(calibrated, length):
    camera, seen = calibrated
    rng = np.random.default_rng(0)
    correlation = np.exp(-APART / length) if length else np.eye(len(APART))
    root, off = np.linalg.cholesky(correlation), []
    for corners in 10 * seen:
        _, jacobian = by_pose(camera, corners)
        errors = 0.2 * (root @ rng.normal(size=(len(root), 2))).ravel()
        solve = np.linalg.pinv(jacobian)
        step = solve @ errors
        found = solve @ corner_covariance(corners.points, errors - jacobian @ step, jacobian) @ solve.T
        off.append(step @ np.linalg.solve(found, step) / 6)
    assert 0.8 < np.mean(off) < 1.5


@given(st.integers(0, 999), st.integers(4, 54), st.sampled_from([0.0, 1e-12, 0.2]))
def test_whatever_corners_are_seen_there_is_a_covariance(seed, count, noise):
    rng = np.random.default_rng(seed)
    some = rng.permutation(len(BOARD.points))[:count]
    jacobian = rng.normal(size=(2 * count, 6))
    found = corner_covariance(BOARD.points[some], noise * rng.normal(size=2 * count), jacobian)
    assert found.shape == (2 * count, 2 * count) and np.isfinite(found).all()
    assert np.linalg.eigvalsh(found).min() >= -1e-12 * np.abs(found).max()
    np.testing.assert_array_equal(found, found.T)
