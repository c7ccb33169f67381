"""What must stand where, to be seen in these boxes: the arithmetic behind `locate`, one thing at a time.

The middle of a box is not where the middle of the thing is seen: that is off by up to 3 mm for blocks and 13 mm for
cones. So the box is explained rather than its middle cast back: where must a solid of the known height and form stand,
and how wide must it be, for its box to have these four edges? Gauss-Newton steps find out, and the last of them carries
the derivatives by all that went in, from which the covariance follows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from arm5dof.vision.camera import Array, Camera
from arm5dof.vision.localization.solids import FORMS, Solid, box

STEPS = 10

HINT = 0.01
"""Weight of things being as deep as they are wide, beside boxes weighted by pixels. It moves what a box tells by less
than a micrometre, and keeps things from vanishing whose boxes are too flat to tell any depth."""

PLANE = 1e-3
"""Weight of the table beside boxes weighted by pixels, metres. Nothing else tells the height, so any will do."""


class Things(struct.PyTreeNode):
    """What is known of the things detected, as arrays."""

    half_height: Array
    """(n,), metres."""
    deviation: Array
    """Standard deviations of the half heights, (n,), metres."""
    form: Array
    """Places in `FORMS`, (n,), int."""

    @classmethod
    def of(cls, solids: Sequence[Solid]) -> Things:
        return cls(
            np.array([solid.half_height for solid in solids]),
            np.array([solid.deviation for solid in solids]),
            np.array([list(FORMS).index(solid.form) for solid in solids], int),
        )


class Explanation(struct.PyTreeNode):
    """A solid that explains v boxes."""

    middle: jax.Array
    """(3,) in the base frame, metres."""
    radii: jax.Array
    """Half its width and depth as each camera sees it, (v, 2), metres."""
    misfit: jax.Array
    """Between its boxes and the given ones, root mean square over the edges, pixels."""


def explain(
    cameras: Sequence[Camera],
    boxes: jax.Array,
    half_height: jax.Array,
    form: Array,
    start: Array,
    table: float | None,
    pixels: float,
) -> Explanation:
    """The solid that explains the boxes (v, 4) of one thing in the pictures of v cameras.

    form:   its place in `FORMS`
    start:  about where it is, (3,)
    table:  the height that it stands on, metres; None if only the boxes are to tell
    pixels: standard deviation of an edge
    """
    parts = jnp.asarray(np.stack(list(FORMS.values())))[form]

    def residual(unknown: jax.Array, cameras: Sequence[Camera], boxes: jax.Array, half_height: jax.Array) -> jax.Array:
        middle, logarithms = unknown[:3], unknown[3:].reshape(-1, 2)
        rows = [
            (box(camera, middle, jnp.exp(radii), half_height, parts) - seen) / pixels
            for camera, radii, seen in zip(cameras, logarithms, boxes, strict=True)
        ]
        rows.append(HINT * (logarithms[:, 0] - logarithms[:, 1]))
        if table is not None:
            rows.append((middle[2:] - table - half_height) / PLANE)
        return jnp.concatenate(rows)

    def step(unknown: jax.Array, *given: Any) -> tuple[jax.Array, jax.Array]:
        jacobian = jax.jacfwd(residual)(unknown, *jax.lax.stop_gradient(given))
        scale = jnp.linalg.norm(jacobian, axis=0)
        scaled, left = jacobian / scale, residual(unknown, *given)
        factor = jax.scipy.linalg.cho_factor(scaled.T @ scaled)
        return jax.scipy.linalg.cho_solve(factor, scaled.T @ left) / scale, left

    def bounded(_: int, unknown: jax.Array) -> jax.Array:
        change, _left = step(unknown, *jax.lax.stop_gradient(given))
        return unknown - jnp.clip(change, -1, 1)

    given = (cameras, boxes, half_height)
    begin = jnp.concatenate([start, jnp.log(_half_sides(*jax.lax.stop_gradient(given[:2]), start)).repeat(2)])
    found = jax.lax.fori_loop(0, STEPS, bounded, begin)
    change, left = step(found, *given)
    unknown, edges = found - change, left[: boxes.size] * pixels
    return Explanation(unknown[:3], jnp.exp(unknown[3:].reshape(-1, 2)), jnp.sqrt(jnp.mean(edges**2)))


def propagate(
    estimate: Callable[..., tuple[jax.Array, Any]], given: Sequence[jax.Array], covariances: Sequence[jax.Array]
) -> tuple[jax.Array, Any]:
    """The covariance (3, 3), to first order, of a position that is estimated from several independent vectors (k,) with
    covariances (k, k), and what else the estimate returns."""
    jacobians, other = jax.jacfwd(estimate, tuple(range(len(given))), has_aux=True)(*given)
    return sum(j @ c @ j.T for j, c in zip(jacobians, covariances, strict=True)), other


def _half_sides(cameras: Sequence[Camera], boxes: jax.Array, at: Array) -> jax.Array:
    """About how wide (v,) a thing is whose boxes are these, metres."""
    return jnp.stack(
        [
            (seen[2] - seen[0] + seen[3] - seen[1]) / 4 * camera.to_camera(at)[2] / camera.matrix[0, 0]
            for camera, seen in zip(cameras, boxes, strict=True)
        ]
    )
