"""Video files written and read with OpenCV."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from helpers.onnx_bytes import SIZE

RATE = 12.5
"""Frames per second."""


def write_video(path: Path, images: Sequence[np.ndarray], code: str = "mp4v") -> Path:
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*code), RATE, images[0].shape[1::-1])
    for image in images:
        writer.write(image[..., ::-1])
    writer.release()
    return path


def read_video(path: Path) -> tuple[list[np.ndarray], float]:
    """Frames, RGB, and their number in a second."""
    capture, frames = cv2.VideoCapture(str(path)), []
    while (read := capture.read())[0]:
        frames.append(read[1][..., ::-1])
    return frames, capture.get(cv2.CAP_PROP_FPS)


def greys(n: int) -> list[np.ndarray]:
    """Frames that get lighter."""
    return [np.full((SIZE, SIZE, 3), 20 + 200 * i // n, np.uint8) for i in range(n)]
