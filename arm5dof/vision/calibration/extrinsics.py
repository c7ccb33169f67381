"""Where a calibrated camera stands: from a board at a known place, or from what the hand does with a board."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.calibration import covariance as uncertainty
from arm5dof.vision.calibration.boards import Board, Corners
from arm5dof.vision.calibration.hand_eye import HandEye, eye_in_hand, eye_to_hand
from arm5dof.vision.calibration.intrinsics import board_error, board_pose, names, read_grey
from arm5dof.vision.camera import Camera

MAX_ERROR = 2.0
"""Root mean square error of a board's corners, pixels, above which another camera took the photograph."""


def from_board(
    camera: Camera, path: Path, board: Board, board_to_base: np.ndarray, placed: tuple[float, float] = (0.0, 0.0)
) -> Camera:
    """The camera with its pose, from one photograph of a board whose pose (4, 4) in the base frame is known. `placed`
    says how well: standard deviations of the board's place (metres) and turn (radians), along and about each axis.

    Raises `UserError` if the board is not seen, leaves its own pose open, or does not fit the camera's intrinsics."""
    corners = find(camera, path, board)
    if corners is None:
        mismatch = board.mismatch([board.inspect(read_grey(path), None)])
        raise UserError(f"{path} does not show the {board}; {mismatch or 'is it seen whole, in focus?'}")
    return from_corners(camera, corners, board_to_base, placed)


def from_corners(
    camera: Camera, corners: Corners, board_to_base: np.ndarray, placed: tuple[float, float] = (0.0, 0.0)
) -> Camera:
    """The same from corners that have been found."""
    seen = board_pose(camera, corners)
    noise = uncertainty.board_noise(camera, corners, seen) + uncertainty.carried(placed, seen)
    return uncertainty.with_pose(camera, lambda c: board_to_base @ np.linalg.inv(board_pose(c, corners)), noise)


@dataclass(frozen=True)
class FromHand:
    """What the hand's movements told of a camera."""

    camera: Camera
    """Its pose is in the base frame or, of a camera on the hand, in the hand's."""
    hand_eye: HandEye
    used: list[str]
    """The photographs that show the board."""
    without: list[str]
    """Those that do not."""


def from_hand(
    camera: Camera,
    hands: Sequence[np.ndarray],
    paths: Sequence[Path],
    board: Board,
    on_hand: bool,
    progress: Callable[[int, str], None] = lambda *_: None,
) -> FromHand:
    """The camera with its pose, from photographs of a board, each with the pose (4, 4) of the hand in the base frame.
    Either the camera is on the hand and the board stands still, or the camera stands and the hand holds the board.

    `progress` is told how many photographs have been looked at. Raises `UserError` if they do not determine the pose,
    contradict each other, or do not fit the camera's intrinsics."""
    seen: dict[str, tuple[np.ndarray, Corners]] = {}
    labels = names(paths)
    for i, (hand, path, label) in enumerate(zip(hands, paths, labels, strict=True)):
        corners = find(camera, path, board)
        if corners is not None:
            seen[label] = hand, corners
        progress(i + 1, label)
    solve = eye_in_hand if on_hand else eye_to_hand
    poses = [hand for hand, _ in seen.values()]

    def hand_eye(camera: Camera) -> HandEye:
        return solve(poses, [board_pose(camera, corners) for _, corners in seen.values()])

    result = hand_eye(camera)
    return FromHand(
        uncertainty.with_pose(camera, lambda c: hand_eye(c).camera, result.covariance),
        result,
        list(seen),
        [label for label in labels if label not in seen],
    )


def find(camera: Camera, path: Path, board: Board) -> Corners | None:
    """The board's corners in a photograph; None if it is not seen. Raises `UserError` if the board leaves its own pose
    open or the photograph is not of this camera."""
    if board.turns:
        raise UserError(
            f"the {board} looks the same after half a turn: take one with an odd and an even number of corners, or a "
            "ChArUco board"
        )
    grey = read_grey(path)
    if grey.shape != (camera.height, camera.width):
        raise UserError(
            f"{path} has {grey.shape[1]}x{grey.shape[0]} pixels and the camera {camera.width}x{camera.height}: take it "
            "as the calibration's photographs were taken"
        )
    corners = board.find(grey)
    if corners is not None and (error := board_error(camera, corners)) > MAX_ERROR:
        raise UserError(f"{path}: the board is off by {error:.1f} pixels: is this the camera that was calibrated?")
    return corners
