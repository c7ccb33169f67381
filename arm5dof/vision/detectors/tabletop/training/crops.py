"""The crops that the refiner learns from: round what the proposer proposed in the pictures that it learnt from, and
round true boxes, moved a little."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from arm5dof.vision.detectors.tabletop.proposals import crop, overlap, squares, to_crop
from arm5dof.vision.detectors.tabletop.training.training_set import TrainingSet, overprinted, relit
from arm5dof.vision.synthetic.ground_truth import VISIBLE

THING, BACKGROUND = 0.4, 0.3
"""A proposal is of a thing that it overlaps by so much; if it overlaps none by as little as this, it is of none."""
MOVED, SCALED = 0.2, 0.2
"""How far the middles of boxes are moved, in their width and height, and the logarithm of how much they are scaled."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Boxes to look at closely, and what is there."""

    scene: np.ndarray
    """(n,) in which picture."""
    boxes: np.ndarray
    """(n, 4) pixels."""
    wanted: np.ndarray
    """(n, 4) the box of the thing that is there; of background, the box itself."""
    class_id: np.ndarray
    """(n,), -1 for background."""
    likely: np.ndarray
    """(n,) how likely the proposer thought that there is something; 1 for true boxes."""


def candidates(data: TrainingSet, scene: int, proposals: np.ndarray, likely: np.ndarray) -> Candidates:
    """Of one scene: proposals (n, 4), each so likely (n,), and the boxes of the things. What is mostly hidden is left
    out."""
    mine = np.s_[data.first(scene) : data.first(scene + 1)]
    things, class_id, counts = data.boxes[mine], data.class_id[mine], data.visible[mine] >= VISIBLE
    if not len(things):
        return Candidates(np.full(len(proposals), scene), proposals, proposals, np.full(len(proposals), -1), likely)
    boxes, likely = np.concatenate([proposals, things[counts]]), np.concatenate([likely, np.ones(counts.sum())])
    fit = overlap(boxes, things)
    best, which = fit.max(1), fit.argmax(1)
    none = best < BACKGROUND
    wanted = np.where(none[:, None], boxes, things[which])
    taken = none | ((best >= THING) & counts[which])
    class_id = np.where(none, -1, class_id[which])
    return Candidates(np.full(taken.sum(), scene), boxes[taken], wanted[taken], class_id[taken], likely[taken])


def batch(
    data: TrainingSet, found: Candidates, seed: tuple[int, ...], size: int
) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Crops (size, CROP, CROP, 3) uint8 and how wide they were, (size,), pixels; the boxes (size, 4) of what they show,
    as shares of the crop, and its class (size,), -1 for background: half of them, and what the proposer is misled by
    more often than what it is not. The same seed gives the same bits."""
    rng = np.random.default_rng(seed)
    things, background = np.flatnonzero(found.class_id >= 0), np.flatnonzero(found.class_id < 0)
    half = size // 2 if len(background) else size
    rows = rng.choice(things, half)
    if half < size:
        misled = found.likely[background].astype(float)
        rows = np.concatenate([rows, rng.choice(background, size - half, p=misled / misled.sum())])
    crops, widths, wanted = zip(*(_crop(data, found, row, rng) for row in rows), strict=True)
    boxes = np.stack(wanted).astype(np.float32)
    return (np.stack(crops), np.array(widths, np.float32)), (boxes, found.class_id[rows].astype(np.int32))


def _crop(
    data: TrainingSet, found: Candidates, row: int, rng: np.random.Generator
) -> tuple[np.ndarray, float, np.ndarray]:
    """One, moved, mirrored and in other light."""
    low, high = np.split(found.boxes[row].astype(float), 2)
    middle = (low + high) / 2 + rng.uniform(-MOVED, MOVED, 2) * (high - low)
    half = (high - low) / 2 * np.exp(rng.uniform(-SCALED, SCALED, 2))
    (square,) = squares(np.concatenate([middle - half, middle + half])[None])
    scene = found.scene[row]
    owner = crop(data.owners[scene], square, cv2.INTER_NEAREST)
    seen = overprinted(crop(data.pictures[scene], square), owner, rng)
    (wanted,) = to_crop(found.wanted[row][None], square[None])
    if rng.random() < 0.5:  # Only left and right: no camera hangs upside down, and light comes from above.
        seen = np.flip(seen, 1)
        wanted[[0, 2]] = 1 - wanted[[2, 0]]
    return relit(np.ascontiguousarray(seen), rng), float(square[2]), np.clip(wanted, -0.5, 1.5)
