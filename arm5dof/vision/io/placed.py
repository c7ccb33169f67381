"""What is told of things that `locate` placed: rows for programs, a table for people, pictures with positions in."""

from __future__ import annotations

from typing import Any

import numpy as np

from arm5dof.vision.frames import Frame
from arm5dof.vision.io import detections_file
from arm5dof.vision.io.annotate import annotate
from arm5dof.vision.localization.locate import Located


def as_json(name: str | None, found: Located) -> dict[str, Any]:
    """What is where in one frame."""
    return {"name": name, "things": found.rows()}


def frame_as_json(frame: Frame, found: Located) -> dict[str, Any]:
    """The same where the frame is at hand: also what `vision detect` tells of it and of its boxes."""
    told = detections_file.as_json(frame, found.detections)
    boxes = told.pop("detections")
    return {**told, "things": [{**box, **row} for box, row in zip(boxes, found.rows(), strict=True)]}


def table(name: str | None, found: Located) -> str:
    """Millimetres, and standard deviations along x, y and z."""
    head = f"  {'class':16} conf        x       y       z mm       +-"
    lines = [*([] if name is None else [name]), head if len(found.detections) else "  nothing"]
    deviations = 1e3 * np.sqrt(found.covariance.diagonal(axis1=1, axis2=2))
    for row, position, deviation in zip(found.rows(), 1e3 * found.position, deviations, strict=True):
        told = row["reason"] or "{:8.1f}{:8.1f}{:8.1f}      {:6.1f}{:6.1f}{:6.1f}".format(*position, *deviation)
        lines.append(f"  {row['class_name']:16} {row['confidence']:.2f} {told}")
    return "\n".join(lines)


def draw(image: np.ndarray, found: Located) -> np.ndarray:
    """A copy of an RGB uint8 image (h, w, 3) with the boxes, and x, y and z in millimetres or why there are none."""
    labels = [
        f"{row['class_name']}: {row['reason'] or '{:z.0f} {:z.0f} {:z.0f} mm'.format(*position)}"
        for row, position in zip(found.rows(), 1e3 * found.position, strict=True)
    ]
    return annotate(image, found.detections, labels)
