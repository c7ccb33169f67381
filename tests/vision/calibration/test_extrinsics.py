"""Where cameras stand: boards drawn at known places and held by a known hand."""

import cv2
import numpy as np
import pytest
from helpers.photographs import BOARD, CAMERA, KNOWN, TRUE, draw, hand_poses, photograph, photograph_board, poses

from arm5dof.errors import UserError
from arm5dof.vision.calibration.charuco import Charuco
from arm5dof.vision.calibration.checkerboard import Checkerboard
from arm5dof.vision.calibration.extrinsics import from_board, from_hand


@pytest.mark.parametrize("board", [Charuco(8, 6, 0.03, 0.022), Checkerboard(8, 5, 0.03)], ids=str)
@pytest.mark.parametrize("turn", [0.3, 2.9])
def test_extrinsics_from_a_board_at_a_known_pose(board, turn, tmp_path):
    """The board lies on the table, upright or upside down in the image; the camera's pose comes out the same."""
    pose = next(poses(np.random.default_rng(1), 1, (0.1, 0.06)))
    spin = np.eye(4)
    spin[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    center = np.eye(4)
    center[:2, 3] = 0.1, 0.06
    pose = pose @ center @ spin @ np.linalg.inv(center)
    path = tmp_path / "board.png"
    cv2.imwrite(str(path), photograph(*draw(board), pose))
    board_to_base = np.array([[0, 1, 0, 0.2], [1, 0, 0, 0.1], [0, 0, -1, 0], [0, 0, 0, 1.0]])
    camera = from_board(TRUE, path, board, board_to_base)
    expected = board_to_base @ np.linalg.inv(pose)
    np.testing.assert_allclose(camera.position, expected[:3, 3], atol=1e-3)
    np.testing.assert_allclose(camera.rotation, expected[:3, :3], atol=3e-3)
    assert camera.has_extrinsics and camera.position[2] > 0.3

    with pytest.raises(UserError, match="640x480 pixels and the camera 320x240"):
        from_board(TRUE.replace(width=320, height=240), path, board, board_to_base)
    with pytest.raises(UserError, match="does not show the 6x9 checkerboard"):
        from_board(TRUE, path, Checkerboard(6, 9, 0.025), board_to_base)
    if isinstance(board, Checkerboard):
        with pytest.raises(UserError, match="does not show the 9x7 checkerboard; 1 of the 1 show one of 8x5 inner"):
            from_board(TRUE, path, Checkerboard(9, 7, 0.025), board_to_base)
    cv2.imwrite(str(path), photograph(*draw(Checkerboard(7, 5, 0.03)), pose))
    with pytest.raises(UserError, match="after half a turn"):
        from_board(TRUE, path, Checkerboard(7, 5, 0.03), board_to_base)
    cv2.imwrite(str(path), photograph(*draw(board), pose))
    wrong = TRUE.replace(distortion=np.array([3.0, 0, 0, 0, 0]))
    with pytest.raises(UserError, match="is this the camera that was calibrated"):
        from_board(wrong, path, board, board_to_base)


@pytest.fixture(scope="module")
def shots(tmp_path_factory):
    return photograph_board(tmp_path_factory.mktemp("shots"))


@pytest.mark.parametrize("eye_in_hand", [True, False])
def test_a_moving_hand_tells_where_the_camera_is(shots, eye_in_hand):
    paths, seen = shots
    told = []
    found = from_hand(
        KNOWN, hand_poses(seen, eye_in_hand), paths, BOARD, eye_in_hand, lambda done, name: told.append((done, name))
    )
    np.testing.assert_allclose(found.camera.position, CAMERA[:3, 3], atol=2e-3)
    np.testing.assert_allclose(found.camera.rotation, CAMERA[:3, :3], atol=5e-3)
    assert found.without == [paths[-1].name] and len(found.used) == len(paths) - 1
    assert told[-1] == (len(paths), paths[-1].name) and found.camera.has_extrinsics
    # The pose's own deviations, and on top of them what those of the intrinsics do to it.
    with_lens = np.sqrt(np.diag(found.camera.covariance)[-6:])
    assert (with_lens > np.sqrt(np.diag(found.hand_eye.covariance))).all() and (with_lens < 0.01).all()
