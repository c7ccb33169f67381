"""`arm5dof vision locate` on images, videos, cameras and random scenes: images in, points out."""

import json

import cv2
import numpy as np
import pytest
from helpers.onnx_bytes import NAMES, SIZE, constant, output
from helpers.videos import greys, read_video, write_video

from arm5dof.cli import main as cli
from arm5dof.vision.camera import Camera
from arm5dof.vision.images import read
from arm5dof.vision.rendering.simulated import simulated_camera
from arm5dof.vision.synthetic import scene_builder as scenery
from arm5dof.vision.synthetic.samples import render_sample
from arm5dof.vision.synthetic.scenes import random_scene

SCENES = 3
KNOWN = np.diag(np.square([*[0.5] * 4, *[1e-3] * 5, *[1e-3] * 6]))
"""How well cameras are, as covariance."""


def command(*words):
    return cli.main(["vision", "locate", *map(str, words)])


def told(capsys, *words):
    assert command(*words, "--json") == 0
    return json.loads(capsys.readouterr().out)


@pytest.fixture(scope="module")
def shots():
    """What `simulated` shows."""
    return [render_sample(number, 0, "evaluation", "auto") for number in range(SCENES)]


@pytest.fixture(scope="module")
def photo(shots, tmp_path_factory):
    """The picture of a scene, and beside it its camera, and how well that is known."""
    folder = tmp_path_factory.mktemp("photo")
    cv2.imwrite(str(folder / "scene.png"), shots[1].image[..., ::-1])
    shots[1].camera.replace(covariance=KNOWN).save(folder / "posed.yml")
    return folder / "scene.png"


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A network that finds one and the same ball, from the 12th to the 28th column and the 16th to the 40th row, in
    every image of 64 x 64, and a camera of that size, 0.5 m above the table."""
    folder = tmp_path_factory.mktemp("small")
    constant(folder / "ball.onnx", output("yolov8"), (1, 3, SIZE, SIZE), {"names": str(list(NAMES))})
    matrix = np.array([[100, 0, 31.5], [0, 100, 31.5], [0, 0, 1]])
    camera = Camera(matrix, np.zeros(5), np.diag([1.0, -1, -1]), np.array([0.2, 0, 0.52]), SIZE, SIZE)
    camera.replace(covariance=KNOWN).save(folder / "down.yml")
    return ["--detector", folder / "ball.onnx", "--camera", folder / "down.yml", "--height", "ball=0.02"]


SMALL_BALL = 0.2 + 0.5 * (20 - 32) / 100, 0.5 * (32 - 28) / 100, 0.02
"""Where the center of its box is seen, by similar triangles; the object is seen from a little aside."""


def errors(objects, there):
    """Distances of objects from the nearest of their class, metres."""
    names = [found["class_name"] for found in objects]
    true = {
        name: there.position[there.class_id == found["class_id"]] for name, found in zip(names, objects, strict=True)
    }
    return [
        np.linalg.norm(true[name] - found["position"], axis=1).min(initial=np.inf)
        for name, found in zip(names, objects, strict=True)
        if found["position"]
    ]


def test_heights_of_classes_that_the_detector_does_not_have(small, tmp_path, capsys):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((SIZE, SIZE, 3), np.uint8))
    for name, hint in (("bal", "did you mean 'ball'?"), ("orange", "it knows: cube, ball")):
        assert command(tmp_path / "a.png", *small, "--height", f"{name}=0.03") == 2
        said = capsys.readouterr()
        assert said.err == f"arm5dof: the detector knows no class {name!r}; {hint}\n" and not said.out


def test_a_camera_that_the_shipped_detector_is_not_for(shots, photo, capsys):
    """Rolled by a quarter turn. A detector of one's own is asked no such thing."""
    camera = shots[1].camera
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    camera.replace(rotation=camera.rotation @ quarter, covariance=KNOWN).save(photo.parent / "rolled.yml")
    for words, warned in ((["rolled.yml"], True), (["posed.yml"], False)):
        assert command(photo, "--camera", photo.parent / words[0], "--classes", "ring") == 0
        said = capsys.readouterr().err
        assert ("the shipped detector is for cameras 0.5 to 1 m" in said and "rolled by" in said) == warned, said


