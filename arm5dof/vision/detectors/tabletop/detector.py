"""`TabletopDetector`: the detector that ships, for the objects of the catalogue on a table.

found = TabletopDetector()(image)
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np

from arm5dof.runtime import forks, xla
from arm5dof.vision.boxes import mirror, nms
from arm5dof.vision.detections import Detections, check_thresholds
from arm5dof.vision.detectors.tabletop.crops import boxes_to_image, crop, crop_squares
from arm5dof.vision.detectors.tabletop.networks import Proposer, Refiner
from arm5dof.vision.detectors.tabletop.weights import load_weights
from arm5dof.vision.images import letterbox, rgb

INPUT_SIZE = (640, 480)
"""Width and height to which images are fitted, pixels; the refiner's crops are taken from that."""
PROPOSER_SIZE = (320, 240)
"""Width and height of the image that the proposer sees, pixels."""
MAX_PROPOSALS = 40
"""The most that are refined."""
PROPOSAL_THRESHOLD, PROPOSAL_FLOOR = 0.07, 0.01
"""Less likely proposals are not refined, but with test-time augmentation, or where they fill up a batch of the refiner:
those below the second never."""
CUT = 2
"""What comes as near to an edge of a window inside the image is cut by it, pixels."""
PROPOSAL_IOU = 0.6
"""Of proposals that overlap more, the likeliest is refined."""
PROPOSER_WEIGHT = 0.4
"""A detection's confidence is the geometric mean of both networks' scores, the proposer's with this weight."""
RESCORE_THRESHOLD = 0.02
"""With test-time augmentation, what is less likely an object is not refined again."""
BATCH = 4
"""Crops in one call of the refiner."""


class TabletopDetector:
    """Finds objects of the catalogue in images.

    Args:
        weights: A file that training wrote; None for the one that ships.
        confidence: Detections below it are dropped, in [0, 1].
        iou: Of boxes that overlap more the best stays, in [0, 1], whatever their classes: an object is of one class.
        tta: Test-time augmentation: refine less likely proposals too, and what may be an object three times, once
            mirrored, and average. More is found, and boxes fit better, in twice the time.
        windows: Look for objects in four windows of the image too, in which they are larger. More is found, and more
            that is no object.

    Raises:
        UserError: The file is missing, damaged or of another network, or a threshold lies outside [0, 1].
    """

    def __init__(
        self,
        weights: str | Path | None = None,
        confidence: float = 0.25,
        iou: float = 0.6,
        tta: bool = False,
        windows: bool = False,
    ) -> None:
        check_thresholds(confidence, iou)
        params, self.class_names = load_weights(weights)
        self._params = jax.device_put(params)
        self._confidence, self._iou, self._tta = confidence, iou, tta
        self._propose = propose_in_windows if windows else propose

    def __call__(self, image: np.ndarray) -> Detections:
        """What is in an image (h, w, 3), RGB uint8 or anything else that `images.rgb` takes."""
        forks.check()
        boxed = letterbox(rgb(image), INPUT_SIZE)
        refine_here = partial(refine, self._params["refiner"], boxed.image)
        proposed, objectness = self._propose(self._params["proposer"], boxed.image)
        if not self._tta:
            count = _whole_batches(int(np.count_nonzero(objectness >= PROPOSAL_THRESHOLD)))
            proposed, objectness = proposed[:count], objectness[:count]
        boxes, logits = refine_here(proposed)
        if self._tta:
            rows = self._best(boxes, logits, objectness, RESCORE_THRESHOLD)
            boxes, logits, objectness = boxes[rows], logits[rows], objectness[rows]
            mirrored, mirrored_logits = refine_here(boxes, mirrored=True)
            again, again_logits = refine_here(mirrored)
            boxes, logits = (mirrored + again) / 2, (logits + mirrored_logits + again_logits) / 3
        rows = self._best(boxes, logits, objectness, self._confidence)
        scores = class_scores(logits[rows], objectness[rows])
        return Detections(boxed.to_source(boxes[rows]), scores.max(1), scores.argmax(1), self.class_names)

    def _best(self, boxes: np.ndarray, logits: np.ndarray, objectness: np.ndarray, threshold: float) -> np.ndarray:
        """Rows of the boxes (n, 4) that score at least so much: the best wherever several overlap."""
        scores = class_scores(logits, objectness).max(1)
        rows = np.flatnonzero((scores >= threshold) & (boxes[:, 2:] > boxes[:, :2]).all(1))
        return rows[nms(boxes[rows], scores[rows], self._iou)]


def class_scores(logits: np.ndarray, objectness: np.ndarray) -> np.ndarray:
    """Scores of each class (n, classes), in [0, 1], from the refiner's logits (n, classes) and the proposer's scores of
    there being an object (n,)."""
    return np.asarray((1 + np.exp(-logits)) ** (PROPOSER_WEIGHT - 1) * objectness[:, None] ** PROPOSER_WEIGHT)


