"""`TabletopDetector`: the detector that ships, for the things of the catalogue on a table.

    found = TabletopDetector()(image)

Its weights are a `.npz` file, trained by `arm5dof vision train`: arrays by their names in the network, normalisation
folded in, and the names of the classes. Nothing in it is ever unpickled.
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from arm5dof.errors import UserError
from arm5dof.runtime import files, xla
from arm5dof.vision.detections import Detections, check_thresholds, strongest
from arm5dof.vision.detectors.loading import SHIPPED
from arm5dof.vision.detectors.tabletop.networks import COARSEST, CROP, Proposer, Refiner
from arm5dof.vision.detectors.tabletop.proposals import REDUCED, crop, squares, to_picture
from arm5dof.vision.images import letterbox, rgb

SIZE = (640, 480)
"""Width and height of the pictures that it looks at, pixels. Other images are fitted in."""
PROPOSALS = 40
"""The most that are looked at closely."""
LIKELY, POSSIBLE = 0.07, 0.01
"""Proposals less so are not looked at, but for a careful look, or where they make up a call of the refiner: those less
than the second never."""
APART = 0.6
"""Of proposals that overlap more the likeliest is looked at."""
TRUST = 0.4
"""A detection's confidence is the geometric mean of what both networks say, with this weight for the proposer's."""
LEAST = 0.02
"""What is less likely a thing is not looked at again."""
TOGETHER = 4
"""So many crops are one call of the refiner."""
NAMES = "class_names"
DAMAGED = (
    zipfile.BadZipFile,
    zipfile.LargeZipFile,
    zlib.error,
    ValueError,
    KeyError,
    TypeError,
    EOFError,
    AttributeError,
)
"""What NumPy raises for files that are no archives of arrays."""


class TabletopDetector:
    """Finds things of the catalogue in images.

    weights:     a file that `arm5dof vision train` wrote; without it, the one that ships
    confidence:  detections below are dropped
    iou:         of boxes that overlap more the best stays, whatever their classes: a thing is of one class
    careful:     look at less likely proposals too, and at what may be a thing twice more, first mirrored, from where it
                 then seems to be: more is found, and boxes fit better, in twice the time

    Raises `UserError` if the file is missing, damaged or of another network.
    """

    def __init__(
        self, weights: str | Path | None = None, confidence: float = 0.25, iou: float = 0.6, careful: bool = False
    ) -> None:
        check_thresholds(confidence, iou)
        params, self._class_names = load_weights(SHIPPED if weights is None else weights)
        self._params = jax.device_put(params)
        self._confidence, self._iou, self._careful = confidence, iou, careful

    @property
    def class_names(self) -> tuple[str, ...]:
        return self._class_names

    def __call__(self, image: np.ndarray) -> Detections:
        """Detections in an RGB uint8 image (h, w, 3)."""
        boxed = letterbox(rgb(image), SIZE)
        look = partial(refine, self._params["refiner"], boxed.image)
        proposed, likely = propose(self._params["proposer"], boxed.image)
        if not self._careful:
            count = _filled(int(np.count_nonzero(likely >= LIKELY)))
            proposed, likely = proposed[:count], likely[:count]
        boxes, logits = look(proposed)
        if self._careful:
            again = self._best(boxes, logits, likely, LEAST)
            boxes, logits, likely = boxes[again], logits[again], likely[again]
            once, first = look(boxes, mirrored=True)
            twice, second = look(once)
            boxes, logits = (once + twice) / 2, (logits + first + second) / 3
        found = self._best(boxes, logits, likely, self._confidence)
        scores = confidences(logits[found], likely[found])
        return Detections(boxed.to_source(boxes[found]), scores.max(1), scores.argmax(1), self._class_names)

    def _best(self, boxes: np.ndarray, logits: np.ndarray, likely: np.ndarray, least: float) -> np.ndarray:
        """Which of the boxes (n, 4) are things, at least so confidently: the best wherever several overlap."""
        scores = confidences(logits, likely).max(1)
        rows = np.flatnonzero((scores >= least) & (boxes[:, 2:] > boxes[:, :2]).all(1))
        return rows[strongest(boxes[rows], scores[rows], self._iou)]


def confidences(logits: np.ndarray, likely: np.ndarray) -> np.ndarray:
    """Of each class (n, classes), from the refiner's logits (n, classes) and how likely the proposer thought that there
    is something (n,)."""
    return np.asarray((1 + np.exp(-logits)) ** (TRUST - 1) * likely[:, None] ** TRUST)


def propose(params: dict[str, Any], picture: np.ndarray, least: float = POSSIBLE) -> tuple[np.ndarray, np.ndarray]:
    """Boxes (n, 4) of what may be things in a picture, pixels, and how likely they are (n,), the likeliest first and
    none less than `least`."""
    reduced = cv2.resize(picture, REDUCED, interpolation=cv2.INTER_AREA)
    boxes, logits = (np.asarray(x) for x in _proposer()(params, reduced))
    rows = np.flatnonzero(logits > np.log(least / (1 - least)))
    boxes, likely = boxes[rows] * (picture.shape[1] / REDUCED[0]), 1 / (1 + np.exp(-logits[rows]))
    kept = strongest(boxes, likely, APART)[:PROPOSALS]
    return boxes[kept], likely[kept]


def refine(
    params: dict[str, Any], picture: np.ndarray, proposed: np.ndarray, mirrored: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Boxes (n, 4), pixels, and logits (n, classes) of what lies in the proposed boxes (n, 4), looked at as it is or
    mirrored, left and right."""
    count, classes = len(proposed), params["logits"]["bias"].size
    if not count:
        return np.empty((0, 4)), np.empty((0, classes))
    where = squares(proposed)

    def look(rows: np.ndarray) -> list[np.ndarray]:
        crops = np.stack([crop(picture, where[i]) for i in rows])
        crops = np.flip(crops, 2) if mirrored else crops
        return [np.asarray(x) for x in _refiner()(params, crops, where[rows, 2].astype(np.float32))]

    rows = np.minimum(np.arange(_filled(count)), count - 1).reshape(-1, TOGETHER)
    shares, logits = (np.concatenate(parts)[:count] for parts in zip(*_threads().map(look, rows), strict=True))
    if mirrored:
        shares[:, [0, 2]] = 1 - shares[:, [2, 0]]
    return to_picture(shares, where), logits


