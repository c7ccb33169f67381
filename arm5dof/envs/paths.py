"""Of several answers to each goal, those that go together: near where the arm is, and without a jump along a line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from arm5dof.envs.base import Goal

JUMP = 0.5
"""A joint that moves further from one goal of a line to the next has jumped, radians (metres for slides)."""
MISSED, JUMPED = 1e9, 1e5
"""What a goal missed and a jump count beside the joints' travel, radians: more than any line travels."""
SAME = 0.05
"""Answers are the same whose joints differ by less, radians (metres for slides)."""


class Path(NamedTuple):
    """Answers to a line of n goals."""

    q: jax.Array
    """Joint positions, (n, dof), radians (metres for slides)."""
    outcome: Goal
    """Where they lead by forward kinematics, a goal with leading axis n."""
    errors: dict[str, jax.Array]
    """How far that is from the goals, by component: (n,) each, metres or radians."""
    jumps: np.ndarray
    """Whether a joint has moved by more than `JUMP` since the goal before, (n,) bool."""


def moved(a: np.ndarray, b: np.ndarray, turns: Sequence[bool]) -> np.ndarray:
    """From one pose to another by the shorter way, (..., dof): of joints that turn modulo a turn."""
    way = b - a
    return np.where(turns, (way + np.pi) % (2 * np.pi) - np.pi, way)


def chain(q: np.ndarray, met: np.ndarray, turns: Sequence[bool], start: np.ndarray | None = None) -> np.ndarray:
    """Choose one of several poses at each goal of a line: the fewest goals missed, then the fewest jumps, then the
    shortest way of the joints (Viterbi's algorithm).

    Args:
        q: Joint positions, (k, n, dof), radians.
        met: Which of them meet their goal, (k, n) bool.
        turns: Which joints are angles modulo a turn, (dof,).
        start: Where the arm is, (dof,), from where the way is counted too; None for anywhere.

    Returns:
        Which pose, (n,) int.
    """
    missed = np.where(met, 0.0, MISSED)
    cost = missed[:, 0] + (0.0 if start is None else np.abs(moved(start, q[:, 0], turns)).sum(-1))
    back = []
    for before, here, miss in zip(q[:, :-1].swapaxes(0, 1), q[:, 1:].swapaxes(0, 1), missed[:, 1:].T, strict=True):
        way = np.abs(moved(before[:, None], here, turns))
        through = cost[:, None] + way.sum(-1) + JUMPED * (way.max(-1) > JUMP)
        back.append(through.argmin(0))
        cost = through.min(0) + miss
    chosen = [int(cost.argmin())]
    for links in reversed(back):
        chosen.append(int(links[chosen[-1]]))
    return np.array(chosen[::-1])


def jumps(q: np.ndarray) -> np.ndarray:
    """Where joints jump, (n,) bool, along poses (n, dof)."""
    return np.append(False, np.abs(np.diff(q, axis=0)).max(-1) > JUMP)


def beside(q: np.ndarray, near: np.ndarray, turns: Sequence[bool], stops: np.ndarray) -> np.ndarray:
    """The same poses, (..., dof), whose joints that turn make no turn more than they need from others, and none beyond
    their stops (dof, 2)."""
    there = near + moved(near, q, turns)
    there = there - 2 * np.pi * np.ceil(np.maximum(there - stops[:, 1], 0) / (2 * np.pi))
    there = there + 2 * np.pi * np.ceil(np.maximum(stops[:, 0] - there, 0) / (2 * np.pi))
    return np.where(turns, there, q)


def unwound(q: np.ndarray, turns: Sequence[bool], stops: np.ndarray) -> np.ndarray:
    """Poses along a line, (n, dof), whose joints that turn count on from the first, as far as their stops (dof, 2)."""
    line = [q[0]]
    for pose in q[1:]:
        line.append(beside(pose, line[-1], turns, stops))
    return np.stack(line)


def nearest(q: np.ndarray, met: np.ndarray, reward: np.ndarray, turns: Sequence[bool], near: np.ndarray) -> np.ndarray:
    """Which of several answers (k, n, dof) to each goal is nearest to a pose (dof,), or to one for each (n, dof), by
    its furthest joint, of those that meet it (k, n) bool; the one of the highest reward (k, n) where none does. (n,)"""
    away = np.where(met, np.abs(moved(near, q, turns)).max(-1), np.inf)
    return np.where(met.any(0), away.argmin(0), reward.argmax(0))


def distinct(q: np.ndarray, reward: np.ndarray, turns: Sequence[bool]) -> list[int]:
    """Which of several poses (k, dof) differ, in the order of their rewards (k,), the highest first."""
    chosen: list[int] = []
    for i in np.argsort(-reward, kind="stable"):
        if all(np.abs(moved(q[i], q[j], turns)).max() >= SAME for j in chosen):
            chosen.append(int(i))
    return chosen
