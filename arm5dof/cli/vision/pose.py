"""`arm5dof vision pose`."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from arm5dof.cli.parser import nothing_left
from arm5dof.cli.vision import camera_report, options
from arm5dof.errors import UserError

if TYPE_CHECKING:
    import numpy as np

HELP = """\
Find where a camera stands, from one photograph of a board whose place is known.

Calibrate the camera first. Lay the board on the table, printed side up, where the arm will work, and measure from the
arm's base to the board's first corner and along its rows:

  arm5dof vision pose camera.yml board.jpg --board 9x6 --square 0.025 --at 0.20 0.10 0 -90 --out posed.yml

--at X Y Z TURN: the first inner corner lies at X Y Z, metres in the base frame, and the rows of corners run in the
direction TURN, degrees from the base's x axis towards its y axis. Seen so that rows run from left to right, the first
corner is the top left one, and the board's own corner beside it is black; on a ChArUco board it is the one that
OpenCV counts as 0. Only a board with an odd and an even number of corners tells its first corner.

--at X Y Z QW QX QY QZ: a board that does not lie flat, by the pose of its frame: x along the rows of corners, y down
the columns, z into the board.

The pose goes into a new file beside the intrinsics, with the covariance of both.
"""


def declare(commands: argparse._SubParsersAction) -> None:
    """Add `pose` to the vision commands."""
    p = commands.add_parser("pose", help="find where a camera stands", description=HELP)
    p.add_argument("camera", type=Path, metavar="CAMERA.yml", help="the calibrated camera")
    p.add_argument("image", type=Path, metavar="IMAGE", help="a photograph of the board")
    options.add_board(p)
    p.add_argument("--at", type=float, nargs="+", required=True, metavar="N", help="X Y Z TURN, or X Y Z QW QX QY QZ")
    p.add_argument(
        "--placed",
        type=float,
        nargs=2,
        default=(5e-4, 0.1),
        metavar=("METRES", "DEGREES"),
        help="how well that was measured, as standard deviations; default 0.0005 0.1",
    )
    p.add_argument("--out", type=Path, required=True, metavar="OUT.yml", help="where the camera with its pose goes")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(run=run)


def run(args: argparse.Namespace, rest: list[str]) -> None:
    """`arm5dof vision pose`."""
    nothing_left(rest, "vision pose")
    options.writable(args.out, (".yml", ".yaml"))
    board_to_base, placement_std = _at(args.at), _placed(args.placed)

    from arm5dof.runtime import files
    from arm5dof.vision.calibration.extrinsics import from_board
    from arm5dof.vision.camera import Camera

    board = options.board(args.board, args.square, args.charuco, args.dictionary)
    options.say_untagged([args.image])
    with options.board_remedy():
        camera = from_board(Camera.load(args.camera), args.image, board, board_to_base, placement_std)
    camera.save(args.out, {"board": str(board), "square_size": board.square})
    if args.json:
        print(files.to_json(camera_report.as_json(camera)))
    else:
        print(f"{camera_report.pose_table(camera)}\ncamera: {args.out}")


def _at(numbers: list[float]) -> np.ndarray:
    """The board's pose (4, 4)."""
    if len(numbers) not in (4, 7) or not all(map(math.isfinite, numbers)):
        raise UserError("--at takes X Y Z TURN (metres, degrees) or X Y Z QW QX QY QZ")
    from arm5dof.vision.calibration.poses import lying_board, pose_from_quaternion

    if len(numbers) == 7:
        return pose_from_quaternion(numbers)
    x, y, z, degrees = numbers
    return lying_board(x, y, z, math.radians(degrees))


def _placed(given: tuple[float, float]) -> tuple[float, float]:
    metres, degrees = given
    if not (0 <= metres < 1 and 0 <= degrees < 90):
        raise UserError("--placed takes standard deviations: METRES and DEGREES, such as 0.001 0.2")
    return metres, math.radians(degrees)
