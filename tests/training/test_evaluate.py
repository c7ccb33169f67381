"""The accuracy protocol, against C MuJoCo and against itself where two figures must agree."""

from __future__ import annotations

import itertools
from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from arm5dof.arm import Arm
from arm5dof.ddpg import DDPG
from arm5dof.envs.episodes import corrected
from arm5dof.envs.inverse_kinematics import candidates
from arm5dof.envs.metrics import Error
from arm5dof.envs.reach import Reach, ReachConfig
from arm5dof.training import evaluate
from arm5dof.training.config import load_config
from arm5dof.training.policy import Policy

SMALL = {"actor_width": 16, "actor_depth": 1, "critic_width": 8, "critic_depth": 1, "heads": 3}
CONFIG = load_config("kinematic.toml", **SMALL).ddpg


@pytest.fixture(scope="module")
def policy(kinematic: Reach) -> Policy:
    """A policy that has learnt nothing: its errors are large, and the same are asked for in every test."""
    agent = DDPG(kinematic, CONFIG, num_envs=2, episode_length=kinematic.config.episode_length, total_steps=1)
    return Policy(kinematic, agent, CONFIG, jax.jit(agent.init)(CONFIG, jax.random.key(0)).networks)


def refined(policy: Policy, refinements: int) -> Policy:
    """The same policy, its evaluation with another number of corrections."""
    return policy.replace(env=Reach(replace(policy.env.config, refinements=refinements), policy.env.arm))


@pytest.fixture(scope="module")
def goals(kinematic: Reach) -> jax.Array:
    return jax.vmap(kinematic.sample_goal)(jax.random.split(jax.random.key(1), 100))


def test_errors_are_what_c_mujoco_finds(policy: Policy, goals: jax.Array):
    answer = policy.solve(goals, corrections=2)
    arm = policy.env.arm
    data = mujoco.MjData(arm.mj_model)
    parts = (answer.q, answer.outcome, answer.errors["distance"], goals)
    for q, position, error, goal in zip(*map(np.asarray, parts), strict=True):
        data.qpos[arm.qpos] = q
        mujoco.mj_kinematics(arm.mj_model, data)
        found = data.site_xpos[arm.site]
        np.testing.assert_allclose(position, found, atol=1e-6)
        assert error == pytest.approx(np.linalg.norm(found - goal), abs=1e-6)


def test_actions_are_those_of_the_heads_that_the_critic_prefers(policy: Policy, goals: jax.Array):
    obs = jax.vmap(policy.env.replace_goal, (None, 0))(policy.env.start(policy.env.arm.home, goals[0]).obs, goals)
    action, _ = policy.agent.act(CONFIG, policy.networks.actor, policy.networks.critic, obs)
    np.testing.assert_allclose(policy(obs), action, atol=1e-6)


def test_asking_again_never_makes_an_answer_worse(policy: Policy, goals: jax.Array):
    errors = [np.asarray(policy.solve(goals, corrections=n).errors["distance"]) for n in range(4)]
    for before, after in itertools.pairwise(errors):
        assert (after <= before).all()
    assert (errors[-1] < errors[0]).any()


class ByCritic:
    """A policy that has one answer to each goal: that of the head which its critic likes best."""

    def __init__(self, policy: Policy, goals: jax.Array) -> None:
        self.policy, self.favourite = policy, policy.branch(jax.vmap(policy.env.question)(goals))

    def __call__(self, obs: dict, branch: jax.Array) -> jax.Array:
        return self.policy(obs, self.favourite)

    def answers(self, obs: dict) -> jax.Array:
        return self(obs, self.favourite)[:, None]


