"""Where cameras stand: boards drawn at known places and held by a known hand, on the command line too."""

import json

import cv2
import numpy as np
import pytest
from helpers.photographs import TRUE, draw, photograph, poses
from scipy.spatial.transform import Rotation

from arm5dof.cli import main as cli
from arm5dof.errors import UserError
from arm5dof.runtime import progress
from arm5dof.vision.calibration.boards import Charuco, Checkerboard
from arm5dof.vision.calibration.extrinsics import from_board, from_hand
from arm5dof.vision.camera import Camera

KNOWN = TRUE.replace(covariance=np.diag(np.square([0.5, 0.5, 0.5, 0.5, *[1e-3] * 5, *[0] * 6])))

BOARD = Checkerboard(8, 5, 0.03)


@pytest.mark.parametrize("board", [Charuco(8, 6, 0.03, 0.022), Checkerboard(8, 5, 0.03)], ids=str)
@pytest.mark.parametrize("turn", [0.3, 2.9])
def test_extrinsics_from_a_board_at_a_known_pose(board, turn, tmp_path):
    """The board lies on the table, upright or upside down in the picture; the camera's pose comes out the same."""
    pose = next(poses(np.random.default_rng(1), 1, (0.1, 0.06)))
    spin = np.eye(4)
    spin[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    middle = np.eye(4)
    middle[:2, 3] = 0.1, 0.06
    pose = pose @ middle @ spin @ np.linalg.inv(middle)
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
    with pytest.raises(UserError, match="after half a turn"):
        from_board(TRUE, path, Checkerboard(9, 7, 0.025), board_to_base)
    wrong = TRUE.replace(distortion=np.array([3.0, 0, 0, 0, 0]))
    with pytest.raises(UserError, match="is this the camera that was calibrated"):
        from_board(wrong, path, board, board_to_base)


def matrix(rotation, position):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.as_matrix(), position
    return pose


CAMERA = matrix(Rotation.from_euler("xyz", [0.4, -0.3, 1.1]), [0.05, -0.02, 0.04])
"""On the hand, or beside the arm."""

OTHER = matrix(Rotation.from_euler("xyz", [0.2, 0.1, -0.5]), [0.3, 0.1, 0.02])
"""The board's pose, where it lies or in the hand."""


@pytest.fixture(scope="module")
def shots(tmp_path_factory):
    """Photographs of a board, and its poses (4, 4) in the camera's frame; the last shows none."""
    folder, rng = tmp_path_factory.mktemp("shots"), np.random.default_rng(3)
    seen = list(poses(rng, 10, (0.1, 0.06)))
    paths = [folder / f"{i}.png" for i in range(len(seen) + 1)]
    for path, pose in zip(paths, seen, strict=False):
        cv2.imwrite(str(path), photograph(*draw(BOARD), pose))
    cv2.imwrite(str(paths[-1]), np.full((480, 640), 128, np.uint8))
    return paths, np.array([*seen, seen[0]])


def hands(seen, on_hand):
    """The hand's poses (n, 4, 4) at which the camera sees the board so."""
    return OTHER @ np.linalg.inv(CAMERA @ seen) if on_hand else CAMERA @ seen @ np.linalg.inv(OTHER)


@pytest.mark.parametrize("on_hand", [True, False])
def test_a_moving_hand_tells_where_the_camera_is(shots, on_hand):
    paths, seen = shots
    told = []
    found = from_hand(KNOWN, hands(seen, on_hand), paths, BOARD, on_hand, lambda done, name: told.append((done, name)))
    np.testing.assert_allclose(found.camera.position, CAMERA[:3, 3], atol=2e-3)
    np.testing.assert_allclose(found.camera.rotation, CAMERA[:3, :3], atol=5e-3)
    assert found.without == [paths[-1].name] and len(found.used) == len(paths) - 1
    assert told[-1] == (len(paths), paths[-1].name) and found.camera.has_extrinsics
    # The pose's own deviations, and on top of them what those of the intrinsics do to it.
    with_lens = np.sqrt(np.diag(found.camera.covariance)[-6:])
    assert (with_lens > np.sqrt(np.diag(found.hand_eye.covariance))).all() and (with_lens < 0.01).all()


def command(*words):
    return cli.main(["vision", *map(str, words)])


def test_the_pose_command(tmp_path, capsys):
    """A board on the table, its rows along the base's y axis; or held upright, said by a quaternion."""
    seen = next(poses(np.random.default_rng(4), 1, (0.1, 0.06)))
    cv2.imwrite(str(tmp_path / "board.png"), photograph(*draw(BOARD), seen))
    KNOWN.replace(has_extrinsics=False).save(tmp_path / "camera.yml")
    words = ["pose", tmp_path / "camera.yml", tmp_path / "board.png", "--board", "8x5", "--square", "0.03"]
    quaternion = Rotation.from_euler("xyz", [0.3, 0.5, 0.7])
    w = np.roll(quaternion.as_quat(), 1)
    for i, (at, place) in enumerate(
        [
            ((0.2, 0.1, 0.01, 90), matrix(Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]]), [0.2, 0.1, 0.01])),
            ((0.2, 0.1, 0.01, *w), matrix(quaternion, [0.2, 0.1, 0.01])),
        ]
    ):
        out = tmp_path / f"posed{i}.yml"
        assert command(*words, "--at", *at, "--out", out, "--json") == 0
        said = json.loads(capsys.readouterr().out)
        camera, true = Camera.load(out), place @ np.linalg.inv(seen)
        np.testing.assert_allclose(camera.position, true[:3, 3], atol=1e-3)
        np.testing.assert_allclose(camera.rotation, true[:3, :3], atol=3e-3)
        np.testing.assert_allclose(said["position_m"], camera.position)
        np.testing.assert_allclose(said["rotation"], camera.rotation)
        assert all(0 < v < 2e-3 for v in said["deviations"]["shift_m"]) and max(said["deviations"]["turn_deg"]) < 0.5
    # A board that lies less exactly tells less.
    assert command(*words, "--at", 0.2, 0.1, 0, 90, "--placed", 0.01, 1, "--out", tmp_path / "c.yml", "--json") == 0
    assert min(json.loads(capsys.readouterr().out)["deviations"]["shift_m"]) > 0.01
    assert command(*words, "--at", 0.2, 0.1, 0, 90, "--out", tmp_path / "d.yml") == 0
    said = capsys.readouterr().out
    assert "stands at" in said and "+-" in said and said.endswith(f"camera: {tmp_path / 'd.yml'}\n")
    TRUE.replace(has_extrinsics=False).save(tmp_path / "bare.yml")
    words[1] = tmp_path / "bare.yml"
    assert command(*words, "--at", 0.2, 0.1, 0, 90, "--out", tmp_path / "e.yml") == 0
    assert "how well is unknown" in capsys.readouterr().out and Camera.load(tmp_path / "e.yml").covariance is None


