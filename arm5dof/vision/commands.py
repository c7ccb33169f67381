"""`arm5dof vision ...`: what the command line does with cameras. Declared here, imported by `arm5dof.cli`.

Declaring must be quick, so everything that takes OpenCV or JAX is imported where it is used.
"""

from __future__ import annotations

import argparse
import json
import re
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from arm5dof import files
from arm5dof.errors import UserError
from arm5dof.vision import detect_command, doctor_command

if TYPE_CHECKING:
    from arm5dof.vision.boards import Board
    from arm5dof.vision.calibrate import Calibration, Views

BAR_AFTER_S = 2.0

CALIBRATE_HELP = """\
Calibrate a camera from photographs of a board.

Print a checkerboard, glue it to something flat, measure a square with a ruler, and take 10 to 20 photographs with the
camera at its working focus: the whole board in each, tilted by 30 to 45 degrees to all sides, near and far, in the
middle and in the corners of the picture. Do not move zoom or focus between them.

  arm5dof vision calibrate photos/ --board 9x6 --square 0.025 --out camera.yml
  arm5dof vision calibrate *.jpg --board 9x6 --square 0.025 --out camera.yml --preview straight.png
  arm5dof vision calibrate photos/ --board 8x6 --square 0.03 --charuco 0.022 --out camera.yml

A checkerboard is counted in inner corners, where four squares meet: one of 10 x 7 squares has 9x6. A ChArUco board is
counted in squares. The result goes into a YAML file in OpenCV's format. Judge it by the +- of the intrinsics rather
than by the error in pixels: few photographs fit well and say little. Exit status 2, and nothing written, if the
photographs are too few, show another board, or leave the intrinsics uncertain.
"""


def declare(parser: argparse.ArgumentParser) -> None:
    """Add the vision commands to the parser of `arm5dof vision`."""
    parser.set_defaults(run=lambda known, rest: parser.print_help())
    commands = parser.add_subparsers(metavar="COMMAND")
    raw = argparse.RawDescriptionHelpFormatter

    p = commands.add_parser(
        "calibrate", help="calibrate a camera from photographs", description=CALIBRATE_HELP, formatter_class=raw
    )
    p.add_argument("images", type=Path, nargs="+", metavar="IMAGES", help="photographs, or folders of them")
    p.add_argument(
        "--board", type=_board_size, required=True, metavar="9x6", help="inner corners; with --charuco: squares"
    )
    p.add_argument("--square", type=float, required=True, metavar="METRES", help="the side of a square")
    p.add_argument("--charuco", type=float, metavar="METRES", help="a ChArUco board with markers of this side")
    p.add_argument("--dictionary", metavar="NAME", help="of the ChArUco board's markers; default DICT_5X5_100")
    p.add_argument(
        "--distortion",
        type=int,
        choices=(4, 5, 8),
        default=5,
        help="how many coefficients to estimate; default 5, 8 for wide lenses",
    )
    p.add_argument("--out", type=Path, required=True, metavar="CAMERA.yml", help="where the camera goes")
    p.add_argument("--preview", type=Path, metavar="OUT.png", help="a photograph before and after undistortion")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(run=calibrate)

    detect_command.declare(commands)
    doctor_command.declare(commands)


def calibrate(known: argparse.Namespace, rest: list[str]) -> None:
    """`arm5dof vision calibrate`."""
    if rest:
        raise UserError(f"unexpected argument {rest[0]!r} (see arm5dof vision calibrate --help)")
    _writable(known.out, (".yml", ".yaml"))
    if known.preview is not None:
        _writable(known.preview, (".png", ".jpg"))

    from arm5dof.vision import calibrate as calibration
    from arm5dof.vision.sources import image_files

    paths = image_files(known.images)
    board = _board(known)
    views = _watched(paths, board)
    result = calibration.calibrate(views, known.distortion)
    used = next(path for path, name in zip(paths, calibration.names(paths), strict=True) if name in result.errors)
    notes = {
        "nframes": len(result.errors),
        "board": str(board),
        "square_size": known.square,
        "avg_reprojection_error": result.rms,
        "intrinsics_standard_deviations": result.deviations.reshape(-1, 1),
    }
    # Both files or none: the preview takes its place when the camera has been written.
    with ExitStack() as stack:
        if known.preview is not None:
            encoded = calibration.preview(used, result.camera, known.preview.suffix)
            stack.enter_context(files.replacing(known.preview)).write_bytes(encoded)
        result.camera.save(known.out, notes)
    print(json.dumps(as_json(views, result)) if known.json else table(views, result) + f"\ncamera: {known.out}")


