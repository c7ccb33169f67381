"""`arm5dof vision hand-eye`. Everything that takes OpenCV or JAX is imported where it is used."""

from __future__ import annotations

import argparse
import csv
import json
from pathlib import Path
from typing import TYPE_CHECKING

from arm5dof.cli.vision import options
from arm5dof.cli.vision import pose as pose_command
from arm5dof.errors import UserError

if TYPE_CHECKING:
    import numpy as np

COLUMNS = ("image", "x", "y", "z", "qw", "qx", "qy", "qz")

HELP = """\
Find where a camera stands, or sits on the hand, from photographs of a board and the hand's poses.

Calibrate the camera first. Then either

  --on-hand   the camera is on the hand and the board lies still, or
  --beside    the camera stands beside the arm and the hand holds the board.

Move the hand to 15 poses, turning it by 30 degrees and more about two axes at least, the whole board in view, and take
a photograph at each. Write the poses into a CSV with the header

  image,x,y,z,qw,qx,qy,qz

the photograph (beside the CSV, or with its path), the hand's place in the base frame in metres, and its turn as a
quaternion.

  arm5dof vision hand-eye camera.yml poses.csv --on-hand --board 9x6 --square 0.025 --out on_hand.yml

The pose goes into a new file beside the intrinsics, with the covariance of both. That of a camera on the hand is in the
hand's frame: arm5dof vision locate takes the hand's pose with it.
"""


def declare(commands: argparse._SubParsersAction) -> None:
    """Add `hand-eye` to the vision commands."""
    raw = argparse.RawDescriptionHelpFormatter
    p = commands.add_parser(
        "hand-eye", help="find where a camera stands by moving the hand", description=HELP, formatter_class=raw
    )
    p.add_argument("camera", type=Path, metavar="CAMERA.yml", help="the calibrated camera")
    p.add_argument("poses", type=Path, metavar="POSES.csv", help="photographs and the hand's poses")
    where = p.add_mutually_exclusive_group(required=True)
    where.add_argument("--on-hand", action="store_true", help="the camera is on the hand, the board lies still")
    where.add_argument("--beside", action="store_true", help="the camera stands, the board is in the hand")
    options.add_board(p)
    p.add_argument("--out", type=Path, required=True, metavar="OUT.yml", help="where the camera with its pose goes")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(run=run)


def run(known: argparse.Namespace, rest: list[str]) -> None:
    """`arm5dof vision hand-eye`."""
    options.nothing_left(rest, "hand-eye")
    options.writable(known.out, (".yml", ".yaml"))
    hands, paths = read_poses(known.poses)

    import numpy as np

    from arm5dof.runtime.progress import late_bar
    from arm5dof.vision.calibration.extrinsics import from_hand
    from arm5dof.vision.camera import Camera

    camera, board = Camera.load(known.camera), options.board(known)
    with late_bar("looking for the board", len(paths), "photographs") as progress:
        found = from_hand(camera, hands, paths, board, known.on_hand, progress)
    camera, left = found.camera, found.hand_eye
    notes = {"board": str(board), "square_size": known.square, "nframes": len(found.used)}
    if known.on_hand:
        rotation, position = np.asarray(camera.rotation, float), np.asarray(camera.position, float)
        notes |= {"hand_rotation": rotation, "hand_position": position.reshape(3, 1)}
    camera.replace(has_extrinsics=not known.on_hand).save(known.out, notes)

    frame = "hand" if known.on_hand else "base"
    if known.json:
        more = {"frame": frame, "rotation_deg": left.rotation_deg, "translation_m": left.translation_m}
        print(json.dumps(pose_command.as_json(camera) | more | {"used": found.used, "without_board": found.without}))
        return
    print(pose_command.table(camera, frame))
    print(f"\n{len(found.used)} photographs, {left.rotation_deg:.2f} degrees and {1e3 * left.translation_m:.1f} mm off")
    for name in found.without:
        print(f"{name}: left out: board not found")
    print(f"camera: {known.out}")


def read_poses(path: Path) -> tuple[list[np.ndarray], list[Path]]:
    """The hand's poses (4, 4) and the photographs in a CSV. Raises `UserError` if it is none such."""
    hands, paths = [], []
    try:
        with open(path, newline="", encoding="utf-8-sig") as handle:
            reader = csv.DictReader(handle)
            if not set(COLUMNS) <= set(reader.fieldnames or ()):
                raise UserError(f"{path} needs a header with {', '.join(COLUMNS)}")
            for row in reader:
                try:
                    hands.append(options.pose([float(row[name]) for name in COLUMNS[1:]]))
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
