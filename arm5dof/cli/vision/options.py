"""What several vision commands take on the command line. Quick to import, as the commands are."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from arm5dof.errors import UserError

if TYPE_CHECKING:
    from arm5dof.vision.calibration.boards import Board


def add_board(parser: argparse.ArgumentParser) -> None:
    """The options that describe a calibration board."""
    parser.add_argument(
        "--board", type=_board_size, required=True, metavar="9x6", help="inner corners; with --charuco: squares"
    )
    parser.add_argument("--square", type=float, required=True, metavar="METRES", help="the side of a square")
    parser.add_argument("--charuco", type=float, metavar="METRES", help="a ChArUco board with markers of this side")
    parser.add_argument("--dictionary", metavar="NAME", help="of the ChArUco board's markers; default DICT_5X5_100")


def board(size: tuple[int, int], square: float, marker: float | None, dictionary: str | None) -> Board:
    """The board that they describe: a ChArUco board if its markers have a side. Raises `UserError` if there is none
    such."""
    from arm5dof.vision.calibration.charuco import Charuco
    from arm5dof.vision.calibration.checkerboard import Checkerboard

    if marker is not None:
        return Charuco(*size, square, marker, dictionary or "DICT_5X5_100")
    if dictionary is not None:
        raise UserError("--dictionary belongs to a ChArUco board: give the side of its markers with --charuco")
    return Checkerboard(*size, square)


def say_untagged(paths: Iterable[Path]) -> None:
    """Say in one line that EXIF orientation tags are ignored, if any of these photographs has one."""
    from arm5dof.vision.images import has_orientation

    tagged = [path for path in paths if has_orientation(path)]
    if tagged:
        more = f" and {len(tagged) - 1} more" if len(tagged) > 1 else ""
        print(
            f"arm5dof: the orientation tag of {tagged[0]}{more} is ignored: a camera model belongs to the "
            "sensor's pixels",
            file=sys.stderr,
        )


def say_unread(unread: Mapping[str, str]) -> None:
    """Say what is wrong with each file that was left out since it cannot be read."""
    for reason in unread.values():
        print(f"arm5dof: left out: {reason}", file=sys.stderr)


@contextmanager
def board_remedy() -> Iterator[None]:
    """Where images show a checkerboard of another size, say how to ask for it."""
    from arm5dof.vision.calibration.boards import BoardNotFoundError

    try:
        yield
    except BoardNotFoundError as error:
        if error.size is None:
            raise
        raise UserError(f"{error}: give --board {error.size}") from None


@contextmanager
def lens_remedy() -> Iterator[None]:
    """Where photographs fit another lens model, say how to ask for it."""
    from arm5dof.vision.calibration.intrinsics import LensError

    try:
        yield
    except LensError as error:
        option = "--lens fisheye" if error.lens == "fisheye" else f"--distortion {error.coefficients}"
        raise UserError(f"{error}: give {option}") from None


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
