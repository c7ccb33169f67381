"""`arm5dof vision pose`: a photograph of a board in, a camera with its pose out; bad input one line."""

import json

import cv2
import numpy as np
from helpers.photographs import BOARD, KNOWN, TRUE, draw, matrix, photograph, poses
from scipy.spatial.transform import Rotation

from arm5dof.cli import main as cli
from arm5dof.vision.camera import Camera


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


def test_bad_input_is_one_line(tmp_path, capfd):
    seen = next(poses(np.random.default_rng(3), 1, (0.1, 0.06)))
    cv2.imwrite(str(tmp_path / "board.png"), photograph(*draw(BOARD), seen))
    cv2.imwrite(str(tmp_path / "none.png"), np.full((480, 640), 128, np.uint8))
    (tmp_path / "words.csv").write_text("image,x,y,z,qw,qx,qy,qz")
    KNOWN.replace(has_extrinsics=False).save(tmp_path / "camera.yml")
    before = sorted(tmp_path.rglob("*"))

    def refused(expected, *words):
        assert command(*words) == 2, expected
        err = capfd.readouterr().err
        assert err.startswith("arm5dof: ") and expected in err and err.count("\n") == 1, err

    board, out = ["--board", "8x5", "--square", "0.03"], ["--out", tmp_path / "out.yml"]
    pose = ["pose", tmp_path / "camera.yml", tmp_path / "board.png", *board]
    for at in (["0.2"], ["0", "0", "0", "nan"], ["0", "0", "0", "1", "0"]):
        refused("--at takes X Y Z TURN", *pose, "--at", *at, *out)
    refused("length 1, not 2", *pose, "--at", 0, 0, 0, 2, 0, 0, 0, *out)
    refused("--placed takes standard deviations", *pose, "--at", 0, 0, 0, 0, "--placed", -1, 0, *out)
    refused("does not show the 8x5 checkerboard", *pose[:2], tmp_path / "none.png", *board, "--at", 0, 0, 0, 0, *out)
    other = ["--board", "7x4", "--square", "0.03", "--at", 0, 0, 0, 0]
    refused("show one of 8x5 inner corners: give --board 8x5", *pose[:3], *other, *out)
    refused("is no camera file", "pose", tmp_path / "words.csv", *pose[2:], "--at", 0, 0, 0, 0, *out)
    refused("must end in .yml", *pose, "--at", 0, 0, 0, 0, "--out", tmp_path / "out.txt")
    refused("unexpected argument '--hight'", *pose, "--at", 0, 0, 0, 0, *out, "--hight", "3")
    assert sorted(tmp_path.rglob("*")) == before
