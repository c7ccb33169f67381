"""Detectors by the names of their files, and what they find in frames:

    for frame, found in detect(open_source(["clip.mp4"]).frames, load_detector("yolov5n.pt"), ["person"]):
        print(frame.time, found.xyxy)

with `open_source` of `arm5dof.vision.io.sources`.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from arm5dof.errors import UserError
from arm5dof.vision.detections import Detections, Detector, check_known
from arm5dof.vision.detectors.coco import COCO
from arm5dof.vision.frames import Frame


def load_detector(
    path: str | Path | None = None,
    class_names: Sequence[str] | None = None,
    confidence: float = 0.25,
    iou: float = 0.45,
    size: int | None = None,
    tta: bool = False,
    onnxruntime: bool = False,
) -> Detector:
    """Load the detector in a file, or the one that ships.

    Args:
        path: YOLOv5's own weights (`.pt`), a network of the YOLO family as ONNX (`.onnx`), or weights of the tabletop
            detector (`.npz`). A file with another suffix is recognized by its content. None for the tabletop detector
            that ships.
        class_names: Names of the network's classes, such as `COCO`; None for those in the file.
        confidence: Detections below it are dropped, in [0, 1].
        iou: Of boxes of one class that overlap more, the best stays, in [0, 1]; networks that choose for themselves,
            such as YOLOv10 and 26, take no notice.
        size: Side of the network's input, pixels; None for the file's, or 640 where that leaves it open.
        tta: Test-time augmentation: see `TabletopDetector`, which alone has it, and which takes neither class names nor
            a size.
        onnxruntime: Run an `.onnx` file by ONNX Runtime (`pip install 'arm5dof[onnx]'`) and not by OpenCV.

    Returns:
        A function from an RGB image to `Detections`.

    Raises:
        UserError: The file is none of these or is damaged, it has another number of classes than were named, or it does
            not take an argument that was given.

    Example:
        >>> load_detector().class_names[:3]
        ('red cube', 'blue cube', 'ball')
    """
    if path is not None and not Path(path).is_file():
        raise UserError(f"no detector {str(path)!r}: give a .pt, .onnx or .npz file")
    kind = ".npz" if path is None else _kind(Path(path))
    if isinstance(class_names, str):
        raise UserError(f"class_names is a list with the name of each class, not one text: {class_names[:40]!r}")
    # Each takes its second to import, and only one is needed.
    if onnxruntime and kind != ".onnx":
        raise UserError("ONNX Runtime runs .onnx files only: give one, or leave onnxruntime out")
    if path is None or kind == ".npz":
        from arm5dof.vision.detectors.tabletop.detector import TabletopDetector

        if class_names is not None or size is not None:
            raise UserError("the tabletop detector's class names and its size are fixed: leave them out")
        return TabletopDetector(path, confidence, iou, tta)
    if tta:
        raise UserError(f"{path} is not the tabletop detector, which alone has test-time augmentation: leave tta out")
    if kind == ".pt":
        from arm5dof.vision.detectors.yolov5.model import YOLOv5

        return YOLOv5(path, class_names, confidence, iou, 640 if size is None else size)
    if kind == ".onnx":
        from arm5dof.vision.detectors.yolo_onnx import OnnxYOLO

        return OnnxYOLO(path, class_names, confidence, iou, size, onnxruntime)
    raise UserError(f"{path} is no detector: give YOLOv5's weights (.pt), a network as ONNX (.onnx), or .npz")


def is_tabletop(path: str | Path | None) -> bool:
    """Whether what `load_detector` loads from a file, or without one, is the tabletop detector."""
    return path is None or (Path(path).is_file() and _kind(Path(path)) == ".npz")


def read_names(given: str | Path) -> list[str]:
    """Read names of classes from a text file with one in each line, in the order of their ids.

    Args:
        given: The file; or `coco`, for the 80 classes of COCO. A file of that name is `./coco`.

    Raises:
        UserError: There is no such file, it is no text, or a line of it is empty.
    """
    if given == "coco":
        return list(COCO)
    path = Path(given)
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
    """Run a detector on one frame after another.

    Args:
        frames: Images, which are taken one at a time.
        detector: What runs on them.
        classes: Names of the classes to keep; None for all.

    Returns:
        An iterator of each frame and what was found in it. It raises whatever the frames raise.

    Raises:
        UserError: At once, if the detector does not know one of the classes.
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
