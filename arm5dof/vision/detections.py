"""`Detections`: what a detector found in an image, and what all detectors share."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from arm5dof.errors import UserError, nearest
from arm5dof.vision import boxes


@dataclass(frozen=True, eq=False)
class Detections:
    """Boxes in an image, the most confident first. The fields are named as in the `supervision` library.

    Raises `ValueError` for arrays of different lengths, values that are not finite, and unknown class ids.

    >>> from arm5dof import Detections
    >>> found = Detections([[300, 220, 340, 260], [10, 20, 50, 80]], [0.6, 0.9], [0, 1], ("cup", "ball"))
    >>> len(found), found.xyxy[0].tolist(), found.class_names[found.class_id[0]]
    (2, [10.0, 20.0, 50.0, 80.0], 'ball')
    """

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

    @classmethod
    def from_scores(
        cls,
        cxcywh: np.ndarray,
        scores: np.ndarray,
        class_names: tuple[str, ...],
        confidence: float,
        iou: float,
        limit: int = 300,
    ) -> Detections:
        """What is left of a YOLO network's output: each box with its best class, without the less confident ones and
        those that non-maximum suppression removes, class by class.

        Args:
            cxcywh: Centers, widths and heights of boxes, (n, 4), pixels.
            scores: Of each class, (n, classes).
            class_names: Names of the classes.
            confidence: Boxes with lower scores are dropped.
            iou: Of boxes of one class that overlap more, the best stays.
            limit: The largest number of detections.

        Raises:
            UserError: Boxes or scores are not finite.
        """
        if not (np.isfinite(cxcywh).all() and np.isfinite(scores).all()):
            raise UserError("the network's output is not finite: its weights are damaged")
        best = scores.argmax(1)
        score = scores[np.arange(len(scores)), best]
        rows = np.flatnonzero((score >= confidence) & (cxcywh[:, 2:] > 0).all(1))
        xyxy, score, best = boxes.from_center_size(cxcywh[rows]), score[rows], best[rows]
        kept = boxes.nms(xyxy, score, iou, best)[:limit]
        return cls(xyxy[kept], score[kept], best[kept], class_names)

    def __len__(self) -> int:
        return len(self.confidence)

    def __getitem__(self, index: int | slice | np.ndarray) -> Detections:
        """Some of the boxes: by number, slice, or mask (n,)."""
        rows = np.arange(len(self))[index].reshape(-1)
        return Detections(self.xyxy[rows], self.confidence[rows], self.class_id[rows], self.class_names)

    def __iter__(self) -> Iterator[Detections]:
        return (self[i] for i in range(len(self)))

    @property
    def data(self) -> dict[str, np.ndarray]:
        """The name of each box's class, under `class_name`, (n,)."""
        return {"class_name": np.array([self.class_names[i] for i in self.class_id], dtype=str)}

    @property
    def center(self) -> np.ndarray:
        """Centers of the boxes, (n, 2), pixels, as OpenCV's camera model counts: whole numbers are centers of pixels.
        That is half a pixel less than in `xyxy`."""
        return (self.xyxy[:, :2] + self.xyxy[:, 2:]) / 2 - 0.5

    def named(self, *names: str) -> Detections:
        """The boxes of one class or several.

        Raises:
            UserError: The detector does not know such a class.
        """
        check_known(names, self.class_names)
        return self[np.isin(self.data["class_name"], names)]

    def rows(self) -> list[dict[str, Any]]:
        """For JSON, of each box: `class_name`, `class_id`, `confidence`, and `xyxy`, its edges in pixels."""
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
    def class_names(self) -> tuple[str, ...]:
        """The classes, by their ids."""

    def __call__(self, image: np.ndarray) -> Detections:
        """What is in an RGB uint8 image (h, w, 3)."""


def check_known(names: Iterable[str], class_names: Sequence[str]) -> None:
    """Raise `UserError` unless all `names` are among a detector's."""
    for name in names:
        if name not in class_names:
            known = "it knows: " + ", ".join(class_names[:20]) + (", ..." if len(class_names) > 20 else "")
            near = nearest(name, class_names)
            hint = known if near is None else f"did you mean {near!r}?"
            raise UserError(f"the detector knows no class {name!r}; {hint}")


def check_thresholds(confidence: float, iou: float) -> None:
    """Raise `UserError` unless both lie in [0, 1]."""
    for name, value in (("confidence", confidence), ("iou", iou)):
        if not 0 <= value <= 1:
            raise UserError(f"{name} must lie between 0 and 1, got {value}")
