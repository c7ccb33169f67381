"""`arm5dof grasp` and `arm5dof export`: what they print and write, and one line with status 2 for bad input."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import jax
import numpy as np
import pytest

from arm5dof.arm import load_arm
from arm5dof.cli import main as cli
from arm5dof.grasp import video
from arm5dof.grasp.gripper import SITE
from arm5dof.grasp.robot import SimulatedRobot
from arm5dof.grasp.scene import tabletop_scene
from arm5dof.grasp.shipped import shipped
from arm5dof.training.config import load_config
from arm5dof.training.run import Run
from arm5dof.vision.objects import CLASS_NAMES
from arm5dof.vision.synthetic.scenes import Placement

UP = np.array([0.0, 0.0, np.pi / 2, 0.0, 0.0])
KEYS = {"success_percent", "wrong_object_percent", "scenes", "failures"}

Fails = Callable[..., str]


def run(*arguments: object) -> int:
    return cli.main([str(a) for a in arguments])


@pytest.fixture
def fails(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Fails:
    """Run `arm5dof grasp` in an empty folder; it must fail and write nothing. Returns its one line."""
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")

    def check(*arguments: object) -> str:
        capsys.readouterr()
        assert run("grasp", *arguments) == 2
        out, err = capsys.readouterr()
        assert err.startswith("arm5dof: ") and err.count("\n") == 1 and not out
        assert not list((tmp_path / "empty").iterdir())
        return err.removeprefix("arm5dof: ").rstrip()

    return check


@pytest.fixture(scope="module")
def photo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `photo.png` of a can alone on a table, and the camera that took it, with and without its pose."""
    folder = tmp_path_factory.mktemp("photo")
    can = Placement(CLASS_NAMES.index("can"), np.array([0.18, 0.05, 0.02]), 0.0)
    scene = tabletop_scene(3, objects=[can], distractors=False, bins=(), start=UP)
    image = SimulatedRobot(scene).image()
    cv2.imwrite(str(folder / "photo.png"), image[..., ::-1])
    cv2.imwrite(str(folder / "small.png"), image[::2, ::2, ::-1])
    scene.camera.save(folder / "posed.yml")
    scene.camera.replace(has_extrinsics=False).save(folder / "unposed.yml")
    return folder


