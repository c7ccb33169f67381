"""`arm5dof vision doctor` from end to end."""

import json
import os
import subprocess
import sys

import pytest

from arm5dof.cli.main import main
from arm5dof.runtime import files
from arm5dof.vision.rendering import opengl


def test_says_what_works(capsys):
    assert main(["vision", "doctor", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    rendering = {line["what"]: line for line in report["rendering"]}
    assert rendering["software"]["works"] and "ms" in rendering["software"]["detail"]
    for library in opengl.libraries():
        line = rendering[f"OpenGL by {library}"]
        assert line["works"] == (opengl.problem(library) is None)
        assert line["works"] or line["remedy"]
    working = opengl.working_library()
    assert rendering["chosen"]["detail"] == (f"OpenGL by {working}" if working else "software")
    assert all(line["works"] for line in report["detectors"]) and len(report["detectors"]) >= 3


def test_a_choice_that_mujoco_cannot_be_imported_with_is_named_and_left_out():
    environment = {**os.environ, "MUJOCO_GL": "nonsense", "PYTHONPATH": str(files.PACKAGE.parent)}
    done = subprocess.run(
        [sys.executable, "-m", "arm5dof", "vision", "doctor"], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0] == "rendering" and "MUJOCO_GL=nonsense" in lines[1] and "unset MUJOCO_GL" in lines[2]
    assert any("software" in line and "works" in line for line in lines)


def test_takes_no_arguments(capsys):
    assert main(["vision", "doctor", "now"]) == 2
    assert "unexpected argument 'now'" in capsys.readouterr().err


@pytest.mark.parametrize("value", ["off", "disable"])
def test_mujoco_gl_can_forbid_opengl(value, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", value)
    assert opengl.candidates() == ()


def test_mujoco_gl_chooses(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", opengl.libraries()[-1])
    assert opengl.candidates() == (opengl.libraries()[-1],)
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    assert opengl.candidates() == opengl.libraries()
