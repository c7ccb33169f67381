"""EXIF orientation tags: a camera model belongs to the sensor's pixels, so they turn nothing where one is used."""

import json

import numpy as np
import pytest
from PIL import Image

from arm5dof.cli import main as cli
from arm5dof.vision.camera import Camera


@pytest.fixture
def folder(test_data):
    return test_data / "faults" / "10-exif-mixed"


def command(*words):
    return cli.main(["vision", *map(str, words)])


BOX = {"class_name": "cube", "class_id": 0, "confidence": 0.9, "xyxy": [30, 20, 36, 26]}
BOARD = ["--board", "9x6", "--square", "0.02"]


def test_half_the_photographs_tagged_move_nothing(folder, tmp_path, capfd):
    """cx was 12 px and 12 deviations off, cy 10."""
    assert command("calibrate", folder / "photos", *BOARD, "--out", tmp_path / "c.yml") == 0
    error = capfd.readouterr().err
    assert "v01.jpg and 7 more is ignored: a camera model belongs to the sensor's pixels" in error
    camera = Camera.load(tmp_path / "c.yml")
    found = np.array([camera.matrix[0, 0], camera.matrix[1, 1], *camera.matrix[:2, 2]])
    assert (np.abs(found - [640, 641, 408.5, 292.5]) < 3 * np.sqrt(np.diag(camera.covariance)[:4])).all()


def test_a_pose_is_the_same_with_and_without_the_tag(folder, tmp_path, capfd):
    for name in ("upside_down", "same_view"):
        out = tmp_path / f"{name}.yml"
        image = folder / f"{name}.jpg"
        assert command("pose", folder / "camera.yml", image, *BOARD, "--at", 0.1, 0.1, 0, 0, "--out", out) == 0
        assert ("is ignored" in capfd.readouterr().err) == (name == "upside_down")
    one, other = (Camera.load(tmp_path / f"{name}.yml") for name in ("upside_down", "same_view"))
    np.testing.assert_allclose(one.position, other.position, atol=1e-4)


def test_detections_in_a_turned_photograph_are_not_located(tmp_path, capfd):
    exif = Image.Exif()
    exif[0x0112] = 3
    path, camera = tmp_path / "a.jpg", tmp_path / "c.yml"
    Image.fromarray(np.zeros((48, 64, 3), np.uint8)).save(path, exif=exif)
    matrix = np.array([[60, 0, 31.5], [0, 60, 23.5], [0, 0, 1.0]])
    Camera(matrix, np.zeros(5), np.diag([1.0, -1, -1]), np.array([0, 0, 0.5]), 64, 48).save(camera)
    found = tmp_path / "found.json"
    for turned, status in ((None, 2), (True, 2), (False, 0)):
        entry = {"name": str(path), "time_s": None, "image_size": [64, 48], "turned": turned, "detections": [BOX]}
        if turned is None:  # As files were before it was noted.
            del entry["turned"]
        found.write_text(json.dumps([entry]))
        assert command("locate", found, "--camera", camera, "--height", "cube=0.015") == status
        said = "a.jpg has an orientation tag, by which it was turned" in capfd.readouterr().err
        assert said == bool(status)


def test_detections_say_which_photographs_were_turned(tmp_path, capfd):
    """Mirrored, so that its size tells nothing; and gone when it is to be located in."""
    exif = Image.Exif()
    exif[0x0112] = 2
    pixels, camera = np.zeros((48, 64, 3), np.uint8), tmp_path / "c.yml"
    Image.fromarray(pixels).save(tmp_path / "mirrored.jpg", exif=exif)
    Image.fromarray(pixels).save(tmp_path / "plain.jpg")
    matrix = np.array([[60, 0, 31.5], [0, 60, 23.5], [0, 0, 1.0]])
    Camera(matrix, np.zeros(5), np.diag([1.0, -1, -1]), np.array([0, 0, 0.5]), 64, 48).save(camera)
    for name, turned in (("mirrored", True), ("plain", False)):
        path, out = tmp_path / f"{name}.jpg", tmp_path / name
        assert command("detect", path, "--out", out) == 0
        (frame,) = json.loads((out / "detections.json").read_text())
        assert frame["turned"] is turned
        path.unlink()
        assert command("locate", out / "detections.json", "--camera", camera) == (2 if turned else 0)
        assert ("mirrored.jpg has an orientation tag" in capfd.readouterr().err) == turned
