"""What training asks of the network: which cells should find which thing, and how far the answers are from that."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from arm5dof.vision.camera import Array
from arm5dof.vision.detectors.tabletop.networks import STRIDE

CELLS = 9
"""The most cells that may answer for a thing."""
SMALLEST = 10.0
"""A thing's box is taken to be at least so wide and high when its cells are chosen, pixels."""
CLOSE = 0.1
"""What a cell is to the proposer's boxes, this share of a crop is to the refiner's."""
LOCALISATION, CLOSENESS = 4.0, 1.0
"""Weights of the two measures of a box's error beside that of the classification."""


class Labels(NamedTuple):
    """What there is to find in a picture, in as many rows as the picture with most of them needs."""

    boxes: Array
    """(m, 4) edges, pixels; width and height are positive."""
    found: Array
    """(m,) bool: should be found. False for rows that say nothing."""
    ignored: Array
    """(m,) bool: may be found or not, such as what is mostly hidden."""


class Targets(NamedTuple):
    """What each of n cells should answer."""

    scores: jax.Array
    """(n,) in [0, 1]: how well its box fits its thing, 0 if it has none."""
    boxes: jax.Array
    """(n, 4)."""
    judged: jax.Array
    """(n,) bool: False where any answer will do."""


def assign(middles: Array, boxes: jax.Array, scores: jax.Array, labels: Labels) -> Targets:
    """Task-aligned assignment (Feng et al., 2021): each thing is the business of those cells in its box that already
    answer best. What a cell is to say is how well its box fits, so that confidence means accuracy.

    middles: (n, 2) of the cells, pixels
    boxes:   (n, 4) that the cells predict
    scores:  (n,) that they predict
    """
    fit = overlap(labels.boxes[:, None], boxes)
    middle, half = (labels.boxes[:, :2] + labels.boxes[:, 2:]) / 2, (labels.boxes[:, 2:] - labels.boxes[:, :2]) / 2
    offset = jnp.abs(middles - middle[:, None])
    inside = (offset < jnp.maximum(half, SMALLEST / 2)[:, None]).all(-1)
    # The last term decides while nothing fits yet: nearer cells first.
    near = 1e-9 * jnp.exp(-(offset**2).sum(-1) / STRIDE**2)
    merit = jnp.sqrt(scores) * fit**6 + near
    merit = jnp.where(inside & labels.found[:, None], merit, 0.0)
    chosen = (merit > 0) & (merit >= jax.lax.top_k(merit, min(CELLS, len(middles)))[0][:, -1:])
    # A cell that several things want goes to the one that it fits best.
    merit = jnp.where(chosen, merit, 0.0)
    owner = merit.argmax(0)
    mine = chosen & (jnp.arange(len(chosen))[:, None] == owner)
    merit = jnp.where(mine, merit, 0.0)
    best = jnp.where(mine, fit, 0.0).max(1, keepdims=True)
    worth = (merit / jnp.maximum(merit.max(1, keepdims=True), 1e-12) * best).max(0)
    hidden = ((offset < half[:, None]).all(-1) & labels.ignored[:, None]).any(0)
    return Targets(worth, labels.boxes[owner], mine.any(0) | ~hidden)


class Losses(NamedTuple):
    """Parts of the loss, sums, and the sum of target scores by which they are to be divided."""

    classification: jax.Array
    localisation: jax.Array
    closeness: jax.Array
    worth: jax.Array

    def total(self) -> jax.Array:
        """The loss."""
        weighted = self.classification + LOCALISATION * self.localisation + CLOSENESS * self.closeness
        return weighted / jnp.maximum(self.worth, 1.0)


def proposed(boxes: jax.Array, logits: jax.Array, labels: Labels, middles: Array) -> Losses:
    """Of the proposer's answers to one picture: cross entropy of the scores; and of the boxes, weighted by their target
    scores, the generalised overlap (Rezatofighi et al., 2019) and the distance of the edges in cells."""
    fixed_boxes, fixed_logits = jax.lax.stop_gradient((boxes, logits))
    targets = assign(middles, fixed_boxes, jax.nn.sigmoid(fixed_logits), labels)
    entropy = optax.sigmoid_binary_cross_entropy(logits, targets.scores)
    return Losses(
        jnp.where(targets.judged, entropy, 0).sum(),
        (targets.scores * (1 - generalised_overlap(boxes, targets.boxes))).sum(),
        (targets.scores * jnp.abs(boxes - targets.boxes).mean(-1) / STRIDE).sum(),
        targets.scores.sum(),
    )


def refined(boxes: jax.Array, logits: jax.Array, wanted: jax.Array, class_id: jax.Array) -> Losses:
    """Of the refiner's answer to one crop, the same: the thing's box (4,) is `wanted`, its class `class_id`, -1 for
    background. Its score should be how well the box fits."""
    thing = class_id >= 0
    fit = jnp.where(thing, overlap(jax.lax.stop_gradient(boxes), wanted), 0)
    scores = fit * jax.nn.one_hot(class_id, logits.shape[-1])
    return Losses(
        optax.sigmoid_binary_cross_entropy(logits, scores).sum(),
        jnp.where(thing, 1 - generalised_overlap(boxes, wanted), 0),
        jnp.where(thing, jnp.abs(boxes - wanted).mean(-1) / CLOSE, 0),
        thing.astype(float),
    )


def overlap(a: Array, b: Array) -> jax.Array:
    """Intersection over union of boxes (..., 4)."""
    shared, union, _ = _areas(a, b)
    return shared / jnp.maximum(union, 1e-6)


def generalised_overlap(a: Array, b: Array) -> jax.Array:
    """Overlap less the share of the box round both that neither covers, in (-1, 1]."""
    shared, union, around = _areas(a, b)
    return shared / jnp.maximum(union, 1e-6) - (around - union) / jnp.maximum(around, 1e-6)


def _areas(a: Array, b: Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Of what boxes share, of their union, and of the box round both."""
    low, high = jnp.maximum(a[..., :2], b[..., :2]), jnp.minimum(a[..., 2:], b[..., 2:])
    shared = jnp.maximum(high - low, 0).prod(-1)
    outer = jnp.maximum(a[..., 2:], b[..., 2:]) - jnp.minimum(a[..., :2], b[..., :2])
    one, other = (jnp.maximum(x[..., 2:] - x[..., :2], 0).prod(-1) for x in (a, b))
    return shared, one + other - shared, outer.prod(-1)
