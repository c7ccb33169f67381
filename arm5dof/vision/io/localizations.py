"""What is told of localizations: rows for programs, a table for people, images with positions drawn in."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TextIO

import numpy as np

from arm5dof.vision.frames import Frame
from arm5dof.vision.io import detections_file
from arm5dof.vision.io.annotate import annotate
from arm5dof.vision.io.sinks import Write
from arm5dof.vision.localization.common import Localization


def as_json(name: str | None, found: Localization) -> dict[str, Any]:
    """What JSON says of one frame of which only the name is known: `name` and `objects`, as `Localization.rows`."""
    return {"name": name, "objects": found.rows()}


def frame_as_json(frame: Frame, found: Localization) -> dict[str, Any]:
    """The same of a frame at hand: also what `detections_file.as_json` says of it and of its boxes."""
    said = detections_file.as_json(frame, found.detections)
    boxes = said.pop("detections")
    return {**said, "objects": [{**box, **row} for box, row in zip(boxes, found.rows(), strict=True)]}


def as_text(name: str | None, found: Localization) -> str:
    """A table for people: positions in millimetres, and their standard deviations along x, y and z."""
    head = f"  {'class':16} conf        x       y       z mm       +-"
    lines = [*([] if name is None else [name]), head if len(found.detections) else "  nothing"]
    stds = 1e3 * np.sqrt(found.covariance.diagonal(axis1=1, axis2=2))
    for row, position, std in zip(found.rows(), 1e3 * found.position, stds, strict=True):
        said = row["reason"] or "{:8.1f}{:8.1f}{:8.1f}      {:6.1f}{:6.1f}{:6.1f}".format(*position, *std)
        lines.append(f"  {row['class_name']:16} {row['confidence']:.2f} {said}")
    return "\n".join(lines)


@contextmanager
def localization_table(stream: TextIO) -> Iterator[Write]:
    """For people: each frame and, below it, where its objects are."""

    def write(frame: Frame, found: Localization) -> None:
        at = "" if frame.time is None else f" at {frame.time:.2f} s"
        stream.write(as_text(frame.name + at, found) + "\n")
        stream.flush()

    yield write


def draw(image: np.ndarray, found: Localization) -> np.ndarray:
    """Draw boxes with x, y and z in millimetres, or why there are none.

    Args:
        image: RGB uint8, (h, w, 3).
        found: What was located in it.

    Returns:
        A new image of the same kind.
    """
    labels = [
        f"{row['class_name']}: {row['reason'] or '{:z.0f} {:z.0f} {:z.0f} mm'.format(*position)}"
        for row, position in zip(found.rows(), 1e3 * found.position, strict=True)
    ]
    return annotate(image, found.detections, labels)