def test_random_scenes(shots, tmp_path, capsys):
    frames = told(capsys, f"simulated:{SCENES}", "--out", tmp_path / "placed")
    assert frames == json.loads((tmp_path / "placed" / "positions.json").read_text())
    assert [frame["name"] for frame in frames] == [f"scene{number}.png" for number in range(SCENES)]
    off = np.concatenate([errors(f["objects"], shot.truth) for f, shot in zip(frames, shots, strict=True)])
    # The detector may see an object where there is none.
    assert len(off) >= 8 and np.median(off) < 2e-3 and np.mean(off < 5e-3) > 0.9
    for frame, shot in zip(frames, shots, strict=True):
        drawn = read(tmp_path / "placed" / frame["name"])
        changed = (drawn != shot.image).any(-1)
        assert drawn.shape == shot.image.shape and changed.mean() < 0.3
        for found in frame["objects"]:
            left, top, _, bottom = map(round, found["xyxy"])
            assert changed[top:bottom, left].mean() > 0.9


def test_a_photograph_and_its_camera(shots, photo, tmp_path, capsys):
    """It is one of the random scenes and placed as it is there; by a depth image, nearly so."""
    words = [photo, "--camera", photo.with_name("posed.yml")]
    (frame,) = told(capsys, *words, "--out", tmp_path / "placed")
    assert frame["name"] == str(photo) and frame["time_s"] is None and frame["image_size"] == [640, 480]
    assert {p.name for p in (tmp_path / "placed").iterdir()} == {"scene.png", "positions.json"}
    simulated = told(capsys, "simulated:2")[1]["objects"]
    assert [found["xyxy"] for found in frame["objects"]] == [found["xyxy"] for found in simulated]
    for ours, theirs in zip(frame["objects"], simulated, strict=True):
        np.testing.assert_allclose(ours["position"], theirs["position"], atol=1e-5)
        assert np.linalg.eigvalsh(ours["covariance"]).min() > 0 and ours["reason"] is None

    scene = random_scene((0, 1), "evaluation")
    depth = simulated_camera(scene.model, scenery.CAMERA, back_end="software").depth(scene.data)
    millimetres = np.round(1000 * np.nan_to_num(depth, posinf=0)).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "depth.png"), millimetres)
    (seen,) = told(capsys, *words, "--depth", tmp_path / "depth.png")
    off = errors(seen["objects"], shots[1].truth)
    assert len(off) > 3 and np.median(off) < 4e-3


def test_for_people(photo, capsys):
    words = [photo, "--camera", photo.with_name("posed.yml"), "--classes", "dumbbell,ball", "--tta"]
    assert command(*words, "--reach", 0.1, 0.2) == 0
    captured = capsys.readouterr()
    name, head, *rows, summary = captured.out.splitlines()
    assert name == str(photo) and head.split()[:2] == ["class", "conf"] and summary.startswith("1 frame in")
    assert rows and {row.split()[0] for row in rows} == {"dumbbell", "ball"}
    assert any(row.endswith("outside the workspace") for row in rows)
    assert not captured.err


def test_a_video_with_a_detector_of_ones_own(small, tmp_path, capsys):
    clip, out = write_video(tmp_path / "clip.mp4", greys(5)), tmp_path / "placed"
    assert command(clip, *small, "--out", out) == 0
    captured = capsys.readouterr()
    assert "5 frames in" in captured.out and f"written: {out}" in captured.out
    frames = json.loads((out / "positions.json").read_text())
    np.testing.assert_allclose([frame["time_s"] for frame in frames], np.arange(5) / 12.5, atol=1e-3)
    for frame in frames:
        (ball,) = frame["objects"]
        assert (ball["class_name"], ball["xyxy"]) == ("ball", [12, 16, 28, 40])
        np.testing.assert_allclose(ball["position"], SMALL_BALL, atol=5e-3)
    pictures, before = read_video(out / "clip.mp4")[0], read_video(clip)[0]
    assert len(pictures) == 5
    assert all(np.abs(p.astype(int) - b)[16:40, 11:29].max() > 40 for p, b in zip(pictures, before, strict=True))
    assert command(clip, *small) == 0
    assert f"{clip} at 0.32 s\n" in capsys.readouterr().out


def test_a_camera_that_is_taken_away(small, tmp_path, capsys, monkeypatch):
    """A video played where camera 0 would be opened; there is none where tests run."""
    clip, opened = str(write_video(tmp_path / "clip.mp4", greys(3))), cv2.VideoCapture
    monkeypatch.setattr(cv2, "VideoCapture", lambda what, *more: opened(clip if what == 0 else what, *more))
    assert command(0, *small, "--out", tmp_path / "placed", "--reach", 0, 0.01) == 2
    assert f"any more: was it unplugged or closed?; 3 frames before that in {tmp_path}" in capsys.readouterr().err
    frames = json.loads((tmp_path / "placed" / "positions.json").read_text())
    assert [[found["reason"] for found in frame["objects"]] for frame in frames] == [["outside the workspace"]] * 3


