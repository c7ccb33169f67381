"""Fisheye lenses calibrated from photographs that OpenCV's functions drew, and lenses that want another model."""

import numpy as np
import pytest
from helpers.fisheye import BOARD, FISHEYE, WIDE, photographs

from arm5dof.cli import main as cli
from arm5dof.errors import UserError
from arm5dof.vision.calibration.intrinsics import LensError, calibrate
from arm5dof.vision.calibration.views import find_views
from arm5dof.vision.camera import Camera


@pytest.mark.parametrize(("true", "widest"), [(FISHEYE, 50), (WIDE, 65)])
def test_drawn_photographs_give_the_lens_they_were_drawn_through(true, widest, tmp_path):
    views = find_views(photographs(tmp_path, true, 13, widest), BOARD)
    result = calibrate(views, lens="fisheye")
    assert result.names == ["fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"] and not result.outliers
    expected = np.concatenate([np.diag(true.matrix)[:2], true.matrix[:2, 2], true.distortion])
    assert (np.abs(result.intrinsics - expected) <= 3 * result.deviations).all()
    assert (result.deviations[:4] < 0.1).all() and result.rms < 0.06
    known = np.sqrt(np.diag(result.camera.covariance))
    np.testing.assert_allclose(known[:8], result.deviations, rtol=1e-3)
    with pytest.raises(UserError, match="5 distortion coefficients: give 4"):
        calibrate(views, 5, "fisheye")
    if true is WIDE:
        with pytest.raises(LensError, match=r"the photographs fit a fisheye lens to 0\.0\d pixels") as caught:
            calibrate(views)
        assert (caught.value.lens, caught.value.coefficients) == ("fisheye", 4)


def test_the_command_names_the_lens_and_calibrates_it(tmp_path, capfd):
    paths = photographs(tmp_path, WIDE, 8, 65)
    words = ["vision", "calibrate", *map(str, paths), "--board", "9x6", "--square", "0.02"]
    words += ["--out", str(tmp_path / "c.yml")]
    assert cli.main(words) == 2
    error = capfd.readouterr().err
    assert error.endswith(": give --lens fisheye\n") and error.count("\n") == 1
    assert cli.main([*words, "--lens", "fisheye", "--preview", str(tmp_path / "p.png")]) == 0
    assert "k4 " in capfd.readouterr().out
    camera = Camera.load(tmp_path / "c.yml")
    assert camera.lens == "fisheye" and camera.covariance.shape == (14, 14)


def test_a_fisheye_file_gives_the_right_pose(test_data, tmp_path):
    """A photograph drawn 450 mm above the table; read as a pinhole's it gave (-105, -32, 417) mm."""
    folder = test_data / "faults" / "13-fisheye-yaml"
    words = ["vision", "pose", folder / "fish.yml", folder / "fish.png", "--board", "9x6", "--square", "0.02"]
    assert cli.main([*map(str, words), "--at", "0.14", "0.13", "0", "0", "--out", str(tmp_path / "p.yml")]) == 0
    camera = Camera.load(tmp_path / "p.yml")
    assert camera.lens == "fisheye"
    np.testing.assert_allclose(camera.position, [0, 0, 0.45], atol=1e-3)
