"""`arm5dof vision locate`. Everything that takes OpenCV or JAX is imported where it is used."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from itertools import starmap
from pathlib import Path
from typing import TYPE_CHECKING, Any

from arm5dof.errors import UserError
from arm5dof.vision import options

if TYPE_CHECKING:
    import numpy as np

    from arm5dof.vision.camera import Camera
    from arm5dof.vision.detections import Detections
    from arm5dof.vision.locate import Located, Workspace

HELP = """\
Tell where the things that a detector found are, in the arm's base frame.

  arm5dof vision detect photo.jpg --detector best.onnx --json > found.json
  arm5dof vision locate found.json --camera posed.yml --height cup=0.045 --height orange=0.035:ball

The camera file must have the camera's pose: see arm5dof vision pose and hand-eye. A camera on the hand takes the hand's
pose at the moment of the photograph with --hand.

--height NAME=METRES says how high the middle of a NAME is above the table, half its height as it lies there. How wide
it is does not matter, but its form does: NAME=METRES:block is the default and means anything with the same outline all
the way up, :ball what is rounded above and below, :cone what is pointed. Without any --height, things are those of the
simulated table, whose heights are known.

There are three ways. By one picture: things stand on the table, and where the line of sight meets it is where they are.
By a depth image that shows what the camera shows, which rests less on the boxes and on the table's height:

  arm5dof vision locate found.json --camera posed.yml --height cup=0.045 --depth depth.png

By two pictures of the same moment, each with its camera. Things need not stand on the table:

  arm5dof vision locate left.json right.json --camera left.yml --camera right.yml --height cup=0.045

