"""Inverse kinematics by a policy: goals in, joint positions out, and a loop that corrects the answers."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from arm5dof.envs.base import Act, ForwardModel, Goal

T = TypeVar("T")
DAMPING = 1e-4
"""Of the first step, square metres: less than the square of what a joint's whole range moves."""
LIMIT = 1e-4
"""Actions nearer to a limit count as at it: an actor's tanh only comes near."""


class Answer(NamedTuple):
    """Answers to n goals, or to a single one without the leading axis."""

    q: jax.Array
    """Joint positions, (n, dof), radians (metres for slides)."""
    outcome: Goal
    """Where they lead by forward kinematics, a goal with leading axis n."""
    errors: dict[str, jax.Array]
    """How far that is from the goal, by component: (n,) each, metres or radians."""


def solve(env: ForwardModel, act: Act, goals: Goal, corrections: int) -> Answer:
    """Ask a policy for actions that lead to goals (leading axis n), from the arm's home pose: its preferred answer, or
    with `corrections` > 0 of all `candidates` the one of the highest reward."""
    if corrections:
        answers, rewards = candidates(env, act, goals, corrections)
        best = rewards.argmax(0)
        return jax.tree.map(lambda x: x[best, jnp.arange(len(best))], answers)
    return _judge(env, goals, act(jax.vmap(env.question)(goals)))[0]


def candidates(env: ForwardModel, act: Act, goals: Goal, corrections: int) -> tuple[Answer, jax.Array]:
    """Several answers to each goal, (candidates, n), the policy's preferred one first, and their rewards.

    Those that are followed (`env.branches`) are corrected so often, each on its own branch. How is for the task to say
    (`env.correction`): "target" asks the policy again, for goals shifted by the error that it was seen to make, with
    no Jacobian; "jacobian" takes steps of damped least squares within the joint limits, also from a few random poses
    (`env.restarts`).
    """
    observe = jax.vmap(env.question)
    judge = partial(_judge, env, goals)

    def follow(branch: jax.Array) -> tuple[Answer, jax.Array]:
        asked = goals
        best = answer, reward = judge(act(observe(goals), branch))
        for _ in range(corrections):
            asked = jax.vmap(env.correct)(asked, answer.outcome, goals)
            answer, reward = judge(act(observe(asked), branch))
            best = choose(reward > best[1], (answer, reward), best)
        return best

    def descend(action: jax.Array) -> tuple[Answer, jax.Array]:
        return judge(jax.vmap(partial(_descend, env, corrections))(action, goals))

    obs = observe(goals)
    if env.correction == "target":
        if env.branches == 1:
            return jax.tree.map(lambda x: x[None], follow(act.branch(obs)))
        return jax.lax.map(follow, act.branches(obs)[:, : env.branches].T)
    first = jax.lax.map(partial(act, obs), act.branches(obs)[:, : env.branches].T)
    random = jax.random.uniform(jax.random.key(0), (env.restarts, *first.shape[1:]), minval=-1, maxval=1)
    return jax.lax.map(descend, jnp.concatenate([first, random]))


def _judge(env: ForwardModel, goals: Goal, action: jax.Array) -> tuple[Answer, jax.Array]:
    """Actions (n, action_size) as answers to goals, and their rewards (n,)."""
    outcome = jax.vmap(env.outcome)(action)
    reward, _ = jax.vmap(env.goal_reward)(outcome, goals, action)
    return Answer(jax.vmap(env.joints)(action), outcome, jax.vmap(env.errors)(outcome, goals)), reward


def _descend(env: ForwardModel, steps: int, action: jax.Array, goal: Goal) -> jax.Array:
    """Levenberg-Marquardt from one action (action_size,) to where the residual is smallest within [-1, 1]. An action
    at a limit that it would cross stays there for that step."""

    def residual(action: jax.Array) -> jax.Array:
        return env.residual(env.outcome(action), goal)

    def step(carry: tuple[jax.Array, jax.Array], _: None) -> tuple[tuple[jax.Array, jax.Array], None]:
        action, damping = carry
        now, jacobian = residual(action), jax.jacfwd(residual)(action)
        gradient = jacobian.T @ now
        free = (jnp.abs(action) < 1) | (action * gradient > 0)
        jacobian = jacobian * free
        normal = jacobian.T @ jacobian + jnp.diag(jnp.where(free, damping, 1.0))
        moved = jnp.clip(action - jnp.linalg.solve(normal, gradient * free), -1, 1)
        better = (residual(moved) ** 2).sum() < (now**2).sum()
        return (jnp.where(better, moved, action), damping * jnp.where(better, 0.1, 10.0)), None

    edge = jnp.where(jnp.abs(action) > 1 - LIMIT, jnp.sign(action), action)
    return jax.lax.scan(step, (edge, jnp.asarray(DAMPING)), None, steps)[0][0]


def choose(mask: jax.Array, where_true: T, where_false: T) -> T:
    """Of two pytrees with leading axis n, the rows of the one where `mask` (n,) is true, and of the other elsewhere."""
    pick = lambda a, b: jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - 1)), a, b)
    return jax.tree.map(pick, where_true, where_false)
