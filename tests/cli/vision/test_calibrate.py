"""`arm5dof vision calibrate`: photographs of a board in, a camera out; bad input one line."""

import json
import shutil
import subprocess
import sys

import pytest

from arm5dof.cli import main as cli
from arm5dof.vision.camera import Camera


def command(*arguments):
    return cli.main(["vision", "calibrate", *map(str, arguments)])


def test_the_command_writes_a_camera_and_tells_how_well_it_is_known(photographs, tmp_path, capsys):
    out, image = tmp_path / "camera.yml", tmp_path / "straight.png"
    words = [photographs[0].parent, "--board", "9x6", "--square", 0.025, "--out", out, "--preview", image]
    assert command(*words) == 0
    said = capsys.readouterr().out
    assert all(path.name in said for path in photographs)
    assert "fx          532.90 +- 0.60 pixels" in said and "error 0.185 pixels RMS" in said
    camera = Camera.load(out)
    assert abs(camera.matrix[0, 0] - 532.3) <= 1 and not camera.has_extrinsics
    assert image.read_bytes().startswith(b"\x89PNG") and {out, image} == set(tmp_path.iterdir())

    assert command(*photographs, *words[1:5], "--out", tmp_path / "again.yml", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert list(found) == [
        "image_size",
        "rms_px",
        "intrinsics",
        "errors_px",
        "outliers_px",
        "copies",
        "without_board",
        "unread",
    ]
    assert found["intrinsics"]["fx"]["value"] == pytest.approx(camera.matrix[0, 0], abs=1e-3)
    assert len(found["errors_px"]) == 13 and found["image_size"] == [640, 480]


def test_copies_of_photographs_are_named(photographs, tmp_path, capsys):
    shutil.copy(photographs[2], tmp_path / "copy.jpg")
    words = ["--board", "9x6", "--square", 0.025, "--out", tmp_path / "camera.yml"]
    assert command(*photographs[:8], tmp_path / "copy.jpg", *words) == 0
    said = capsys.readouterr().out
    assert f"copy.jpg    -      left out: the same as {photographs[2].name}" in said and "8 photographs of" in said


def test_a_file_that_is_no_photograph_is_left_out(photographs, tmp_path, capfd):
    (tmp_path / "words.jpg").write_text("hello")
    words = [*photographs[:8], "--board", "9x6", "--square", 0.025]
    assert command(tmp_path / "words.jpg", *words, "--out", tmp_path / "camera.yml") == 0
    said = capfd.readouterr()
    assert (
        said.err.startswith(f"arm5dof: left out: {tmp_path / 'words.jpg'} is empty, damaged")
        and said.err.count("\n") == 1
    )
    assert "words.jpg   -      left out: cannot be read" in said.out and "8 photographs of" in said.out
    assert command(*words, "--out", tmp_path / "without.yml") == 0
    one, other = (Camera.load(tmp_path / f"{name}.yml") for name in ("camera", "without"))
    assert abs(one.matrix - other.matrix).max() < 1e-3


def test_the_command_refuses_bad_input_in_one_line(photographs, tmp_path, capfd):
    (tmp_path / "none").mkdir()
    (tmp_path / "there.yml").write_text("precious")
    (tmp_path / "empty.jpg").touch()
    (tmp_path / "words.jpg").write_text("hello")
    before = sorted(tmp_path.rglob("*"))
    good = {"--board": "9x6", "--square": "0.025", "--out": tmp_path / "camera.yml"}
    for images, changes, expected in [
        ([tmp_path / "absent"], {}, "no image and no folder"),
        ([tmp_path / "none"], {}, "holds no images"),
        ([tmp_path / "empty.jpg"], {}, "empty.jpg is empty"),
        ([tmp_path / "empty.jpg", tmp_path / "words.jpg"], {}, "and none of the 1 others can be used"),
        (photographs[:1], {}, "1 of 1 photographs show the 9x6 checkerboard and a calibration takes 5"),
        (photographs[:1] * 9, {}, "1 of 1 photographs"),
        (photographs[:6], {"--board": "8x6"}, "show one of 9x6 inner corners: give --board 9x6"),
        (photographs, {"--board": "9"}, "give inner corners such as 9x6"),
        (photographs, {"--board": "2x9"}, "at least 3x3"),
        (photographs, {"--square": "25"}, "in metres"),
        (photographs, {"--square": "nan"}, "in metres"),
        (photographs, {"--dictionary": "DICT_4X4_50"}, "with --charuco"),
        (photographs[:5], {"--charuco": "0.02"}, "no marker of DICT_5X5_100"),
        (photographs, {"--distortion": "6"}, "invalid choice"),
        (photographs, {"--out": tmp_path / "there.yml"}, "exists: choose another name"),
        (photographs, {"--out": tmp_path / "camera.txt"}, "must end in .yml"),
        (photographs, {"--out": tmp_path / "nowhere" / "camera.yml"}, "no folder"),
        (photographs, {"--preview": tmp_path / "nowhere" / "p.png"}, "no folder"),
        (photographs, {"--prewiew": tmp_path / "p.png"}, "unexpected argument '--prewiew'"),
    ]:
        words = [word for pair in {**good, **changes}.items() for word in pair]
        assert command(*images, *words) == 2, expected
        err = capfd.readouterr().err
        assert err.startswith("arm5dof: ") and expected in err and err.count("\n") == 1, err
    assert sorted(tmp_path.rglob("*")) == before and (tmp_path / "there.yml").read_text() == "precious"


def test_help_teaches_and_costs_nothing(capsys):
    with pytest.raises(SystemExit) as caught:
        command("--help")
    said = capsys.readouterr().out
    assert caught.value.code == 0 and "10 to 20 photographs" in said and "--preview" in said
    assert cli.main(["vision"]) == 0 and "calibrate" in capsys.readouterr().out
    slow = {"cv2", "flax", "jax", "mujoco", "numpy", "arm5dof.runtime", "importlib.metadata"}
    code = f"import sys, arm5dof.cli.main as c; c.make_parser(); print({slow} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"
