"""Several picks and places in a row, in scenes with contacts."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from helpers.errors import said

from arm5dof.arm import load_arm
from arm5dof.grasp.evaluation import Program, Setting
from arm5dof.grasp.jobs import Step, read_job
from arm5dof.grasp.scene import tabletop_scene
from arm5dof.grasp.shipped import shipped
from arm5dof.grasp.world import World
from arm5dof.vision.objects import CLASS_NAMES
from arm5dof.vision.synthetic.scenes import Placement

RED, BLUE, CAN = (CLASS_NAMES.index(name) for name in ("red cube", "blue cube", "can"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "has no steps"),
        ("step = 3", "has no steps"),
        ("[[step]]\npick = ", "not valid TOML"),
        ('[[stpe]]\npick = "can"', "did you mean 'step'?"),
        ('[[step]]\npikc = "can"\nbin = "can"', "did you mean 'pick'?"),
        ('[[step]]\nbin = "can"', "has no pick"),
        ('[[step]]\npick = "cup"\nbin = "can"', "pick = 'cup'"),
        ('[[step]]\npick = "can"\nbin = "bin 3"', "bin = 'bin 3'"),
        ('[[step]]\npick = "can"', "one of place, bin and on"),
        ('[[step]]\npick = "can"\nbin = "can"\non = "ring"', "one of place, bin and on"),
        ('[[step]]\npick = "any"\nplace = [0.1, 0.1]', 'picks "any"'),
        ('[[step]]\npick = "can"\nplace = [0.1]', "two numbers"),
        ('[[step]]\npick = "can"\nplace = [0.1, nan]', "two numbers"),
        (f'[[step]]\npick = "can"\nplace = [0.1, 1{"0" * 400}]', "two numbers"),
        (f"x = 1{'0' * 5000}", "not valid TOML"),
        ("x = " + "[" * 10_000, "not valid TOML"),
    ],
)
def test_what_is_no_job_is_told(tmp_path: Path, text: str, words: str):
    path = tmp_path / "job.toml"
    path.write_text(text)
    told = said(partial(read_job, path))
    assert words in told and str(path) in told


def test_a_file_that_is_not_there_is_told(tmp_path: Path):
    assert "No such file" in said(partial(read_job, tmp_path / "none.toml"))


@pytest.fixture(scope="module")
def program() -> Program:
    """It sees where objects truly are, and is given its scenes."""
    return Program(Setting(shipped("arm5.xml").policy, "arm5.xml", (0.1, 0.25), 1, "truth"))


def trial(program: Program, monkeypatch: pytest.MonkeyPatch, steps: list[Step], *objects: Placement):
    """Do a job with objects that lie in known places."""
    scene = partial(tabletop_scene, 5, objects=objects, distractors=False)
    rest = World(load_arm("arm5.xml", "grasp")).rest(scene().camera)
    made = scene(start=rest)
    monkeypatch.setattr(program, "scene", lambda _: made)
    monkeypatch.setattr(program, "setting", Setting(*([None] * 4), eyes="truth", job=tuple(steps)))  # type: ignore
    return program.trial(0), made


def test_cubes_are_stacked(program: Program, monkeypatch: pytest.MonkeyPatch):
    red, blue = (
        Placement(RED, np.array([0.17, 0.08, 0.0125]), 0.3),
        Placement(BLUE, np.array([0.18, -0.06, 0.0125]), 0.0),
    )
    done, scene = trial(program, monkeypatch, [Step("red cube", on="blue cube")], red, blue)
    (top, below) = scene.object_poses()[0]
    assert done.success and top[2] == pytest.approx(0.0375, abs=1e-3) and np.hypot(*(top - below)[:2]) < 0.01


def test_a_table_is_sorted(program: Program, monkeypatch: pytest.MonkeyPatch):
    lies = [(RED, 0.17, 0.08, 0.0125), (RED, 0.18, -0.06, 0.0125), (CAN, 0.05, 0.18, 0.02)]
    objects = [Placement(kind, np.array([x, y, z]), 0.2) for kind, x, y, z in lies]
    done, scene = trial(program, monkeypatch, [Step("any", bin="class")], *objects)
    assert done.success and scene.in_bin("red cube").tolist() == [True, True, False] and scene.in_bin("can")[2]


def test_what_cannot_be_done_is_said(program: Program, monkeypatch: pytest.MonkeyPatch):
    can = Placement(CAN, np.array([0.05, 0.18, 0.02]), 0.0)
    done, scene = trial(program, monkeypatch, [Step("ring", bin="ring"), Step("can", bin="class")], can)
    assert not done.success and "no ring is seen" in done.said
    assert scene.in_bin("can")[0], "the next step is done all the same"
