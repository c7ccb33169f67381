"""Inverse kinematics by a policy: goals in, joint positions out, and a loop that corrects what to ask for."""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from arm5dof.envs.base import Act, ForwardModel, Goal

T = TypeVar("T")


class Answer(NamedTuple):
    """Answers to n goals, or to a single one without the leading axis."""

    q: jax.Array
    """Joint positions, (n, dof), radians (metres for slides)."""
    outcome: Goal
    """Where they lead by forward kinematics, a goal with leading axis n."""
    errors: dict[str, jax.Array]
    """How far that is from the goal, by component: (n,) each, metres or radians."""


def solve(env: ForwardModel, act: Act, goals: Goal, corrections: int) -> Answer:
    """Ask a policy for actions that lead to goals (leading axis n), from the arm's home pose.

    With `corrections` > 0 it is asked again as often, for goals shifted by the error that it was seen to make
    (closed-loop target correction); the answer of the highest reward counts. No Jacobian is involved, and each of the
    candidate answers that are followed (`env.branches`) keeps to its branch.
    """
    if not corrections or env.branches == 1:
        return _follow(env, act, goals, act.branch(jax.vmap(env.question)(goals)), corrections)[0]
    branches = act.branches(jax.vmap(env.question)(goals))[:, : env.branches]
    answers, rewards = jax.lax.map(lambda branch: _follow(env, act, goals, branch, corrections), branches.T)
    best = rewards.argmax(0)
    return jax.tree.map(lambda x: x[best, jnp.arange(len(best))], answers)


def _follow(env: ForwardModel, act: Act, goals: Goal, branch: jax.Array, corrections: int) -> tuple[Answer, jax.Array]:
    """The best answers of given branches (n,), and their rewards (n,)."""
    observe = jax.vmap(env.question)

    def ask(asked: Goal) -> tuple[Answer, jax.Array]:
        action = act(observe(asked), branch)
        outcome = jax.vmap(env.outcome)(action)
        reward, _ = jax.vmap(env.goal_reward)(outcome, goals, action)
        return Answer(jax.vmap(env.joints)(action), outcome, jax.vmap(env.errors)(outcome, goals)), reward

    asked = goals
    best = answer, reward = ask(goals)
    for _ in range(corrections):
        asked = jax.vmap(env.correct)(asked, answer.outcome, goals)
        answer, reward = ask(asked)
        best = choose(reward > best[1], (answer, reward), best)
    return best


def choose(mask: jax.Array, where_true: T, where_false: T) -> T:
    """Of two pytrees with leading axis n, the rows of the one where `mask` (n,) is true, and of the other elsewhere."""
    pick = lambda a, b: jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - 1)), a, b)
    return jax.tree.map(pick, where_true, where_false)
