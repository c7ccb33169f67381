"""Views of a board: its corners in photographs, and what its pose was in each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import cv2
import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision import images
from arm5dof.vision.calibration.boards import Board, Corners
from arm5dof.vision.calibration.poses import pose_matrix
from arm5dof.vision.camera import Camera
from arm5dof.vision.images import ImageError

SAME_PHOTOGRAPH = 0.5
"""Views whose corners are closer than so many pixels, on average, are one photograph twice, encoded anew perhaps, or
two of a camera and a board that stood still: the second says nothing that the first does not."""

MIN_VIEWS = 5
"""Different views that a calibration takes. OpenCV's 13 photographs give the focal length to 0.1 % from any five of
them, and to between 0.1 and 2 % from two or three."""


STEPS = 20
"""At most, to the pose of a board; four are usual."""


class BoardView(NamedTuple):
    """A board in a photograph."""

    name: str
    corners: Corners


class BoardViews(NamedTuple):
    """What was found in a set of photographs."""

    found: list[BoardView]
    without: list[str]
    """Names of the photographs in which the board was not found."""
    size: tuple[int, int]
    """Width and height of every photograph that shows the board, pixels."""
    unread: Mapping[str, str] = MappingProxyType({})
    """What is wrong with the files that cannot be read as photographs, by name."""


def find_views(paths: Sequence[Path], board: Board, progress: Callable[[int, str], object] | None = None) -> BoardViews:
    """Look for the board in photographs.

    Args:
        paths: Image files.
        board: What they show.
        progress: Is told how many are done, and the name of the last.

    Returns:
        Its corners in each of them.

    Raises:
        BoardNotFoundError: They show another board, or none.
        UserError: None can be read, those that show the board differ in size, or are too few.
    """
    sizes: dict[str, tuple[int, int]] = {}
    unread: dict[str, str] = {}
    found, without, notes = [], [], []
    for i, (path, name) in enumerate(zip(paths, image_names(paths), strict=True)):
        try:
            gray = read_gray(path)
        except ImageError as error:
            unread[name] = str(error)
        else:
            corners = board.find(gray)
            notes.append(board.inspect(gray, corners))
            if corners is None:
                without.append(name)
            else:
                found.append(BoardView(name, corners))
                sizes[name] = gray.shape[1], gray.shape[0]
        if progress is not None:
            progress(i + 1, name)
    images.check_some_usable(unread.values(), len(paths))
    summary = f"{len(found)} of {len(paths)} photographs show the {board}"
    summary += f", {len(unread)} cannot be read ({', '.join(unread)})" if unread else ""
    board.check_inspected(notes, summary)
    if len(found) < MIN_VIEWS:
        hint = "; in the others it is not seen whole, with a white margin and in focus" if without else ""
        raise UserError(
            f"{summary} and a calibration takes {MIN_VIEWS}, from different sides, tilted, near and far{hint}"
        )
    return BoardViews(found, without, _one_size(sizes), unread)


def distinct(views: Sequence[BoardView]) -> tuple[list[BoardView], dict[str, str]]:
    """Count photographs that are there twice once.

    Args:
        views: A board in photographs.

    Returns:
        The first of those that are alike; and the name of that by the names of the others.
    """
    kept: list[BoardView] = []
    copies: dict[str, str] = {}
    for view in views:
        first = next((other for other in kept if apart(view.corners, other.corners) < SAME_PHOTOGRAPH), None)
        if first is None:
            kept.append(view)
        else:
            copies[view.name] = first.name
    return kept, copies


def apart(a: Corners, b: Corners) -> float:
    """Mean distance in the image between the corners that two views share, pixels; infinite if they share none."""
    places = {tuple(point): pixel for point, pixel in zip(b.points, b.pixels, strict=True)}
    distances = [
        np.linalg.norm(pixel - places[key])
        for point, pixel in zip(a.points, a.pixels, strict=True)
        if (key := tuple(point)) in places
    ]
    return float(np.mean(distances)) if distances else np.inf


def board_pose(camera: Camera, corners: Corners) -> np.ndarray:
    """The pose of a board from one photograph.

    Args:
        camera: What took it; its extrinsics do not matter.
        corners: What it shows of the board.

    Returns:
        Board to camera frame, (4, 4), metres.
    """
    plane = camera.model.normalize(corners.pixels, camera.opencv)
    # A flat board has two poses that look alike; the first is the one with the smaller error.
    _, turns, shifts, _ = cv2.solvePnPGeneric(corners.points, plane, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    pose = np.concatenate([turns[0], shifts[0]]).ravel()
    seen = camera.model.project(corners.points, pose[:3], pose[3:], camera.opencv)
    for _ in range(STEPS):  # Gauss-Newton steps on the pixels, halved until they lead downhill.
        step = np.linalg.lstsq(seen.by_pose, (corners.pixels - seen.pixels).ravel(), rcond=None)[0]
        for _ in range(STEPS):
            moved = pose + step
            again = camera.model.project(corners.points, moved[:3], moved[3:], camera.opencv)
            if np.linalg.norm(again.pixels - corners.pixels) < np.linalg.norm(seen.pixels - corners.pixels):
                break
            step = step / 2
        else:
            break
        pose, seen = moved, again
        if np.abs(step).max() < 1e-7:
            break
    return pose_matrix(cv2.Rodrigues(pose[:3])[0], pose[3:])


def board_error(camera: Camera, corners: Corners) -> float:
    """Root mean square reprojection error of a view with the best pose, pixels."""
    pose = board_pose(camera, corners)
    turn, _ = cv2.Rodrigues(pose[:3, :3])
    pixels = camera.model.project(corners.points, turn, pose[:3, 3], camera.opencv).pixels
    return float(np.sqrt(np.square(pixels - corners.pixels).sum(-1).mean()))


def _one_size(sizes: dict[str, tuple[int, int]]) -> tuple[int, int]:
    (size, _), *more = Counter(sizes.values()).most_common()
    if more:
        others = [f"{name} ({w}x{h})" for name, (w, h) in sizes.items() if (w, h) != size]
        raise UserError(
            f"the photographs differ in size: most have {size[0]}x{size[1]} pixels, but not {', '.join(others[:10])}; "
            "leave those out, or calibrate each size by itself"
        )
    return size


def image_names(paths: Sequence[Path]) -> list[str]:
    """File names, with their folders where two are the same."""
    count = Counter(path.name for path in paths)
    return [path.name if count[path.name] == 1 else str(path) for path in paths]


def read_gray(path: Path) -> np.ndarray:
    """A photograph in gray as the sensor saw it, whatever its EXIF orientation tag says, (h, w), uint8. Raises
    `ImageError` if it is none."""
    return images.decode(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
