"""How well a camera is known: against the errors of many calibrations."""

import numpy as np
from helpers import tabletop
from helpers.tabletop import HEIGHT, LENS, WIDTH, over_the_table, pose
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from arm5dof.vision.calibration.checkerboard import Checkerboard
from arm5dof.vision.calibration.covariance import add_pose, placement_covariance
from arm5dof.vision.calibration.intrinsics import calibrate
from arm5dof.vision.calibration.views import find_views
from arm5dof.vision.camera import Camera


def own_error(camera, true):
    """What must be done to the true pose (4, 4) to get the camera's, (6,): scipy's turn and shift in its own frame."""
    move = np.linalg.inv(true) @ pose(np.asarray(camera.rotation), np.asarray(camera.position))
    return np.concatenate([Rotation.from_matrix(move[:3, :3]).as_rotvec(), move[:3, 3]])


def covered(distances, dimensions):
    return [np.mean(np.array(distances) < chi2.ppf(nominal, dimensions)) for nominal in (0.5, 0.68, 0.95)]


def test_the_covariance_holds_the_stated_deviations(photographs):
    result = calibrate(find_views(photographs, Checkerboard(9, 6, 0.025)))
    deviations = np.sqrt(np.diag(result.camera.covariance))
    np.testing.assert_allclose(deviations[:9], result.deviations, rtol=1e-9)
    assert not deviations[9:].any() and not result.camera.has_extrinsics


def test_intrinsics_and_pose_are_off_as_stated():
    """The true ones lie within the covariance as often as they should, errors of both at once."""
    rng = np.random.default_rng(0)
    lens, both = [], []
    for _ in range(150):
        true, camera = tabletop.calibrated_and_posed(rng)
        wrong = np.asarray(camera.matrix) - LENS[0]
        error = [wrong[0, 0], wrong[1, 1], wrong[0, 2], wrong[1, 2], *(camera.distortion - LENS[1])]
        error = np.concatenate([error, own_error(camera, pose(true.rotation, true.position))])
        covariance = np.asarray(camera.covariance)
        lens.append(error[:9] @ np.linalg.solve(covariance[:9, :9], error[:9]))
        both.append(error @ np.linalg.solve(covariance, error))
    for nominal, *shares in zip((0.5, 0.68, 0.95), covered(lens, 9), covered(both, 15), strict=True):
        assert all(abs(share - nominal) < 0.1 for share in shares)


def test_a_board_out_of_place_takes_the_camera_with_it():
    rng = np.random.default_rng(1)
    camera = over_the_table(rng)
    seen = np.linalg.inv(camera) @ tabletop.BOARD_TO_BASE
    expected = placement_covariance((1e-3, 5e-3), seen)
    errors = []
    for _ in range(4000):
        turn = Rotation.from_rotvec(5e-3 * rng.normal(size=3)).as_matrix()
        moved = tabletop.BOARD_TO_BASE @ pose(turn, 1e-3 * rng.normal(size=3)) @ np.linalg.inv(seen)
        errors.append(own_error(tabletop.camera_at(moved), camera))
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        np.cov(np.transpose(errors)) / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.1
    )


def test_a_camera_of_which_nothing_is_known_stays_one():
    camera = Camera(*LENS, np.eye(3), np.zeros(3), WIDTH, HEIGHT, has_extrinsics=False)
    posed = add_pose(camera, lambda c: pose(np.eye(3), [0, 0, 1]), np.eye(6))
    assert posed.has_extrinsics and posed.covariance is None and posed.position[2] == 1
