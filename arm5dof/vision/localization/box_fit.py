"""Which solid is seen in these boxes: the arithmetic behind `locate`, one object at a time.

The center of a box is not where the center of the object is seen: that is off by up to 3 mm for blocks and 13 mm for
cones. So a solid is fitted to the box rather than its center cast back: where must a solid of the known height and form
stand, and how wide must it be, for its box to have these four edges? Gauss-Newton steps find out, and the last of them
carries the derivatives by all that went in, from which the covariance follows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from arm5dof.vision.camera import Array, Camera
from arm5dof.vision.localization.solids import FORMS, solid_box

STEPS = 10

SQUARE_WEIGHT = 0.01
"""Weight of objects being as deep as they are wide, beside boxes weighted by their standard deviation. It moves what a
box tells by less than a micrometre, and keeps objects from vanishing whose boxes are too flat to tell any depth."""

ALIKE_WEIGHT = 10.0
"""The same weight where an edge of the box is not known, and this tells the depth or the width in its place."""

ELONGATION_STD = 0.4
"""Standard deviation of the logarithm of an object's width by its depth: of a brick it is 0.7 across, -0.7 along."""

SKEW_STD = 0.6
"""Standard deviation of an object's skew, as `solid_box` has it: 0.52 to 0.65 for rectangles turned anyhow that are up
to four times as long as wide. It is an error of form: fits take it to be zero, since no box tells it."""

TABLE_STD = 1e-3
"""Standard deviation of the table's height beside boxes weighted by theirs, metres. Nothing else tells the height, so
any will do."""


class BoxFit(struct.PyTreeNode):
    """A solid that fits v boxes."""

    center: jax.Array
    """(3,) in the base frame, metres."""
    radii: jax.Array
    """Half its width and depth as each camera sees it, (v, 2), metres."""
    reprojection_rms: jax.Array
    """Between its boxes and the given ones, root mean square over the edges, pixels."""


class Uncertain(NamedTuple):
    """A vector and how well it is known."""

    value: jax.Array
    """(k,)."""
    covariance: jax.Array
    """(k, k)."""


def fit_box(
    cameras: Sequence[Camera],
    boxes: jax.Array,
    half_height: jax.Array,
    form: Array,
    start: Array,
    table_height: float | None,
    box_std: float,
    known: Array | None = None,
    elongation: Array | float = 0.0,
    skew: Array | None = None,
) -> BoxFit:
    """Fit a solid to the boxes of one object.

    Args:
        cameras: v cameras.
        boxes: Its box in each camera's image, (v, 4), pixels.
        half_height: Of the solid, (), metres.
        form: Its index in `FORMS`, ().
        start: About where it is, (3,), metres, base frame.
        table_height: Of what it stands on in the base frame, metres; None if only the boxes are to tell.
        box_std: Standard deviation of an edge, pixels.
        known: Which edges of the boxes are where the object ends, (v, 4) bool; None for all.
        elongation: The logarithm of its width by its depth, (), which counts where not all edges are known.
        skew: Of the solid as each camera sees it, (v,); None for zeros.

    Returns:
        The best solid. It can be differentiated by cameras, boxes, half height, elongation and skew.
    """
    parts = jnp.asarray(np.stack(list(FORMS.values())))[form]

    def residual(
        unknown: jax.Array,
        cameras: Sequence[Camera],
        boxes: jax.Array,
        half_height: jax.Array,
        elongation: Array | float,
        skew: Array,
    ) -> jax.Array:
        center, logarithms = unknown[:3], unknown[3:].reshape(-1, 2)
        rows = [
            (solid_box(camera, center, jnp.exp(radii), half_height, parts, each) - seen) / box_std
            for camera, radii, seen, each in zip(cameras, logarithms, boxes, skew, strict=True)
        ]
        if known is None:
            rows.append(SQUARE_WEIGHT * (logarithms[:, 0] - logarithms[:, 1]))
        else:
            rows = [jnp.where(these, row, 0.0) for row, these in zip(rows, known, strict=True)]
            weights = jnp.where(known.all(1), SQUARE_WEIGHT, ALIKE_WEIGHT)
            rows.append(weights * (logarithms[:, 0] - logarithms[:, 1] - elongation))
        if table_height is not None:
            rows.append((center[2:] - table_height - half_height) / TABLE_STD)
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

    given = (cameras, boxes, half_height, elongation, jnp.zeros(len(cameras)) if skew is None else skew)
    begin = jnp.concatenate([start, jnp.log(_half_widths(*jax.lax.stop_gradient(given[:2]), start)).repeat(2)])
    found = jax.lax.fori_loop(0, STEPS, bounded, begin)
    change, left = step(found, *given)
    unknown, edges = found - change, left[: boxes.size] * box_std
    return BoxFit(unknown[:3], jnp.exp(unknown[3:].reshape(-1, 2)), jnp.sqrt(jnp.mean(edges**2)))


def propagate(estimate: Callable[..., tuple[jax.Array, Any]], inputs: Sequence[Uncertain]) -> tuple[jax.Array, Any]:
    """Propagate covariances through an estimate, to first order.

    Args:
        estimate: Takes the inputs' values, returns a position (3,) and anything else.
        inputs: Independent of each other.

    Returns:
        The position's covariance, (3, 3), and what else the estimate returns.
    """
    values, covariances = zip(*inputs, strict=True)
    jacobians, other = jax.jacfwd(estimate, tuple(range(len(values))), has_aux=True)(*values)
    return sum(j @ c @ j.T for j, c in zip(jacobians, covariances, strict=True)), other


def independent(values: Array, std: Array | float) -> Uncertain:
    """Numbers (k,) of one standard deviation, independent of each other."""
    return Uncertain(jnp.asarray(values), jnp.eye(len(values)) * std**2)


def camera_errors(camera: Camera) -> Uncertain:
    """The errors (m,) of a camera as `Camera.perturbed` takes them: zero as far as one knows, and their covariance,
    zero too if it is unknown."""
    size = 10 + camera.distortion.shape[0]
    covariance = jnp.zeros((size, size)) if camera.covariance is None else jnp.asarray(camera.covariance)
    return Uncertain(jnp.zeros(size), covariance)


def box_center(box: Array) -> Array:
    """The center (2,) of a box (4,), in pixels as `Camera` counts them: whole numbers are the centers of pixels."""
    return (box[:2] + box[2:]) / 2 - 0.5


def _half_widths(cameras: Sequence[Camera], boxes: jax.Array, at: Array) -> jax.Array:
    """About how wide (v,) an object is whose boxes are these, metres."""
    return jnp.stack(
        [
            (seen[2] - seen[0] + seen[3] - seen[1]) / 4 * camera.to_camera(at)[2] / camera.matrix[0, 0]
            for camera, seen in zip(cameras, boxes, strict=True)
        ]
    )
