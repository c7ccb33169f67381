"""`arm5dof vision locate`: detections in, points out."""

import io
import json

import cv2
import numpy as np
import pytest
from helpers import tabletop
from helpers.tabletop import detections

from arm5dof.cli import main as cli
from arm5dof.vision.camera import Camera
from arm5dof.vision.detections import Detections
from arm5dof.vision.io import sinks as outputs
from arm5dof.vision.io.sources import Frame
from arm5dof.vision.objects import CLASS_NAMES
from arm5dof.vision.rendering.simulated import simulated_camera
from arm5dof.vision.synthetic.ground_truth import truth
from arm5dof.vision.synthetic.scene_builder import CAMERA
from arm5dof.vision.synthetic.scenes import random_scene

HEIGHTS = ["--height", "cube=0.015", "--height", "ball=0.018:ball"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A posed camera, detections in both formats, and a depth image of what it sees."""
    folder, rng = tmp_path_factory.mktemp("locate"), np.random.default_rng(0)
    names = ["cube", "ball", "can"]
    model, data, centers = tabletop.table(rng, names, [tabletop.over_the_table(rng)])
    camera = Camera.from_mujoco(model, "0", tabletop.WIDTH, tabletop.HEIGHT)
    camera = camera.replace(covariance=np.diag(np.square([*[0.5] * 4, *[1e-3] * 5, *[1e-3] * 6])))
    ids, depth = tabletop.cast(model, data, camera)
    found = detections(tabletop.boxes(model, ids, 3), names)
    camera.save(folder / "posed.yml")
    camera.replace(has_extrinsics=False).save(folder / "unposed.yml")
    camera.replace(covariance=None).save(folder / "bare.yml")
    hand = {"hand_rotation": camera.rotation, "hand_position": camera.position.reshape(3, 1)}
    camera.replace(has_extrinsics=False).save(folder / "on_hand.yml", hand)
    (folder / "list.json").write_text(found.to_json())
    frame = {"name": "a.jpg", "time_s": None, "image_size": [640, 480], "detections": json.loads(found.to_json())}
    (folder / "frames.json").write_text(json.dumps([frame, {**frame, "name": "b.jpg", "detections": []}]))
    (folder / "other.json").write_text(json.dumps([{**frame, "image_size": [320, 240]}]))
    cv2.imwrite(str(folder / "depth.png"), np.round(1000 * depth).astype(np.uint16))
    np.save(folder / "centers.npy", centers)
    return folder


def command(*words):
    return cli.main(["vision", "locate", *map(str, words)])


def told(capsys, *words):
    assert command(*words, "--json") == 0
    return json.loads(capsys.readouterr().out)


def test_for_programs(folder, capsys):
    centers = np.load(folder / "centers.npy")
    (frame,) = told(capsys, folder / "list.json", "--camera", folder / "posed.yml", *HEIGHTS)
    assert frame["name"] is None and [each["class_name"] for each in frame["objects"]] == ["cube", "ball", "can"]
    cube, ball, can = frame["objects"]
    for each, center in zip((cube, ball), centers, strict=False):
        np.testing.assert_allclose(each["position"], center, atol=2e-3)
        assert each["reason"] is None and (np.linalg.eigvalsh(each["covariance"]) > 0).all()
    assert can == {**can, "position": None, "covariance": None, "reason": "no height is known of can"}

    first, second = told(capsys, folder / "frames.json", "--camera", folder / "posed.yml", *HEIGHTS)
    assert first == {"name": "a.jpg", "objects": frame["objects"]} and second == {"name": "b.jpg", "objects": []}
    seen = ["--depth", folder / "depth.png"]
    (by_depth,) = told(capsys, folder / "list.json", "--camera", folder / "posed.yml", *HEIGHTS, *seen)
    np.testing.assert_allclose(by_depth["objects"][1]["position"], centers[1], atol=2e-3)
    (near,) = told(capsys, folder / "list.json", "--camera", folder / "posed.yml", *HEIGHTS, "--reach", "0", "0.01")
    assert near["objects"][0]["reason"] == "outside the workspace"
    (rough,) = told(capsys, folder / "list.json", "--camera", folder / "posed.yml", *HEIGHTS, "--box-std", "20")
    assert np.trace(rough["objects"][0]["covariance"]) > 50 * np.trace(cube["covariance"])
    # The hand at the base: the camera is where it was.
    words = ["--camera", folder / "on_hand.yml", "--hand", 0, 0, 0, 1, 0, 0, 0]
    assert told(capsys, folder / "list.json", *words, *HEIGHTS)[0]["objects"][0] == cube


def test_two_cameras(folder, tmp_path, capsys):
    """The same objects from elsewhere, in the air for all that one knows of the table."""
    rng, names = np.random.default_rng(0), ["cube", "ball", "can"]
    model, data, centers = tabletop.table(rng, names, [tabletop.over_the_table(rng) for _ in range(2)])
    files, words = [], list(HEIGHTS)
    for name, shown in (("0", names), ("1", names[:2])):
        camera = Camera.from_mujoco(model, name, tabletop.WIDTH, tabletop.HEIGHT)
        camera.save(tmp_path / f"{name}.yml")
        found = detections(tabletop.boxes(model, tabletop.cast(model, data, camera)[0], len(shown)), shown)
        (tmp_path / f"{name}.json").write_text(found.to_json())
        files += [tmp_path / f"{name}.json"]
        words += ["--camera", tmp_path / f"{name}.yml"]
    (frame,) = told(capsys, *files, *words, "--table", "0.5")
    cube, ball, can = frame["objects"]
    np.testing.assert_allclose([cube["position"], ball["position"]], centers[:2], atol=2e-3)
    assert can["position"] is None and can["reason"] == "the other picture shows no can there"


def test_a_simulated_image_becomes_places(tmp_path, capsys, monkeypatch):
    """From pixels to metres: the camera's image of a scene, the boxes of what can be seen in it as a frame that
    `vision detect` prints, and their places by `vision locate`, which knows what stands on that table. By the image,
    and by the depth image."""
    errors = []
    for seed in range(8):
        scene = random_scene(seed, "evaluation")
        camera = Camera.from_mujoco(scene.model, CAMERA, 640, 480, scene.data)
        drawn = simulated_camera(scene.model, CAMERA, back_end="software")
        there = truth(scene, drawn.segmentation(scene.data))
        whole = there.counts & (there.visible > 0.9)
        found = Detections(there.xyxy[whole], np.linspace(0.9, 0.5, whole.sum()), there.class_id[whole], CLASS_NAMES)
        frame = outputs.as_json(Frame(f"scene {seed}", drawn.rgb(scene.data)), found)
        camera.save(tmp_path / f"{seed}.yml")
        depth = np.nan_to_num(1000 * drawn.depth(scene.data), posinf=0)
        cv2.imwrite(str(tmp_path / f"{seed}.png"), np.round(depth).astype(np.uint16))
        for more in ([], ["--depth", tmp_path / f"{seed}.png"]):
            monkeypatch.setattr("sys.stdin", io.StringIO(json.dumps([frame])))
            (said,) = told(capsys, "-", "--camera", tmp_path / f"{seed}.yml", *more)
            assert said["name"] == f"scene {seed}" and len(said["objects"]) == len(found)
            for each, name, place in zip(said["objects"], found.data["class_name"], there.position[whole], strict=True):
                assert each["class_name"] == name
                assert each["reason"] in (None, "the picture's edge cuts it off")
                if each["position"]:
                    errors.append(np.linalg.norm(np.subtract(each["position"], place)))
    assert len(errors) > 30 and np.median(errors) < 6e-4 and np.max(errors) < 2.5e-3


def test_a_photograph_becomes_places(test_data, tmp_path, capsys):
    """What YOLOv5's own weights find in a photograph goes into `locate` as it is printed."""
    words = ["detect", test_data / "vision/photos/bus.jpg", "--detector", test_data / "vision/models/yolov5n.pt"]
    assert cli.main(["vision", *map(str, words), "--json"]) == 0
    (tmp_path / "found.json").write_text(capsys.readouterr().out)
    # About what took it: 1.7 m above the street, looking along x and a little down, for heads are at the horizon.
    level, down = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]), cv2.Rodrigues(np.array([-np.deg2rad(9), 0, 0]))[0]
    matrix = np.array([[900, 0, 405], [0, 900, 540], [0, 0, 1.0]])
    Camera(matrix, np.zeros(5), level @ down, np.array([0, 0, 1.7]), 810, 1080).save(tmp_path / "camera.yml")
    (frame,) = told(
        capsys, tmp_path / "found.json", "--camera", tmp_path / "camera.yml", "--height", "person=0.86", "--box-std", 10
    )
    reasons = [(each["class_name"], each["reason"]) for each in frame["objects"]]
    assert ("bus", "no height is known of bus") in reasons and len(reasons) == 4
    people = [each["position"] for each in frame["objects"] if each["position"]]
    # Two who wait at about the same distance, on the left; the third is cut off.
    assert len(people) == 2 and all(2 < x < 5 and 0 < y < 2 and abs(z - 0.86) < 1e-3 for x, y, z in people)


