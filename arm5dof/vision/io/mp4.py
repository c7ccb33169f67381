"""`Mp4`: a video file that is whole or is told not to be."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.opencv import quiet


class Mp4:
    """MPEG-4 part 2: players show it, browsers do not. All else that pip's OpenCV can put into an MP4 is VP9, which
    takes several times longer.

    Args:
        path: Where to.
        size: Width and height, pixels.
        rate: Frames per second.

    Raises:
        UserError: OpenCV cannot write such a video there.
    """

    def __init__(self, path: Path, size: tuple[int, int], rate: float) -> None:
        self._path, self._size = path, size
        self.frames = 0
        with quiet():
            code = cv2.VideoWriter.fourcc(*"mp4v")
            self._encoder = cv2.VideoWriter(str(path.absolute()), cv2.CAP_FFMPEG, code, rate, size)
        if not self._encoder.isOpened():
            width, height = size
            raise UserError(f"OpenCV cannot write a video of {width} x {height} at {rate:g} frames per second")

    def write(self, image: np.ndarray, times: int = 1) -> None:
        """Add an image (h, w, 3), RGB uint8, so many times. One of another size is fitted."""
        if image.shape[1::-1] != self._size:  # The encoder would leave it out without a word.
            image = cv2.resize(image, self._size)
        with quiet():
            for _ in range(times):
                self._encoder.write(image[..., ::-1])
        self.frames += times

    def close(self) -> None:
        """Finish the file."""
        self._encoder.release()

    def check(self) -> None:
        """Raise `UserError` unless every frame is in the file: the encoder tells nobody of a full disk."""
        with quiet():
            capture = cv2.VideoCapture(str(self._path), cv2.CAP_FFMPEG)
        if capture.get(cv2.CAP_PROP_FRAME_COUNT) != self.frames:
            raise UserError("the video could not be written whole: is the disk full?")