def test_json_has_these_keys(capsys: pytest.CaptureFixture[str]):
    assert run("grasp", "--eyes", "truth", "--seed", 31, "--bin", "class", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found.keys() >= KEYS and found["scenes"] == 1 and found["success_percent"] == 100 and not found["failures"]


def test_several_scenes(capsys: pytest.CaptureFixture[str]):
    assert run("grasp", "--eyes", "truth", "--seed", 31, "--scenes", 2, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found.keys() >= KEYS and found["scenes"] == 2
    assert sum(found["failures"].values()) == round(found["reachable"] * (1 - found["success_percent"] / 100))


def test_what_goes_on_is_told_and_recorded(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(video, "SIZE", (160, 120))  # Without a GPU larger ones take a minute.
    monkeypatch.setattr(video, "simulated_camera", partial(video.simulated_camera, back_end="software"))
    assert run("grasp", "--seed", 31, "--video", tmp_path / "grasp.mp4") == 0
    assert capsys.readouterr().out.endswith(": done\n")
    assert [path.name for path in tmp_path.iterdir()] == ["grasp.mp4"]
    capture, frames = cv2.VideoCapture(str(tmp_path / "grasp.mp4")), []
    while (read := capture.read())[0]:
        frames.append(read[1])
    assert len(frames) > 50 and frames[0].shape == (120, 320, 3)
    assert np.abs(frames[0][:90].astype(int) - frames[-1][:90]).mean() > 1
    assert "exists" in _fails(capsys, "grasp", "--video", tmp_path / "grasp.mp4")


def _fails(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    assert run(*arguments) == 2
    return capsys.readouterr().err


def test_a_photograph_gives_timed_joint_angles(capsys: pytest.CaptureFixture[str], photo: Path):
    asked = ("--image", photo / "photo.png", "--camera", photo / "posed.yml", "--pick", "can")
    assert run("grasp", *asked, "--json") == 0
    commands = json.loads(capsys.readouterr().out)
    arm = load_arm("arm5.xml", SITE)
    assert [one["time_s"] for one in commands] == sorted(one["time_s"] for one in commands)
    assert all(one.keys() == {"time_s", "joints_rad", "opening_m"} for one in commands)
    assert all(tuple(one["joints_rad"]) == arm.joint_names for one in commands)
    q = np.array([list(one["joints_rad"].values()) for one in commands])
    points = np.asarray(jax.vmap(arm.forward)(q))
    lowest = points[:, 2].argmin()
    np.testing.assert_allclose(points[lowest], [0.18, 0.05, 0.02], atol=0.004)
    assert commands[-1]["opening_m"] < 0 < commands[lowest]["opening_m"] and points[-1, 2] > 0.07

    assert run("grasp", *asked, "--place", 0.15, -0.1) == 0
    lines = capsys.readouterr().out.splitlines()
    assert all(name in lines[0] for name in arm.joint_names) and len(lines) > len(commands) + 1


def test_bad_input_is_one_line(fails: Fails, photo: Path):
    classes = ", ".join(CLASS_NAMES)
    assert fails("--pick", "moon") == f"no class 'moon': the detector knows {classes}"
    assert fails("--bin", "moon", "--video", "out.mp4") == f"no bin 'moon': there are {classes}"
    assert "no policy 'absent'" in fails("--policy", "absent")
    assert "no policy ships for mine.xml" in fails("--arm", "mine.xml")
    assert "no place nan 0.0" in fails("--place", "nan", 0)
    assert "give two radii above 0" in fails("--radii", 0.3, 0.1)
    assert "argument --bin: not allowed with argument --place" in fails("--place", 0.1, 0, "--bin", "can")
    assert "no folder 'nowhere'" in fails("--video", "nowhere/out.mp4")
    assert "must end in .mp4" in fails("--video", "out.avi")
    assert fails("--image", photo / "photo.png") == "--image and --camera go together"

    image = ("--image", photo / "photo.png", "--pick", "can", "--camera")
    assert "--pick CLASS" in fails("--image", photo / "photo.png", "--camera", photo / "posed.yml")
    assert "the camera has no extrinsics" in fails(*image, photo / "unposed.yml")
    assert "no class 'moon'" in fails(*image[:3], "moon", *image[4:], photo / "posed.yml")
    assert fails(*image, photo / "posed.yml", "--pick", "ball") == f"{photo / 'photo.png'}: no ball is seen"
    assert "leave out --bin" in fails(*image, photo / "posed.yml", "--bin", "can")
    assert "no place" in fails(*image, photo / "posed.yml", "--place", "inf", 0)
    told = fails("--image", photo / "small.png", "--pick", "can", "--camera", photo / "posed.yml")
    assert told == "the image is 320 x 240, the camera was calibrated for 640 x 480: give one of its own"
    assert str(photo / "absent.png") in fails("--image", photo / "absent.png", *image[2:], photo / "posed.yml")
    assert str(photo / "absent.yml") in fails(*image, photo / "absent.yml")


def test_policies_of_another_arm_or_site_are_one_line(fails: Fails, tmp_path: Path):
    policy = shipped("arm5.xml").policy
    with zipfile.ZipFile(policy) as before, zipfile.ZipFile(tmp_path / "site.zip", "w") as after:
        for name in before.namelist():
            after.writestr(name, before.read(name).replace(b'site = "grasp"', b'site = "ee"'))
    (tmp_path / "cut.zip").write_bytes(policy.read_bytes()[:5000])
    assert 'site = "grasp"' in fails("--policy", tmp_path / "site.zip")
    assert "is no policy, or damaged" in fails("--policy", tmp_path / "cut.zip")
    assert fails("--policy", policy, "--arm", "arm7_gripper.xml").startswith("the policy is of another arm (theta_1, ")
    assert "no site, body or geom 'grasp'" in fails("--policy", policy, "--arm", "arm7.xml")


def test_export_writes_what_grasp_reads(capsys: pytest.CaptureFixture[str], fails: Fails, tmp_path: Path):
    small = {"actor_width": 16, "actor_depth": 1, "critic_width": 8, "critic_depth": 1, "replay_capacity": 64}
    created = Run.create(load_config("kinematic.toml", arm="arm5.xml", site="grasp", **small), tmp_path / "run")
    created.checkpoints().save(created.trainer()._init(created.config.ddpg, jax.random.key(0)))
    capsys.readouterr()
    assert run("export", tmp_path / "run", tmp_path / "policy.zip") == 0
    assert capsys.readouterr().out.startswith(f"{tmp_path / 'policy.zip'}: ")
    for source in ("policy.zip", "run"):
        assert fails("--policy", tmp_path / source).startswith("the policy is of Reach and not for grasping: train one")
    for bad in ("policy.zip", "policy.tar", "nowhere/policy.zip"):
        assert _fails(capsys, "export", tmp_path / "run", tmp_path / bad).count("\n") == 1
    assert "arm5dof: " in _fails(capsys, "export", tmp_path, tmp_path / "other.zip")
    assert not (tmp_path / "other.zip").exists()
