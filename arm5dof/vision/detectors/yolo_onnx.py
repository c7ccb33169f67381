"""Detectors of the YOLO family in ONNX files, run by OpenCV.

A network's output is recognized by its shape. With n cells in its grids (strides 8, 16, 32 and sometimes 64):

    YOLOv5, v7    (1, 3 n, 5 + classes)    center, size, objectness, scores; three anchors in a cell
    YOLOv8, v11   (1, 4 + classes, n)      center, size, scores
    YOLOX         (1, n, 5 + classes)      center and log size in cells, objectness, scores; or decoded already

OpenCV only warns where an input does not fit the network, and goes on with wrong numbers. So every network is tried
once when it is loaded: its boxes must stand at their cells.
"""

from __future__ import annotations

import ast
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.detections import Detections, check_thresholds
from arm5dof.vision.detectors import onnx_file
from arm5dof.vision.images import GREY, check_size, letterbox, rgb
from arm5dof.vision.opencv import quiet

PYRAMIDS = ((8, 16, 32), (8, 16, 32, 64))
"""Strides of the scales that such networks have."""

MAX_OFFSET = {"yolov5": 1.5, "yolov8": 8, "yolox": 8}
"""How far a box's center may lie from the center of its cell, in cells. YOLOv5's cannot be further away than 1,
YOLOv8's than 7.5; YOLOX sets no bound."""


