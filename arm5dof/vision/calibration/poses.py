"""Poses, as matrices (4, 4) and as people write them: numbers, and CSV files of them."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from arm5dof.errors import UserError

COLUMNS = ("image", "x", "y", "z", "qw", "qx", "qy", "qz")


def pose_matrix(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """The pose (4, 4) of a rotation (3, 3) and a position (3,)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, position
    return matrix


def pose_from_quaternion(numbers: Sequence[float]) -> np.ndarray:
    """The pose of a frame.

    Args:
        numbers: Position x y z, metres, and rotation as a quaternion w x y z of length 1, which may be off by 1 %.

    Returns:
        (4, 4), metres.

    Raises:
        UserError: These are not seven finite numbers, or the quaternion has another length.
    """
    if len(numbers) != 7 or not all(map(math.isfinite, numbers)):
        raise UserError("a pose is seven numbers: x y z in metres and the quaternion w x y z")
    quaternion = np.array(numbers[3:], float)
    length = np.linalg.norm(quaternion)
    if abs(length - 1) > 0.01:
        raise UserError(f"a quaternion w x y z has length 1, not {length:.3g}")
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, quaternion / length)
    return pose_matrix(rotation.reshape(3, 3), np.array(numbers[:3]))


def lying_board(x: float, y: float, z: float, turn: float) -> np.ndarray:
    """The pose of a board that lies flat, printed side up.

    Args:
        x: Of its first corner in the base frame, metres.
        y: The same.
        z: The same.
        turn: The direction of its rows of corners, radians from the base's x axis towards its y axis.

    Returns:
        Board to base frame, (4, 4), metres.

    Raises:
        UserError: A number is not finite.
    """
    # The rows turn about the base's z axis; then the board turns over, its z axis being that into the table.
    return pose_from_quaternion([x, y, z, 0.0, math.cos(turn / 2), math.sin(turn / 2), 0.0])


def read_hand_poses(path: Path) -> tuple[list[np.ndarray], list[Path]]:
    """Read the hand's poses and the photographs that were taken there.

    Args:
        path: A CSV file with the columns `COLUMNS`: a photograph, its path from the file's folder, and the hand's
            position (metres) and quaternion in the base frame.

    Returns:
        Hand to base frame, (4, 4) each, and the photographs.

    Raises:
        UserError: It is none such, holds something else than poses, or a photograph is not there.
        OSError: It cannot be read.
    """
    hands, paths = [], []
    try:
        with open(path, newline="", encoding="utf-8-sig") as handle:
            reader = csv.DictReader(handle)
            if not set(COLUMNS) <= set(reader.fieldnames or ()):
                raise UserError(f"{path} needs a header with {', '.join(COLUMNS)}")
            for row in reader:
                try:
                    hands.append(pose_from_quaternion([float(row[name]) for name in COLUMNS[1:]]))
                except (TypeError, ValueError):
                    raise UserError(f"{path}, line {reader.line_num}: a pose is seven numbers") from None
                except UserError as error:
                    raise UserError(f"{path}, line {reader.line_num}: {error}") from None
                paths.append(path.parent / row["image"])
    except (UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path} is not a CSV file: {error}") from None
    missing = [str(photograph) for photograph in paths if not photograph.is_file()]
    if missing:
        raise UserError(f"{path} names photographs that are not there: {', '.join(missing[:5])}")
    return hands, paths
