"""Which of the proposer's cells should find which object."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from arm5dof.vision.boxes import iou
from arm5dof.vision.camera import Array
from arm5dof.vision.detectors.tabletop.networks import STRIDE

MAX_CELLS = 9
"""The most cells that are assigned to an object."""
MIN_BOX_SIZE = 10.0
"""A box is taken to be at least so wide and high when its object's cells are chosen, pixels."""


class Labels(NamedTuple):
    """What there is to find in an image, in as many rows as the image with most objects needs."""

    boxes: Array
    """(m, 4) edges, pixels; width and height are positive."""
    found: Array
    """(m,) bool: should be found. False for rows that are padding."""
    ignored: Array
    """(m,) bool: may be found or not, such as what is mostly hidden."""


class Targets(NamedTuple):
    """What each of n cells should answer."""

    scores: jax.Array
    """(n,) in [0, 1]: how well its box fits its object, 0 if it has none."""
    boxes: jax.Array
    """(n, 4), pixels."""
    scored: jax.Array
    """(n,) bool: False where any score will do."""


def assign(centers: Array, boxes: jax.Array, scores: jax.Array, labels: Labels) -> Targets:
    """Task-aligned assignment (Feng et al., 2021): to each object those of the cells in its box that already answer
    best. The score that a cell should give is how well its box fits, so that confidence means accuracy.

    Args:
        centers: Of the cells, (n, 2), pixels.
        boxes: That the cells predict, (n, 4), pixels.
        scores: That they predict, (n,).
        labels: What there is to find.
    """
    fit = iou(labels.boxes[:, None], boxes)
    middle, half = (labels.boxes[:, :2] + labels.boxes[:, 2:]) / 2, (labels.boxes[:, 2:] - labels.boxes[:, :2]) / 2
    offset = jnp.abs(centers - middle[:, None])
    inside = (offset < jnp.maximum(half, MIN_BOX_SIZE / 2)[:, None]).all(-1)
    # The last term decides while nothing fits yet: nearer cells first.
    near = 1e-9 * jnp.exp(-(offset**2).sum(-1) / STRIDE**2)
    alignment = jnp.sqrt(scores) * fit**6 + near
    alignment = jnp.where(inside & labels.found[:, None], alignment, 0.0)
    best = jax.lax.top_k(alignment, min(MAX_CELLS, len(centers)))[0]
    chosen = (alignment > 0) & (alignment >= best[:, -1:])
    # A cell that several objects want goes to the one with which it is aligned best.
    alignment = jnp.where(chosen, alignment, 0.0)
    owner = alignment.argmax(0)
    assigned = chosen & (jnp.arange(len(chosen))[:, None] == owner)
    alignment = jnp.where(assigned, alignment, 0.0)
    best_fit = jnp.where(assigned, fit, 0.0).max(1, keepdims=True)
    target_scores = (alignment / jnp.maximum(alignment.max(1, keepdims=True), 1e-12) * best_fit).max(0)
    hidden = ((offset < half[:, None]).all(-1) & labels.ignored[:, None]).any(0)
    return Targets(target_scores, labels.boxes[owner], assigned.any(0) | ~hidden)
