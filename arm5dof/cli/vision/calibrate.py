"""`arm5dof vision calibrate`."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from arm5dof.cli.parser import nothing_left
from arm5dof.cli.vision import options

if TYPE_CHECKING:
    from arm5dof.vision.calibration.fit import Calibration
    from arm5dof.vision.calibration.views import BoardViews

HELP = """\
Calibrate a camera from photographs of a board.

Print a checkerboard, glue it to something flat, measure a square with a ruler, and take 10 to 20 photographs with the
camera at its working focus: the whole board in each, tilted by 30 to 45 degrees to all sides, near and far, in the
middle and in the corners of the image. Do not move zoom or focus between them.

  arm5dof vision calibrate photos/ --board 9x6 --square 0.025 --out camera.yml
  arm5dof vision calibrate *.jpg --board 9x6 --square 0.025 --out camera.yml --preview straight.png
  arm5dof vision calibrate photos/ --board 8x6 --square 0.03 --charuco 0.022 --out camera.yml
  arm5dof vision calibrate photos/ --board 9x6 --square 0.025 --lens fisheye --out camera.yml

A checkerboard is counted in inner corners, where four squares meet: one of 10 x 7 squares has 9x6. A ChArUco board is
counted in squares. The result goes into a YAML file in OpenCV's format. Judge it by the +- of the intrinsics rather
than by the error in pixels: few photographs fit well and say little. A file that cannot be read is named and left out,
as is a photograph without the board; the exit status is still 0. Exit status 2, and nothing written, if the
photographs are too few, show another board, leave the intrinsics uncertain, or were taken by a lens that another model
describes much better: that of --lens fisheye, or eight coefficients, which wide lenses want.
"""


def declare(commands: argparse._SubParsersAction) -> None:
    """Add `calibrate` to the vision commands."""
    p = commands.add_parser("calibrate", help="calibrate a camera from photographs", description=HELP)
    p.add_argument("images", type=Path, nargs="+", metavar="IMAGES", help="photographs, or folders of them")
    options.add_board(p)
    p.add_argument(
        "--distortion",
        type=int,
        choices=(4, 5, 8),
        help="how many coefficients to estimate; default 5, 8 for wide lenses; 4 of a fisheye lens",
    )
    p.add_argument("--lens", choices=("pinhole", "fisheye"), default="pinhole", help="lens model; default pinhole")
    p.add_argument("--out", type=Path, required=True, metavar="CAMERA.yml", help="where the camera goes")
    p.add_argument("--preview", type=Path, metavar="OUT.png", help="a photograph before and after undistortion")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(run=run)


def run(args: argparse.Namespace, rest: list[str]) -> None:
    """`arm5dof vision calibrate`."""
    nothing_left(rest, "vision calibrate")
    options.writable(args.out, (".yml", ".yaml"))
    if args.preview is not None:
        options.writable(args.preview, (".png", ".jpg"))

    from arm5dof.runtime import files
    from arm5dof.runtime.progress import late_bar
    from arm5dof.vision.calibration.intrinsics import calibrate, preview
    from arm5dof.vision.calibration.views import find_views, image_names
    from arm5dof.vision.io.sources import image_files

    paths = image_files(args.images)
    board = options.board(args.board, args.square, args.charuco, args.dictionary)
    options.say_untagged(paths)
    with late_bar("looking for the board", len(paths), "photographs") as progress, options.board_remedy():
        views = find_views(paths, board, progress)
    options.say_unread(views.unread)
    with options.lens_remedy():
        result = calibrate(views, args.distortion, args.lens)
    # Both files or none: the preview takes its place when the camera has been written.
    with ExitStack() as stack:
        if args.preview is not None:
            used = next(p for p, name in zip(paths, image_names(paths), strict=True) if name in result.errors)
            encoded = preview(used, result.camera, args.preview.suffix)
            stack.enter_context(files.replacing(args.preview)).write_bytes(encoded)
        result.save(args.out, board)
    if args.json:
        print(files.to_json(as_json(views, result)))
    else:
        print(f"{calibration_table(views, result)}\ncamera: {args.out}")


def calibration_table(views: BoardViews, result: Calibration) -> str:
    """What a calibration found, for people."""
    names = ["photograph", *result.errors, *result.outliers, *result.copies, *views.without, *views.unread]
    width = max(map(len, names))
    lines = [f"{'photograph':{width}}  error, pixels"]
    lines += [f"{name:{width}}  {error:.3f}" for name, error in result.errors.items()]
    lines += [
        f"{name:{width}}  {error:.3f}  left out: does not fit the others" for name, error in result.outliers.items()
    ]
    lines += [f"{name:{width}}  -      left out: the same as {first}" for name, first in result.copies.items()]
    lines += [f"{name:{width}}  -      left out: board not found" for name in views.without]
    lines += [f"{name:{width}}  -      left out: cannot be read" for name in views.unread]
    lines += ["", f"{'intrinsic':{width}}  value +- standard deviation"]
    for name, value, deviation in zip(result.names, result.intrinsics, result.deviations, strict=True):
        digits, unit = (2, " pixels") if name[0] in "fc" else (5, "")
        lines.append(f"{name:{width}}  {value:.{digits}f} +- {deviation:.{digits}f}{unit}")
    size = f"{result.camera.width}x{result.camera.height}"
    return "\n".join([*lines, "", f"{len(result.errors)} photographs of {size}, error {result.rms:.3f} pixels RMS"])


def as_json(views: BoardViews, result: Calibration) -> dict[str, Any]:
    """The same for programs."""
    both = zip(result.intrinsics, result.deviations, strict=True)
    return {
        "image_size": [result.camera.width, result.camera.height],
        "rms_px": result.rms,
        "intrinsics": {
            name: {"value": float(value), "deviation": float(deviation)}
            for name, (value, deviation) in zip(result.names, both, strict=True)
        },
        "errors_px": result.errors,
        "outliers_px": result.outliers,
        "copies": result.copies,
        "without_board": views.without,
        "unread": views.unread,
    }
