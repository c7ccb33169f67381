"""Detections from JSON: a list of them as `Detections.to_json` writes it, or the frames that `vision detect` writes."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.detections import Detections


class Frame(NamedTuple):
    """What was found in one picture."""

    name: str | None
    """None if the file does not tell."""
    size: tuple[int, int] | None
    """Width and height; None if the file does not tell."""
    detections: Detections


def read(path: Path) -> list[Frame]:
    """The frames in a file, or in what is piped in if it is called `-`. Raises `UserError` if it is none such."""
    try:
        content = json.loads(sys.stdin.read() if str(path) == "-" else path.read_text(encoding="utf-8"))
        if not isinstance(content, list):
            raise TypeError
        if content and all("detections" in entry for entry in content):
            return [_frame(entry) for entry in content]
        return [Frame(None, None, _detections(content))]
    except (ValueError, TypeError, KeyError, AttributeError):
        raise UserError(f"{path} holds no detections: give the JSON that arm5dof vision detect writes") from None


def _frame(entry: dict[str, Any]) -> Frame:
    width, height = entry["image_size"]
    return Frame(str(entry["name"]), (int(width), int(height)), _detections(entry["detections"]))


def _detections(rows: list[dict[str, Any]]) -> Detections:
    """Their classes are numbered anew, since a file need not name them all."""
    names = tuple(dict.fromkeys(str(row["class_name"]) for row in rows))
    return Detections(
        np.array([row["xyxy"] for row in rows], float).reshape(-1, 4),
        np.array([row["confidence"] for row in rows], float),
        np.array([names.index(str(row["class_name"])) for row in rows], int),
        names,
    )