Printed are millimetres, and standard deviations that follow from those of the cameras, the boxes (--pixels), the depth
image (--depth-error) and the heights (half a millimetre). With --json: a list of frames, {"name", "things"}, and in
that for each detection {"class_name", "confidence", "position", "covariance", "reason"}, metres and square metres in
the base frame; what cannot be located has null for both, and a reason.
"""


def declare(commands: argparse._SubParsersAction) -> None:
    """Add `locate` to the vision commands."""
    raw = argparse.RawDescriptionHelpFormatter
    p = commands.add_parser("locate", help="tell where detected things are", description=HELP, formatter_class=raw)
    p.add_argument(
        "detections",
        type=Path,
        nargs="+",
        metavar="DETECTIONS.json",
        help="what vision detect --json printed, one for each camera; - reads it from a pipe",
    )
    p.add_argument(
        "--camera", type=Path, action="append", required=True, metavar="CAMERA.yml", help="a camera with a pose; or two"
    )
    p.add_argument(
        "--height",
        type=_height,
        action="append",
        default=[],
        metavar="NAME=METRES[:FORM]",
        help="of the middle of a class of things above the table; repeatable; default: those of the simulated table",
    )
    p.add_argument("--table", type=float, default=0.0, metavar="METRES", help="height of the table; default 0")
    p.add_argument(
        "--pixels", type=float, default=1.0, metavar="N", help="standard deviation of a box's edges; default 1"
    )
    p.add_argument(
        "--reach",
        type=float,
        nargs=2,
        metavar=("MIN", "MAX"),
        help="only what is so far from the origin of the base frame, metres",
    )
    p.add_argument(
        "--hand",
        type=float,
        nargs=7,
        metavar=("X", "Y", "Z", "QW", "QX", "QY", "QZ"),
        help="the hand's pose, for a camera on the hand",
    )
    p.add_argument("--depth", type=Path, metavar="DEPTH.png", help="the depth image of the one frame, in millimetres")
    p.add_argument(
        "--depth-error",
        type=float,
        default=0.002,
        metavar="METRES",
        help="standard deviation of what the depths of a thing are off together; default 0.002",
    )
    p.add_argument("--json", action="store_true", help="print JSON")
    p.set_defaults(run=run)


def run(known: argparse.Namespace, rest: list[str]) -> None:
    """`arm5dof vision locate`."""
    options.nothing_left(rest, "locate")
    _check(known)
    hand = None if known.hand is None else options.pose(known.hand)

    from arm5dof.progress import Bar
    from arm5dof.vision.camera import Camera
    from arm5dof.vision.cloud import by_depth, read_depth
    from arm5dof.vision.locate import by_plane
    from arm5dof.vision.solid import CATALOGUE_SOLIDS, Solid
    from arm5dof.vision.views import by_views

    solids = {name: Solid(half, form) for name, half, form in known.height} or CATALOGUE_SOLIDS
    cameras = [Camera.load(path, hand) for path in known.camera]
    for path, camera in zip(known.camera, cameras, strict=True):
        if camera.covariance is None:
            print(
                f"arm5dof: {path} does not say how well the camera is known, so the deviations leave that out; "
                "vision calibrate and vision pose write it",
                file=sys.stderr,
            )
    moments = _moments(known.detections, cameras)
    depth = None if known.depth is None else read_depth(known.depth)
    if depth is not None and len(moments) != 1:
        raise UserError(f"{known.depth} is the depth image of one frame, and {known.detections[0]} has {len(moments)}")

    common = {"pixels": known.pixels, "workspace": _workspace(known.reach)}
    answers = []
    with Bar("locating", len(moments), "frames") as bar:
        bar.update(0, "starting")
        for name, found in moments:
            if len(cameras) > 1:
                located = by_views(found, cameras, solids, **common)
            elif depth is not None:
                more = {"table": known.table, "deviation": known.depth_error}
                located = by_depth(found[0], depth, cameras[0], solids, **common, **more)
            else:
                located = by_plane(found[0], cameras[0], solids, table=known.table, **common)
            answers.append((name, located))
            bar.update(len(answers), name or "")
    print(json.dumps([as_json(*answer) for answer in answers]) if known.json else "\n".join(starmap(table, answers)))


def as_json(name: str | None, found: Located) -> dict[str, Any]:
    """What is where in one frame, for programs."""
    return {"name": name, "things": found.rows()}


def table(name: str | None, found: Located) -> str:
    """The same for people: millimetres, and standard deviations along x, y and z."""
    import numpy as np

    head = f"  {'class':16} conf        x       y       z mm       +-"
    lines = [*([] if name is None else [name]), head if len(found.detections) else "  nothing"]
    deviations = 1e3 * np.sqrt(found.covariance.diagonal(axis1=1, axis2=2))
    for row, position, deviation in zip(found.rows(), 1e3 * found.position, deviations, strict=True):
        told = row["reason"] or "{:8.1f}{:8.1f}{:8.1f}      {:6.1f}{:6.1f}{:6.1f}".format(*position, *deviation)
        lines.append(f"  {row['class_name']:16} {row['confidence']:.2f} {told}")
    return "\n".join(lines)


def _check(known: argparse.Namespace) -> None:
    """Raise `UserError` for what can be told wrong without reading a file."""
    if not math.isfinite(known.table):
        raise UserError(f"--table takes a height in metres, not {known.table:g}")
    if not 0 <= known.depth_error < math.inf:
        raise UserError(f"--depth-error takes metres, such as 0.002, not {known.depth_error:g}")
    if len(known.detections) != len(known.camera) or len(known.camera) > 2:
        raise UserError("give one DETECTIONS.json and its --camera, or two and theirs in the same order")
    if len(known.camera) == 2 and (known.hand or known.depth):
        raise UserError("--hand and --depth go with one camera: leave them out, or the second camera")


def _moments(paths: Sequence[Path], cameras: Sequence[Camera]) -> list[tuple[str | None, list[Detections]]]:
    """The names of frames, and what each camera's picture shows there."""
    from arm5dof.vision import detections_file

    views = [detections_file.read(path) for path in paths]
    if len(views[0]) != len(views[-1]):
        raise UserError(
            f"{paths[0]} has {len(views[0])} frames and {paths[-1]} {len(views[-1])}: give pictures of the same moments"
        )
    for frames, camera in zip(views, cameras, strict=True):
        for frame in frames:
            if frame.size not in (None, (camera.width, camera.height)):
                size = "x".join(map(str, frame.size))
                raise UserError(f"{frame.name} has {size} pixels and the camera {camera.width}x{camera.height}")
    moments = zip(*views, strict=True)
    return [(" + ".join(f.name for f in m if f.name) or None, [f.detections for f in m]) for m in moments]


def _height(text: str) -> tuple[str, float, str]:
    name, _, rest = text.rpartition("=")
    number, _, form = rest.partition(":")
    try:
        return name, float(number), form or "block"
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no NAME=METRES, such as cube=0.015") from None


def _workspace(reach: list[float] | None) -> Workspace | None:
    """Points between two distances from the origin."""
    if reach is None:
        return None
    low, high = reach
    if not 0 <= low < high:
        raise UserError(f"--reach takes the smallest distance and the largest, metres: not {low:g} {high:g}")

    def within(points: np.ndarray) -> np.ndarray:
        away = (points**2).sum(1) ** 0.5
        return (away >= low) & (away <= high)

    return within
