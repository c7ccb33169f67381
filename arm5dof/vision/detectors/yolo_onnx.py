"""Detectors of the YOLO family in ONNX files: YOLOv5, v7, v8, v10, v11, 26 and YOLOX.

OpenCV only warns where an input does not fit the network, and goes on with wrong numbers. So every network is tried
once when it is loaded: its boxes must stand at their cells.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.detections import Detections, check_thresholds
from arm5dof.vision.detectors import onnx_file
from arm5dof.vision.detectors.onnx_network import open_network
from arm5dof.vision.detectors.yolo_outputs import EndToEnd, Grid, boxes_among, check_task, recognize
from arm5dof.vision.images import GREY, check_size, letterbox, rgb

FLOATS = (1, 10)
"""Kinds of an image whose values lie in [0, 1] or [0, 255] as networks were trained: float32 and float16."""


class OnnxYOLO:
    """A detector with the network of an ONNX file.

    Args:
        path: The file. Of a network that segments the boxes are used.
        class_names: Names of the network's classes; None for those in the file's metadata.
        confidence: Detections below it are dropped, in [0, 1].
        iou: Of boxes of one class that overlap more, the best stays, in [0, 1]; but for networks that choose for
            themselves.
        size: Side of the square input, pixels, for a network that leaves it open; None for what the metadata say, or
            640.
        onnxruntime: Run it by ONNX Runtime and not by OpenCV: for many networks in half the time.

    Raises:
        UserError: The file is missing, damaged, or holds no YOLO detector; it does not take an argument that was given;
            ONNX Runtime is not installed; or a threshold lies outside [0, 1].
    """

    def __init__(
        self,
        path: str | Path,
        class_names: Sequence[str] | None = None,
        confidence: float = 0.25,
        iou: float = 0.45,
        size: int | None = None,
        onnxruntime: bool = False,
    ) -> None:
        check_thresholds(confidence, iou)
        self._confidence, self._iou = confidence, iou
        self._path = Path(path)
        description = onnx_file.describe(self._path)
        with self._named():
            check_task(description.metadata.get("task", "detect"))
            stride = _whole_number(description.metadata, "stride")
            self._size = _input_size(description, size, stride)
            self._run = open_network(self._path, onnxruntime)
            self._layout = self._recognize(stride)
            self.class_names = _names(class_names, description.metadata, self._layout.classes)

    def __call__(self, image: np.ndarray) -> Detections:
        """What is in an image (h, w, 3), RGB uint8 or anything else that `images.rgb` takes."""
        boxed = letterbox(rgb(image), self._size)
        with self._named():
            output = boxes_among(self._run(self._layout.blob(boxed.image)))
            found = self._layout.found(output, self.class_names, self._confidence, self._iou)
        return replace(found, xyxy=boxed.to_source(found.xyxy))

    def _recognize(self, stride: int | None) -> Grid | EndToEnd:
        """The layout of the output. Raises `UserError` if it is none that is known, or a grey image says otherwise."""
        grey = np.full((self._size[1], self._size[0], 3), GREY, np.uint8)
        layout = recognize(self._run(cv2.dnn.blobFromImage(grey, 1 / 255)), self._size, stride)
        return layout.checked(boxes_among(self._run(layout.blob(grey))))

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Say of which file it is that something is wrong."""
        try:
            yield
        except UserError as error:
            raise UserError(f"{self._path}: {error}") from None


def _input_size(description: onnx_file.Description, size: int | None, stride: int | None) -> tuple[int, int]:
    """Width and height of the input: the file's where it fixes them."""
    if len(description.inputs) != 1:
        raise UserError(f"no YOLO detector: it has {len(description.inputs)} inputs instead of one image")
    (taken,) = description.inputs
    shape = taken.shape or (None,) * 4
    if len(shape) != 4 or shape[0] not in (1, None) or shape[1] not in (3, None):
        shown = ", ".join("?" if n is None else str(n) for n in shape)
        raise UserError(f"no YOLO detector for single images: its input is ({shown}) and not (1, 3, h, w)")
    if taken.kind not in FLOATS:
        raise UserError("its input is not floating point: export the network without preprocessing of its own")
    exported = (None, None) if size is not None or None not in shape[2:] else _image_size(description.metadata)
    height, width = (n or size or said or 640 for n, said in zip(shape[2:], exported, strict=True))
    if size is not None and (width, height) != (size, size):
        raise UserError(f"it takes images of {width} x {height} pixels only, and not of size {size}: leave it out")
    for side in (width, height):
        check_size(side, stride or 32)
    return width, height


def _image_size(metadata: Mapping[str, str]) -> tuple[int | None, int | None]:
    """Height and width for which Ultralytics exported the network, as far as the file says so."""
    if "imgsz" not in metadata:
        return None, None
    value = _literal(metadata, "imgsz")
    sides = value if isinstance(value, list | tuple) else [value, value]
    if len(sides) != 2 or not all(type(side) is int and side > 0 for side in sides):
        raise UserError(f"the size of images in the file, {metadata['imgsz'][:40]!r}, cannot be read: give size")
    return sides[0], sides[1]


def _whole_number(metadata: Mapping[str, str], key: str) -> int | None:
    value = _literal(metadata, key)
    return value if type(value) is int and value > 0 else None


def _names(given: Sequence[str] | None, metadata: Mapping[str, str], classes: int | None) -> tuple[str, ...]:
    """The names given, or the file's: a Python list, or a dict from numbers, as Ultralytics write it."""
    if given is None:
        if "names" not in metadata:
            count = "" if classes is None else f" {classes}"
            raise UserError(f"the file does not say what its{count} classes are called: give class_names")
        names = _literal(metadata, "names")
        if isinstance(names, dict):
            names = [names.get(i, names.get(str(i))) for i in range(len(names))]
        if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
            raise UserError("the class names in the file cannot be read: give class_names")
        given = names
    if classes not in (None, len(given)):
        raise UserError(
            f"the network tells {classes} classes apart, and {len(given)} names were given: give one name for each"
        )
    return tuple(given)


def _literal(metadata: Mapping[str, str], key: str) -> Any:
    """A value of the metadata, which are Python's literals; None if it is not there, or none."""
    try:
        return ast.literal_eval(metadata.get(key, "None"))
    except (ValueError, SyntaxError, TypeError, RecursionError, MemoryError):
        return None
