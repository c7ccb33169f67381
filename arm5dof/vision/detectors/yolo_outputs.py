"""What the outputs of networks of the YOLO family mean, recognized by their shapes.

With n cells in a network's grids (strides 8, 16, 32 and sometimes 64):

    YOLOv5, v7         (1, 3 n, 5 + classes)    center, size, objectness, scores; three anchors in a cell
    YOLOv8, v11        (1, 4 + classes, n)      center, size, scores
    YOLOX              (1, n, 5 + classes)      center and log size in cells, objectness, scores; or decoded already
    YOLOv10, 26,       (1, k, 6) or (k, 6)      corners, score, class; suppression is done
    or with it inside

A network that segments has the m coefficients of its masks behind that, and an output (1, m, h / 4, w / 4) of masks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.detections import Detections

PYRAMIDS = ((8, 16, 32), (8, 16, 32, 64))
"""Strides of the scales that such networks have."""

GRIDS = (("yolov5", 3, 1, 2, 5), ("yolov8", 1, 2, 1, 4), ("yolox", 1, 1, 2, 5))
"""Layouts by name: anchors in a cell, the axes of rows and of columns, and how many columns come before the classes."""

END_TO_END = 6
"""Columns of an output from which non-maximum suppression is done."""

MASK_STRIDE = 4
"""Of the masks of a network that segments."""

MAX_OFFSET = {"yolov5": 1.5, "yolov8": 8, "yolox": 8}
"""How far a box's center may lie from the center of its cell, in cells. YOLOv5's cannot be further away than 1,
YOLOv8's than 7.5; YOLOX sets no bound."""

TOLERANCE = 1e-3
"""Of scores beyond [0, 1], and of classes beside whole numbers."""

MIN_PIXELS = 2.0
"""If no box reaches farther, coordinates are shares of the image."""

MIN_KEYPOINT = 50.0
"""A column that reaches so high holds pixels and no scores, not even those before a sigmoid."""


