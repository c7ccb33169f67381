"""`arm5dof vision hand-eye`."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from arm5dof.cli.parser import nothing_left
from arm5dof.cli.vision import camera_report, options

HELP = """\
Find where a camera stands, or sits on the hand, from photographs of a board and the hand's poses.

Calibrate the camera first. Then either

  --eye-in-hand   the camera is on the hand and the board lies still, or
  --eye-to-hand   the camera stands beside the arm and the hand holds the board.

Move the hand to 15 poses, turning it by 30 degrees and more about two axes at least, the whole board in view, and take
a photograph at each. Write the poses into a CSV with the header

  image,x,y,z,qw,qx,qy,qz

the photograph (beside the CSV, or with its path), the hand's place in the base frame in metres, and its turn as a
quaternion.

  arm5dof vision hand-eye camera.yml poses.csv --eye-in-hand --board 9x6 --square 0.025 --out on_hand.yml

How exact the hand is, is estimated too. Poses that contradict the others are named and left out, up to a quarter; so
are photographs that do not show the board or cannot be read.

The pose goes into a new file beside the intrinsics, with the covariance of both. That of a camera on the hand is in the
hand's frame: arm5dof vision locate takes the hand's pose with it.
"""


def declare(commands: argparse._SubParsersAction) -> None:
    """Add `hand-eye` to the vision commands."""
    p = commands.add_parser("hand-eye", help="find where a camera stands by moving the hand", description=HELP)
    p.add_argument("camera", type=Path, metavar="CAMERA.yml", help="the calibrated camera")
    p.add_argument("poses", type=Path, metavar="POSES.csv", help="photographs and the hand's poses")
    where = p.add_mutually_exclusive_group(required=True)
    where.add_argument("--eye-in-hand", action="store_true", help="the camera is on the hand, the board lies still")
    where.add_argument("--eye-to-hand", action="store_true", help="the camera stands, the board is in the hand")
    options.add_board(p)
    p.add_argument("--out", type=Path, required=True, metavar="OUT.yml", help="where the camera with its pose goes")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(run=run)


def run(args: argparse.Namespace, rest: list[str]) -> None:
    """`arm5dof vision hand-eye`."""
    nothing_left(rest, "vision hand-eye")
    options.writable(args.out, (".yml", ".yaml"))

    from arm5dof.runtime import files
    from arm5dof.runtime.progress import late_bar
    from arm5dof.vision.calibration.extrinsics import from_hand
    from arm5dof.vision.calibration.poses import read_hand_poses
    from arm5dof.vision.camera import Camera

    hands, paths = read_hand_poses(args.poses)
    camera = Camera.load(args.camera)
    board = options.board(args.board, args.square, args.charuco, args.dictionary)
    options.say_untagged(paths)
    with late_bar("looking for the board", len(paths), "photographs") as progress, options.board_remedy():
        found = from_hand(camera, hands, paths, board, args.eye_in_hand, progress)
    options.say_unread(found.unread)
    found.save(args.out, board)

    frame, left = "hand" if args.eye_in_hand else "base", found.hand_eye
    turn_deg, shift = math.degrees(left.noise[1]), float(left.noise[2])
    if args.json:
        more = {"frame": frame, "rotation_deg": left.rotation_deg, "translation_m": left.translation_m}
        more |= {"hand_rotation_deg": turn_deg, "hand_translation_m": shift}
        more |= {"used": found.used, "without_board": found.without, "outliers": found.outliers}
        more |= {"unread": found.unread}
        print(files.to_json(camera_report.as_json(found.camera) | more))
        return
    print(camera_report.pose_table(found.camera, frame))
    error = f"{left.rotation_deg:.2f} degrees and {1e3 * left.translation_m:.1f} mm RMS"
    print(f"\n{len(found.used)} photographs, error {error}")
    print(f"the hand's own error about and along each axis: {turn_deg:.2f} degrees and {1e3 * shift:.1f} mm")
    for name, (degrees, metres) in found.outliers.items():
        print(f"{name}: left out: {degrees:.1f} degrees and {1e3 * metres:.0f} mm off: is the hand's pose right?")
    for name in found.without:
        print(f"{name}: left out: board not found")
    for name in found.unread:
        print(f"{name}: left out: cannot be read")
    print(f"camera: {args.out}")
