"""The closed-form inverse of the paper's arm, with all its branches.

The inverse that the paper prints in section 4.2 is wrong in most lines, so this one is derived anew from the direct
model. What is wrong in print: its theta_2 is really theta_12, and the offset under the root must be d5, not d1 + d2;
theta_12 = Atan2(a_y, a_x) is off by pi in half the cases (a_x and a_y carry the sign of -S_345); theta_23 has no
meaning, since joints 2 and 3 turn about different axes; theta_3 and theta_34 need each other; several signs are left
open. Only the differences theta_1, theta_4 and theta_5 are right.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from arm5dof.arm.kinematics.dh import A3, A4, D1, D5

INNER, OUTER = A4 - A3, A3 + A4
"""Shortest and longest distance between shoulder and wrist, metres."""


class Solutions(NamedTuple):
    """All branches of the inverse: front and back (s_r), elbow down and up (s_e).

    `theta` is (..., 4, 5) in radians, NaN where a branch does not reach. `valid` is (..., 4): the branch reaches the
    position and, if limits were given, respects them.
    """

    theta: jax.Array
    valid: jax.Array


def inverse(position: jax.Array, pitch: jax.Array | None = None, limits: jax.Array | None = None) -> Solutions:
    """Joint angles that put DH frame 5 at `position`.

    `position` is (..., 3) in metres, base frame. `pitch` (...) in radians is theta_345, the elevation of the tool's
    x axis in the arm's own plane; without it theta_5, which does not move the end effector, is 0. `limits` is (5, 2)
    in radians, lower and upper. Joints 1 and 2 share an axis, so only theta_12 is determined: it is split evenly, as
    far as the limits allow. With z = p_z - d1 and signs s_r, s_e = +-1:

        r        = s_r sqrt(p_x^2 + p_y^2 - d5^2)
        theta_12 = atan2(p_y, p_x) + atan2(d5, r)
        theta_4  = s_e acos((r^2 + z^2 - a3^2 - a4^2) / (2 a3 a4))
        theta_3  = atan2(z, r) - atan2(a4 sin theta_4, a3 + a4 cos theta_4)
        theta_5  = theta_345 - theta_3 - theta_4

    The joint that limits wrap around is brought into them by whole turns. `unreachable_because` says in words why
    no branch reaches a position.
    """
    position = jnp.asarray(position)
    dtype = position.dtype
    lower, upper = (
        (jnp.full(5, -jnp.pi, dtype), jnp.full(5, jnp.pi, dtype)) if limits is None else jnp.asarray(limits, dtype).T
    )
    x, y, z = (position[..., None, i] for i in range(3))
    z = z - D1
    s_r = jnp.array([1, 1, -1, -1], dtype)
    s_e = jnp.array([1, -1, 1, -1], dtype)

    # Rounding may push a point of the boundary just outside: the tolerance is a few ulp of the squares involved.
    slack = 16 * jnp.finfo(dtype).eps
    radius2 = x**2 + y**2 - D5**2
    cosine = (radius2 + z**2 - A3**2 - A4**2) / (2 * A3 * A4)
    reaches = (radius2 >= -slack * D5**2) & (jnp.abs(cosine) <= 1 + slack)

    r = s_r * jnp.sqrt(jnp.maximum(radius2, 0))
    theta12 = jnp.arctan2(y, x) + jnp.arctan2(jnp.full_like(r, D5), r)
    theta4 = s_e * jnp.arccos(jnp.clip(cosine, -1, 1))
    theta3 = jnp.arctan2(z + 0 * r, r) - jnp.arctan2(A4 * jnp.sin(theta4), A3 + A4 * jnp.cos(theta4))

    theta12 = _into(theta12, lower[0] + lower[1], upper[0] + upper[1])
    theta1 = jnp.clip(theta12 / 2, jnp.maximum(lower[0], theta12 - upper[1]), jnp.minimum(upper[0], theta12 - lower[1]))
    theta3 = _into(theta3, lower[2], upper[2])
    theta4 = _into(theta4, lower[3], upper[3])
    theta5 = jnp.zeros_like(r) if pitch is None else jnp.asarray(pitch, dtype)[..., None] - theta3 - theta4
    theta5 = _into(theta5, lower[4], upper[4])
    theta = jnp.stack([theta1, theta12 - theta1, theta3, theta4, theta5], axis=-1)

    valid = reaches & jnp.isfinite(theta).all(-1)
    if limits is not None:
        valid &= jnp.all((theta >= lower - 4 * slack) & (theta <= upper + 4 * slack), axis=-1)
    return Solutions(jnp.where(reaches[..., None], theta, jnp.nan), valid)


def unreachable_because(position: jax.Array) -> str | None:
    """Why the arm, its joints unlimited, cannot reach one position (3,); None where it can."""
    position = jnp.asarray(position)
    if not jnp.isfinite(position).all():
        return "the position is not finite"
    if inverse(position).valid.any():
        return None
    x, y, z = (float(v) for v in position)
    radius, height = (x * x + y * y) ** 0.5, z - D1
    if radius < D5:
        return f"it is {radius * 1e3:.1f} mm from the vertical axis, inside the hole of {D5 * 1e3:.0f} mm round it"
    distance = max(radius**2 - D5**2 + height**2, 0.0) ** 0.5
    return f"it is {distance * 1e3:.1f} mm from the shoulder, outside {INNER * 1e3:.0f} to {OUTER * 1e3:.0f} mm"


def _into(angle: jax.Array, lower: jax.Array, upper: jax.Array) -> jax.Array:
    """Add whole turns until `angle` lies within pi of the middle of an interval."""
    middle = (lower + upper) / 2
    turns = jnp.round((angle - middle) / (2 * jnp.pi))
    return angle - 2 * jnp.pi * turns
