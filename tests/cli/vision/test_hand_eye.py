"""`arm5dof vision hand-eye`: photographs of a board and the hand's poses in, a camera with its pose out; bad input one
line."""

import json

import numpy as np
import pytest
from helpers.photographs import CAMERA, KNOWN, hand_poses, photograph_board, write_poses

from arm5dof.cli import main as cli
from arm5dof.runtime import progress
from arm5dof.vision.camera import Camera


def command(*words):
    return cli.main(["vision", *map(str, words)])


@pytest.fixture(scope="module")
def shots(tmp_path_factory):
    return photograph_board(tmp_path_factory.mktemp("shots"))


@pytest.mark.parametrize("flag", ["--eye-in-hand", "--eye-to-hand"])
def test_the_hand_eye_command(shots, flag, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(progress, "PATIENCE_S", -1)
    monkeypatch.setattr(progress, "LINE_EVERY_S", -1)
    paths, seen = shots
    arm = hand_poses(seen, flag == "--eye-in-hand")
    table = write_poses(paths[0].parent / f"poses{flag}.csv", arm, [path.name for path in paths])
    KNOWN.replace(has_extrinsics=False).save(tmp_path / "camera.yml")
    words = ["hand-eye", tmp_path / "camera.yml", table, flag, "--board", "8x5", "--square", "0.03"]
    assert command(*words, "--out", tmp_path / "out.yml") == 0
    said, seen_meanwhile = capsys.readouterr()
    assert "looking for the board: 11/11 photographs" in seen_meanwhile
    assert "10 photographs" in said and "10.png: left out: board not found" in said
    if flag == "--eye-in-hand":
        assert "in the hand frame" in said and not Camera.load(tmp_path / "out.yml").has_extrinsics
        camera, true = Camera.load(tmp_path / "out.yml", arm[2]), arm[2] @ CAMERA
    else:
        camera, true = Camera.load(tmp_path / "out.yml"), CAMERA
    np.testing.assert_allclose(camera.position, true[:3, 3], atol=2e-3)
    np.testing.assert_allclose(camera.rotation, true[:3, :3], atol=5e-3)
    assert camera.has_extrinsics and camera.covariance is not None
    assert command(*words, "--out", tmp_path / "again.yml", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["frame"] == ("hand" if flag == "--eye-in-hand" else "base")
    assert told["without_board"] == ["10.png"] and len(told["used"]) == 10 and told["rotation_deg"] < 0.5


def test_a_wrong_pose_is_named_and_left_out(shots, tmp_path, capsys):
    paths, seen = shots
    arm = hand_poses(seen, True)
    arm[3, 0, 3] += 0.03
    table = write_poses(paths[0].parent / "wrong.csv", arm, [path.name for path in paths])
    KNOWN.replace(has_extrinsics=False).save(tmp_path / "camera.yml")
    words = ["hand-eye", tmp_path / "camera.yml", table, "--eye-in-hand", "--board", "8x5", "--square", "0.03"]
    assert command(*words, "--out", tmp_path / "out.yml") == 0
    said = capsys.readouterr().out
    assert "9 photographs" in said and "3.png: left out: " in said and "is the hand's pose right?" in said
    np.testing.assert_allclose(Camera.load(tmp_path / "out.yml", np.eye(4)).position, CAMERA[:3, 3], atol=2e-3)


def test_a_file_that_is_no_photograph_is_named_and_left_out(shots, tmp_path, capfd):
    paths, seen = shots
    (paths[0].parent / "words.png").write_text("hello")
    names = ["words.png" if i == 3 else path.name for i, path in enumerate(paths)]
    table = write_poses(paths[0].parent / "unread.csv", hand_poses(seen, True), names)
    KNOWN.replace(has_extrinsics=False).save(tmp_path / "camera.yml")
    words = ["hand-eye", tmp_path / "camera.yml", table, "--eye-in-hand", "--board", "8x5", "--square", "0.03"]
    assert command(*words, "--out", tmp_path / "out.yml") == 0
    said = capfd.readouterr()
    assert "9 photographs" in said.out and "words.png: left out: cannot be read" in said.out
    assert "words.png is empty, damaged, or no image" in said.err and said.err.count("\n") == 1


def test_bad_input_is_one_line(shots, tmp_path, capfd):
    paths, seen = shots
    KNOWN.replace(has_extrinsics=False).save(tmp_path / "camera.yml")
    (tmp_path / "there.yml").write_text("precious")
    good = write_poses(paths[0].parent / "good.csv", hand_poses(seen, True), [path.name for path in paths])
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
        refused(expected, *hand_eye, good.parent / f"{name}.csv", "--eye-in-hand", *board, *out)
    refused("one of the arguments --eye-in-hand --eye-to-hand is required", *hand_eye, good, *board, *out)
    refused("if the camera is on the hand (eye in hand)", *hand_eye, good, "--eye-to-hand", *board, *out)
    refused(
        "show one of 8x5 inner corners: give --board 8x5",
        *hand_eye,
        good,
        "--eye-in-hand",
        "--board",
        "9x7",
        "--square",
        "0.03",
        *out,
    )
    refused("exists: choose another", *hand_eye, good, "--eye-in-hand", *board, "--out", tmp_path / "there.yml")

    assert sorted(tmp_path.rglob("*")) == before and (tmp_path / "there.yml").read_text() == "precious"
