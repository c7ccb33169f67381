"""Rotations and directions: how far two are apart, and what takes one to the other. All have any leading axes."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def angle_between(a: jax.Array, b: jax.Array) -> jax.Array:
    """The angle, (...) in radians, between unit vectors (..., 3). Exact near 0 and near pi, where an arc cosine of
    their product is not."""
    return 2 * jnp.arctan2(_norm(a - b), _norm(a + b))


def rotation_angle(a: jax.Array, b: jax.Array) -> jax.Array:
    """The angle, (...) in radians, of the rotation between two rotation matrices (..., 3, 3). Exact near 0."""
    chord = _norm((a - b).reshape(*a.shape[:-2], 9)) / jnp.sqrt(8.0)  # = sin(angle / 2)
    return 2 * jnp.arcsin(jnp.minimum(chord, 1.0))


def carry_direction(vector: jax.Array, start: jax.Array, end: jax.Array) -> jax.Array:
    """`vector` (..., 3) turned by the smallest rotation that takes the unit vector `start` to `end` (..., 3);
    unchanged where these are opposite, so that no rotation is the smallest (Rodrigues' formula)."""
    axis, cosine = jnp.cross(start, end), (start * end).sum(-1, keepdims=True)
    once = jnp.cross(axis, vector)
    turned = vector + once + jnp.cross(axis, once) / jnp.maximum(1 + cosine, 1e-6)
    return jnp.where(cosine > 1e-6 - 1, turned, vector)


def from_quaternion(quaternion: jax.Array) -> jax.Array:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4) in the order w, x, y, z."""
    w, x, y, z = jnp.moveaxis(quaternion, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def _norm(x: jax.Array) -> jax.Array:
    """The length, whose gradient at zero is zero rather than not a number."""
    square = (x**2).sum(-1)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