def test_an_episode_ends_where_c_mujoco_brings_the_arm(arm: Arm):
    """A very long one, of which no more is simulated than until the arms are at rest."""
    n, env = 20, Reach(ReachConfig(episode_length=10**7), arm)
    agent = DDPG(env, CONFIG, num_envs=2, episode_length=160, total_steps=1)
    policy = Policy(env, agent, CONFIG, jax.jit(agent.init)(CONFIG, jax.random.key(0)).networks)
    goals = jax.vmap(env.sample_goal)(jax.random.split(jax.random.key(1), n))
    starts = arm.sample(jax.random.key(2), (n,))
    state = jax.vmap(env.start)(starts, goals)
    errors = jax.jit(lambda: corrected(env, policy, state, goals, 0))()["distance"]
    asked = jax.vmap(env.joints)(policy(state.obs))
    model = arm.free_model
    data = mujoco.MjData(model)
    for start, told, goal, error in zip(*map(np.asarray, (starts, asked, goals, errors)), strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos[arm.qpos], data.ctrl[arm.actuators] = start, arm.to_ctrl(told)
        mujoco.mj_step(model, data, nstep=160 * env.config.substeps)
        mujoco.mj_kinematics(model, data)
        assert error == pytest.approx(np.linalg.norm(data.site_xpos[arm.site] - goal), abs=1e-5)


@pytest.mark.parametrize("refinements", [0, 3])
def test_in_the_kinematic_setting_an_episode_is_the_corrected_answer(policy: Policy, refinements: int):
    """There the arm is its forward model, and what an episode shows of an error is what the policy knows already."""
    one, key = refined(policy, refinements), jax.random.key(5)
    found = jax.jit(lambda: one.env.evaluate(one, key, 50))()
    goals = jax.vmap(one.env.sample_goal)(jax.random.split(jax.random.split(key)[0], 50))
    answer = jax.jit(lambda: candidates(one.env, ByCritic(one, goals), goals, refinements, 1))().answer
    np.testing.assert_allclose(found["episode"], answer.errors["distance"][0], rtol=1e-3, atol=1e-6)
    assert (found["refined"] <= found["episode"] + 1e-6).all()
    same = (found["refined"] == found["one_shot"]).all()
    assert same if refinements == 0 else (found["refined"] < 1e-3).mean() > 0.9


def test_the_same_seed_asks_the_same(policy: Policy):
    first, again, other = (evaluate.evaluate(refined(policy, 0), 50, seed=seed) for seed in (3, 3, 4))
    assert first == again
    assert first != other


def test_targets_that_fill_no_chunk_are_counted_exactly(policy: Policy, monkeypatch: pytest.MonkeyPatch):
    """Progress goes to the last target, and a share of 130 targets is a multiple of 1 / 130."""
    monkeypatch.setattr(evaluate, "CHUNK", 50)
    told: list[int] = []
    found = evaluate.evaluate(refined(policy, 0), 130, progress=told.append)
    assert told == [50, 100, 130]
    for share in found["one_shot"]["within"].values():
        assert share * 1.3 == pytest.approx(round(share * 1.3), abs=1e-9)


def test_a_policy_that_always_fails_is_not_accurate(policy: Policy):
    """An arm driven to NaN misses its target, whatever a median would say of NaN."""
    broken = replace(policy, networks=jax.tree.map(lambda p: p * jnp.nan, policy.networks))
    found = evaluate.evaluate(refined(broken, 0), 50)
    for accuracy in (found[name] for name in ("one_shot", "refined", "episode")):
        assert set(accuracy["within"].values()) == {0.0}


def test_accuracy_counts():
    errors = np.array([0.5, 1.0, 4.0, 9.0, 15.0, 30.0, np.inf, 2.0]) / 1e3
    found = Error().summary(errors)
    assert found["within"] == {"1": 25.0, "5": 50.0, "10": 62.5, "20": 75.0}
    assert found["median_mm"] == pytest.approx(6.5)
    assert list(found) == ["median_mm", "p95_mm", "within"]
    lines = evaluate.tables(Reach.metrics, {"one_shot": found}).splitlines()
    assert lines[-1].startswith("| one_shot | 6.50 mm |") and "62.50 %" in lines[-1]
