"""Calibration boards and their corners in an image: checkerboards and ChArUco boards.

A board's frame has its origin in the first inner corner, x along the rows of corners, y down the columns, z into the
board, away from the camera.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import cv2
import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.opencv import quiet

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

MIN_MARKERS = 6
"""So many markers tell what board they are on."""

MARKER_TOLERANCE = 0.15
"""How much, as a share, the markers' size may differ from what is stated."""

FAMILIES = (
    *(f"DICT_{n}X{n}_100" for n in (4, 5, 6, 7)),
    *("DICT_ARUCO_ORIGINAL", "DICT_ARUCO_MIP_36h12", "DICT_APRILTAG_36h11"),
)
"""Dictionaries among which that of an unknown board is looked for."""

RADIUS, SAMPLES = 0.25, 16
"""Of the circle, in squares, on which a corner is recognized by its four alternating quarters; points on it."""


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
        _check_lengths(self.square)

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
        grid = None if _is_narrow(gray) else self._detect(gray)
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
        small, scale = _reduced(gray)
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, pixels = cv2.findChessboardCorners(small, size, flags=flags)
        if found:
            pixels = (pixels + 0.5) / scale - 0.5
        else:
            found, pixels = cv2.findChessboardCornersSB(gray, size)
        return pixels.reshape(self.rows, self.columns, 2).astype(np.float32) if found else None

    def inspect(self, gray: np.ndarray, found: Corners | None) -> Note:
        """The larger and the smaller number of corners of the whole board: a part of it can pass for a smaller one."""
        if _is_narrow(gray):
            return ()
        if found is not None:
            size: tuple[int, ...] = _whole_size(gray, found.pixels.reshape(self.rows, self.columns, 2))
        else:
            seen, _, meta = cv2.findChessboardCornersSBWithMeta(_reduced(gray)[0], (3, 3), cv2.CALIB_CB_LARGER)
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


