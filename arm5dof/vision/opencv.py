"""OpenCV without its log: what it warns of is checked here and said in one line of our own."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import cv2

# FFmpeg has a log of its own, whose level OpenCV sets when it opens its first video: -8 is silence.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


@contextmanager
def quiet() -> Iterator[None]:
    """Silence OpenCV's warnings, which may come by the dozen for each frame."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


_lock = threading.Lock()


@contextmanager
def overheard() -> Iterator[list[str]]:
    """Silence what the libraries inside OpenCV write to stderr by themselves, as those of JPEG and PNG do. When the
    block ends, the list has their lines."""
    lines: list[str] = []
    with quiet(), _lock:  # There is only one stderr.
        try:
            kept = os.dup(2)
        except OSError:  # It is closed, and so are their mouths.
            yield lines
            return
        reading, writing = os.pipe()
        os.set_blocking(reading, False)
        os.set_blocking(writing, False)  # What is too much for the pipe gets lost.
        os.dup2(writing, 2)
        os.close(writing)
        try:
            yield lines
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            with suppress(BlockingIOError):  # Another process may still hold the pipe's other end.
                lines += os.read(reading, 1 << 16).decode(errors="replace").splitlines()
            os.close(reading)
