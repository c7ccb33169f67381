"""What several vision commands take on the command line. Quick to import, like the commands."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from arm5dof.errors import UserError

if TYPE_CHECKING:
    import numpy as np

    from arm5dof.vision.calibration.boards import Board


def add_board(parser: argparse.ArgumentParser) -> None:
    """The options that describe a calibration board."""
    parser.add_argument(
        "--board", type=_board_size, required=True, metavar="9x6", help="inner corners; with --charuco: squares"
    )
    parser.add_argument("--square", type=float, required=True, metavar="METRES", help="the side of a square")
    parser.add_argument("--charuco", type=float, metavar="METRES", help="a ChArUco board with markers of this side")
    parser.add_argument("--dictionary", metavar="NAME", help="of the ChArUco board's markers; default DICT_5X5_100")


def board(known: argparse.Namespace) -> Board:
    """The board that they describe. Raises `UserError` if there is none such."""
    from arm5dof.vision.calibration.boards import Charuco, Checkerboard

    columns, rows = known.board
    if known.charuco is not None:
        return Charuco(columns, rows, known.square, known.charuco, known.dictionary or "DICT_5X5_100")
    if known.dictionary is not None:
        raise UserError("--dictionary belongs to a ChArUco board: give the side of its markers with --charuco")
    return Checkerboard(columns, rows, known.square)


def pose(numbers: Sequence[float]) -> np.ndarray:
    """The pose (4, 4) of a frame from its place x y z (metres) and its turn as a quaternion w x y z. Raises `UserError`
    if they are not seven finite numbers with a quaternion of length 1."""
    import mujoco
    import numpy as np

    if len(numbers) != 7 or not all(map(math.isfinite, numbers)):
        raise UserError("a pose is seven numbers: x y z in metres and the quaternion w x y z")
    quaternion = np.array(numbers[3:], float)
    length = np.linalg.norm(quaternion)
    if abs(length - 1) > 0.01:
        raise UserError(f"a quaternion w x y z has length 1, not {length:.3g}")
    rotation, matrix = np.zeros(9), np.eye(4)
    mujoco.mju_quat2Mat(rotation, quaternion / length)
    matrix[:3, :3], matrix[:3, 3] = rotation.reshape(3, 3), numbers[:3]
    return matrix


def nothing_left(rest: Sequence[str], command: str) -> None:
    """Raise `UserError` if the command line has more than the command knows."""
    if rest:
        raise UserError(f"unexpected argument {rest[0]!r} (see arm5dof vision {command} --help)")


def writable(path: Path, suffixes: tuple[str, ...]) -> None:
    """Say what is wrong with an output's name before the work begins."""
    if path.suffix.lower() not in suffixes:
        raise UserError(f"{path}: the name must end in {' or '.join(suffixes)}")
    if path.exists():
        raise UserError(f"{path} exists: choose another name")
    if not path.parent.is_dir():
        raise UserError(f"no folder {str(path.parent)!r} to write {path.name} into")


def _board_size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,3})[xX](\d{1,3})", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is no size of a board: give inner corners such as 9x6")
    return int(match[1]), int(match[2])
