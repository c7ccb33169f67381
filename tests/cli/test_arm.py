"""`arm5dof arm`: how a robot is read, and what it can be trained in."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import mujoco
import numpy as np
import pytest

from arm5dof.arm import load_arm
from arm5dof.cli import main as cli

ROVER = """<mujoco><compiler angle="radian"/><worldbody><body name="chassis" pos="0 0 .2"><freejoint/><geom size=".2"/>
    <body pos="0 0 .2"><joint/><geom size=".05" contype="0" conaffinity="0"/>
    <body name="lift"><joint name="lift" type="slide" range="0 .3"/><geom size=".05" contype="0" conaffinity="0"/>
    <body name="hand" pos=".3 0 0"><geom size=".05" contype="0" conaffinity="0"/></body></body></body></body>
    </worldbody><actuator><position joint="lift"/></actuator></mujoco>"""


@pytest.fixture
def rover(tmp_path: Path) -> Path:
    path = tmp_path / "rover.xml"
    path.write_text(ROVER)
    return path


def test_a_new_robot_is_told_of(rover: Path, capsys):
    assert cli.main(["arm", str(rover)]) == 2
    assert 'hold what carries the arm still, base = "chassis"' in capsys.readouterr().err
    assert cli.main(["arm", str(rover), "--base", "chassis"]) == 0
    title, *rows = capsys.readouterr().out.splitlines()
    assert "joint_0 held" in title and "chosen: body 'hand', by its name" in title and "reach 0.424 m" in title
    assert [row.split() for row in rows[1:3]] == [
        ["joint_0", "continuous", "-180.0", "180.0", "deg", "none"],
        ["lift", "slide", "0.0", "300.0", "mm", "position"],
    ]
    assert rows[3] == "kinematic dynamics: yes"
    assert rows[4].startswith("servo dynamics: yes, the servos computed for joint_0 ")


def test_json_is_in_radians_and_metres(rover: Path, capsys):
    assert cli.main(["arm", str(rover), "--base", "chassis", "--site", "body lift 0.3 0 0", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["end_effector"], told["chosen"], told["held"]) == ("body lift 0.3 0 0", None, ["joint_0"])
    lift = {"name": "lift", "kind": "slide", "unit": "m", "lower": 0.0, "upper": 0.3, "actuator": "position"}
    assert told["joints"][1] == lift and told["joints"][0]["lower"] == -np.pi
    assert told["reach_m"] == pytest.approx(np.hypot(0.3, 0.3)) and told["base"]["position_m"] == [0, 0, 0.2]
    assert told["dynamics"]["kinematic"]["works"] and told["dynamics"]["kinematic"]["reason"] is None
    servo = told["dynamics"]["servo"]
    assert servo["works"] and servo["computed"] == ["joint_0"]
    assert servo["rest_seconds"] < 5


def test_the_figure_shows_the_axes_of_the_end_effector(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setenv("MUJOCO_GL", "off")
    path = tmp_path / "arm.png"
    assert cli.main(["arm", "arm7.xml", "--figure", str(path)]) == 0
    assert "the servos settle in 3 physics steps, which MJX simulates at every transition" in capsys.readouterr().out
    blue, green, red = np.moveaxis(cv2.imread(str(path)).astype(int), -1, 0)
    for one, *others in ((red, green, blue), (green, red, blue), (blue, red, green)):
        assert ((one > 60) & (one > 3 * np.maximum(*others))).sum() > 100
    assert 0.5 < (np.minimum(np.minimum(red, green), blue) == 255).mean() < 0.99
    assert cli.main(["arm", "arm7.xml", "--figure", str(path)]) == 2
    assert "exists" in capsys.readouterr().err


def test_what_a_training_keeps_is_what_was_told(rover: Path):
    told = load_arm(rover, base="chassis")
    kept = load_arm(mujoco.MjModel.from_xml_string(told.mj_spec.to_xml()), base="chassis")
    assert kept.joint_names == told.joint_names and kept.why_site == ""
    np.testing.assert_allclose(kept.chain[-1].offset, told.chain[-1].offset)