def test_bad_input_is_one_line(photo, small, tmp_path, capfd):
    posed, clip = photo.with_name("posed.yml"), write_video(tmp_path / "clip.mp4", greys(2))
    (tmp_path / "found.json").write_text("[]")
    (tmp_path / "listed.txt").write_text(" []")
    (tmp_path / "folder").mkdir()
    cv2.imwrite(str(tmp_path / "depth.png"), np.full((480, 640), 700, np.uint16))
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((SIZE, SIZE), np.uint8))
    before = sorted(tmp_path.rglob("*"))
    camera = ["--camera", posed]
    for words, expected in [
        ([photo], "give one --camera CAMERA.yml with the camera's pose: arm5dof vision pose writes one"),
        ([photo, *camera, *camera], "two go with two DETECTIONS.json"),
        (["simulated:1", *camera], "simulated scenes come with their cameras: leave out --camera"),
        (["simulated:1", "--depth", tmp_path / "depth.png"], "simulated scenes come with their cameras"),
        ([photo, tmp_path / "found.json", *camera], "images and DETECTIONS.json do not go together"),
        ([photo, tmp_path / "listed.txt", photo, *camera], "images and DETECTIONS.json do not go together"),
        ([tmp_path / "listed.txt"], "give one DETECTIONS.json and its --camera"),
        (
            [tmp_path / "found.json", *camera, "--tta", "--iou", 0.5],
            "leave out --iou, --tta: that takes images",
        ),
        ([tmp_path / "found.json", *camera, "--out", tmp_path / "new"], "leave out --out: that takes images"),
        ([photo, *camera, "--out", tmp_path / "folder"], "folder exists: choose another --out"),
        (
            [photo, tmp_path / "small.png", *camera, "--depth", tmp_path / "depth.png"],
            "is the depth image of one frame",
        ),
        ([clip, *camera, "--depth", tmp_path / "depth.png"], "is the depth image of one frame"),
        ([tmp_path / "absent.png", *camera], "no image, video or folder"),
        ([photo, *small, "--out", tmp_path / "new"], "scene.png has 640x480 pixels and the camera 64x64"),
        (
            [tmp_path / "small.png", *camera, "--out", tmp_path / "new"],
            "small.png has 64x64 pixels and the camera 640x480",
        ),
        ([photo, *camera, "--height", "ball=0"], "give metres above zero"),
        ([clip, *small, "--tta"], "is not the tabletop detector, which alone has test-time augmentation"),
    ]:
        assert command(*words) == 2, expected
        captured = capfd.readouterr()
        assert captured.err.startswith("arm5dof: ") and expected in captured.err, captured.err
        assert captured.err.count("\n") == 1 and not captured.out and sorted(tmp_path.rglob("*")) == before


def test_images_that_are_damaged_or_of_another_size_are_left_out(photo, tmp_path, capfd):
    other, words = tmp_path / "other.png", tmp_path / "words.png"
    cv2.imwrite(str(other), np.zeros((1, 320), np.uint8))
    words.write_text("hello")
    options = ["--camera", photo.with_name("posed.yml"), "--out", tmp_path / "placed"]
    assert command(other, photo, words, *options) == 1
    first, second, last = capfd.readouterr().err.splitlines()
    assert first == f"arm5dof: {other} has 320x1 pixels and the camera 640x480"
    assert second.startswith(f"arm5dof: {words} is empty, damaged") and "2 of 3 files left out" in last
    assert {p.name for p in (tmp_path / "placed").iterdir()} == {"scene.png", "positions.json"}
    assert len(json.loads((tmp_path / "placed" / "positions.json").read_text())) == 1
    assert command(other, words, *options[:2]) == 2
    err = capfd.readouterr().err
    assert "has 320x1 pixels" in err and "; and none of the 1 others can be used" in err and err.count("\n") == 1


def test_a_height_of_a_class_that_the_detector_does_not_know(capfd):
    assert cli.main(["vision", "locate", "simulated", "--height", "persn=0.5"]) == 2
    assert "the detector knows no class 'persn'; it knows: red cube," in capfd.readouterr().err