def table(views: Views, result: Calibration) -> str:
    """What a calibration found, for people."""
    from arm5dof.vision.calibrate import INTRINSICS

    width = max(len(name) for name in [*result.errors, *result.outliers, *views.without, "photograph"])
    lines = [f"{'photograph':{width}}  error, pixels"]
    lines += [f"{name:{width}}  {error:.3f}" for name, error in result.errors.items()]
    lines += [
        f"{name:{width}}  {error:.3f}  left out: does not fit the others" for name, error in result.outliers.items()
    ]
    lines += [f"{name:{width}}  -      left out: board not found" for name in views.without]
    lines += ["", f"{'intrinsic':{width}}  value +- standard deviation"]
    for name, value, deviation in zip(INTRINSICS, result.intrinsics, result.deviations, strict=False):
        digits, unit = (2, " pixels") if name[0] in "fc" else (5, "")
        lines.append(f"{name:{width}}  {value:.{digits}f} +- {deviation:.{digits}f}{unit}")
    size = f"{result.camera.width}x{result.camera.height}"
    return "\n".join([*lines, "", f"{len(result.errors)} photographs of {size}, error {result.rms:.3f} pixels RMS"])


def as_json(views: Views, result: Calibration) -> dict[str, Any]:
    """The same for programs."""
    from arm5dof.vision.calibrate import INTRINSICS

    both = zip(result.intrinsics, result.deviations, strict=True)
    return {
        "image_size": [result.camera.width, result.camera.height],
        "rms_px": result.rms,
        "intrinsics": {
            name: {"value": float(value), "deviation": float(deviation)}
            for name, (value, deviation) in zip(INTRINSICS, both, strict=False)
        },
        "errors_px": result.errors,
        "outliers_px": result.outliers,
        "without_board": views.without,
    }


def _watched(paths: list[Path], board: Board) -> Views:
    """Look for the board, with a progress bar if that takes long enough to want one."""
    from arm5dof.progress import Bar
    from arm5dof.vision.calibrate import find_views

    started, bar = time.monotonic(), None
    with ExitStack() as stack:

        def progress(done: int, name: str) -> None:
            nonlocal bar
            if bar is None and time.monotonic() - started > BAR_AFTER_S:
                bar = stack.enter_context(Bar("looking for the board", len(paths), "photographs"))
            if bar is not None:
                bar.update(done, name)

        return find_views(paths, board, progress)


def _board(known: argparse.Namespace) -> Board:
    from arm5dof.vision.boards import Charuco, Checkerboard

    columns, rows = known.board
    if known.charuco is not None:
        return Charuco(columns, rows, known.square, known.charuco, known.dictionary or "DICT_5X5_100")
    if known.dictionary is not None:
        raise UserError("--dictionary belongs to a ChArUco board: give the side of its markers with --charuco")
    return Checkerboard(columns, rows, known.square)


def _board_size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,3})[xX](\d{1,3})", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is no size of a board: give inner corners such as 9x6")
    return int(match[1]), int(match[2])


def _writable(path: Path, suffixes: tuple[str, ...]) -> None:
    """Say what is wrong with an output's name before the work begins."""
    if path.suffix.lower() not in suffixes:
        raise UserError(f"{path}: the name must end in {' or '.join(suffixes)}")
    if path.exists():
        raise UserError(f"{path} exists: choose another name")
    if not path.parent.is_dir():
        raise UserError(f"no folder {str(path.parent)!r} to write {path.name} into")
