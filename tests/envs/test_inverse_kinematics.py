"""Corrections of answers, with a policy that answers at random."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

from arm5dof.arm import Arm
from arm5dof.envs.inverse_kinematics import AT_ONCE, Answer, Candidate, candidates, nearest, solve
from arm5dof.envs.reach import Reach, ReachConfig
from arm5dof.envs.reach_pose import ReachPose, ReachPoseConfig

BRANCHES = 3


class Random:
    """Answers that have nothing to do with the goal."""

    def __init__(self, size: int, n: int) -> None:
        self.actions = jax.random.uniform(jax.random.key(2), (BRANCHES, n, size), minval=-1, maxval=1)

    def of(self, n: int) -> Random:
        """The same for so many goals."""
        return Random(self.actions.shape[-1], n)

    def __call__(self, obs, branch=None):
        return self.actions[self.branch(obs) if branch is None else branch, jnp.arange(len(obs["state"]))]

    def branch(self, obs):
        return jnp.zeros(len(obs["state"]), int)

    def answers(self, obs):
        return self.actions[:, : len(obs["state"])].swapaxes(0, 1)


@pytest.mark.parametrize("stretch", [1.0, 1.5])
def test_least_squares_leaves_nothing_to_scipys(arm: Arm, stretch: float):
    """Started at our answer, within the same limits, it comes no nearer, be the goal within reach or not."""
    n = 30
    env, act = Reach(ReachConfig(dynamics="kinematic", correction="jacobian", branches=1), arm), Random(arm.dof, n)
    goals = jax.vmap(env.sample_goal)(jax.random.split(jax.random.key(1), n))
    goals = env.arm.origin + (goals - env.arm.origin) * stretch
    answer = jax.tree.map(lambda x: x[0], candidates(env, act, goals, 40, 1).answer)
    ours, actions = np.asarray(answer.errors["distance"]), np.asarray(jax.vmap(env.arm.to_action)(answer.q))
    assert np.abs(actions).max() <= 1 + 1e-6
    assert (ours < solve(env, act, goals, 0).answer.errors["distance"]).all()
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
        answer = candidates(env, Random(arm.dof, 200), goals, 10, env.branches).answer
        forward = jax.vmap(jax.vmap(env.forward))
        np.testing.assert_allclose(forward(answer.q).position, answer.outcome.position, atol=1e-6)
        found = np.asarray((answer.errors["distance"] < 1e-3) & (answer.errors["angle"] < 0.01))
        return found.any(0).mean()

    one, three, seven = met(branches=1), met(branches=3), met(branches=3, restarts=4)
    assert 0.1 < one < three - 0.1 and three < seven - 0.05


@pytest.mark.parametrize("stretch", [0.8, 1.3])
def test_what_is_missed_is_answered_by_the_nearest(arm: Arm, stretch: float):
    """Of a policy that knows nothing; from each of many random poses SciPy's least squares comes no nearer than a
    tenth and 2 mm, be the goal within reach or not."""
    n = 20
    env, act = Reach(ReachConfig(dynamics="kinematic"), arm), Random(arm.dof, n)
    goals = jax.vmap(env.sample_goal)(jax.random.split(jax.random.key(1), n))
    goals = env.arm.origin + (goals - env.arm.origin) * stretch
    missed = jnp.zeros((n, arm.dof))
    found = Candidate(missed, Answer(missed, goals, {"distance": jnp.ones(n)}), -jnp.ones(n))
    ours = np.asarray(jax.jit(lambda g: nearest(env, act.of(AT_ONCE), g, found))(goals).answer.errors["distance"])
    away = jax.jit(lambda action, goal: env.residual(env.outcome(action), goal))
    jacobian = jax.jit(jax.jacfwd(away))
    starts = np.random.default_rng(0).uniform(-0.99, 0.99, (8, arm.dof))
    theirs = [
        np.sqrt(2 * min(least_squares(away, q, jacobian, (-1, 1), args=(goal,)).cost for q in starts)) for goal in goals
    ]
    assert (ours <= 1.1 * np.array(theirs) + 2e-3).all()
    assert (ours < 1e-3).mean() > 0.7 if stretch < 1 else (ours > 1e-3).mean() > 0.3


def test_what_is_met_stays_as_it_is(arm: Arm):
    """And one goal's answer does not depend on the others beside it."""
    n = 300
    env, act = Reach(ReachConfig(dynamics="kinematic"), arm), Random(arm.dof, n)
    q = env.arm.sample(jax.random.key(1), (n,))
    goals, action = env.arm.forward(q), jax.vmap(env.arm.to_action)(q)
    off = jnp.where(jnp.arange(n) % 2 == 0, 0.0, 0.05)
    found = Candidate(action, Answer(q, goals, {"distance": off}), -off)
    kept = jax.jit(lambda g: nearest(env, act.of(AT_ONCE), g, found))(goals)
    np.testing.assert_array_equal(kept.answer.q[::2], q[::2])
    assert (np.abs(kept.answer.q - q).max(1)[1::2] > 0).all()
    np.testing.assert_allclose(env.arm.forward(kept.answer.q), kept.answer.outcome, atol=1e-6)
    assert (np.asarray(kept.answer.errors["distance"])[1::2] < 1e-3).all()