def _filled(count: int) -> int:
    """How many crops the calls hold that so many take."""
    return -(-count // TOGETHER) * TOGETHER


@cache
def _threads() -> ThreadPoolExecutor:
    """XLA keeps but one core busy with networks so small."""
    return ThreadPoolExecutor(xla.cores(), "detector")


@cache
def _proposer() -> Any:
    """Weights and a reduced picture to boxes (n, 4) and logits (n,)."""

    def forward(params: dict[str, Any], picture: jax.Array) -> tuple[jax.Array, jax.Array]:
        found: Any = Proposer(normalised=False).apply({"params": params}, picture[None])
        (boxes,), (logits,) = found
        return boxes, logits

    return jax.jit(forward, compiler_options=xla.fusion_emitters())


@cache
def _refiner() -> Any:
    """Weights, crops (n, CROP, CROP, 3) and their widths (n,) to boxes (n, 4) and logits (n, classes)."""

    def forward(params: dict[str, Any], crops: jax.Array, widths: jax.Array) -> Any:
        return Refiner(params["logits"]["bias"].size, normalised=False).apply({"params": params}, crops, widths)

    return jax.jit(forward, compiler_options=xla.fusion_emitters())


def save_weights(path: Path, params: dict[str, Any], class_names: Sequence[str]) -> None:
    """Write folded weights atomically, rounded to half precision. The same weights give the same bits."""
    arrays = {name: np.asarray(value, np.float16) for name, value in flatten_dict(params, sep="/").items()}
    with files.replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, allow_pickle=False, **{NAMES: np.array(class_names)}, **arrays)


def load_weights(path: str | Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Folded weights in single precision, and the names of the classes. Raises `UserError`."""
    path = Path(path)
    if not path.is_file():
        raise UserError(f"no weights {str(path)!r}: give a file that arm5dof vision train wrote")
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        class_names = tuple(str(name) for name in arrays.pop(NAMES))
        arrays = {name: value.astype(np.float32) for name, value in arrays.items()}
    except DAMAGED:
        raise UserError(
            f"{path} is damaged, or no weights of this detector: train them with arm5dof vision train"
        ) from None
    shapes = {name: value.shape for name, value in arrays.items()}
    if shapes != _shapes(len(class_names)) or not all(np.isfinite(value).all() for value in arrays.values()):
        raise UserError(f"{path} holds other weights than the network has: train them anew with arm5dof vision train")
    return unflatten_dict(arrays, sep="/"), class_names


@cache
def _shapes(classes: int) -> dict[str, tuple[int, ...]]:
    picture, crops = (np.zeros((1, side, side, 3), np.uint8) for side in (COARSEST, CROP))
    made = {
        "proposer": jax.eval_shape(Proposer(normalised=False).init, jax.random.key(0), picture),
        "refiner": jax.eval_shape(Refiner(classes, False).init, jax.random.key(0), crops, np.ones(1, np.float32)),
    }
    params = {name: variables["params"] for name, variables in made.items()}
    return {name: value.shape for name, value in flatten_dict(params, sep="/").items()}
