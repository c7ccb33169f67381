"""The paper's formulas: forward against MuJoCo and against Table 1, inverse against forward."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import sympy
from hypothesis import assume, given
from hypothesis import strategies as st

from arm5dof.arm import Arm
from arm5dof.arm.kinematics import TABLE_1, forward, inverse, unreachable_because

MILLION = 1_000_000
NANOMETRE = 1e-9
D5, INNER, OUTER = 0.030, 0.025, 0.265


def poses(count: int, low: np.ndarray | float = -np.pi, high: np.ndarray | float = np.pi, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(low, high, (count, 5))


def wrapped(angle: np.ndarray) -> np.ndarray:
    """The same angles in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def in_chunks(function, *arrays: np.ndarray) -> list:
    """Call a jitted function in float64 on 10^5 rows at a time."""
    with jax.enable_x64(True):
        jitted = jax.jit(function)
        return [
            jax.device_get(jitted(*(jnp.asarray(a[i : i + 100_000], jnp.float64) for a in arrays)))
            for i in range(0, len(arrays[0]), 100_000)
        ]


def limits_of(arm: Arm) -> np.ndarray:
    return np.stack([arm.lower, arm.upper], axis=1)


# Forward


def test_forward_is_mujocos_end_effector_on_a_million_poses(arm: Arm):
    theta = poses(MILLION)
    model, data = arm.mj_model, mujoco.MjData(arm.mj_model)
    position, rotation = np.empty((MILLION, 3)), np.empty((MILLION, 9))
    qpos, xpos, xmat = data.qpos, data.site_xpos[arm.site], data.site_xmat[arm.site]
    for i in range(MILLION):
        qpos[:5] = theta[i]
        mujoco.mj_kinematics(model, data)
        position[i], rotation[i] = xpos, xmat

    ours = in_chunks(forward, theta)
    assert np.abs(np.concatenate([p.position for p in ours]) - position).max() < NANOMETRE
    assert np.abs(np.concatenate([p.rotation for p in ours]) - rotation.reshape(-1, 3, 3)).max() < 1e-9


