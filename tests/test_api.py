"""What Python users meet first: the package's names, its examples, and what it says of mistakes."""

import doctest
import os
import re
import subprocess
import sys
from importlib import resources

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import arm5dof
from arm5dof.arm import Arm
from arm5dof.ddpg import DDPG, DDPGConfig
from arm5dof.envs import Reach, ReachConfig
from arm5dof.errors import UserError
from arm5dof.training.config import load_config
from arm5dof.training.policy import Policy
from arm5dof.training.run import Run

SMALL = load_config("kinematic.toml", actor_width=16, actor_depth=1, critic_width=8, heads=3).ddpg


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


@pytest.fixture(scope="module")
def policy(kinematic: Reach) -> Policy:
    """A policy that has learnt nothing."""
    agent = DDPG(kinematic, SMALL, num_envs=2, episode_length=kinematic.episode_length, total_steps=1)
    return Policy(kinematic, agent, SMALL, jax.jit(agent.init)(SMALL, jax.random.key(0)).networks)


def said(call) -> str:
    """The one line of the `UserError` that a call raises."""
    with pytest.raises(UserError) as caught:
        call()
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_one_goal_is_answered_as_the_first_of_many(policy: Policy):
    one, many = policy.solve([0.15, 0.05, 0.12], corrections=2), policy.solve([[0.15, 0.05, 0.12]], corrections=2)
    assert one.q.shape == (5,) and one.outcome.shape == (3,) and one.errors["distance"].shape == ()
    assert many.q.shape == (1, 5) and many.outcome.shape == (1, 3) and many.errors["distance"].shape == (1,)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b[0]), one, many)
    by_name = policy.solve(target=np.array([0.15, 0.05, 0.12]), corrections=2)
    jax.tree.map(np.testing.assert_array_equal, one, by_name)


@pytest.mark.parametrize(
    "target",
    [
        *([], [[]], np.zeros((0, 3))),
        *([0.1, 0.2], [[0.1, 0.2]], [[0.1, 0.2, 0.3], [0.1]], np.zeros((1, 1, 3))),
        *(0.1, "here", None, [["x", "y", "z"]]),
    ],
    ids=repr,
)
def test_what_is_no_target_is_told_what_one_is(policy: Policy, target):
    assert said(lambda: policy.solve(target)).startswith("target takes 3 numbers (x, y, z), or rows of them, not ")


def test_solve_says_what_it_takes(policy: Policy):
    point = [0.1, 0.1, 0.1]
    assert said(lambda: policy.solve([0.1, float("nan"), 0.1])) == "target 1 is not finite: 0.1 nan 0.1"
    assert said(lambda: policy.solve([point, [0.1, 0, -np.inf]])) == "target 2 is not finite: 0.1 0.0 -inf"
    takes = "solve takes target (x, y, z) for this task, each once, not "
    assert said(lambda: policy.solve(taget=point)) == f"{takes}taget"
    assert said(lambda: policy.solve(point, approach=point)) == f"{takes}target, approach"
    assert said(lambda: policy.solve(point, target=point)) == f"{takes}target, target"
    assert said(lambda: policy.solve()) == f"{takes}nothing"
    for wrong in (-1, 1.5, "2"):
        said_of = said(lambda wrong=wrong: policy.solve(point, corrections=wrong))
        assert said_of == f"corrections = {wrong!r}: it should be a whole number, 0 or more"


def test_a_policy_takes_one_observation_or_many(policy: Policy):
    obs = jax.jit(jax.vmap(policy.env.reset))(jax.random.split(jax.random.key(1), 7)).obs
    actions, branches = policy(obs), policy.branch(obs)
    assert actions.shape == (7, 5) and branches.shape == (7,)
    one = jax.tree.map(lambda x: x[3], obs)
    assert policy(one).shape == (5,) and policy.branch(one).shape == ()
    np.testing.assert_allclose(policy(one), actions[3], atol=1e-6)
    np.testing.assert_allclose(jax.jit(policy)(one), actions[3], atol=1e-6)
    np.testing.assert_allclose(jax.jit(jax.vmap(policy))(obs), actions, atol=1e-6)
    other = (branches + 1) % 3
    np.testing.assert_allclose(policy(one, other[3]), policy(obs, other)[3], atol=1e-6)
    assert np.abs(policy(one, other[3]) - actions[3]).max() > 1e-3
    arrays = jax.tree.map(np.asarray, obs)
    np.testing.assert_array_equal(policy(arrays), actions)


def test_a_policy_says_what_it_acts_on(policy: Policy):
    state, privileged = jnp.zeros((4, 3)), jnp.zeros((4, 11))
    takes = "a policy acts on observations, a dictionary of privileged_state (11,) and state (3,), not "
    assert said(lambda: policy([0.1, 0.1, 0.1])) == f"{takes}list; for goals use solve"
    assert said(lambda: policy({"state": state})) == f"{takes}state; for goals use solve"
    assert said(lambda: policy({})).startswith(takes)
    for wrong in (
        {"state": state[:, :2], "privileged_state": privileged},
        {"state": state, "privileged_state": privileged[:, :10]},
        {"state": state[0], "privileged_state": privileged},
        {"state": state[:2], "privileged_state": privileged},
        {"state": state[None], "privileged_state": privileged[None]},
        {"state": 3.0, "privileged_state": privileged},
    ):
        for call in (policy, policy.branch, jax.jit(policy)):
            text = said(lambda call=call, wrong=wrong: call(wrong))
            assert text.startswith("this policy acts on privileged_state (11,) and state (3,), or (n, size) for n ")
            assert f"state {np.shape(wrong['state'])}" in text


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


def test_objects_show_themselves_as_tables(policy: Policy, arm: Arm, tmp_path):
    run = Run.create(load_config("kinematic.toml"), tmp_path / "run")
    for shown, words in (
        (arm, ["Arm of 5 joints", "theta_3", "hinge", "from (deg, mm)"]),
        (policy, ["Policy", "Reach", "3 heads", "target (x, y, z)"]),
        (run, [f"Run {tmp_path / 'run'}, task reach", "episodes", "metric"]),
    ):
        text, html = repr(shown), shown._repr_html_()
        for word in words:
            assert word in text and word in html
        rows = text.splitlines()[1:]
        assert html.count("<tr>") == html.count("</tr>") == len(rows)
        starts = [m.start() for m in re.finditer(r"(?<=  )\S", rows[0])]
        assert all(row[at - 1] == " " for row in rows for at in starts if len(row) > at)