@dataclass(frozen=True, eq=False)
class _Layout:
    """What the rows of an output are."""

    name: str
    classes: int
    center: np.ndarray
    """Centers of the rows' cells, (n, 2), pixels."""
    stride: np.ndarray
    """Their widths, (n, 1), pixels."""
    raw: bool = False
    """Whether centers and sizes are still in cells."""

    def blob(self, image: np.ndarray) -> np.ndarray:
        """The network's input for an RGB image. YOLOX was trained on BGR in [0, 255], the rest on RGB in [0, 1]."""
        yolox = self.name == "yolox"
        return cv2.dnn.blobFromImage(image, 1.0 if yolox else 1 / 255, swapRB=yolox)

    def decode(self, output: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Boxes (n, 4), center and size in pixels, and scores (n, classes)."""
        rows = output[0].T if self.name == "yolov8" else output[0]
        boxes, scores = rows[:, :4], rows[:, 4:]
        if self.name != "yolov8":
            scores = scores[:, :1] * scores[:, 1:]
        if self.raw:
            corner = self.center - self.stride / 2
            with np.errstate(over="ignore"):  # What overflows is found not to be finite.
                boxes = np.concatenate([boxes[:, :2] * self.stride + corner, np.exp(boxes[:, 2:]) * self.stride], 1)
        return boxes, scores

    def offset(self, output: np.ndarray) -> float:
        """How far from the centers of their cells the boxes are, in cells, but for the worst twentieth."""
        offset = np.abs(self.decode(output)[0][:, :2] - self.center) / self.stride
        return float(np.quantile(offset.max(1), 0.95))


class OnnxYOLO:
    """A detector with the network of an ONNX file.

    Args:
        path: The file.
        class_names: Names of the network's classes; None for those in the file's metadata.
        confidence: Detections below it are dropped, in [0, 1].
        iou: Of boxes of one class that overlap more, the best stays, in [0, 1].
        size: Side of the square input, pixels, for a network that leaves it open; None for 640.

    Raises:
        UserError: The file is missing, damaged, or holds no YOLO detector; it does not take an argument that was given;
            or a threshold lies outside [0, 1].
    """

    def __init__(
        self,
        path: str | Path,
        class_names: Sequence[str] | None = None,
        confidence: float = 0.25,
        iou: float = 0.45,
        size: int | None = None,
    ) -> None:
        check_thresholds(confidence, iou)
        self._confidence, self._iou = confidence, iou
        self._path = Path(path)
        description = onnx_file.describe(self._path)
        self.class_names = _names(self._path, class_names, description.metadata)
        self._size = _input_size(self._path, description, size)
        try:
            with quiet():
                self._network = cv2.dnn.readNetFromONNX(str(self._path))
                self._outputs = self._network.getUnconnectedOutLayersNames()
        except cv2.error as error:
            raise UserError(f"{path}: OpenCV cannot read this network ({_reason(error)}): export it anew") from None
        self._layout = self._recognize()

    def __call__(self, image: np.ndarray) -> Detections:
        """What is in an image (h, w, 3), RGB uint8 or anything else that `images.rgb` takes."""
        boxed = letterbox(rgb(image), self._size)
        boxes, scores = self._layout.decode(self._forward(self._layout.blob(boxed.image)))
        found = Detections.from_scores(boxes, scores, self.class_names, self._confidence, self._iou)
        return replace(found, xyxy=boxed.to_source(found.xyxy))

    def _forward(self, blob: np.ndarray) -> np.ndarray:
        """The one output of three dimensions; exports may carry feature maps beside it."""
        try:
            with quiet():
                self._network.setInput(blob)
                outputs = [np.asarray(x) for x in self._network.forward(self._outputs)]
        except cv2.error as error:
            raise UserError(
                f"{self._path}: the network does not run at {self._size[0]} x {self._size[1]} pixels "
                f"({_reason(error)}): give the size that it was exported for"
            ) from None
        flat = [x for x in outputs if x.ndim == 3 and len(x) == 1]
        if len(flat) != 1:
            shapes = ", ".join(str(x.shape) for x in outputs)
            raise UserError(f"{self._path} is no YOLO detector: its outputs have the shapes {shapes}")
        return flat[0].astype(np.float32)

    def _recognize(self) -> _Layout:
        """The layout of the output for a grey image. Raises `UserError` if it is none that is known."""
        grey = np.full((self._size[1], self._size[0], 3), GREY, np.uint8)
        output = self._forward(cv2.dnn.blobFromImage(grey, 1 / 255))
        layout = _layout(output.shape, self._size)
        if layout is None:
            raise UserError(
                f"{self._path}: an output of shape {output.shape} for {self._size[0]} x {self._size[1]} pixels is none "
                "of YOLOv5's, v7's, v8's, v11's or YOLOX's: export it without non-maximum suppression, or give its size"
            )
        if layout.classes != len(self.class_names):
            raise UserError(
                f"{self._path} tells {layout.classes} classes apart, and {len(self.class_names)} names were given: "
                "give one name for each class"
            )
        output = self._forward(layout.blob(grey))
        if not np.isfinite(output).all():
            raise UserError(f"{self._path}: the network's output is not finite: its weights are damaged")
        if layout.name == "yolox":
            layout = min(layout, replace(layout, raw=True), key=lambda layout: layout.offset(output))
        scores = layout.decode(output)[1]
        if scores.min() < -1e-3 or scores.max() > 1 + 1e-3:
            raise UserError(f"{self._path}: scores outside [0, 1]: export the network with its last sigmoid")
        if layout.offset(output) > MAX_OFFSET[layout.name]:
            raise UserError(
                f"{self._path}: boxes far from their cells: the network was exported for another size than "
                f"{self._size[0]} x {self._size[1]} pixels, or with its coordinates scaled"
            )
        return layout


def _layout(shape: tuple[int, ...], size: tuple[int, int]) -> _Layout | None:
    for strides in PYRAMIDS:
        for name, anchors, rows, columns in (("yolov5", 3, 1, 2), ("yolov8", 1, 2, 1), ("yolox", 1, 1, 2)):
            center, stride = _cells(size, strides, anchors)
            classes = shape[columns] - (4 if name == "yolov8" else 5)
            if shape[rows] == len(center) and classes > 0:
                return _Layout(name, classes, center, stride)
    return None


def _cells(size: tuple[int, int], strides: tuple[int, ...], anchors: int) -> tuple[np.ndarray, np.ndarray]:
    """Centers (n, 2) and widths (n, 1) of every cell, by scale, anchor, row and column."""
    centers, widths = [], []
    for stride in strides:
        x, y = np.meshgrid(np.arange(size[0] // stride), np.arange(size[1] // stride))
        grid = np.tile((np.stack([x, y], -1).reshape(-1, 2) + 0.5) * stride, (anchors, 1))
        centers.append(grid)
        widths.append(np.full((len(grid), 1), stride))
    return np.concatenate(centers).astype(np.float32), np.concatenate(widths).astype(np.float32)


def _input_size(path: Path, description: onnx_file.Description, size: int | None) -> tuple[int, int]:
    """Width and height of the input: the file's where it fixes them."""
    if len(description.inputs) != 1:
        raise UserError(f"{path} is no YOLO detector: it has {len(description.inputs)} inputs instead of one image")
    shape = description.inputs[0]
    if len(shape) != 4 or shape[0] not in (1, None) or shape[1] not in (3, None):
        shown = ", ".join("?" if n is None else str(n) for n in shape)
        raise UserError(f"{path} is no YOLO detector for single images: its input is ({shown}) and not (1, 3, h, w)")
    width, height = (n or size or 640 for n in (shape[3], shape[2]))
    if size is not None and (width, height) != (size, size):
        raise UserError(f"{path} takes images of {width} x {height} pixels only, and not of size {size}: leave it out")
    check_size(width)
    check_size(height)
    return width, height


def _names(path: Path, given: Sequence[str] | None, metadata: dict[str, str]) -> tuple[str, ...]:
    """The names given, or the file's: a Python list, or a dict from numbers, as Ultralytics write it."""
    if given is not None:
        return tuple(given)
    if "names" not in metadata:
        raise UserError(f"{path} does not say what its classes are called: give class_names")
    try:
        names = ast.literal_eval(metadata["names"])
        if isinstance(names, dict):
            names = [names[i] for i in range(len(names))]
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise ValueError
    except (ValueError, SyntaxError, TypeError, KeyError, RecursionError, MemoryError):
        raise UserError(f"{path}: the class names in the file cannot be read: give class_names") from None
    return tuple(names)


def _reason(error: cv2.error) -> str:
    """OpenCV's own words, without its version, source file and line."""
    return (error.err or str(error)).strip().splitlines()[0][:200]
