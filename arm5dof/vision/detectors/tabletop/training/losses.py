"""How far the two networks' answers are from what they should be."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from arm5dof.vision.boxes import giou, iou
from arm5dof.vision.camera import Array
from arm5dof.vision.detectors.tabletop.networks import STRIDE
from arm5dof.vision.detectors.tabletop.training.assignment import Labels, assign

CROP_UNIT = 0.1
"""Distances of edges are counted in cells for the proposer, and in this share of a crop for the refiner."""
LOCALISATION_WEIGHT, CLOSENESS_WEIGHT = 4.0, 1.0
"""Of the two measures of a box's error, beside that of the classification."""


class Losses(NamedTuple):
    """Parts of the loss, sums over boxes, and the sum of target scores by which they are to be divided."""

    classification: jax.Array
    """Cross entropy of the scores."""
    localisation: jax.Array
    """1 - generalized IoU of the boxes, weighted by their target scores."""
    closeness: jax.Array
    """Mean distance of their edges, likewise."""
    target_scores: jax.Array

    def total(self) -> jax.Array:
        """The loss."""
        weighted = self.classification + LOCALISATION_WEIGHT * self.localisation + CLOSENESS_WEIGHT * self.closeness
        return weighted / jnp.maximum(self.target_scores, 1.0)


def proposer_losses(boxes: jax.Array, logits: jax.Array, labels: Labels, centers: Array) -> Losses:
    """Of the proposer's answer to one image.

    Args:
        boxes: Of its cells, (n, 4), pixels.
        logits: (n,).
        labels: What there is to find.
        centers: Of the cells, (n, 2), pixels.
    """
    fixed_boxes, fixed_logits = jax.lax.stop_gradient((boxes, logits))
    targets = assign(centers, fixed_boxes, jax.nn.sigmoid(fixed_logits), labels)
    entropy = optax.sigmoid_binary_cross_entropy(logits, targets.scores)
    return Losses(
        jnp.where(targets.scored, entropy, 0).sum(),
        (targets.scores * (1 - giou(boxes, targets.boxes))).sum(),
        (targets.scores * jnp.abs(boxes - targets.boxes).mean(-1) / STRIDE).sum(),
        targets.scores.sum(),
    )


def refiner_losses(box: jax.Array, logits: jax.Array, target: jax.Array, class_id: jax.Array) -> Losses:
    """Of the refiner's answer to one crop. Its score should be how well the box fits.

    Args:
        box: (4,) relative to the crop.
        logits: (classes,).
        target: The box (4,) of the object in the crop.
        class_id: Its class, -1 for background.
    """
    is_object = class_id >= 0
    fit = jnp.where(is_object, iou(jax.lax.stop_gradient(box), target), 0)
    scores = fit * jax.nn.one_hot(class_id, logits.shape[-1])
    return Losses(
        optax.sigmoid_binary_cross_entropy(logits, scores).sum(),
        jnp.where(is_object, 1 - giou(box, target), 0),
        jnp.where(is_object, jnp.abs(box - target).mean(-1) / CROP_UNIT, 0),
        is_object.astype(float),
    )