def propose(params: dict[str, Any], image: np.ndarray, floor: float = PROPOSAL_FLOOR) -> tuple[np.ndarray, np.ndarray]:
    """Find what may be objects.

    Args:
        params: The proposer's weights, from `fold_batch_norm`.
        image: RGB uint8, of `INPUT_SIZE`.
        floor: Less likely proposals are dropped.

    Returns:
        Boxes (n, 4), pixels, and how likely they hold an object (n,), the likeliest first, at most `MAX_PROPOSALS`.
    """
    reduced = cv2.resize(image, PROPOSER_SIZE, interpolation=cv2.INTER_AREA)
    boxes, logits = (np.asarray(x) for x in _proposer()(params, reduced))
    rows = np.flatnonzero(logits > np.log(floor / (1 - floor)))
    boxes, objectness = boxes[rows] * (image.shape[1] / PROPOSER_SIZE[0]), 1 / (1 + np.exp(-logits[rows]))
    return _likeliest(boxes, objectness)


def propose_in_windows(params: dict[str, Any], image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """As `propose`, in the image and in four windows of it that overlap. What an edge of a window cuts is left out."""
    full = np.array([image.shape[1], image.shape[0]])
    size = 2 * full // 3
    found = [propose(params, image)]
    for corner in product(*zip((0, 0), full - size, strict=True)):
        start, end = np.array(corner), corner + size
        boxes, objectness = propose(params, image[start[1] : end[1], start[0] : end[0]])
        boxes = boxes + np.tile(start, 2)
        whole = (boxes[:, :2] >= np.where(start > 0, start + CUT, -np.inf)) & (
            boxes[:, 2:] <= np.where(end < full, end - CUT, np.inf)
        )
        found.append((boxes[whole.all(1)], objectness[whole.all(1)]))
    boxes, objectness = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return _likeliest(boxes, objectness)


def _likeliest(boxes: np.ndarray, objectness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    kept = nms(boxes, objectness, PROPOSAL_IOU)[:MAX_PROPOSALS]
    return boxes[kept], objectness[kept]


def refine(
    params: dict[str, Any], image: np.ndarray, proposed: np.ndarray, mirrored: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Classify what is in proposed boxes, and fit the boxes to it.

    Args:
        params: The refiner's weights, from `fold_batch_norm`.
        image: RGB uint8, of `INPUT_SIZE`.
        proposed: Boxes (n, 4), pixels.
        mirrored: Show the network mirrored crops, left and right exchanged.

    Returns:
        Boxes (n, 4), pixels, and logits (n, classes).
    """
    count, classes = len(proposed), params["logits"]["bias"].size
    if not count:
        return np.empty((0, 4)), np.empty((0, classes))
    squares = crop_squares(proposed)

    def refine_batch(rows: np.ndarray) -> list[np.ndarray]:
        crops = np.stack([crop(image, squares[i]) for i in rows])
        crops = np.flip(crops, 2) if mirrored else crops
        return [np.asarray(x) for x in _refiner()(params, crops, squares[rows, 2].astype(np.float32))]

    rows = np.minimum(np.arange(_whole_batches(count)), count - 1).reshape(-1, BATCH)
    batches = _threads().map(refine_batch, rows)
    relative, logits = (np.concatenate(parts)[:count] for parts in zip(*batches, strict=True))
    return boxes_to_image(mirror(relative, 1) if mirrored else relative, squares), logits


def _whole_batches(count: int) -> int:
    """How many crops are in the batches that so many crops take."""
    return -(-count // BATCH) * BATCH


@cache
def _threads() -> ThreadPoolExecutor:
    """XLA keeps but one core busy with networks so small."""
    return ThreadPoolExecutor(xla.cores(), "detector")


@cache
def _proposer() -> Any:
    """The compiled proposer: weights and an image of `PROPOSER_SIZE` to boxes (n, 4) and logits (n,)."""

    def forward(params: dict[str, Any], image: jax.Array) -> tuple[jax.Array, jax.Array]:
        outputs: Any = Proposer(False).apply({"params": params}, image[None])
        (boxes,), (logits,) = outputs
        return boxes, logits

    return jax.jit(forward, compiler_options=xla.fusion_emitters())


@cache
def _refiner() -> Any:
    """The compiled refiner: weights, crops (n, CROP, CROP, 3) and their widths (n,) to boxes (n, 4) and logits."""

    def forward(params: dict[str, Any], crops: jax.Array, widths: jax.Array) -> Any:
        return Refiner(params["logits"]["bias"].size, False).apply({"params": params}, crops, widths)

    return jax.jit(forward, compiler_options=xla.fusion_emitters())
