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
from arm5dof.vision.synthetic.samples import parallel_map

PRECISION_CONFIDENCE = 0.001
"""Precision is averaged over all recalls, so it is measured with detections as uncertain as this."""
POSITION_CONFIDENCE = 0.25
"""Objects are located by detections at least so confident: what detectors report unless told otherwise."""
TIMED_IMAGES = 100
"""That the speed is measured on."""
TIMED_ROUNDS = 3
"""How often; the fastest counts: what else the machine does only slows it down."""


@dataclass(frozen=True)
class Precision:
    """Average precision, as COCO defines it: of objects of which at least half is seen; those of which less is seen are
    ignored."""

    map50: float
    """Mean over the classes, of boxes with an IoU of at least 50 % with the true one."""
    map50_95: float
    """The same, and mean over an IoU of 50 %, 55 % to 95 %."""
    by_class: dict[str, float | None]
    """The latter of each class; None for classes that are nowhere."""


@dataclass(frozen=True)
class Result:
    """What an evaluation found."""

    precision: Precision
    positions: dict[str, Accuracy]
    """By the method of localization: `plane`, `depth`, `two_views`."""
    edge_px: float
    """Standard deviation of the edges of boxes that find an object, pixels."""
    frames_per_s: float
    """Whole calls of the detector as it ships, image in, detections out."""

    def as_json(self) -> dict[str, Any]:
        """All of it, for a JSON object."""
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
    tta: bool = False,
    progress: Callable[[int], object] = lambda done: None,
) -> Result:
    """Measure the tabletop detector on random scenes in the style of evaluation.

    Args:
        weights: A file of weights; None for those that ship.
        scenes: Number of scenes.
        seed: Of the scenes.
        back_end: What renders them: see `simulated_camera`.
        tta: Use test-time augmentation.
        progress: Called with the number of scenes done.

    Raises:
        UserError: The weights cannot be used, pycocotools is not installed, or there is nothing to find in the scenes.
    """
    thresholds = PRECISION_CONFIDENCE, POSITION_CONFIDENCE
    permissive, detector = (TabletopDetector(weights, confidence, tta=tta) for confidence in thresholds)
    truths: list[Truth] = []
    detections: list[Detections] = []
    images: list[np.ndarray] = []
    tallies: dict[str, Tally] = defaultdict(Tally)
    errors: list[np.ndarray] = []
    samples = parallel_map(partial(render_stereo_sample, seed=seed, back_end=back_end), scenes)
    for done, sample in enumerate(samples, 1):
        first = sample.views[0]
        both = [permissive(view.image) for view in sample.views]
        truths.append(first.truth)
        detections.append(both[0])
        confident = [found[found.confidence >= POSITION_CONFIDENCE] for found in both]
        errors.append(edge_errors(confident[0], first.truth))
        for method, located in locate_by_each(sample, confident).items():
            tallies[method].add(located, first.truth)
        images += [first.image] * (done <= TIMED_IMAGES)
        progress(done)
    positions = {method: tally.accuracy() for method, tally in tallies.items()}
    edge_px = float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))
    return Result(average_precision(truths, detections), positions, edge_px, speed(detector, images))


def average_precision(truths: Sequence[Truth], detections: Sequence[Detections]) -> Precision:
    """Average precision by pycocotools.

    Args:
        truths: What there is in each image.
        detections: What was found in it, of classes of the catalogue.

    Raises:
        UserError: pycocotools is not installed, or there is nothing to find.
    """
    try:
        from pycocotools.coco import COCO
        from pycocotools.cocoeval import COCOeval
    except ImportError:
        raise UserError("average precision needs pycocotools: pip install 'arm5dof[eval]'") from None
    annotations: list[dict[str, Any]] = [
        {"image_id": image, "category_id": int(class_id), "bbox": _xywh(box), "iscrowd": int(not counts)}
        for image, truth in enumerate(truths)
        for box, class_id, counts in zip(truth.xyxy, truth.class_id, truth.counts, strict=True)
    ]
    if all(one["iscrowd"] for one in annotations):
        raise UserError("nothing to find in these scenes: evaluate on more")
    for i, one in enumerate(annotations, 1):
        one |= {"id": i, "area": one["bbox"][2] * one["bbox"][3]}
    answers = [
        {"image_id": image, "category_id": int(class_id), "bbox": _xywh(box), "score": float(confidence)}
        for image, found in enumerate(detections)
        for box, class_id, confidence in zip(found.xyxy, found.class_id, found.confidence, strict=True)
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
    # IoU, recalls, classes, sizes of objects (all of them first), numbers of detections (100 last); -1 for none.
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


def speed(detector: Detector, images: Sequence[np.ndarray]) -> float:
    """Images a second, one after the other."""
    detector(images[0])
    seconds = []
    for _ in range(TIMED_ROUNDS):
        started = time.perf_counter()
        for image in images:
            detector(image)
        seconds.append(time.perf_counter() - started)
    return len(images) / min(seconds)


def _xywh(box: np.ndarray) -> list[float]:
    """As COCO has boxes: left, top, width and height."""
    left, top, right, bottom = (float(v) for v in box)
    return [left, top, right - left, bottom - top]
