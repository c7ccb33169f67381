"""Detectors by the name of their file, and what they find in frames:

    for frame, found in detect(open_source(["clip.mp4"]).frames, load("yolov5n.pt"), ["person"]):
        print(frame.time, found.xyxy)

with `open_source` of `arm5dof.vision.sources`.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from arm5dof.errors import UserError
from arm5dof.runtime import files
from arm5dof.vision.detections import Detections, Detector, check_known
from arm5dof.vision.io.sources import Frame

SHIPPED = files.PACKAGE / "vision" / "detectors" / "tabletop" / "tabletop.npz"
"""Weights of the tabletop detector."""


def load(
    path: str | Path | None = None,
    class_names: Sequence[str] | None = None,
    confidence: float = 0.25,
    iou: float = 0.45,
    size: int | None = None,
    careful: bool = False,
) -> Detector:
    """The detector in a file: YOLOv5's own weights (`.pt`), a network of the YOLO family as ONNX (`.onnx`), or weights
    of the tabletop detector (`.npz`). A file called otherwise is told by its content. Without one, what ships.

    class_names: names of the network's classes; without them, those in the file
    confidence:  detections below are dropped
    iou:         of boxes of one class that overlap more, the best stays
    size:        side of the network's input in pixels; without it the file's, or 640 where that leaves it open
    careful:     see `TabletopDetector`, which alone can be so, and which takes neither names nor a size

    Raises `UserError` if the file is none of these, is damaged, or tells apart another number of classes than are
    named.
    """
    path = SHIPPED if path is None else Path(path)
    if not path.is_file():
        raise UserError(f"no detector {str(path)!r}: give a .pt, .onnx or .npz file")
    kind = _kind(path)
    if careful and kind != ".npz":
        raise UserError(
            f"{path} is not the tabletop detector, which alone can look more carefully: leave --careful out"
        )
    # Each takes its second to import, and only one is needed.
    match kind:
        case ".pt":
            from arm5dof.vision.detectors.yolov5.model import YOLOv5

            return YOLOv5(path, class_names, confidence, iou, 640 if size is None else size)
        case ".onnx":
            from arm5dof.vision.detectors.yolo_onnx import OnnxYOLO

            return OnnxYOLO(path, class_names, confidence, iou, size)
        case ".npz":
            from arm5dof.vision.detectors.tabletop.detector import TabletopDetector

            if class_names is not None or size is not None:
                raise UserError(f"{path}: the tabletop detector's class names and its size are fixed: leave them out")
            return TabletopDetector(path, confidence, iou, careful)
        case _:
            raise UserError(f"{path} is no detector: give YOLOv5's weights (.pt), a network as ONNX (.onnx), or .npz")


def read_names(path: Path) -> list[str]:
    """Names of classes from a text file with one in a line. Raises `UserError` if there are none, or it is no text."""
    try:
        names = path.read_text(encoding="utf-8-sig").strip().splitlines()
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}: give a text file with the name of a class in each line") from None
    except UnicodeDecodeError:
        raise UserError(f"{path} is no text: give one with the name of a class in each line") from None
    if not names or not all(name.strip() for name in names):
        raise UserError(f"{path} is empty or has an empty line: give the name of a class in each line, in their order")
    return [name.strip() for name in names]


def detect(
    frames: Iterable[Frame], detector: Detector, classes: Sequence[str] | None = None
) -> Iterator[tuple[Frame, Detections]]:
    """Each frame with what the detector finds in it, of all classes or those named.

    Raises `UserError` at once if the detector does not know such a class, and later whatever the frames raise.
    """
    if classes is None:
        return ((frame, detector(frame.image)) for frame in frames)
    check_known(classes, detector.class_names)
    return ((frame, detector(frame.image).named(*classes)) for frame in frames)


def _kind(path: Path) -> str | None:
    """The suffix that a file has or, if it has another, should have."""
    suffix = path.suffix.lower()
    if suffix in (".pt", ".onnx", ".npz"):
        return suffix
    if zipfile.is_zipfile(path):
        return ".pt"
    with open(path, "rb") as file:
        return ".onnx" if file.read(1) == b"\x08" else None  # Its first field is the version of its format.
