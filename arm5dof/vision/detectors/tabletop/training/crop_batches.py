"""What the refiner learns from: crops around what the proposer proposes in the images that it has learned from, and
around true boxes, jittered."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from arm5dof.vision.boxes import iou, mirror
from arm5dof.vision.detectors.tabletop.crops import boxes_to_crop, crop, crop_squares
from arm5dof.vision.detectors.tabletop.training.augment import augment_background, augment_photometric
from arm5dof.vision.detectors.tabletop.training.training_set import TrainingSet
from arm5dof.vision.synthetic.ground_truth import VISIBLE

OBJECT_IOU, BACKGROUND_IOU = 0.4, 0.3
"""A proposal is of an object that it overlaps by so much; if it overlaps none by as little as this, of background."""
SHIFT, SCALE = 0.2, 0.2
"""How far the centers of boxes are moved, in their width and height, and the logarithm of how much they are scaled."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Boxes to refine, and what is there."""

    scene: np.ndarray
    """(n,) in which image."""
    boxes: np.ndarray
    """(n, 4) pixels."""
    targets: np.ndarray
    """(n, 4) the box of the object that is there; of background, the box itself."""
    class_id: np.ndarray
    """(n,), -1 for background."""
    objectness: np.ndarray
    """(n,) the proposer's score; 1 for true boxes."""


def label_proposals(data: TrainingSet, scene: int, proposals: np.ndarray, objectness: np.ndarray) -> Candidates:
    """What is in the proposals of one scene, and its true boxes. What is mostly hidden is left out, and what is neither
    object nor background.

    Args:
        data: The images.
        scene: Index of the scene's.
        proposals: Boxes (n, 4), pixels.
        objectness: The proposer's scores (n,).
    """
    rows = np.s_[data.first(scene) : data.first(scene + 1)]
    objects, class_id, seen = data.boxes[rows], data.class_id[rows], data.visible[rows] >= VISIBLE
    if not len(objects):
        return Candidates(np.full(len(proposals), scene), proposals, proposals, np.full(len(proposals), -1), objectness)
    boxes = np.concatenate([proposals, objects[seen]])
    objectness = np.concatenate([objectness, np.ones(seen.sum())])
    fit = iou(boxes[:, None], objects)
    best, which = fit.max(1), fit.argmax(1)
    background = best < BACKGROUND_IOU
    targets = np.where(background[:, None], boxes, objects[which])
    kept = background | ((best >= OBJECT_IOU) & seen[which])
    class_id = np.where(background, -1, class_id[which])
    return Candidates(np.full(kept.sum(), scene), boxes[kept], targets[kept], class_id[kept], objectness[kept])


def crop_batch(
    data: TrainingSet, candidates: Candidates, seed: tuple[int, ...], size: int
) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Draw a batch of crops, half of them of background, and of that more often what misleads the proposer. The same
    seed gives the same bits.

    Args:
        data: The images.
        candidates: Where to crop them.
        seed: Of the batch.
        size: Number of crops.

    Returns:
        What the refiner is given: RGB uint8 (size, CROP, CROP, 3) and the crops' widths (size,), pixels; and what it
        should answer: boxes (size, 4) relative to the crops, and classes (size,), -1 for background.
    """
    rng = np.random.default_rng(seed)
    objects, background = np.flatnonzero(candidates.class_id >= 0), np.flatnonzero(candidates.class_id < 0)
    half = size // 2 if len(background) else size
    rows = rng.choice(objects, half)
    if half < size:
        weight = candidates.objectness[background].astype(float)
        rows = np.concatenate([rows, rng.choice(background, size - half, p=weight / weight.sum())])
    images, widths, targets = zip(*(_crop(data, candidates, row, rng) for row in rows), strict=True)
    boxes = np.stack(targets).astype(np.float32)
    return (np.stack(images), np.array(widths, np.float32)), (boxes, candidates.class_id[rows].astype(np.int32))


def _crop(
    data: TrainingSet, candidates: Candidates, row: int, rng: np.random.Generator
) -> tuple[np.ndarray, float, np.ndarray]:
    """One crop, its width, and its target (4,): jittered, mirrored and in other light."""
    low, high = np.split(candidates.boxes[row].astype(float), 2)
    middle = (low + high) / 2 + rng.uniform(-SHIFT, SHIFT, 2) * (high - low)
    half = (high - low) / 2 * np.exp(rng.uniform(-SCALE, SCALE, 2))
    (square,) = crop_squares(np.concatenate([middle - half, middle + half])[None])
    scene = candidates.scene[row]
    instances = crop(data.instances[scene], square, cv2.INTER_NEAREST)
    image = augment_background(crop(data.images[scene], square), instances, rng)
    (target,) = boxes_to_crop(candidates.targets[row][None], square[None])
    if rng.random() < 0.5:  # Only left and right: no camera hangs upside down, and light comes from above.
        image, target = np.flip(image, 1), mirror(target, 1)
    return augment_photometric(np.ascontiguousarray(image), rng), float(square[2]), np.clip(target, -0.5, 1.5)
