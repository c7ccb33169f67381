"""Where a calibrated camera stands: from a board at a known place, or from what the hand does with a board."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.calibration import hand_eye
from arm5dof.vision.calibration.boards import Board, BoardNotFoundError, Corners
from arm5dof.vision.calibration.covariance import add_pose, placement_covariance, pose_covariance
from arm5dof.vision.calibration.hand_eye import HandEye
from arm5dof.vision.calibration.views import board_error, board_pose, image_names, read_gray
from arm5dof.vision.camera import Camera
from arm5dof.vision.images import ImageError, check_some_usable

MAX_ERROR = 2.0
"""Root mean square error of a board's corners, pixels, above which another camera took the photograph."""


def from_board(
    camera: Camera,
    path: Path,
    board: Board,
    board_to_base: np.ndarray,
    placement_std: tuple[float, float] = (0.0, 0.0),
) -> Camera:
    """Find a camera's pose from one photograph of a board at a known pose.

    Args:
        camera: The calibrated camera.
        path: The photograph.
        board: What it shows.
        board_to_base: The board's pose in the base frame, (4, 4), metres.
        placement_std: How well that is known: standard deviations of the board's position (metres) and rotation
            (radians), along and about each axis.

    Returns:
        The camera with extrinsics and, if that of its intrinsics is known, the covariance of both.

    Raises:
        BoardNotFoundError: The photograph shows another board, or none.
        UserError: The board is not seen whole, leaves its own pose open, or does not fit the camera's intrinsics; or
            the photograph cannot be read.
    """
    corners = find(camera, path, board)
    if corners is None:
        context = f"{path} does not show the {board}"
        board.check_inspected([board.inspect(read_gray(path), None)], context)
        raise UserError(f"{context}; is it seen whole, in focus?")
    return from_corners(camera, corners, board_to_base, placement_std)


def from_corners(
    camera: Camera, corners: Corners, board_to_base: np.ndarray, placement_std: tuple[float, float] = (0.0, 0.0)
) -> Camera:
    """The same from corners that have been found."""
    seen = board_pose(camera, corners)
    noise = pose_covariance(camera, corners, seen) + placement_covariance(placement_std, seen)
    return add_pose(camera, lambda c: board_to_base @ np.linalg.inv(board_pose(c, corners)), noise)


@dataclass(frozen=True)
class HandEyeCalibration:
    """What the hand's movements told of a camera."""

    camera: Camera
    """Its pose is in the base frame or, if it is on the hand, in the hand's frame."""
    eye_in_hand: bool
    """Whether it is on the hand."""
    hand_eye: HandEye
    """The pose before the intrinsics' errors are taken into account, and what is left unexplained."""
    used: list[str]
    """The photographs from which that comes."""
    without: list[str]
    """Those that do not show the board."""
    unread: dict[str, str]
    """What is wrong with the files that cannot be read as photographs, by name."""
    outliers: dict[str, tuple[float, float]]
    """Those that show it but do not go with the hand's pose: by how many degrees and metres."""

    def save(self, path: Path, board: Board) -> None:
        """Write the camera as `Camera.save` does, with notes on how it was calibrated. That of a camera on the hand is
        read by `Camera.load` with the hand's pose."""
        notes = {"board": str(board), "square_size": board.square, "nframes": len(self.used)}
        if self.eye_in_hand:
            rotation, position = np.asarray(self.camera.rotation, float), np.asarray(self.camera.position, float)
            notes |= {"hand_rotation": rotation, "hand_position": position.reshape(3, 1)}
        self.camera.replace(has_extrinsics=not self.eye_in_hand).save(path, notes)


