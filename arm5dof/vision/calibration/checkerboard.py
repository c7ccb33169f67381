"""Checkerboards."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.calibration.boards import (
    BoardNotFoundError,
    Corners,
    Note,
    check_lengths,
    is_narrow,
    reduced,
    refine,
)

RADIUS, SAMPLES = 0.25, 16
"""Of the circle, in squares, on which a corner is recognized by its four alternating quarters; points on it."""


@dataclass(frozen=True)
class Checkerboard:
    """A checkerboard. Raises `UserError` for one that cannot be."""

    columns: int
    """Inner corners along a row."""
    rows: int
    """Inner corners down a column."""
    square: float
    """The side of a square, metres."""

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3:
            raise UserError(f"board {self.columns}x{self.rows}: it takes at least 3x3 inner corners")
        check_lengths(self.square)

    def __str__(self) -> str:
        return f"{self.columns}x{self.rows} checkerboard"

    @property
    def is_ambiguous(self) -> bool:
        """Black meets white under half a turn only if one number is odd and the other even."""
        return (self.columns + self.rows) % 2 == 0

    @property
    def points(self) -> np.ndarray:
        """Corners in the board's frame, (rows * columns, 3) float32, metres, row by row."""
        x, y = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        return (np.stack([x, y, 0 * x], -1) * self.square).astype(np.float32).reshape(-1, 3)

    def find(self, gray: np.ndarray) -> Corners | None:
        """The corners, refined, the first one being that where the square before it is black if the board tells."""
        grid = None if is_narrow(gray) else self._detect(gray)
        if grid is None:
            return None
        grid = refine(gray, grid)
        if _saddles(gray, grid).mean() < 0.9:
            return None
        (a, b), (c, d) = grid[0, 1] - grid[0, 0], grid[1, 0] - grid[0, 0]
        if a * d < b * c:  # Seen from behind, says the order; so it is the order that is wrong.
            grid = grid[::-1]
        if not self.is_ambiguous and _first_is_white(gray, grid):
            grid = grid[::-1, ::-1]
        return Corners(self.points, grid.reshape(-1, 2).copy())

    def _detect(self, gray: np.ndarray) -> np.ndarray | None:
        """Rough corners (rows, columns, 2). The first detector is quick and misses few, the second misses others."""
        size = (self.columns, self.rows)
        small, scale = reduced(gray)
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, pixels = cv2.findChessboardCorners(small, size, flags=flags)
        if found:
            pixels = (pixels + 0.5) / scale - 0.5
        else:
            found, pixels = cv2.findChessboardCornersSB(gray, size)
        return pixels.reshape(self.rows, self.columns, 2).astype(np.float32) if found else None

    def inspect(self, gray: np.ndarray, found: Corners | None) -> Note:
        """The larger and the smaller number of corners of the whole board: a part of it can pass for a smaller one."""
        if is_narrow(gray):
            return ()
        if found is not None:
            size: tuple[int, ...] = _whole_size(gray, found.pixels.reshape(self.rows, self.columns, 2))
        else:
            seen, _, meta = cv2.findChessboardCornersSBWithMeta(reduced(gray)[0], (3, 3), cv2.CALIB_CB_LARGER)
            size = meta.shape[:2] if seen else ()
        return tuple(sorted(size, reverse=True))

    def check_inspected(self, notes: Sequence[Note], context: str) -> None:
        """Refuse images of which more show another size than this."""
        votes = Counter(size for size in notes if size)
        if not votes:
            raise BoardNotFoundError(
                f"{context}; none of them shows any: the whole board must be seen, with a white margin and in focus"
            )
        own = votes[(max(self.columns, self.rows), min(self.columns, self.rows))]
        size, count = max(votes.items(), key=lambda item: item[1])
        if count > own:
            name = "x".join(map(str, size))
            raise BoardNotFoundError(f"{context}; {count} of the {len(notes)} show one of {name} inner corners", name)


def _sample(gray: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Gray values (...) at pixels (..., 2), by linear interpolation; 0 outside the image."""
    x, y = pixels.reshape(-1, 2).astype(np.float32).T
    return cv2.remap(gray, x, y, cv2.INTER_LINEAR).reshape(pixels.shape[:-1]).astype(float)


def _saddles(gray: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """At which of the places (rows, columns, 2) four squares meet: around such a point bright and dark alternate
    twice, and at the rim of a board, or anywhere else, they do not."""
    angles = 2 * np.pi * (np.arange(SAMPLES) + 0.5) / SAMPLES
    along, down = (np.gradient(grid, axis=axis)[:, :, None] for axis in (1, 0))
    circle = RADIUS * (np.cos(angles)[:, None] * along + np.sin(angles)[:, None] * down)
    values = _sample(gray, grid[:, :, None] + circle)
    once, twice = (np.abs(values @ np.exp(1j * k * angles)) / SAMPLES for k in (1, 2))
    return (twice > 1.5 * once) & (twice > 5)


def _grown(grid: np.ndarray) -> np.ndarray:
    """The grid with a line of corners more at its right, where a parabola through the last three would have them."""
    return np.concatenate([grid, 3 * grid[:, -1:] - 3 * grid[:, -2:-1] + grid[:, -3:-2]], axis=1)


def _whole_size(gray: np.ndarray, grid: np.ndarray) -> tuple[int, int]:
    """How many corners along and down the board has, counted on from those found for as long as more follow."""
    turns, stuck = 0, 0
    while stuck < 4 and max(grid.shape) < 100:
        grown = _grown(grid)
        if _saddles(gray, grown)[:, -1].mean() > 0.7:
            grown[:, -1] = refine(gray, grown[:, -1])
            grid, stuck = grown, 0
        else:
            grid, stuck, turns = np.rot90(grid), stuck + 1, turns + 1
    rows, columns = grid.shape[:2]
    return (columns, rows) if turns % 2 == 0 else (rows, columns)


def _first_is_white(gray: np.ndarray, grid: np.ndarray) -> bool:
    """Whether the square between the first four corners is brighter than those beside it."""
    centers = (grid[:-1, :-1] + grid[:-1, 1:] + grid[1:, :-1] + grid[1:, 1:]) / 4
    values, black = _sample(gray, centers), np.indices(centers.shape[:2]).sum(0) % 2 == 0
    return bool(values[black].mean() > values[~black].mean())