def test_printed_equations_are_table_1():
    """Eq. 6, the product of the five link transforms, against the twelve entries that the paper prints."""
    t = sympy.symbols("theta1:6", real=True)
    exact = partial(sympy.nsimplify, rational=True)
    product = sympy.eye(4)
    for angle, link in zip(t, TABLE_1, strict=True):
        d, a, alpha = exact(link.d), exact(link.a), exact(link.alpha / np.pi) * sympy.pi
        ca, sa, c, s = sympy.cos(alpha), sympy.sin(alpha), sympy.cos(angle), sympy.sin(angle)
        product *= sympy.Matrix(
            [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
        )

    d1, _, a3, a4, d5 = (exact(link.d or link.a) for link in TABLE_1)
    c12, s12 = sympy.cos(t[0] + t[1]), sympy.sin(t[0] + t[1])
    c34, s34 = sympy.cos(t[2] + t[3]), sympy.sin(t[2] + t[3])
    c345, s345 = sympy.cos(t[2] + t[3] + t[4]), sympy.sin(t[2] + t[3] + t[4])
    c3, s3 = sympy.cos(t[2]), sympy.sin(t[2])
    printed = sympy.Matrix(
        [
            [c12 * c345, -s12, -c12 * s345, s12 * d5 + c12 * (a4 * c34 + a3 * c3)],
            [s12 * c345, c12, -s12 * s345, -c12 * d5 + s12 * (a4 * c34 + a3 * c3)],
            [s345, 0, c345, d1 + a4 * s34 + a3 * s3],
            [0, 0, 0, 1],
        ]
    )
    assert (product - printed).applyfunc(lambda entry: sympy.expand(sympy.expand_trig(entry))) == sympy.zeros(4)

    theta = poses(1000)
    evaluate = sympy.lambdify(t, product)
    table = np.stack([evaluate(*row) for row in theta])
    (pose,) = in_chunks(forward, theta)
    np.testing.assert_allclose(pose.position, table[:, :3, 3], atol=1e-15, rtol=0)
    np.testing.assert_allclose(pose.rotation, table[:, :3, :3], atol=1e-14, rtol=0)


def test_table_1_has_the_papers_dimensions():
    assert [(round(link.d * 1e3, 9), round(link.a * 1e3, 9), np.degrees(link.alpha)) for link in TABLE_1] == [
        (45, 0, 0),
        (0, 0, 90),
        (0, 120, 0),
        (0, 145, 0),
        (30, 0, -90),
    ]


def test_forward_in_float32_errs_by_less_than_a_micrometre():
    theta = poses(100_000).astype(np.float32)
    (exact,) = in_chunks(forward, theta)
    rounded = jax.jit(forward)(theta)
    assert rounded.position.dtype == jnp.float32
    assert exact.position.dtype == np.float64
    assert np.abs(rounded.position - exact.position).max() < 1e-6
    assert np.abs(rounded.rotation - exact.rotation).max() < 2e-6


@pytest.mark.parametrize("shape", [(), (1,), (2, 3)])
def test_forward_and_inverse_keep_leading_axes(shape: tuple[int, ...]):
    pose = forward(jnp.full((*shape, 5), 0.3))
    assert pose.position.shape == (*shape, 3)
    assert pose.rotation.shape == (*shape, 3, 3)
    solutions = inverse(pose.position, jnp.full(shape, 0.9))
    assert solutions.theta.shape == (*shape, 4, 5)
    assert solutions.valid.shape == (*shape, 4)
    assert solutions.valid.all()


# Inverse


def test_inverse_round_trip_on_a_million_poses():
    """Every branch leads back to the position with the pitch asked for, and one of them is the pose it came from."""

    def errors(theta: jax.Array):
        pitch = theta[:, 2:].sum(-1)
        pose = forward(theta)
        solutions = inverse(pose.position, pitch)
        back = forward(solutions.theta)
        distance = jnp.linalg.norm(back.position - pose.position[:, None], axis=-1)
        found = jnp.concatenate([solutions.theta[..., :2].sum(-1, keepdims=True), solutions.theta[..., 2:]], -1)
        true = jnp.concatenate([theta[:, :2].sum(-1, keepdims=True), theta[:, 2:]], -1)[:, None]
        recovered = jnp.abs(jnp.angle(jnp.exp(1j * (found - true)))).max(-1).min(-1)
        tilt = jnp.abs(jnp.angle(jnp.exp(1j * (found[..., 1:].sum(-1) - pitch[:, None]))))
        return solutions.valid.all(), distance.max(), recovered, tilt.max()

    valid, distance, recovered, tilt = zip(*in_chunks(errors, poses(MILLION)), strict=True)
    assert all(valid)
    assert max(distance) < NANOMETRE
    assert max(tilt) < 1e-9
    # Where the arm is stretched out or folded, acos magnifies the last bit of a position.
    recovered = np.concatenate(recovered)
    assert recovered.max() < 1e-8
    assert np.quantile(recovered, 0.999) < 1e-9


def test_four_branches_are_four_poses():
    (theta,) = in_chunks(lambda t: inverse(forward(t).position, t[:, 2:].sum(-1)).theta, poses(1000))
    for i in range(4):
        for j in range(i):
            assert (np.abs(wrapped(theta[:, i] - theta[:, j])).max(-1) > 1e-6).all()


def test_inverse_without_pitch_leaves_joint_5_alone():
    (pair,) = in_chunks(lambda t: (forward(t).position, inverse(forward(t).position)), poses(1000))
    position, solutions = pair
    assert (solutions.theta[..., 4] == 0).all()
    (back,) = in_chunks(forward, solutions.theta)
    assert np.abs(back.position - position[:, None]).max() < NANOMETRE


def test_limits_are_respected_and_lose_no_reachable_pose(arm: Arm):
    limits = limits_of(arm)
    theta = poses(200_000, arm.lower, arm.upper)

    def solve(theta: jax.Array):
        pose = forward(theta)
        return pose.position, inverse(pose.position, theta[:, 2:].sum(-1), limits), inverse(pose.position, None, limits)

    for (position, full, partly), asked in zip(in_chunks(solve, theta), np.split(theta, 2), strict=True):
        for solutions in (full, partly):
            assert solutions.valid.any(-1).all()
            inside = solutions.theta[solutions.valid]
            assert (inside >= arm.lower - 1e-12).all()
            assert (inside <= arm.upper + 1e-12).all()
            (back,) = [np.asarray(b.position) for b in in_chunks(forward, inside[:100_000])]
            wanted = np.broadcast_to(position[:, None], (*solutions.valid.shape, 3))[solutions.valid][:100_000]
            assert np.abs(back - wanted).max() < NANOMETRE
        pitch = np.where(full.valid, full.theta[..., 2:].sum(-1), np.nan)
        assert np.nanmax(np.abs(wrapped(pitch - asked[:, None, 2:].sum(-1)))) < 1e-9
        recovered = np.abs(wrapped(full.theta[..., 2:] - asked[:, None, 2:])).max(-1)
        assert np.where(full.valid, recovered, np.inf).min(-1).max() < 1e-5


def test_branches_outside_limits_are_invalid(arm: Arm):
    """What is called invalid reaches, but breaks a limit by every choice of whole turns and of the free split."""
    limits = limits_of(arm)
    (free, bound), *_ = in_chunks(
        lambda t: (inverse(forward(t).position), inverse(forward(t).position, None, limits)), poses(20_000)
    )
    assert free.valid.all()
    assert 0.05 < bound.valid.mean() < 0.6
    possible = np.ones(free.theta.shape[:-1], bool)
    for angle, low, high in (
        (free.theta[..., :2].sum(-1), limits[:2, 0].sum(), limits[:2, 1].sum()),
        *((free.theta[..., k], *limits[k]) for k in (2, 3)),
    ):
        possible &= np.any([(angle + n * 2 * np.pi >= low) & (angle + n * 2 * np.pi <= high) for n in (-1, 0, 1)], 0)
    np.testing.assert_array_equal(bound.valid, possible)


@given(
    st.tuples(st.floats(-170, 100), st.floats(1, 70)),
    st.tuples(st.floats(-170, 100), st.floats(1, 70)),
    st.floats(0, 1),
    st.floats(0, 1),
)
def test_theta12_is_split_as_far_as_limits_allow(first, second, share_1, share_2):
    limits = np.radians([[low, low + width] for low, width in (first, second)] + [[-170, 170]] * 3)
    theta = np.array([limits[0] @ (1 - share_1, share_1), limits[1] @ (1 - share_2, share_2), 0.7, -1.1, 0.4])
    with jax.enable_x64(True):
        solutions = inverse(forward(theta).position, theta[2:].sum(), limits)
    recovered = np.abs(wrapped(np.asarray(solutions.theta)[:, 2:] - theta[2:])).max(-1) < 1e-9
    assert (solutions.valid & recovered).any()
    inside = np.asarray(solutions.theta)[np.asarray(solutions.valid)]
    assert (inside >= limits[:, 0] - 1e-12).all()
    assert (inside <= limits[:, 1] + 1e-12).all()


@given(st.lists(st.floats(-0.4, 0.4), min_size=3, max_size=3))
def test_reason_is_given_exactly_where_nothing_reaches(point: list[float]):
    x, y, z = point
    gap = x**2 + y**2 - D5**2
    distance = np.sqrt(max(gap + (z - 0.045) ** 2, 0))
    assume(abs(gap) > 1e-6 and abs(distance - INNER) > 1e-6 and abs(distance - OUTER) > 1e-6)
    reachable = gap > 0 and INNER < distance < OUTER

    solutions = inverse(jnp.array(point), jnp.array(0.5))
    reason = unreachable_because(jnp.array(point))
    if reachable:
        assert reason is None
        assert solutions.valid.all()
        np.testing.assert_allclose(forward(solutions.theta).position, np.tile(point, (4, 1)), atol=2e-6)
    else:
        assert "mm from the" in reason
        assert not solutions.valid.any()
        assert np.isnan(solutions.theta).all()


@pytest.mark.parametrize(
    ("point", "words"),
    [
        ((0.029, 0.0, 0.1), "29.0 mm from the vertical axis"),
        ((0.3, 0.0, 0.045), "298.5 mm from the shoulder, outside 25 to 265 mm"),
        ((0.031, 0.0, 0.045), "7.8 mm from the shoulder, outside 25 to 265 mm"),
        ((np.nan, 0.0, 0.1), "not finite"),
        ((0.1, 0.0, -np.inf), "not finite"),
        ((0.1, 0.1, 1e30), "from the shoulder"),
    ],
)
def test_unreachable_positions_say_why(point: tuple[float, ...], words: str):
    assert words in unreachable_because(jnp.array(point))
    assert not inverse(jnp.array(point)).valid.any()


def test_full_reach_is_reachable_in_float32():
    """Rounding may carry a point of the boundary just outside."""
    stretched = poses(10_000).astype(np.float32) * np.array([1, 1, 1, 0, 1], np.float32)
    folded = stretched + np.array([0, 0, 0, np.pi, 0], np.float32)
    for theta in (stretched, folded):
        position = forward(theta).position
        solutions = inverse(position)
        assert solutions.valid.all()
        assert np.abs(forward(solutions.theta).position - position[:, None]).max() < 1e-6
        assert all(unreachable_because(p) is None for p in position[:20])


@given(st.integers(0, 2), st.sampled_from([np.nan, np.inf, -np.inf]))
def test_nothing_is_valid_for_a_position_that_is_no_number(index: int, poison: float):
    position = np.array([0.15, 0.05, 0.1])
    position[index] = poison
    solutions = inverse(jnp.array(position), jnp.array(0.2), jnp.tile(jnp.array([-3.0, 3.0]), (5, 1)))
    assert not solutions.valid.any()
    assert np.isnan(solutions.theta).all()
    assert not inverse(jnp.array(position)).valid.any()


def test_nothing_is_valid_for_a_pitch_that_is_no_number(arm: Arm):
    assert not inverse(jnp.array([0.15, 0.05, 0.1]), jnp.array(jnp.nan), jnp.asarray(limits_of(arm))).valid.any()
    assert not inverse(jnp.array([0.15, 0.05, 0.1]), jnp.array(jnp.nan)).valid.any()


def test_printed_azimuth_is_off_by_half_a_turn_in_half_the_cases():
    """The paper prints theta12 = atan2(a_y, a_x): those carry the sign of -S_345."""
    theta = poses(20_000)
    (pose,) = in_chunks(forward, theta)
    printed = np.arctan2(pose.rotation[:, 1, 2], pose.rotation[:, 0, 2])
    error = np.abs(wrapped(printed - theta[:, 0] - theta[:, 1]))
    right = error < 1e-9
    assert 0.48 < right.mean() < 0.52
    np.testing.assert_allclose(error[~right], np.pi, atol=1e-9)
    np.testing.assert_array_equal(right, np.sin(theta[:, 2:].sum(-1)) < 0)


def test_printed_root_has_the_wrong_offset():
    """The paper prints d1 + d2 where the arm has d5: no angle comes out right, and a fifth is not even a number."""
    theta = poses(100_000)
    (pose,) = in_chunks(forward, theta)
    x, y, _ = pose.position.T
    offset = TABLE_1[0].d + TABLE_1[1].d
    with np.errstate(invalid="ignore"):
        root = np.sqrt(x**2 + y**2 - offset**2)
    printed = np.arctan2(y, x) + np.arctan2(offset, np.stack([root, -root]))
    assert 0.20 < np.isnan(printed).mean() < 0.22
    assert not (np.abs(wrapped(printed - theta[:, 0] - theta[:, 1])) < 1e-6).any()
