"""Denavit-Hartenberg model of the paper's arm: Table 1 and Eq. 6."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from arm5dof.arm.arm import Pose


class Link(NamedTuple):
    """One row of Table 1: offset `d` and length `a` in metres, twist `alpha` in radians.

    The paper's caption says that a_i is measured along z_i; as its Eq. 6 uses it, it is measured along x_i.
    """

    d: float
    a: float
    alpha: float


TABLE_1 = (
    Link(d=0.045, a=0.0, alpha=0.0),
    Link(d=0.0, a=0.0, alpha=np.pi / 2),
    Link(d=0.0, a=0.120, alpha=0.0),
    Link(d=0.0, a=0.145, alpha=0.0),
    Link(d=0.030, a=0.0, alpha=-np.pi / 2),
)
D1, A3, A4, D5 = TABLE_1[0].d, TABLE_1[2].a, TABLE_1[3].a, TABLE_1[4].d


def forward(theta: jax.Array) -> Pose:
    """Direct geometric model: joint angles (..., 5) in radians to the pose of DH frame 5 in the base frame, whose
    rotation has the columns n, o and a.

    The twelve equations that the paper prints below Eq. 6, which are right. Computes in the dtype it is given:
    float32, or float64 where JAX has it enabled.
    """
    theta = jnp.asarray(theta)
    theta12 = theta[..., 0] + theta[..., 1]
    theta34 = theta[..., 2] + theta[..., 3]
    c12, s12 = jnp.cos(theta12), jnp.sin(theta12)
    c345, s345 = jnp.cos(theta34 + theta[..., 4]), jnp.sin(theta34 + theta[..., 4])
    r = A4 * jnp.cos(theta34) + A3 * jnp.cos(theta[..., 2])
    z = A4 * jnp.sin(theta34) + A3 * jnp.sin(theta[..., 2])
    n = (c345 * c12, c345 * s12, s345)
    o = (-s12, c12, jnp.zeros_like(c12))
    a = (-c12 * s345, -s12 * s345, c345)
    position = jnp.stack([s12 * D5 + r * c12, -c12 * D5 + r * s12, D1 + z], axis=-1)
    return Pose(position, jnp.stack([jnp.stack(column, axis=-1) for column in (n, o, a)], axis=-1))
