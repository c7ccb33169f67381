"""ChArUco boards: a checkerboard with a marker in every white square."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.calibration.boards import (
    WINDOW,
    BoardNotFoundError,
    Corners,
    Note,
    check_lengths,
    is_narrow,
    reduced,
    refine,
)
from arm5dof.vision.opencv import quiet

MIN_MARKERS = 6
"""So many markers tell what board they are on."""

MARKER_TOLERANCE = 0.15
"""How much, as a share, the markers' size may differ from what is stated."""

FAMILIES = (
    *(f"DICT_{n}X{n}_100" for n in (4, 5, 6, 7)),
    *("DICT_ARUCO_ORIGINAL", "DICT_ARUCO_MIP_36h12", "DICT_APRILTAG_36h11"),
)
"""Dictionaries among which that of an unknown board is looked for."""


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
        check_lengths(self.square)
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
        if is_narrow(gray):
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
        if is_narrow(gray):
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
        small, _ = reduced(gray)
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
