"""Placing things as a command does it: its options, the cameras and the way that they ask for. Everything that takes
OpenCV or JAX is imported where it is used."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from arm5dof.cli.vision import options
from arm5dof.errors import UserError

if TYPE_CHECKING:
    import numpy as np

    from arm5dof.vision.camera import Camera
    from arm5dof.vision.detections import Detections
    from arm5dof.vision.localization.locate import Located, Workspace


def add_options(p: argparse.ArgumentParser) -> None:
    """What is known of the cameras, the things and the table."""
    p.add_argument(
        "--camera", type=Path, action="append", default=[], metavar="CAMERA.yml", help="a camera with a pose; or two"
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


def check(known: argparse.Namespace) -> None:
    """Raise `UserError` for what can be told wrong without reading a file."""
    if not math.isfinite(known.table):
        raise UserError(f"--table takes a height in metres, not {known.table:g}")
    if not 0 <= known.depth_error < math.inf:
        raise UserError(f"--depth-error takes metres, such as 0.002, not {known.depth_error:g}")
    if len(known.camera) == 2 and (known.hand or known.depth):
        raise UserError("--hand and --depth go with one camera: leave them out, or the second camera")


def cameras(known: argparse.Namespace) -> list[Camera]:
    """The cameras in the files given, with a word on those whose errors nobody has stated. Raises `UserError` if a file
    holds none."""
    from arm5dof.vision.camera import Camera

    hand = None if known.hand is None else options.pose(known.hand)
    loaded = [Camera.load(path, hand) for path in known.camera]
    for path, camera in zip(known.camera, loaded, strict=True):
        if camera.covariance is None:
            print(
                f"arm5dof: {path} does not say how well the camera is known, so the deviations leave that out; "
                "vision calibrate and vision pose write it",
                file=sys.stderr,
            )
    return loaded


def method(known: argparse.Namespace) -> Callable[[Sequence[Detections], Sequence[Camera]], Located]:
    """What places the things that cameras show at one moment, in one of the three ways. Raises `UserError` for heights,
    a depth image or a reach that cannot be."""
    from arm5dof.vision.localization.depth import by_depth, read_depth
    from arm5dof.vision.localization.locate import by_plane
    from arm5dof.vision.localization.multi_view import by_views
    from arm5dof.vision.localization.solids import CATALOGUE_SOLIDS, Solid

    solids = {name: Solid(half, form) for name, half, form in known.height} or CATALOGUE_SOLIDS
    depth = None if known.depth is None else read_depth(known.depth)
    common = {"pixels": known.pixels, "workspace": _workspace(known.reach)}

    def place(found: Sequence[Detections], cameras: Sequence[Camera]) -> Located:
        if len(cameras) > 1:
            return by_views(found, cameras, solids, **common)
        if depth is not None:
            more = {"table": known.table, "deviation": known.depth_error}
            return by_depth(found[0], depth, cameras[0], solids, **common, **more)
        return by_plane(found[0], cameras[0], solids, table=known.table, **common)

    return place


def check_size(name: str | None, size: tuple[int, ...], camera: Camera) -> None:
    """Raise `UserError` unless a picture of that width and height is one of the camera's."""
    if size != (camera.width, camera.height):
        width, height = size
        raise UserError(f"{name} has {width}x{height} pixels and the camera {camera.width}x{camera.height}")


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
