"""Inverse kinematics by a policy: goals in, joint positions out, and a loop that corrects the answers."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from arm5dof.envs.base import Act, ForwardModel, Goal

T = TypeVar("T")
DAMPING = 1e-4
"""Of the first step, square metres: less than the square of what a joint's whole range moves."""
LIMIT = 1e-4
"""Actions nearer to a limit count as at it: an actor's tanh only comes near."""
STEPS = 6
"""Of least squares from one goal of a line to the next, which is near."""
LAST_STEPS, LAST_STARTS, AT_ONCE = 30, 8, 128
"""Of least squares to goals that all else missed; from how many random actions besides; how many goals at once."""


class Answer(NamedTuple):
    """Answers to n goals, or to a single one without the leading axis."""

    q: jax.Array
    """Joint positions, (n, dof), radians (metres for slides)."""
    outcome: Goal
    """Where they lead by forward kinematics, a goal with leading axis n."""
    errors: dict[str, jax.Array]
    """How far that is from the goal, by component: (n,) each, metres or radians."""


class Candidate(NamedTuple):
    """Actions (n, action_size), the answers that they are, and their rewards (n,)."""

    action: jax.Array
    answer: Answer
    reward: jax.Array


for kind in (Answer, Candidate):  # So that programs that return them can be kept.
    export.register_namedtuple_serialization(kind, serialized_name=f"arm5dof.{kind.__name__}")


def solve(env: ForwardModel, act: Act, goals: Goal, corrections: int) -> Candidate:
    """Ask a policy for actions that lead to goals (leading axis n), from the arm's home pose: of its answers the one of
    the highest reward by the forward model, or with `corrections` > 0 of all `candidates`, and where that misses the
    `nearest`."""
    if corrections:
        found = candidates(env, act, goals, corrections, env.branches)
        best = found.reward.argmax(0)
        return nearest(env, act, goals, jax.tree.map(lambda x: x[best, jnp.arange(len(best))], found))
    actions = act.answers(jax.vmap(env.question)(goals)).swapaxes(0, 1)

    def better(best: Candidate, action: jax.Array) -> tuple[Candidate, None]:
        other = _judge(env, goals, action)
        return choose(other.reward > best.reward, other, best), None

    # Branch after branch, so that what XLA makes of them stays in a cache.
    return jax.lax.scan(better, _judge(env, goals, actions[0]), actions[1:])[0]


def candidates(env: ForwardModel, act: Act, goals: Goal, corrections: int, branches: int | None = None) -> Candidate:
    """Several answers to each goal, (candidates, n), first the policy's own that comes nearest.

    So many branches as are given, or all, are corrected so often, each for itself. How is for the task to say
    (`env.correction`): "target" asks the policy again, for goals shifted by the error that it was seen to make, with
    no Jacobian; "jacobian" takes steps of damped least squares within the joint limits, also from a few random poses
    (`env.restarts`).
    """
    observe = jax.vmap(env.question)
    judge = partial(_judge, env, goals)

    def follow(branch: jax.Array) -> Candidate:
        def again(_: int, state: tuple[Goal, Candidate, Candidate]) -> tuple[Goal, Candidate, Candidate]:
            asked, now, best = state
            asked = jax.vmap(env.correct)(asked, now.answer.outcome, goals)
            now = judge(act(observe(asked), branch))
            return asked, now, choose(now.reward > best.reward, now, best)

        first = judge(act(observe(goals), branch))
        return jax.lax.fori_loop(0, corrections, again, (goals, first, first))[2]

    def descend(action: jax.Array) -> Candidate:
        return judge(jax.vmap(partial(_descend, env, corrections))(action, goals))

    actions, rewards = _answers(env, act, goals)
    order = jnp.argsort(rewards, descending=True)
    if env.correction == "target":
        if branches == 1:
            return jax.tree.map(lambda x: x[None], follow(order[:, 0]))
        return jax.lax.map(follow, order[:, :branches].T)
    first = actions[jnp.arange(len(order)), order[:, :branches].T]
    random = jax.random.uniform(jax.random.key(0), (env.restarts, *first.shape[1:]), minval=-1, maxval=1)
    return jax.lax.map(descend, jnp.concatenate([first, random]))


