"""Answers that go together, against trying everything."""

from __future__ import annotations

from itertools import product

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from arm5dof.envs import paths

FIXED = (False, False)
"""Neither joint turns on and on."""
poses = st.integers(1, 3).flatmap(
    lambda k: st.tuples(
        arrays(float, (k, 4, 2), elements=st.integers(-10, 10).map(lambda i: 0.1 * i)), arrays(bool, (k, 4))
    )
)


def cost(q: np.ndarray, met: np.ndarray, chosen: tuple[int, ...], start: np.ndarray | None) -> tuple[int, int, float]:
    """Goals missed, jumps, and the joints' way, to be compared in this order."""
    n = np.arange(len(chosen))
    line = q[list(chosen), n]
    way = np.abs(np.diff(line, axis=0)).sum() + (0 if start is None else np.abs(line[0] - start).sum())
    return int((~met[list(chosen), n]).sum()), int(paths.jumps(line).sum()), round(float(way), 6)


@given(poses, st.booleans())
def test_no_choice_is_better(given_poses, from_start):
    q, met = given_poses
    start = np.array([0.3, -0.2]) if from_start else None
    best = min(cost(q, met, chosen, start) for chosen in product(range(len(q)), repeat=4))
    assert cost(q, met, tuple(paths.chain(q, met, FIXED, start)), start) == best


@given(poses)
def test_the_nearest_meets_its_goal_where_one_does(given_poses):
    q, met = given_poses
    reward, near = np.random.default_rng(0).random(met.shape), np.zeros(2)
    which = paths.nearest(q, met, reward, FIXED, near)
    for j, i in enumerate(which):
        if met[:, j].any():
            assert met[i, j] and (np.abs(q[i, j]).max() <= np.abs(q[met[:, j], j]).max(-1)).all()
        else:
            assert i == reward[:, j].argmax()


@given(poses)
def test_distinct_answers_stand_for_all(given_poses):
    q, reward = given_poses[0][:, 0], np.arange(len(given_poses[0]), 0, -1.0)
    chosen = paths.distinct(q, reward, FIXED)
    assert chosen[0] == 0
    for i, pose in enumerate(q):
        near = [j for j in chosen if np.abs(pose - q[j]).max() < paths.SAME]
        assert near == [i] if i in chosen else near


@given(arrays(float, (6, 2), elements=st.integers(-31, 31).map(lambda i: 0.1 * i)))
def test_a_turn_more_is_the_same(q):
    """For a joint without limits, and for it alone."""
    turns = (True, False)
    endless = np.full((2, 2), [-np.inf, np.inf])
    line = paths.unwound(q, turns, endless)
    assert (np.abs(np.diff(line[:, 0])) <= np.pi + 1e-9).all()
    np.testing.assert_allclose(np.cos(line[:, 0]), np.cos(q[:, 0]), atol=1e-9)
    np.testing.assert_array_equal(line[:, 1], q[:, 1])
    other = q + 2 * np.pi * np.array([3, 0])
    np.testing.assert_allclose(paths.moved(q, other, turns), 0, atol=1e-9)
    np.testing.assert_allclose(paths.beside(q, other, turns, endless), other, atol=1e-9)
    assert paths.distinct(np.stack([q[0], other[0]]), np.array([1.0, 0.0]), turns) == [0]


@given(
    arrays(float, (6, 1), elements=st.integers(-31, 31).map(lambda i: 0.1 * i)),
    st.floats(3.2, 8.0),
    st.floats(3.2, 8.0),
)
def test_turns_end_at_the_stops(q, below, above):
    stops, turns = np.array([[-below, above]]), (True,)
    line = paths.unwound(q, turns, stops)
    assert (stops[:, 0] <= line).all() and (line <= stops[:, 1]).all()
    np.testing.assert_allclose(np.cos(line), np.cos(q), atol=1e-9)
    # It goes the shorter way unless a stop is in it.
    for a, b, way in zip(line[:-1, 0], line[1:, 0], paths.moved(q[:-1], q[1:], turns)[:, 0], strict=True):
        assert abs(b - a - way) < 1e-9 or not -below <= a + way <= above