@dataclass(frozen=True, eq=False)
class Grid:
    """A row for each box of each cell."""

    name: str
    classes: int
    center: np.ndarray
    """Centers of the rows' cells, (n, 2), pixels."""
    stride: np.ndarray
    """Their widths, (n, 1), pixels."""
    raw: bool = False
    """Whether centers and sizes are still in cells."""

    def blob(self, image: np.ndarray) -> np.ndarray:
        """The input; YOLOX was trained on BGR in [0, 255], the rest on RGB in [0, 1]."""
        yolox = self.name == "yolox"
        return cv2.dnn.blobFromImage(image, 1.0 if yolox else 1 / 255, swapRB=yolox)

    def found(self, output: np.ndarray, names: tuple[str, ...], confidence: float, iou: float) -> Detections:
        """Every cell's best class, after non-maximum suppression."""
        return Detections.from_scores(*self._decode(output), names, confidence, iou)

    def checked(self, output: np.ndarray) -> Grid:
        """The layout, sure of what was open. Raises `UserError` unless the output for a grey image fits."""
        if not np.isfinite(output).all():
            raise UserError("the network's output is not finite: its weights are damaged")
        grid = self
        if self.name == "yolox":
            grid = min(self, replace(self, raw=True), key=lambda grid: grid._offset(output))
        scores = grid._decode(output)[1]
        outside = np.flatnonzero((scores.min(0) < -TOLERANCE) | (scores.max(0) > 1 + TOLERANCE))
        if len(outside) and scores[:, outside].max() > MIN_KEYPOINT:
            raise UserError(_other_task("pose"))
        if list(outside) == [self.classes - 1] and self.classes > 1:
            raise UserError(_other_task("obb"))
        if len(outside):
            raise UserError("scores outside [0, 1]: export the network with its last sigmoid, to detect boxes only")
        if grid._offset(output) > MAX_OFFSET[self.name]:
            raise UserError(
                "boxes far from their cells: the network was exported for another size, or with its coordinates scaled"
            )
        return grid

    def _decode(self, output: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Boxes (n, 4), center and size in pixels, and scores (n, classes)."""
        rows = output[0].T if self.name == "yolov8" else output[0]
        boxes, scores = rows[:, :4], rows[:, 4 : 4 + self.classes]
        if self.name != "yolov8":
            scores = rows[:, 4:5] * rows[:, 5 : 5 + self.classes]
        if self.raw:
            corner = self.center - self.stride / 2
            with np.errstate(over="ignore"):  # What overflows is found not to be finite.
                boxes = np.concatenate([boxes[:, :2] * self.stride + corner, np.exp(boxes[:, 2:]) * self.stride], 1)
        return boxes, scores

    def _offset(self, output: np.ndarray) -> float:
        """How far from the centers of their cells the boxes are, in cells, but for the worst twentieth."""
        offset = np.abs(self._decode(output)[0][:, :2] - self.center) / self.stride
        return float(np.quantile(offset.max(1), 0.95))


class EndToEnd:
    """A row for each object: corners in pixels, score, class. Which boxes are left is the network's choice."""

    classes = None

    def blob(self, image: np.ndarray) -> np.ndarray:
        """The input: RGB in [0, 1]."""
        return cv2.dnn.blobFromImage(image, 1 / 255)

    def found(self, output: np.ndarray, names: tuple[str, ...], confidence: float, iou: float) -> Detections:
        """The rows that are sure enough; `iou` has no say."""
        xyxy, score, label = self._columns(output)
        rows = np.flatnonzero((score >= confidence) & (score > 0) & (xyxy[:, 2:] > xyxy[:, :2]).all(1))
        if len(rows) and np.abs(xyxy[rows]).max() < MIN_PIXELS:
            raise UserError("boxes of no size: the network was exported with its coordinates scaled")
        if len(rows) and label[rows].max() >= len(names):
            raise UserError(f"the network finds class {label[rows].max()}, and there are {len(names)} names: give all")
        return Detections(xyxy[rows], score[rows], label[rows], names)

    def checked(self, output: np.ndarray) -> EndToEnd:
        """The layout. Raises `UserError` unless the output for a grey image fits."""
        self._columns(output)
        return self

    def _columns(self, output: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Corners (k, 4), scores (k,) and classes (k,) int."""
        xyxy, score, label = output[0, :, :4], output[0, :, 4], output[0, :, 5]
        if not np.isfinite(output).all():
            raise UserError("the network's output is not finite: its weights are damaged")
        whole = np.abs(label - np.round(label)) <= TOLERANCE
        if not (whole & (label > -0.5) & (score > -TOLERANCE) & (score < 1 + TOLERANCE)).all():
            raise UserError(
                f"an output of shape {output.shape} is no list of corners, score and class: export the network without "
                "non-maximum suppression"
            )
        return xyxy, np.clip(score, 0, 1), np.round(label).astype(int)


def boxes_among(outputs: Sequence[np.ndarray]) -> np.ndarray:
    """The one output that lists boxes, float32 with three axes; exports may carry masks or feature maps beside it.

    Raises:
        UserError: None does, or several may.
    """
    listed = [x[None] if x.ndim == 2 and x.shape[1] == END_TO_END else x for x in outputs]
    flat = [x for x in listed if x.ndim == 3 and len(x) == 1]
    if len(flat) != 1:
        raise UserError(f"no YOLO detector: its outputs have the shapes {', '.join(str(x.shape) for x in outputs)}")
    return flat[0].astype(np.float32)


def recognize(outputs: Sequence[np.ndarray], size: tuple[int, int], stride: int | None = None) -> Grid | EndToEnd:
    """Find the layout of a network's outputs.

    Args:
        outputs: For any image.
        size: Width and height of the input, pixels.
        stride: The largest of its scales, pixels; None if that is not known.

    Raises:
        UserError: It is none that is known.
    """
    shape = boxes_among(outputs).shape
    inner = (size[1] // MASK_STRIDE, size[0] // MASK_STRIDE)
    masks = [x.shape[1] for x in outputs if x.ndim == 4 and len(x) == 1 and x.shape[2:] == inner]
    behind = masks[0] if len(masks) == 1 else 0
    for strides in PYRAMIDS:
        if stride not in (None, strides[-1]):
            continue
        for name, anchors, rows, columns, before in GRIDS:
            center, width = _cells(size, strides, anchors)
            classes = shape[columns] - before - behind
            if shape[rows] == len(center) and classes > 0:
                return Grid(name, classes, center, width)
    if shape[2] == END_TO_END + behind:
        return EndToEnd()
    raise UserError(
        f"an output of shape {shape} for {size[0]} x {size[1]} pixels is none of YOLOv5's, v7's, v8's, v10's, v11's, "
        "26's or YOLOX's: export a network that detects, or give its size"
    )


def check_task(task: str) -> None:
    """Raise `UserError` for a network that does not say in which upright boxes objects are, by the name of its task in
    Ultralytics' metadata."""
    if task not in ("detect", "segment"):
        raise UserError(_other_task(task))


def _other_task(task: str) -> str:
    said = {"pose": "poses (key points)", "obb": "oriented boxes", "classify": "classes of whole images"}
    return f"its network tells {said.get(task, f'{task!r}')}, which is not supported: export one that detects"


def _cells(size: tuple[int, int], strides: tuple[int, ...], anchors: int) -> tuple[np.ndarray, np.ndarray]:
    """Centers (n, 2) and widths (n, 1) of every cell, by scale, anchor, row and column."""
    centers, widths = [], []
    for stride in strides:
        x, y = np.meshgrid(np.arange(size[0] // stride), np.arange(size[1] // stride))
        grid = np.tile((np.stack([x, y], -1).reshape(-1, 2) + 0.5) * stride, (anchors, 1))
        centers.append(grid)
        widths.append(np.full((len(grid), 1), stride))
    return np.concatenate(centers).astype(np.float32), np.concatenate(widths).astype(np.float32)