def nearest(env: ForwardModel, act: Act, goals: Goal, found: Candidate) -> Candidate:
    """Answers to goals as found, (n,), but where they miss (`Error.close`): there the nearest that the robot can do, by
    damped least squares from all of the policy's answers and from a few random ones. What is not missed costs nothing.
    """
    components = env.components.items()
    missed = jnp.any(jnp.stack([found.answer.errors[name] > error.close for name, error in components]), 0)
    n = len(missed)
    order = jnp.append(jnp.argsort(~missed, stable=True), jnp.full(AT_ONCE, n))  # Out of range: neither read nor kept.
    random = jax.random.uniform(jax.random.key(0), (LAST_STARTS, 1, found.action.shape[-1]), minval=-1, maxval=1)

    def some(state: tuple[jax.Array, Candidate]) -> tuple[jax.Array, Candidate]:
        i, found = state
        rows = jax.lax.dynamic_slice(order, (i,), (AT_ONCE,))
        asked = jax.tree.map(lambda x: x.at[rows].get(mode="clip"), goals)
        starts = act.answers(jax.vmap(env.question)(asked)).swapaxes(0, 1)
        starts = jnp.concatenate([starts, jnp.broadcast_to(random, (LAST_STARTS, *starts.shape[1:]))])
        descend = partial(_descend, env, LAST_STEPS)
        tried = jax.lax.map(lambda start: _judge(env, asked, jax.vmap(descend)(start, asked)), starts)
        best = tried.reward.argmax(0)
        here = jax.tree.map(lambda x: x[best, jnp.arange(AT_ONCE)], tried)
        before = jax.tree.map(lambda x: x.at[rows].get(mode="clip"), found)
        better = missed.at[rows].get(mode="clip") & (here.reward > before.reward)
        here = choose(better, here, before)
        return i + AT_ONCE, jax.tree.map(lambda x, y: x.at[rows].set(y, mode="drop"), found, here)

    return jax.lax.while_loop(lambda state: state[0] < missed.sum(), some, (jnp.array(0), found))[1]


def follow_line(env: ForwardModel, goals: Goal, first: jax.Array) -> Candidate:
    """Answers to goals that lie near each other (leading axis n) by damped least squares, each begun where the one
    before ended, (candidates, n); from several actions (candidates, action_size)."""

    def step(actions: jax.Array, goal: Goal) -> tuple[jax.Array, jax.Array]:
        moved = jax.vmap(partial(_descend, env, STEPS), (0, None))(actions, goal)
        return moved, moved

    actions = jax.lax.scan(step, first, goals)[1].swapaxes(0, 1)
    return jax.lax.map(partial(_judge, env, goals), actions)


def _answers(env: ForwardModel, act: Act, goals: Goal) -> tuple[jax.Array, jax.Array]:
    """A policy's answers to goals, (n, branches, action_size), and their rewards by the forward model."""
    actions = act.answers(jax.vmap(env.question)(goals))

    def reward(action: jax.Array, goal: Goal) -> jax.Array:
        return env.goal_reward(env.outcome(action), goal, action)[0]

    return actions, jax.vmap(jax.vmap(reward, (0, None)))(actions, goals)


def _judge(env: ForwardModel, goals: Goal, action: jax.Array) -> Candidate:
    """Actions (n, action_size) as answers to goals."""
    outcome = jax.vmap(env.outcome)(action)
    reward, _ = jax.vmap(env.goal_reward)(outcome, goals, action)
    answer = Answer(jax.vmap(env.joints)(action), outcome, jax.vmap(env.errors)(outcome, goals))
    return Candidate(action, answer, reward)


def _descend(env: ForwardModel, steps: int, action: jax.Array, goal: Goal) -> jax.Array:
    """Levenberg-Marquardt from one action (action_size,) to where the residual is smallest within [-1, 1]. An action
    at a limit that it would cross stays there for that step; that of a joint that turns comes in again at the other."""
    turns = np.array(env.turns)

    def residual(action: jax.Array) -> jax.Array:
        return env.residual(env.outcome(action), goal)

    def within(action: jax.Array) -> jax.Array:
        limited = jnp.clip(action, -1, 1)
        return jnp.where(turns, (action + 1) % 2 - 1, limited) if turns.any() else limited

    def step(carry: tuple[jax.Array, jax.Array], _: None) -> tuple[tuple[jax.Array, jax.Array], None]:
        action, damping = carry
        now, jacobian = residual(action), jax.jacfwd(residual)(action)
        gradient = jacobian.T @ now
        free = (jnp.abs(action) < 1) | (action * gradient > 0)
        free = free | turns if turns.any() else free
        jacobian = jacobian * free
        normal = jacobian.T @ jacobian + jnp.diag(jnp.where(free, damping, 1.0))
        moved = within(action - jnp.linalg.solve(normal, gradient * free))
        better = (residual(moved) ** 2).sum() < (now**2).sum()
        return (jnp.where(better, moved, action), damping * jnp.where(better, 0.1, 10.0)), None

    edge = jnp.where(jnp.abs(action) > 1 - LIMIT, jnp.sign(action), action)
    return jax.lax.scan(step, (edge, jnp.asarray(DAMPING)), None, steps)[0][0]


def choose(mask: jax.Array, where_true: T, where_false: T) -> T:
    """Of two pytrees with leading axis n, the rows of the one where `mask` (n,) is true, and of the other elsewhere."""
    pick = lambda a, b: jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - 1)), a, b)
    return jax.tree.map(pick, where_true, where_false)