@pytest.mark.parametrize("flag", ["--on-hand", "--beside"])
def test_the_hand_eye_command(shots, flag, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(progress, "PATIENCE_S", -1)
    monkeypatch.setattr(progress, "LINE_EVERY_S", -1)
    paths, seen = shots
    arm = hands(seen, flag == "--on-hand")
    table = write_poses(paths[0].parent / f"poses{flag}.csv", arm, [path.name for path in paths])
    KNOWN.replace(has_extrinsics=False).save(tmp_path / "camera.yml")
    words = ["hand-eye", tmp_path / "camera.yml", table, flag, "--board", "8x5", "--square", "0.03"]
    assert command(*words, "--out", tmp_path / "out.yml") == 0
    said, seen_meanwhile = capsys.readouterr()
    assert "looking for the board: 11/11 photographs" in seen_meanwhile
    assert "10 photographs" in said and "10.png: left out: board not found" in said
    if flag == "--on-hand":
        assert "in the hand frame" in said and not Camera.load(tmp_path / "out.yml").has_extrinsics
        camera, true = Camera.load(tmp_path / "out.yml", arm[2]), arm[2] @ CAMERA
    else:
        camera, true = Camera.load(tmp_path / "out.yml"), CAMERA
    np.testing.assert_allclose(camera.position, true[:3, 3], atol=2e-3)
    np.testing.assert_allclose(camera.rotation, true[:3, :3], atol=5e-3)
    assert camera.has_extrinsics and camera.covariance is not None
    assert command(*words, "--out", tmp_path / "again.yml", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["frame"] == ("hand" if flag == "--on-hand" else "base")
    assert told["without_board"] == ["10.png"] and len(told["used"]) == 10 and told["rotation_deg"] < 0.5


def write_poses(path, arm, names):
    turns = np.roll(Rotation.from_matrix(arm[:, :3, :3]).as_quat(), 1, axis=1)
    rows = [",".join(map(str, [n, *a[:3, 3], *q])) for n, a, q in zip(names, arm, turns, strict=True)]
    path.write_text("\n".join(["image,x,y,z,qw,qx,qy,qz", *rows]))
    return path


def test_bad_input_is_one_line(shots, tmp_path, capfd):
    paths, seen = shots
    KNOWN.replace(has_extrinsics=False).save(tmp_path / "camera.yml")
    (tmp_path / "there.yml").write_text("precious")
    good = write_poses(paths[0].parent / "good.csv", hands(seen, True), [path.name for path in paths])
    lines = good.read_text().splitlines()
    files = {
        "header": "a,b\n1,2",
        "words": "\n".join([lines[0], "0.png,1,2,x,1,0,0,0"]),
        "short": "\n".join([lines[0], "0.png,1,2"]),
        "nan": "\n".join([lines[0], "0.png,nan,0,0,1,0,0,0"]),
        "long": "\n".join([lines[0], "0.png,0,0,0,1,1,0,0"]),
        "absent": "\n".join([lines[0], "absent.png,0,0,0,1,0,0,0"]),
        "few": "\n".join(lines[:4]),
        "still": "\n".join([lines[0], *(f"{i}.png," + lines[1].split(",", 1)[1] for i in range(8))]),
    }
    for name, text in files.items():
        (good.parent / f"{name}.csv").write_text(text)
    (good.parent / "binary.csv").write_bytes(b"\xff\xfe\x00")
    before = sorted(tmp_path.rglob("*"))

    def refused(expected, *words):
        assert command(*words) == 2, expected
        err = capfd.readouterr().err
        assert err.startswith("arm5dof: ") and expected in err and err.count("\n") == 1, err

    board, out = ["--board", "8x5", "--square", "0.03"], ["--out", tmp_path / "out.yml"]
    hand_eye = ["hand-eye", tmp_path / "camera.yml"]
    for name, expected in [
        ("header", "needs a header with image, x, y, z, qw, qx, qy, qz"),
        ("words", "words.csv, line 2: a pose is seven numbers"),
        ("short", "short.csv, line 2: a pose is seven numbers"),
        ("nan", "nan.csv, line 2: a pose is seven numbers"),
        ("long", "long.csv, line 2: a quaternion w x y z has length 1, not 1.41"),
        ("absent", "names photographs that are not there"),
        ("few", "3 poses: hand-eye calibration takes 4"),
        ("still", "about parallel axes only"),
        ("binary", "binary.csv is not a CSV file"),
        ("nowhere", "No such file"),
    ]:
        refused(expected, *hand_eye, good.parent / f"{name}.csv", "--on-hand", *board, *out)
    refused("one of the arguments --on-hand --beside is required", *hand_eye, good, *board, *out)
    refused("contradict each other", *hand_eye, good, "--beside", *board, *out)
    refused("after half a turn", *hand_eye, good, "--on-hand", "--board", "9x7", "--square", "0.03", *out)
    refused("exists: choose another", *hand_eye, good, "--on-hand", *board, "--out", tmp_path / "there.yml")

    pose = ["pose", tmp_path / "camera.yml", paths[0], *board]
    for at in (["0.2"], ["0", "0", "0", "nan"], ["0", "0", "0", "1", "0"]):
        refused("--at takes X Y Z TURN", *pose, "--at", *at, *out)
    refused("length 1, not 2", *pose, "--at", 0, 0, 0, 2, 0, 0, 0, *out)
    refused("--placed takes standard deviations", *pose, "--at", 0, 0, 0, 0, "--placed", -1, 0, *out)
    refused("does not show the 8x5 checkerboard", *pose[:2], paths[-1], *board, "--at", 0, 0, 0, 0, *out)
    refused("is no camera file", *pose[:1], good, paths[0], *board, "--at", 0, 0, 0, 0, *out)
    refused("must end in .yml", *pose, "--at", 0, 0, 0, 0, "--out", tmp_path / "out.txt")
    refused("unexpected argument '--hight'", *pose, "--at", 0, 0, 0, 0, *out, "--hight", "3")
    assert sorted(tmp_path.rglob("*")) == before and (tmp_path / "there.yml").read_text() == "precious"
