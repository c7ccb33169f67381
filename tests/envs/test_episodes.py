"""Episodes of arms whose servos are slow, against C MuJoCo's own loop of steps."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from helpers.soft import soft_arm

from arm5dof import load_config, train
from arm5dof.arm import Arm
from arm5dof.arm.servos import MOST_S, Servos
from arm5dof.envs.episodes import settled
from arm5dof.envs.reach import Reach, ReachConfig

N = 40


@pytest.fixture(scope="module")
def soft() -> Arm:
    return soft_arm()


@pytest.fixture(scope="module")
def env(soft: Arm) -> Reach:
    return Reach(ReachConfig(), soft)


def test_slow_servos_are_told_of_and_not_simulated_at_every_transition(env: Reach, soft: Arm):
    steps = Servos(soft).settle_steps
    assert steps > env.config.substeps and "the servos bring the arm to rest" in env.about
    state = jax.jit(env.step)(env.reset(jax.random.key(0)), jnp.full(5, 0.3))
    np.testing.assert_allclose(soft.to_action(state.data.qpos[soft.qpos]), 0.3, atol=1e-5)
    quick = Reach(ReachConfig(substeps=steps), soft)
    state = jax.jit(quick.step)(quick.reset(jax.random.key(0)), jnp.full(5, 0.3))
    sag = np.abs(soft.to_action(state.data.qpos[soft.qpos]) - 0.3).max()
    assert 1e-3 < sag < 0.1 and "the servos" not in quick.about


def test_uncorrected_errors_are_those_of_a_plain_loop(env: Reach, soft: Arm):
    start, wanted = soft.sample(jax.random.key(1), (2, N))
    goals = jax.vmap(env.forward)(wanted)
    state = jax.vmap(env.start)(start, goals)
    errors = jax.jit(lambda: settled(env, Servos(soft), wanted, state, 0))()
    data, model = mujoco.MjData(soft.free_model), soft.free_model
    for i in range(N):
        mujoco.mj_resetData(model, data)
        data.qpos[soft.qpos], data.ctrl[soft.actuators] = start[i], wanted[i]
        mujoco.mj_step(model, data, nstep=int(2 * MOST_S / model.opt.timestep))
        mujoco.mj_kinematics(model, data)
        expected = np.linalg.norm(data.site_xpos[soft.site] - goals[i])
        assert errors["distance"][i] == pytest.approx(expected, abs=5e-4)
    assert np.median(errors["distance"]) > 2e-3


def test_what_gravity_pulls_down_is_told_again(env: Reach, soft: Arm):
    start, wanted = 0.9 * soft.sample(jax.random.key(2), (2, N)) + 0.1 * soft.home
    state = jax.vmap(env.start)(start, jax.vmap(env.forward)(wanted))
    servos = Servos(soft)
    once, often = (
        np.asarray(jax.jit(lambda k=k: settled(env, servos, wanted, state, k))()["distance"]) for k in (0, 10)
    )
    assert (often < 1e-3).all() and np.median(often) < np.median(once) / 10
    # And a population of policies asks for the same.
    together = jax.jit(jax.vmap(lambda q: settled(env, servos, q, state, 10)))(jnp.stack([wanted, wanted]))
    np.testing.assert_allclose(together["distance"][1], often, atol=1e-6)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_what_is_learnt_without_physics_holds_in_it(soft: Arm, seed: int, tmp_path):
    soft.mj_spec.to_file(str(tmp_path / "soft.xml"))
    config = load_config(
        "reach.toml",
        arm=str(tmp_path / "soft.xml"),
        seed=seed,
        episodes=25,
        num_envs=25,
        evaluate_every=25,
        checkpoint_every=25,
        targets=5000,
    )
    run = train(config, tmp_path / "run")
    (last,) = run.evaluations
    within = last["episode"]["within"]
    assert within["5"] >= 99 and within["1"] >= 97
    assert last["counts"] == {"episode": 500} and "| episode, 500 of these |" in (run.folder / "report.md").read_text()


def test_a_policy_whose_servos_fail_is_told_of(env: Reach):
    """By what was measured: nothing reached, and errors as if the arm had stayed."""
    near = {"within": {"20": 100.0}, "median_mm": 0.2}
    far = {"within": {"20": 0.0}, "median_mm": 300.0}
    results = {"one_shot": near, "episode": near, "means": {"initial": 0.3}}
    assert env.failure(results) == ""
    assert "the servos do not bring the arm there" in env.failure({**results, "episode": far})
    assert "reaches nothing" in env.failure({**results, "one_shot": far, "episode": far})
    posed = Reach(replace(env.config, dynamics="kinematic"), env.arm)
    assert posed.failure({**results, "episode": far}) == ""
