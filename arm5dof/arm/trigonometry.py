"""The cosine and sine of joint angles, of which forward kinematics is made."""

from __future__ import annotations

import jax
import jax.numpy as jnp

QUARTER = (1.5703125, 4.837512969970703125e-4, 7.54978995489188e-8)
"""pi / 2 in three parts of few bits, so that multiples of the first two are exact in float32."""
SINE = (-1.6666654611e-1, 8.3321608736e-3, -1.9515295891e-4)
COSINE = (4.166664568298827e-2, -1.388731625493765e-3, 2.443315711809948e-5)


@jax.custom_jvp
def cos_sin(q: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Cosine and sine of angles in radians, of the same shape and dtype, in float32 to 1e-7 up to 8,192 radians.

    By the polynomials of Moshier's Cephes library (sinf.c) about the nearest quarter turn: on a CPU XLA takes ten times
    as long for its own, which was most of the time of forward kinematics.
    """
    return _quarters(q) if q.dtype == jnp.float32 else (jnp.cos(q), jnp.sin(q))


@cos_sin.defjvp
def _cos_sin_jvp(
    primals: tuple[jax.Array], tangents: tuple[jax.Array]
) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
    """Both are kept for the gradient: XLA would compute them again for every term that they appear in."""
    cosine, sine = jax.lax.optimization_barrier(cos_sin(*primals))
    return (cosine, sine), (-sine * tangents[0], cosine * tangents[0])


def _quarters(q: jax.Array) -> tuple[jax.Array, jax.Array]:
    quarters = jnp.round(q * (2 / jnp.pi))
    for part in QUARTER:
        q = q - quarters * part
    square, turn = q * q, quarters.astype(jnp.int32)
    sine = q + q * square * (SINE[0] + square * (SINE[1] + square * SINE[2]))
    cosine = 1 - square / 2 + square**2 * (COSINE[0] + square * (COSINE[1] + square * COSINE[2]))
    odd, negative, past = (turn & 1) != 0, (turn & 2) != 0, ((turn + 1) & 2) != 0
    along, across = jnp.where(odd, sine, cosine), jnp.where(odd, cosine, sine)
    return jnp.where(past, -along, along), jnp.where(negative, -across, across)
