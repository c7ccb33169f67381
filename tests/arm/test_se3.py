"""Rotations and directions against SciPy, near 0 and near pi too."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from arm5dof.arm import se3

ANGLES = [0.0, 1e-6, 1e-5, 1e-4, 1e-3, 0.1, 1.0, np.pi / 2, 3.0, np.pi - 1e-2, np.pi - 1e-3, np.pi]
TURNS = st.builds(
    lambda axis, angle: Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)),
    hnp.arrays(float, 3, elements=st.floats(-1, 1)).filter(lambda v: np.linalg.norm(v) > 0.1),
    st.one_of(st.floats(0, np.pi), st.sampled_from(ANGLES)),
)
DIRECTIONS = TURNS.map(lambda turn: turn.as_matrix()[:, 0])

angle_between, rotation_angle, carry_direction, from_quaternion = map(
    jax.jit, (se3.angle_between, se3.rotation_angle, se3.carry_direction, se3.from_quaternion)
)


def quaternion(turn: Rotation) -> np.ndarray:
    """w, x, y, z."""
    return np.roll(turn.as_quat(), 1, axis=-1)


def perpendicular(vector: np.ndarray) -> np.ndarray:
    """A unit vector at right angles to another."""
    other = np.cross(vector, np.eye(3)[np.abs(vector).argmin()])
    return other / np.linalg.norm(other)


@pytest.mark.parametrize("angle", ANGLES)
@given(start=DIRECTIONS)
def test_angle_between_is_the_angle_by_which_one_was_turned(angle: float, start: np.ndarray):
    end = Rotation.from_rotvec(angle * perpendicular(start)).apply(start)
    found = angle_between(jnp.asarray(start, jnp.float32), jnp.asarray(end, jnp.float32))
    assert found == pytest.approx(angle, abs=4e-7, rel=1e-6)


@pytest.mark.parametrize("angle", ANGLES)
@given(start=TURNS, axis=DIRECTIONS)
def test_rotation_angle_is_the_angle_by_which_one_was_turned(angle: float, start: Rotation, axis: np.ndarray):
    end = start * Rotation.from_rotvec(angle * axis)
    found = rotation_angle(*(jnp.asarray(turn.as_matrix(), jnp.float32) for turn in (start, end)))
    # Near pi sine of the half angle is flat: float32 leaves a thousandth of a radian there.
    assert found == pytest.approx(angle, abs=1e-6 if angle < 3.1 else 2e-3, rel=1e-6)


@given(a=TURNS, b=TURNS)
def test_angles_are_scipys(a: Rotation, b: Rotation):
    expected = (a.inv() * b).magnitude()
    matrices = [jnp.asarray(turn.as_matrix(), jnp.float32) for turn in (a, b)]
    # An angle follows from the sine of its half, which is flat near pi: float32 leaves 2e-3 there.
    rounding = max(2e-6, 4e-7 / max(np.cos(expected / 2), 2e-4))
    for one, other in (matrices, matrices[::-1]):
        assert rotation_angle(one, other) == pytest.approx(expected, abs=rounding)
    x, y = (turn.as_matrix()[:, 0] for turn in (a, b))
    between = np.arctan2(np.linalg.norm(np.cross(x, y)), x @ y)
    assert angle_between(matrices[0][:, 0], matrices[1][:, 0]) == pytest.approx(between, abs=1e-6)


@given(start=DIRECTIONS, end=DIRECTIONS, vector=hnp.arrays(float, 3, elements=st.floats(-2, 2)))
def test_directions_are_carried_by_the_smallest_rotation(start: np.ndarray, end: np.ndarray, vector: np.ndarray):
    axis, cosine = np.cross(start, end), start @ end
    found = carry_direction(*(jnp.asarray(v, jnp.float32) for v in (vector, start, end)))
    if cosine < -0.999:
        assert np.isfinite(found).all()
        return
    sine = np.linalg.norm(axis)
    turn = Rotation.from_rotvec(np.arctan2(sine, cosine) * axis / sine if sine > 1e-12 else np.zeros(3))
    np.testing.assert_allclose(found, turn.apply(vector), atol=2e-5 if cosine > -0.9 else 2e-3)
    carried = carry_direction(*(jnp.asarray(v, jnp.float32) for v in (start, start, end)))
    np.testing.assert_allclose(carried, end, atol=2e-6 if cosine > -0.9 else 2e-4)


def test_opposite_directions_leave_a_vector_as_it_is():
    x = jnp.array([1.0, 0, 0])
    np.testing.assert_array_equal(carry_direction(jnp.array([0.1, 0.2, 0.3]), x, -x), jnp.array([0.1, 0.2, 0.3]))


@given(turn=TURNS)
def test_quaternions_are_scipys(turn: Rotation):
    for sign in (1, -1):
        found = from_quaternion(jnp.asarray(sign * quaternion(turn), jnp.float32))
        np.testing.assert_allclose(found, turn.as_matrix(), atol=5e-7)


def test_any_leading_axes():
    rng = np.random.default_rng(0)
    turns = [Rotation.random(12, random_state=rng) for _ in range(2)]
    quaternions = [jnp.asarray(quaternion(turn).reshape(3, 4, 4), jnp.float32) for turn in turns]
    a, b = map(from_quaternion, quaternions)
    assert a.shape == (3, 4, 3, 3)
    angles = (turns[0].inv() * turns[1]).magnitude().reshape(3, 4)
    np.testing.assert_allclose(rotation_angle(a, b), angles, atol=1e-3)
    assert angle_between(a[..., 0], b[..., 0]).shape == (3, 4)
    carried = carry_direction(a[..., 0], a[..., 0], b[..., 0])
    np.testing.assert_allclose(carried, b[..., 0], atol=1e-4)


@pytest.mark.parametrize("angle", [0.0, 1e-4, 0.5, 3.0])
def test_gradients_are_finite_and_say_how_angles_grow(angle: float):
    """At 0, where an angle has a tip, the gradient is 0; elsewhere it is 1 along the turn."""

    def turned(angle: jax.Array) -> jax.Array:
        c, s, o, i = jnp.cos(angle), jnp.sin(angle), jnp.zeros(()), jnp.ones(())
        return jnp.array([[c, -s, o], [s, c, o], [o, o, i]])

    expected = 1.0 if angle else 0.0
    direction = jax.grad(lambda x: se3.angle_between(jnp.eye(3)[0], turned(x)[:, 0]))(angle)
    rotation = jax.grad(lambda x: se3.rotation_angle(jnp.eye(3), turned(x)))(angle)
    assert direction == pytest.approx(expected, abs=1e-3) and rotation == pytest.approx(expected, abs=2e-3)
