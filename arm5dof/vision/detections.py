"""`Detections`: what a detector found in an image, and what all detectors share."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np

from arm5dof.errors import UserError


@dataclass(frozen=True, eq=False)
class Detections:
    """Boxes in an image, the most confident first. The fields are named as in the `supervision` library."""

    xyxy: np.ndarray
    """Left, top, right and bottom edges, (n, 4) float32, pixels: pixel i covers [i, i + 1)."""
    confidence: np.ndarray
    """(n,) float32 in [0, 1]."""
    class_id: np.ndarray
    """Indices into `class_names`, (n,) int."""
    class_names: tuple[str, ...]
    """Every class that the detector knows."""

    def __post_init__(self) -> None:
        xyxy = np.asarray(self.xyxy, np.float32).reshape(-1, 4)
        confidence, class_id = np.asarray(self.confidence, np.float32), np.asarray(self.class_id, int)
        if not len(xyxy) == len(confidence) == len(class_id):
            raise ValueError(f"{len(xyxy)} boxes, {len(confidence)} confidences and {len(class_id)} classes")
        if not (np.isfinite(xyxy).all() and np.isfinite(confidence).all()):
            raise ValueError("boxes and confidences must be finite")
        if len(class_id) and not 0 <= class_id.min() <= class_id.max() < len(self.class_names):
            raise ValueError(f"class ids must be 0 to {len(self.class_names) - 1}")
        order = np.argsort(-confidence, kind="stable")
        for name, value in (("xyxy", xyxy), ("confidence", confidence), ("class_id", class_id)):
            object.__setattr__(self, name, value[order])
        object.__setattr__(self, "class_names", tuple(self.class_names))

    def __len__(self) -> int:
        return len(self.confidence)

    def __getitem__(self, index: int | slice | np.ndarray) -> Detections:
        """Some of the boxes: by number, slice, or mask (n,)."""
        pick = np.arange(len(self))[index].reshape(-1)
        return Detections(self.xyxy[pick], self.confidence[pick], self.class_id[pick], self.class_names)

    def __iter__(self) -> Iterator[Detections]:
        return (self[i] for i in range(len(self)))

    @property
    def data(self) -> dict[str, np.ndarray]:
        """The name of each box's class, under `class_name`, (n,)."""
        return {"class_name": np.array([self.class_names[i] for i in self.class_id], dtype=str)}

    @property
    def centre(self) -> np.ndarray:
        """Middles of the boxes, (n, 2), as OpenCV's camera model counts: whole numbers are the middles of pixels."""
        return (self.xyxy[:, :2] + self.xyxy[:, 2:]) / 2 - 0.5

    def named(self, *names: str) -> Detections:
        """The boxes of one class or several. Raises `UserError` if the detector knows none of such a name."""
        check_known(names, self.class_names)
        return self[np.isin(self.data["class_name"], names)]

    def rows(self) -> list[dict[str, Any]]:
        """For each box its class, class id, confidence and edges in pixels, as JSON has them."""
        each = zip(self.data["class_name"], self.class_id, self.confidence, self.xyxy, strict=True)
        return [
            {
                "class_name": str(name),
                "class_id": int(i),
                "confidence": round(float(c), 4),
                "xyxy": [round(float(v), 2) for v in box],
            }
            for name, i, c, box in each
        ]

    def to_json(self) -> str:
        """`rows` as text."""
        return json.dumps(self.rows(), indent=2)


class Detector(Protocol):
    """Anything that finds objects of named classes in an image."""

    @property
    def class_names(self) -> tuple[str, ...]: ...

    def __call__(self, image: np.ndarray) -> Detections:
        """Detections in an RGB uint8 image (h, w, 3)."""


def check_known(names: Iterable[str], class_names: Sequence[str]) -> None:
    """Raise `UserError` unless all `names` are among a detector's."""
    for name in names:
        if name not in class_names:
            known = ", ".join(class_names[:20]) + (", ..." if len(class_names) > 20 else "")
            raise UserError(f"the detector knows no class {name!r}; it knows: {known}")


def check_thresholds(confidence: float, iou: float) -> None:
    """Raise `UserError` unless both lie in [0, 1]."""
    for name, value in (("confidence", confidence), ("iou", iou)):
        if not 0 <= value <= 1:
            raise UserError(f"{name} must lie between 0 and 1, got {value}")


def strongest(xyxy: np.ndarray, scores: np.ndarray, iou: float, group: np.ndarray | None = None) -> np.ndarray:
    """Which of boxes (n, 4), left, top, right and bottom edges, are left, the highest score (n,) first, when of those
    of one group (n,) that overlap more than `iou` only the best stays. Without groups all are of one."""
    if not len(xyxy):
        return np.empty(0, int)
    # OpenCV moves groups apart by the largest coordinate, which is far enough only if none is negative.
    corner = xyxy[:, :2] - xyxy[:, :2].min(0, initial=0)
    whole = np.concatenate([corner, xyxy[:, 2:] - xyxy[:, :2]], axis=1)
    group = np.zeros(len(xyxy), int) if group is None else group
    return np.asarray(cv2.dnn.NMSBoxesBatched(whole.tolist(), scores.tolist(), group.tolist(), 0.0, iou), int)


def suppress(
    boxes: np.ndarray,
    scores: np.ndarray,
    class_names: tuple[str, ...],
    confidence: float,
    iou: float,
    limit: int = 300,
) -> Detections:
    """Each box's best class, the boxes at least so confident, and of those of one class that overlap more than `iou`
    the best.

    boxes:  (n, 4) centre x and y, width, height, pixels
    scores: (n, classes)
    limit:  the largest number of detections
    """
    if not (np.isfinite(boxes).all() and np.isfinite(scores).all()):
        raise UserError("the network's output is not finite: its weights are damaged")
    best = scores.argmax(1)
    score = scores[np.arange(len(scores)), best]
    kept = np.flatnonzero((score >= confidence) & (boxes[:, 2:] > 0).all(1))
    boxes, score, best = boxes[kept], score[kept], best[kept]
    xyxy = np.concatenate([boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, :2] + boxes[:, 2:] / 2], axis=1)
    chosen = strongest(xyxy, score, iou, best)[:limit]
    return Detections(xyxy[chosen], score[chosen], best[chosen], class_names)
