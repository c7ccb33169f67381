"""Corrections of answers, with a policy that answers at random."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

from arm5dof.arm import Arm
from arm5dof.envs.inverse_kinematics import solve
from arm5dof.envs.reach import Reach, ReachConfig
from arm5dof.envs.reach_pose import ReachPose, ReachPoseConfig

BRANCHES = 3


class Random:
    """Answers that have nothing to do with the goal."""

    def __init__(self, size: int, n: int) -> None:
        self.actions = jax.random.uniform(jax.random.key(2), (BRANCHES, n, size), minval=-1, maxval=1)

    def __call__(self, obs, branch=None):
        return self.actions[self.branch(obs) if branch is None else branch, jnp.arange(len(obs["state"]))]

    def branch(self, obs):
        return jnp.zeros(len(obs["state"]), int)

    def branches(self, obs):
        return jnp.tile(jnp.arange(BRANCHES), (len(obs["state"]), 1))


@pytest.mark.parametrize("stretch", [1.0, 1.5])
def test_least_squares_leaves_nothing_to_scipys(arm: Arm, stretch: float):
    """Started at our answer, within the same limits, it comes no nearer, be the goal within reach or not."""
    n = 30
    env, act = Reach(ReachConfig(dynamics="kinematic", correction="jacobian", branches=1), arm), Random(arm.dof, n)
    goals = jax.vmap(env.sample_goal)(jax.random.split(jax.random.key(1), n))
    goals = env.arm.origin + (goals - env.arm.origin) * stretch
    answer = solve(env, act, goals, 40)
    ours, actions = np.asarray(answer.errors["distance"]), np.asarray(jax.vmap(env.arm.to_action)(answer.q))
    assert np.abs(actions).max() <= 1 + 1e-6
    assert (ours < solve(env, act, goals, 0).errors["distance"]).all()
    away = jax.jit(lambda action, goal: env.residual(env.outcome(action), goal))
    jacobian = jax.jit(jax.jacfwd(away))
    inside = np.clip(actions, -0.99999, 0.99999)
    fits = [least_squares(away, q, jacobian, (-1, 1), args=(goal,)) for q, goal in zip(inside, goals, strict=True)]
    theirs = np.sqrt([2 * fit.cost for fit in fits])
    assert (ours <= 1.005 * theirs + 1e-5).all()
    assert (ours < 1e-5).mean() > 0.5 if stretch == 1 else (ours > 1e-3).mean() > 0.5


@pytest.mark.parametrize("orientation", ["approach", "rotation"])
def test_a_residual_is_as_long_as_the_reward_says(arm: Arm, orientation: str):
    """Near the goal, where it matters; farther away the chord of an angle is shorter than its arc."""
    env = ReachPose(ReachPoseConfig(dynamics="kinematic", orientation=orientation), arm)
    q = env.arm.sample(jax.random.key(3), (200,))
    one, other = (
        jax.vmap(env.forward)(q),
        jax.vmap(env.forward)(q + 0.01 * jax.random.normal(jax.random.key(4), q.shape)),
    )
    length = jnp.linalg.norm(jax.vmap(env.residual)(one, other), axis=-1)
    reward, _ = jax.vmap(env.goal_reward)(one, other, q)
    np.testing.assert_allclose(length, -reward, rtol=2e-3, atol=1e-6)


def test_more_starts_reach_more_goals(arm: Arm):
    def met(**settings) -> float:
        env = ReachPose(ReachPoseConfig(dynamics="kinematic", tool_axis="x", correction="jacobian", **settings), arm)
        goals = jax.vmap(env.sample_goal)(jax.random.split(jax.random.key(1), 200))
        answer = solve(env, Random(arm.dof, 200), goals, 10)
        np.testing.assert_allclose(jax.vmap(env.forward)(answer.q).position, answer.outcome.position, atol=1e-6)
        found = np.asarray((answer.errors["distance"] < 1e-3) & (answer.errors["angle"] < 0.01))
        return found.mean()

    one, three, seven = met(branches=1), met(branches=3), met(branches=3, restarts=4)
    assert 0.1 < one < three - 0.1 and three < seven - 0.05
