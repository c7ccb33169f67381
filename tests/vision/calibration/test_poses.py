"""Poses as people write them, against scipy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from arm5dof.errors import UserError
from arm5dof.vision.calibration.poses import lying_board, pose_from_quaternion


def test_a_quaternion_is_scipys():
    rotation = Rotation.random(rng=np.random.default_rng(0))
    pose = pose_from_quaternion([0.1, 0.2, 0.3, *np.roll(1.005 * rotation.as_quat(), 1)])
    np.testing.assert_allclose(pose[:3, :3], rotation.as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(pose[:, 3], [0.1, 0.2, 0.3, 1])
    for numbers in ([0] * 6, [0, 0, 0, 1, 0, 0, np.nan], [0, 0, 0, np.inf, 0, 0, 0]):
        with pytest.raises(UserError, match="a pose is seven numbers"):
            pose_from_quaternion(numbers)
    with pytest.raises(UserError, match=r"has length 1, not 1\.02"):
        pose_from_quaternion([0, 0, 0, 1.02, 0, 0, 0])


def test_a_lying_board_has_its_z_axis_down_and_its_rows_turned():
    turn = np.deg2rad(30)
    pose = lying_board(0.2, 0.1, 0.01, turn)
    np.testing.assert_allclose(pose[:3, 0], [np.cos(turn), np.sin(turn), 0], atol=1e-12)
    np.testing.assert_allclose(pose[:3, 2], [0, 0, -1], atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1) and pose[:3, 3].tolist() == [0.2, 0.1, 0.01]