def test_for_people(folder, capsys):
    assert command(folder / "frames.json", "--camera", folder / "posed.yml", *HEIGHTS) == 0
    captured = capsys.readouterr()
    name, head, cube, _, can, other, nothing = captured.out.splitlines()
    assert (name, other, nothing) == ("a.jpg", "b.jpg", "  nothing") and head.split()[:2] == ["class", "conf"]
    position = 1e3 * np.load(folder / "centers.npy")[0]
    label, confidence, *numbers = cube.split()
    assert (label, confidence) == ("cube", "0.90")
    np.testing.assert_allclose([float(n) for n in numbers[:3]], position, atol=2)
    assert all(0 < float(n) < 10 for n in numbers[3:]) and len(numbers) == 6
    assert can.endswith("0.50 no height is known of can") and not captured.err
    assert command(folder / "frames.json", "--camera", folder / "bare.yml", *HEIGHTS) == 0
    err = capsys.readouterr().err
    assert "does not say how well the camera is known" in err and err.count("\n") == 1


def test_a_height_that_no_detection_has_but_for_a_letter(folder, capsys):
    """The file does not tell what the detector knows, so that it may be meant."""
    words = [folder / "list.json", "--camera", folder / "posed.yml", "--height"]
    assert command(*words, "cubes=0.015", "--height", "ball=0.018") == 0
    assert "no cubes was detected; did you mean 'cube'?" in capsys.readouterr().err
    assert command(*words, "cubes=0.015", "--height", "cube=0.015") == 0
    assert not capsys.readouterr().err