@dataclass(frozen=True)
class Charuco:
    """A ChArUco board as OpenCV counts it. Raises `UserError` for one that cannot be."""

    columns: int
    """Squares along a row."""
    rows: int
    """Squares down a column."""
    square: float
    """The side of a square, metres."""
    marker: float
    """The side of a marker, metres."""
    dictionary: str = "DICT_5X5_100"
    """OpenCV's name for the set of markers."""
    is_ambiguous = False

    def __post_init__(self) -> None:
        _check_lengths(self.square)
        if min(self.columns, self.rows) < 3:
            raise UserError(f"board {self.columns}x{self.rows}: a ChArUco board has at least 3x3 squares")
        if not 0 < self.marker < self.square:
            raise UserError(f"markers of {self.marker:g} m do not fit into squares of {self.square:g} m")
        names = [name for name in dir(cv2.aruco) if name.startswith("DICT_")]
        if self.dictionary not in names:
            raise UserError(f"no marker dictionary {self.dictionary!r}: choose from {', '.join(names)}")
        needed, there = self.columns * self.rows // 2, len(self._dictionary.bytesList)
        if needed > there:
            raise UserError(f"{self} needs {needed} markers and {self.dictionary} has {there}: which one was printed?")

    def __str__(self) -> str:
        return f"ChArUco board of {self.columns}x{self.rows} squares"

    @property
    def _dictionary(self) -> cv2.aruco.Dictionary:
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))

    @property
    def opencv(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's object, for instance to draw the board with `generateImage`."""
        with quiet():
            return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, self._dictionary)

    def find(self, gray: np.ndarray) -> Corners | None:
        """The corners that are seen, six at least and not all in a line; part of the board is enough."""
        if _is_narrow(gray):
            return None
        board = self.opencv
        pixels, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(gray)
        if ids is None and self.rows % 2 == 0:  # OpenCV before 4.6 began with the other colour.
            board.setLegacyPattern(True)
            pixels, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(gray)
        if ids is None or len(ids) < 6 or board.checkCharucoCornersCollinear(ids):
            return None
        every = np.asarray(board.getChessboardCorners())
        points = every[ids.ravel()] - every[0]
        # The window must not reach into the markers, which begin this far from a corner.
        share = min(WINDOW, (1 - self.marker / self.square) / 2)
        return Corners(points.astype(np.float32), refine(gray, pixels.reshape(-1, 2), share))

    def inspect(self, gray: np.ndarray, found: Corners | None) -> Note:
        """The markers in an image; and if they cannot be this board's, what they show instead."""
        if _is_narrow(gray):
            return ()
        marks, ids, _ = cv2.aruco.ArucoDetector(self._dictionary).detectMarkers(gray)
        seen = () if ids is None else tuple(map(int, ids.ravel()))
        if len(seen) >= MIN_MARKERS:
            said = self._misfit(np.reshape(marks, (-1, 4, 2)), seen)
        else:
            said = None if found is not None else self._other_markers(gray)
        return seen if said is None else (*seen, said)

    def _misfit(self, marks: np.ndarray, seen: tuple[int, ...]) -> str | None:
        """What is wrong with markers (n, 4, 2) of the right dictionary. Their centers do not depend on the size of the
        markers, which then follows."""
        corners = np.concatenate([marks, np.ones((*marks.shape[:2], 1))], -1).swapaxes(0, 1)
        centers = np.cross(np.cross(corners[0], corners[2]), np.cross(corners[1], corners[3]))
        centers = centers[:, :2] / centers[:, 2:]
        turned = replace(self, columns=self.rows, rows=self.columns)
        for board, legacy in [(self, False), (self, True), (turned, False), (turned, True)]:
            layout = board.opencv
            layout.setLegacyPattern(legacy)
            places = {
                int(k): np.mean(at, 0)[:2]
                for k, at in zip(np.ravel(layout.getIds()), layout.getObjPoints(), strict=True)
            }
            known = [k in places for k in seen]
            if sum(known) < MIN_MARKERS:
                continue
            points = np.array([places[k] for k in seen if k in places])
            to_board, fits = cv2.findHomography(centers[known], points, cv2.RANSAC, 0.2 * self.square)
            if to_board is None or fits.sum() < 0.8 * len(seen):
                continue
            if board is turned:
                return f"{turned.columns}x{turned.rows}"
            flat = cv2.perspectiveTransform(marks[known].astype(float).reshape(-1, 1, 2), to_board).reshape(-1, 4, 2)
            sides = np.linalg.norm(flat - np.roll(flat, 1, axis=1), axis=-1)
            share, stated = float(np.median(sides)) / self.square, self.marker / self.square
            if abs(share / stated - 1) > MARKER_TOLERANCE:
                return f"markers {share:.2f} times as large as its squares, not {stated:.2f} times: measure both"
            return None
        return None

    def _other_markers(self, gray: np.ndarray) -> str | None:
        """What markers an image shows that has too few of the right dictionary."""
        small, _ = _reduced(gray)
        _, ids, _ = cv2.aruco.ArucoDetector(self._dictionary).detectMarkers(cv2.flip(small, 1))
        if ids is not None and len(ids) >= MIN_MARKERS:
            return "the mirror image of one: print it again as it is, and photograph the printed side"
        found = {}
        for name in FAMILIES:
            dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
            _, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(small)
            found[name] = 0 if ids is None else len(np.unique(ids))
        name = max(found, key=found.__getitem__)
        if found[name] < MIN_MARKERS or self.dictionary.startswith(name.removesuffix("100")):
            return None
        # The smaller dictionaries of a family are the beginnings of the larger.
        needed, family = self.columns * self.rows // 2, name.removesuffix("100")
        size = next((n for n in (50, 100, 250) if needed <= n), 1000)
        return f"markers of {f'{family}{size}' if family != name else name}: is that the dictionary that was printed?"

    def check_inspected(self, notes: Sequence[Note], context: str) -> None:
        """Refuse images without markers, with more of them than this board has, or with those of another board."""
        said = Counter(what for note in notes for what in note if isinstance(what, str))
        if said:
            what, count = said.most_common(1)[0]
            own = sum(len(note) >= MIN_MARKERS and not isinstance(note[-1], str) for note in notes)
            if count > own:
                size = what if re.fullmatch(r"\d+x\d+", what) else None
                shown = f"one of {size} squares" if size else what
                raise BoardNotFoundError(f"{context}; {count} of the {len(notes)} show {shown}", size)
        ids, there = [i for note in notes for i in note if isinstance(i, int)], self.columns * self.rows // 2
        if not ids:
            raise BoardNotFoundError(
                f"{context}; they show no marker of {self.dictionary}: which dictionary was printed?"
            )
        if 4 * sum(i >= there for i in ids) > len(ids):
            raise BoardNotFoundError(
                f"{context}; a board of {self.columns}x{self.rows} squares has the markers 0 to {there - 1} and the "
                f"photographs show some up to {max(ids)}: count the squares along and down"
            )


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


def _check_lengths(square: float) -> None:
    if not 0 < square <= LARGEST_SQUARE:
        remedy = "such as 0.025"
        if LARGEST_SQUARE < square < 1000:
            unit, metres = ("centimetres", square / 100) if square < 10 else ("millimetres", square / 1000)
            remedy = f"{metres:g} if {square:g} is in {unit}"
        raise UserError(f"squares of {square:g} m: give the side of a square in metres, {remedy}")


def _is_narrow(gray: np.ndarray) -> bool:
    """Whether an image, reduced as boards are looked for, has fewer than `MIN_SIDE` pixels a side."""
    return min(gray.shape) * min(1.0, DETECTION_SIZE / max(gray.shape)) < MIN_SIDE


def _reduced(gray: np.ndarray) -> tuple[np.ndarray, float]:
    """The image, no larger than boards are looked for in, and by what factor it was reduced."""
    scale = min(1.0, DETECTION_SIZE / max(gray.shape))
    return (gray if scale == 1 else cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)), scale


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
