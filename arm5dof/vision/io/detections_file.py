"""Detections as JSON, written and read: the frames of `as_json`, or one list of what `Detections.to_json` writes."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.detections import Detections
from arm5dof.vision.frames import Frame


class DetectedFrame(NamedTuple):
    """What was found in one image."""

    name: str | None
    """None if the file does not tell."""
    size: tuple[int, int] | None
    """Width and height, pixels; None if the file does not tell."""
    turned: bool | None
    """Whether it was turned as its EXIF orientation tag says; None if the file does not tell."""
    detections: Detections


def as_json(frame: Frame, detections: Detections) -> dict[str, Any]:
    """What was found in one frame, for JSON: `name`; `time_s`, seconds since the beginning or None for a photograph;
    `image_size`, width and height; `turned`, whether that is so by an EXIF orientation tag; and `detections`, as
    `Detections.rows` has them."""
    height, width = frame.image.shape[:2]
    time = None if frame.time is None else round(frame.time, 4)
    known = {"name": frame.name, "time_s": time, "image_size": [width, height], "turned": frame.turned}
    return {**known, "detections": detections.rows()}


def read(path: Path) -> list[DetectedFrame]:
    """Read detections.

    Args:
        path: The file; `-` for what is piped in.

    Returns:
        Its frames; one without a name and size if it is a list of detections.

    Raises:
        UserError: It holds no detections.
    """
    try:
        content = json.loads(sys.stdin.read() if str(path) == "-" else path.read_text(encoding="utf-8"))
        if not isinstance(content, list):
            raise TypeError
        if content and all("detections" in entry for entry in content):
            return [_frame(entry) for entry in content]
        return [DetectedFrame(None, None, None, _detections(content))]
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
        raise UserError(f"{path} holds no detections: give the JSON that arm5dof vision detect writes") from None


def _frame(entry: dict[str, Any]) -> DetectedFrame:
    width, height = entry["image_size"]
    turned = entry.get("turned")
    if turned not in (True, False, None):
        raise TypeError
    return DetectedFrame(str(entry["name"]), (int(width), int(height)), turned, _detections(entry["detections"]))


def _detections(rows: list[dict[str, Any]]) -> Detections:
    """Their classes are numbered anew, since a file need not name them all."""
    names = tuple(dict.fromkeys(str(row["class_name"]) for row in rows))
    return Detections(
        np.array([[float(edge) for edge in row["xyxy"]] for row in rows]).reshape(len(rows), 4),
        np.array([float(row["confidence"]) for row in rows]),
        np.array([names.index(str(row["class_name"])) for row in rows], int),
        names,
    )
