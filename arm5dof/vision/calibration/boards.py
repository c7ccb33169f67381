"""Calibration boards as whoever calibrates sees them, and what finding one in an image takes.

A board's frame has its origin in the first inner corner, x along the rows of corners, y down the columns, z into the
board, away from the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import cv2
import numpy as np

from arm5dof.errors import UserError

DETECTION_SIZE = 1280
"""Boards are looked for in images reduced to at most so many pixels a side; corners are refined in the original."""

MIN_SIDE = 32
"""Pixels. In narrower images there is no board, and OpenCV's detectors raise errors of their own."""

WINDOW = 0.25
"""Half the corner window, as a share of the smallest distance between corners. Windows that reach into the next
corners pull it off its place: OpenCV's sample takes 11 pixels always, and one of its own 13 photographs is then out by
1.2 pixels."""

REFINE = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-4)

LARGEST_SQUARE = 0.5
"""Metres. Boards with larger squares are rare, numbers in centimetres and millimetres are not."""


class BoardNotFoundError(UserError):
    """Images do not show the board that they should."""

    def __init__(self, message: str, size: str | None = None) -> None:
        super().__init__(message)
        self.size = size
        """The inner corners, such as `9x6`, of the checkerboard that they show instead; None if they show none."""


Note = tuple[int | str, ...]
"""What `Board.inspect` says of an image, for `Board.check_inspected`."""


class Corners(NamedTuple):
    """What of a board was seen in an image."""

    points: np.ndarray
    """Corners in the board's frame, (n, 3), float32, metres."""
    pixels: np.ndarray
    """The same in the image, (n, 2), float32, pixels."""


class Board(Protocol):
    """Something flat with corners at known places. `str` names it."""

    @property
    def square(self) -> float:
        """The side of a square, metres."""

    @property
    def is_ambiguous(self) -> bool:
        """Whether it looks the same after half a turn, so that an image leaves its pose open."""

    def find(self, gray: np.ndarray) -> Corners | None:
        """Find the board.

        Args:
            gray: (h, w), uint8.

        Returns:
            Its corners, to a fraction of a pixel; None if it is not seen.
        """

    def inspect(self, gray: np.ndarray, found: Corners | None) -> Note:
        """What kind of board an image (h, w) shows, whether or not this one was `found` in it."""

    def check_inspected(self, notes: Sequence[Note], context: str) -> None:
        """Raise `BoardNotFoundError`, its message beginning with `context`, if images show another board than this or
        none, by what `inspect` says of each."""


def refine(
    gray: np.ndarray,
    corners: np.ndarray,
    share: float = WINDOW,
    window: int | None = None,
    until: tuple[int, int, float] = REFINE,
) -> np.ndarray:
    """Refine corners to a fraction of a pixel.

    Args:
        gray: (h, w), uint8.
        corners: (..., 2), pixels.
        share: Half the side of the square that each is found from, as a share of the distance to the nearest corner.
        window: The same in pixels, instead.
        until: OpenCV's criterion for when to stop.

    Returns:
        (..., 2) float32, pixels.
    """
    pixels = corners.reshape(-1, 2).astype(np.float32)
    if window is None:
        apart = np.linalg.norm(pixels[:, None] - pixels, axis=-1) + np.diag(np.full(len(pixels), np.inf))
        window = int(np.clip(share * apart.min(), 2, 15))
    return cv2.cornerSubPix(gray, pixels.reshape(-1, 1, 2).copy(), (window, window), (-1, -1), until).reshape(
        corners.shape
    )


def check_lengths(square: float) -> None:
    """Raise `UserError` for squares of no plausible size, metres."""
    if not 0 < square <= LARGEST_SQUARE:
        remedy = "such as 0.025"
        if LARGEST_SQUARE < square < 1000:
            unit, metres = ("centimetres", square / 100) if square < 10 else ("millimetres", square / 1000)
            remedy = f"{metres:g} if {square:g} is in {unit}"
        raise UserError(f"squares of {square:g} m: give the side of a square in metres, {remedy}")


def is_narrow(gray: np.ndarray) -> bool:
    """Whether an image, reduced as boards are looked for, has fewer than `MIN_SIDE` pixels a side."""
    return min(gray.shape) * min(1.0, DETECTION_SIZE / max(gray.shape)) < MIN_SIDE


def reduced(gray: np.ndarray) -> tuple[np.ndarray, float]:
    """The image, no larger than boards are looked for in, and by what factor it was reduced."""
    scale = min(1.0, DETECTION_SIZE / max(gray.shape))
    return (gray if scale == 1 else cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)), scale