def test_bad_input_is_one_line(folder, tmp_path, capfd):
    for name, text in {
        "words": "hello",
        "number": "3",
        "strings": '["a"]',
        "keys": '[{"class_name": "cube"}]',
        "box": '[{"class_name": "cube", "confidence": 1, "xyxy": [1, 2, 3]}]',
        "nan": '[{"class_name": "cube", "confidence": NaN, "xyxy": [1, 2, 3, 4]}]',
        "frame": '[{"name": "a", "image_size": [3], "detections": []}]',
        "huge": f'[{{"class_name": "cube", "confidence": 1, "xyxy": [1, 2, 3, 1{"0" * 400}]}}]',
        "nested": '[{"class_name": "cube", "confidence": [1], "xyxy": [1, 2, 3, 4]}]',
        "edges": '[{"class_name": "cube", "confidence": 1, "xyxy": [[1, 2], [3, 4]]}]',
        "deep": "[" * 100_000,
    }.items():
        (tmp_path / f"{name}.json").write_text(text)
        assert command(tmp_path / f"{name}.json", "--camera", folder / "posed.yml", *HEIGHTS) == 2
        err = capfd.readouterr().err
        assert err.startswith("arm5dof: ") and "holds no detections: give the JSON" in err and err.count("\n") == 1
    for changes, expected in [
        ({"camera": folder / "unposed.yml"}, "the camera has no extrinsics"),
        ({"camera": folder / "on_hand.yml"}, "the camera has no extrinsics"),
        ({"camera": folder / "list.json"}, "no camera"),
        ({"height": "cube"}, "is no NAME=METRES"),
        ({"height": "cube=x"}, "is no NAME=METRES"),
        ({"height": "cube=0"}, "give metres above zero"),
        ({"height": "cube=0.01:pea"}, "no form 'pea': choose from block, ball, cone"),
        ({"box-std": 0}, "a number of pixels above zero"),
        ({"table": "nan"}, "--table"),
        ({"reach": [0.3, 0.1]}, "--reach takes the smallest distance and the largest"),
        ({"hand": [0, 0, 0, 1, 0, 0, 0]}, "has no hand_rotation"),
        ({"hand": [0, 0, 0, 0, 0, 0, 0]}, "has length 1, not 0"),
        ({"depth": folder / "list.json"}, "give a PNG file with one channel of 16 bits"),
        ({"depth-error": -1}, "--depth-error takes metres"),
        ({"camera": [folder / "posed.yml", "--camera", folder / "posed.yml"]}, "give one DETECTIONS.json and its"),
        ({"hight": 3}, "unexpected argument '--hight'"),
    ]:
        words = {"camera": folder / "posed.yml", "height": "cube=0.015", **changes}
        flat = [w for k, v in words.items() for w in (f"--{k}", *(v if isinstance(v, list) else [v]))]
        assert command(folder / "list.json", *flat) == 2, expected
        err = capfd.readouterr().err
        assert err.startswith("arm5dof: ") and expected in err and err.count("\n") == 1, err
    words = ["--camera", folder / "posed.yml", *HEIGHTS]
    assert command(folder / "other.json", *words) == 2
    assert "a.jpg has 320x240 pixels and the camera 640x480" in capfd.readouterr().err
    assert command(folder / "frames.json", *words, "--depth", folder / "depth.png") == 2
    assert "is the depth image of one frame" in capfd.readouterr().err
    two = [folder / "frames.json", folder / "list.json", *words[:2], *words]
    assert command(*two) == 2
    assert "frames.json has 2 frames and" in capfd.readouterr().err
    assert command(*two, "--depth", folder / "depth.png") == 2
    assert "--hand and --depth go with one camera" in capfd.readouterr().err