def from_hand(
    camera: Camera,
    hands: Sequence[np.ndarray],
    paths: Sequence[Path],
    board: Board,
    eye_in_hand: bool,
    progress: Callable[[int, str], object] | None = None,
) -> HandEyeCalibration:
    """Find a camera's pose from photographs of a board at several poses of the hand.

    Args:
        camera: The calibrated camera.
        hands: The hand's poses in the base frame, (4, 4) each, metres.
        paths: The photographs that were taken there.
        board: What they show.
        eye_in_hand: Whether the camera is on the hand and the board stands still; otherwise the camera stands still and
            the hand holds the board.
        progress: Is told how many photographs have been looked at, and the name of the last.

    Returns:
        The camera's pose in the hand's frame or the base frame, and how well it is known.

    Raises:
        UserError: The photographs do not determine the pose, contradict each other or the mount, do not fit the
            camera's intrinsics, or none can be read.
    """
    seen: dict[str, tuple[np.ndarray, Corners]] = {}
    unread: dict[str, str] = {}
    names = image_names(paths)
    for i, (hand, path, name) in enumerate(zip(hands, paths, names, strict=True)):
        try:
            corners = find(camera, path, board)
        except ImageError as error:
            unread[name] = str(error)
        else:
            if corners is not None:
                seen[name] = hand, corners
        if progress is not None:
            progress(i + 1, name)
    check_some_usable(unread.values(), len(paths))
    shown = list(seen)

    def at(chosen: Sequence[str], camera: Camera) -> tuple[list[np.ndarray], list[np.ndarray]]:
        return [seen[name][0] for name in chosen], [board_pose(camera, seen[name][1]) for name in chosen]

    poses, boards = at(shown, camera)
    spread = {name: board_spread(camera, seen[name][1], board) for name, board in zip(shown, boards, strict=True)}
    judge = hand_eye.eye_in_hand if eye_in_hand else hand_eye.eye_to_hand
    result = judge(poses, boards, [spread[name] for name in shown])
    outliers = {shown[i]: off for i, off in result.outliers.items()}
    used = [name for name in shown if name not in outliers]

    def solve_for(camera: Camera) -> np.ndarray:
        return hand_eye.again(*at(used, camera), [spread[name] for name in used], result.noise, eye_in_hand)

    return HandEyeCalibration(
        add_pose(camera, solve_for, result.covariance),
        eye_in_hand,
        result,
        used,
        [name for name in names if name not in seen and name not in unread],
        unread,
        outliers,
    )


def board_spread(camera: Camera, corners: Corners, board: np.ndarray) -> np.ndarray:
    """The covariance (6, 6) of a board's pose (4, 4), by its corners: a turn about the camera's axes at its origin, a
    shift along them."""
    carry, (x, y, z) = np.eye(6), board[:3, 3]
    carry[3:, :3] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]  # The camera's turn by w moves the board's origin p by p x w.
    # Hand-eye calibration finds out by what factor that is too small.
    return carry @ pose_covariance(camera, corners, board, independent=True) @ carry.T


def find(camera: Camera, path: Path, board: Board) -> Corners | None:
    """Find a board in a photograph of a calibrated camera.

    Args:
        camera: The camera.
        path: The photograph.
        board: What it shows.

    Returns:
        Its corners; None if it is not seen.

    Raises:
        ImageError: The photograph cannot be read.
        UserError: The board leaves its own pose open, or the photograph is not of this camera.
    """
    gray = read_gray(path)
    if board.is_ambiguous:
        try:
            board.check_inspected([board.inspect(gray, board.find(gray))], f"{path} does not show the {board}")
        except BoardNotFoundError as other:
            if other.size is not None:
                raise
        raise UserError(
            f"the {board} looks the same after half a turn: take one with an odd and an even number of corners, or a "
            "ChArUco board"
        )
    if gray.shape != (camera.height, camera.width):
        raise UserError(
            f"{path} has {gray.shape[1]}x{gray.shape[0]} pixels and the camera {camera.width}x{camera.height}: take it "
            "as the calibration's photographs were taken"
        )
    corners = board.find(gray)
    if corners is not None and (error := board_error(camera, corners)) > MAX_ERROR:
        raise UserError(
            f"{path}: the board has an error of {error:.1f} pixels: is this the camera that was calibrated?"
        )
    return corners
