"""What Python users meet first: the package's names, its examples, and what it says of mistakes."""

import doctest
import os
import subprocess
import sys
from importlib import resources

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.errors import said

import arm5dof
from arm5dof.arm import Arm
from arm5dof.ddpg import DDPGConfig
from arm5dof.envs.reach import ReachConfig
from arm5dof.errors import UserError
from arm5dof.training.config import load_config
from arm5dof.training.run import Run


def python(code, **environment):
    """What a fresh interpreter prints."""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env={**os.environ, **environment}
    )
    return done.stdout


def test_importing_the_package_costs_and_changes_nothing():
    code = """
import os, sys, time
before, started = dict(os.environ), time.process_time()
import arm5dof
print(time.process_time() - started)
assert dict(os.environ) == before
print(*({"jax", "mujoco", "cv2", "numpy", "pydantic"} & set(sys.modules)))
"""
    runs = [python(code).splitlines() for _ in range(3)]
    assert min(float(seconds) for seconds, _ in runs) < 0.1
    assert [heavy for _, heavy in runs] == [""] * 3


def test_every_public_name_is_found_and_listed():
    assert len(arm5dof.__all__) == len(set(arm5dof.__all__))
    for name in arm5dof.__all__:
        assert getattr(arm5dof, name).__name__ == name
    assert set(arm5dof.__all__) <= set(dir(arm5dof))
    fresh = "import arm5dof; print(sorted(arm5dof.__all__) == sorted(set(arm5dof.__all__) & set(dir(arm5dof))))"
    assert python(fresh) == "True\n"
    with pytest.raises(AttributeError, match="no attribute 'Arn'"):
        _ = arm5dof.Arn
    with pytest.raises(ImportError, match="nothing"):
        from arm5dof import nothing  # noqa: F401


def test_type_checkers_may_use_the_packages_types():
    assert (resources.files("arm5dof") / "py.typed").is_file()


def test_every_public_name_has_an_example_that_runs():
    finder = doctest.DocTestFinder(recurse=False)
    for name in arm5dof.__all__:
        (found,) = finder.find(getattr(arm5dof, name), name)
        assert found.examples, f"{name} has no example"
        assert not any(example.options.get(doctest.SKIP) for example in found.examples), name


@pytest.mark.parametrize("method", ["forward", "pose", "joint_positions", "to_joints", "to_action", "to_ctrl"])
def test_an_arm_says_how_many_joints_it_has(arm: Arm, method: str):
    call = getattr(arm, method)
    good = jax.tree.leaves(call(np.zeros((2, 7, 5))))
    assert all(leaf.shape[:2] == (2, 7) for leaf in good)
    for wrong in (np.zeros(4), np.zeros((5, 1)), np.zeros((3, 6)), 0.0, np.zeros(0)):
        text = said(lambda wrong=wrong: call(wrong))
        assert text.endswith(f"takes a number for each of 5 joints, not shape {np.shape(wrong)}")
    with pytest.raises(UserError, match="5 joints"):
        jax.jit(call)(jnp.zeros(4))


def test_settings_are_checked_where_they_are_made():
    assert said(lambda: DDPGConfig(actor_lr=-1)) == "actor_lr = -1: input should be greater than 0"
    assert "'servo' or 'kinematic'" in said(lambda: ReachConfig(dynamics="nope"))
    assert load_config(actor_lr=".001").ddpg.actor_lr == 0.001
    assert "ddpg.actor_lr = 'fast'" in said(lambda: load_config(actor_lr="fast"))
    assert "did you mean 'actor_lr'" in said(lambda: load_config(actor_rl=0.1))


def test_folders_may_be_text(tmp_path):
    settings = load_config("kinematic.toml")
    created = Run.create(settings, str(tmp_path / "run"))
    opened = Run.open(str(tmp_path / "run"))
    assert opened.config == created.config == settings and opened.folder == created.folder
    assert "is no run" in said(lambda: Run.open(str(tmp_path)))
    assert "no checkpoint yet" in said(opened.policy)


def test_objects_show_themselves_as_tables(arm: Arm, tmp_path):
    run = Run.create(load_config("kinematic.toml"), tmp_path / "run")
    for shown, words in (
        (arm, ["Arm of 5 joints", "theta_3", "hinge", "position"]),
        (run, [f"Run {tmp_path / 'run'}, task reach", "episodes", "metric"]),
    ):
        text, html = repr(shown), shown._repr_html_()
        assert all(word in text and word in html for word in words)
        title, *rows = text.splitlines()
        assert title.partition("'")[0] in html and html.count("<tr>") == len(rows)
