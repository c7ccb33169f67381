"""How good the detector is on scenes that it has never seen: mean average precision, and its speed."""

from __future__ import annotations

import io
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.detections import Detections, Detector
from arm5dof.vision.detectors.tabletop.detector import TabletopDetector
from arm5dof.vision.evaluation.localization import (
    Accuracy,
    Tally,
    edge_errors,
    locate_by_each,
    render_stereo_sample,
)
from arm5dof.vision.objects import CLASS_NAMES
from arm5dof.vision.rendering.simulated import BackEnd
from arm5dof.vision.synthetic.ground_truth import Truth
from arm5dof.vision.synthetic.samples import in_order

UNSURE = 0.001
"""Precision is averaged over all recalls, so it is measured with detections as uncertain as this."""
SURE = 0.25
"""Things are placed by detections at least so confident: what detectors report unless told otherwise."""
TIMED = 100
"""Pictures that the speed is measured on."""
ROUNDS = 3
"""How often; the fastest counts: what else the machine does only slows it down."""


@dataclass(frozen=True)
class Precision:
    """Average precision, as COCO defines it: with whole boxes found where at least half of a thing is seen, and things
    of which less is seen ignored."""

    map50: float
    """Mean over the classes, of boxes that overlap the true one by at least 50 %."""
    map50_95: float
    """The same, and mean over overlaps of 50 %, 55 % to 95 %."""
    by_class: dict[str, float | None]
    """The latter of each class; None for classes that are nowhere."""


@dataclass(frozen=True)
class Result:
    """What an evaluation found."""

    precision: Precision
    positions: dict[str, Accuracy]
    """By the method: `plane`, `depth`, `two_views`."""
    edge_px: float
    """Standard deviation of the edges of boxes, of things that are placed."""
    frames_per_s: float
    """Whole calls of the detector as it ships, image in, detections out."""

    def as_json(self) -> dict[str, Any]:
        return {
            "map50": self.precision.map50,
            "map50_95": self.precision.map50_95,
            "position_median_mm": self.positions["plane"].median_mm,
            "position_p95_mm": self.positions["plane"].p95_mm,
            "frames_per_s": self.frames_per_s,
            "edge_px": self.edge_px,
            "positions": {method: asdict(accuracy) for method, accuracy in self.positions.items()},
            "map50_95_by_class": self.precision.by_class,
        }


def evaluate(
    weights: Path | None,
    scenes: int,
    seed: int,
    back_end: BackEnd = "auto",
    careful: bool = False,
    progress: Callable[[int], None] = lambda done: None,
) -> Result:
    """Of a file of weights, or those that ship, on `scenes` pictures in the style of evaluation."""
    unsure, detector = (TabletopDetector(weights, least, careful=careful) for least in (UNSURE, SURE))
    truths: list[Truth] = []
    found: list[Detections] = []
    pictures: list[np.ndarray] = []
    tallies: dict[str, Tally] = defaultdict(Tally)
    off: list[np.ndarray] = []
    for done, seen in enumerate(in_order(partial(render_stereo_sample, seed=seed, back_end=back_end), scenes), 1):
        first = seen.views[0]
        both = [unsure(view.image) for view in seen.views]
        truths.append(first.truth)
        found.append(both[0])
        sure = [some[some.confidence >= SURE] for some in both]
        off.append(edge_errors(sure[0], first.truth))
        for method, located in locate_by_each(seen, sure).items():
            tallies[method].add(located, first.truth)
        pictures += [first.image] * (done <= TIMED)
        progress(done)
    positions = {method: tally.accuracy() for method, tally in tallies.items()}
    edge_px = float(np.sqrt(np.mean(np.concatenate(off) ** 2)))
    return Result(average_precision(truths, found), positions, edge_px, speed(detector, pictures))


def average_precision(truths: Sequence[Truth], found: Sequence[Detections]) -> Precision:
    """By pycocotools, from what there is and what was found in each picture. Raises `UserError` without pycocotools, or
    if there is nothing to find."""
    try:
        from pycocotools.coco import COCO
        from pycocotools.cocoeval import COCOeval
    except ImportError:
        raise UserError("average precision takes pycocotools: pip install 'arm5dof[eval]'") from None
    annotations: list[dict[str, Any]] = [
        {"image_id": image, "category_id": int(class_id), "bbox": _corner_and_size(box), "iscrowd": int(not counts)}
        for image, truth in enumerate(truths)
        for box, class_id, counts in zip(truth.xyxy, truth.class_id, truth.counts, strict=True)
    ]
    if all(one["iscrowd"] for one in annotations):
        raise UserError("nothing to find in these scenes: evaluate on more")
    for i, one in enumerate(annotations, 1):
        one |= {"id": i, "area": one["bbox"][2] * one["bbox"][3]}
    answers = [
        {"image_id": image, "category_id": int(class_id), "bbox": _corner_and_size(box), "score": float(confidence)}
        for image, some in enumerate(found)
        for box, class_id, confidence in zip(some.xyxy, some.class_id, some.confidence, strict=True)
    ]
    if not answers:
        return Precision(0.0, 0.0, dict.fromkeys(CLASS_NAMES, 0.0))
    with redirect_stdout(io.StringIO()):  # It prints tables.
        coco = COCO()
        coco.dataset = {
            "images": [{"id": image} for image in range(len(truths))],
            "annotations": annotations,
            "categories": [{"id": i, "name": name} for i, name in enumerate(CLASS_NAMES)],
        }
        coco.createIndex()
        result = COCOeval(coco, coco.loadRes(answers), "bbox")
        result.evaluate()
        result.accumulate()
    # Overlaps, recalls, classes, sizes of things (all of them first), numbers of detections (100 last); -1 for none.
    precision = result.eval["precision"][:, :, :, 0, -1]
    precision = np.where(precision < 0, np.nan, precision)
    by_class = precision.mean((0, 1))
    return Precision(
        float(np.nanmean(precision[0].mean(0))),
        float(np.nanmean(by_class)),
        {
            name: None if np.isnan(value) else round(float(value), 4)
            for name, value in zip(CLASS_NAMES, by_class, strict=True)
        },
    )


def speed(detector: Detector, pictures: Sequence[np.ndarray]) -> float:
    """Pictures a second, one after the other."""
    detector(pictures[0])
    taken = []
    for _ in range(ROUNDS):
        started = time.perf_counter()
        for picture in pictures:
            detector(picture)
        taken.append(time.perf_counter() - started)
    return len(pictures) / min(taken)


def _corner_and_size(box: np.ndarray) -> list[float]:
    left, top, right, bottom = (float(v) for v in box)
    return [left, top, right - left, bottom - top]
