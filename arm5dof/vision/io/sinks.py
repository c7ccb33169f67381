"""Where results go: a JSON list, a table, images or a video with the boxes drawn in.

Each is a context that gives a function to call with every frame and what was found in it, in turn.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, TextIO

import cv2
import numpy as np

from arm5dof.runtime import files
from arm5dof.vision.detections import Detections
from arm5dof.vision.frames import Frame
from arm5dof.vision.io.annotate import annotate
from arm5dof.vision.io.detections_file import as_json
from arm5dof.vision.io.mp4 import Mp4
from arm5dof.vision.io.sources import DEFAULT_RATE, IMAGE_SUFFIXES, Source

Write = Callable[[Frame, Any], None]
"""Takes a frame and what was found in it: detections, or their localization."""
AsJSON = Callable[[Frame, Any], dict[str, Any]]
Draw = Callable[[np.ndarray, Any], np.ndarray]
"""Takes an RGB uint8 image (h, w, 3) and what was found in it; returns an image with that drawn in."""
Show = Callable[[Frame, np.ndarray], None]
"""Takes a frame and its image with the boxes drawn in."""


@contextmanager
def json_list(stream: TextIO, as_json: AsJSON = as_json) -> Iterator[Write]:
    """A JSON list with a frame in each line, so that a program can follow it and a person can read it.

    Args:
        stream: Where it goes, frame by frame.
        as_json: What to write of a frame and what was found in it.
    """
    before = "[\n"

    def write(frame: Frame, found: Any) -> None:
        nonlocal before
        stream.write(before + json.dumps(as_json(frame, found)))
        stream.flush()
        before = ",\n"

    try:
        yield write
    finally:
        stream.write("[]\n" if before == "[\n" else "\n]\n")


@contextmanager
def detection_table(stream: TextIO) -> Iterator[Write]:
    """For people: each frame and, below it, its detections."""
    head = f"  {'class':16} conf     left      top    right   bottom\n"

    def write(frame: Frame, found: Detections) -> None:
        nonlocal head
        height, width = frame.image.shape[:2]
        at = "" if frame.time is None else f" at {frame.time:.2f} s"
        lines = [f"{frame.name}{at}, {width} x {height}"]
        for row in found.rows():
            edges = "".join(f"{edge:9.1f}" for edge in row["xyxy"])
            lines.append(f"  {row['class_name']:16} {row['confidence']:.2f} {edges}")
        stream.write(head + "\n".join(lines if len(found) else [*lines, "  nothing"]) + "\n")
        head = ""

    yield write


@contextmanager
def folder(
    path: Path, source: Source, list_name: str = "detections.json", as_json: AsJSON = as_json, draw: Draw = annotate
) -> Iterator[Write]:
    """A folder with a JSON list and the frames with boxes drawn in: images named as the photographs are, or a video.
    The folder appears when all is in it, and not at all if the block fails.

    Args:
        path: The new folder.
        source: Where the frames come from.
        list_name: Of the file with the JSON list.
        as_json: What to write into it of a frame and what was found in it.
        draw: Draws that into the frame's image.

    Raises:
        UserError: The folder exists, or a video cannot be written.
    """
    with ExitStack() as stack:
        temporary = stack.enter_context(files.making(path))
        text = stack.enter_context(open(temporary / list_name, "w", encoding="utf-8"))
        note = stack.enter_context(json_list(text, as_json))
        show = _images(temporary) if source.rate is None else stack.enter_context(_video(temporary, source))

        def write(frame: Frame, found: Any) -> None:
            show(frame, draw(frame.image, found))
            note(frame, found)

        yield write


def _images(into: Path) -> Show:
    """A file for each frame, in the format of the photograph that it was, or PNG. Two of a name get numbers."""

    def show(frame: Frame, image: np.ndarray) -> None:
        name = Path(frame.name).name
        wanted = into / (name if name.lower().endswith(IMAGE_SUFFIXES) else f"{name}.png")
        others = (wanted.with_stem(f"{wanted.stem}-{i}") for i in itertools.count(2))
        path = next(p for p in itertools.chain([wanted], others) if not p.exists())
        _, content = cv2.imencode(path.suffix.lower(), image[..., ::-1])
        path.write_bytes(content.tobytes())

    return show


@contextmanager
def _video(into: Path, source: Source) -> Iterator[Show]:
    """An MP4 at the source's rate."""
    video = _Video(into, source.rate or DEFAULT_RATE, source.live)
    try:
        yield video.show
    finally:
        video.close()
    video.check()


class _Video:
    """A video whose name and size the first frame says."""

    def __init__(self, into: Path, rate: float, live: bool) -> None:
        self._into, self._rate, self._live = into, rate, live
        self._file: Mp4 | None = None

    def show(self, frame: Frame, image: np.ndarray) -> None:
        if self._file is None:
            size = (image.shape[1], image.shape[0])
            self._file = Mp4(self._into / f"{Path(frame.name).stem}.mp4", size, self._rate)
        # A camera's frames come as fast as they are looked at; the video runs as fast as the clock did.
        due = round((frame.time or 0) * self._rate) + 1 if self._live else 0
        self._file.write(image, max(1, due - self._file.frames))

    def close(self) -> None:
        if self._file is not None:
            self._file.close()

    def check(self) -> None:
        if self._file is not None:
            self._file.check()
