"""What `vision locate` takes beside detections: cameras, objects' heights, the table, moments that go together."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from arm5dof.errors import UserError, nearest

if TYPE_CHECKING:
    from arm5dof.vision.camera import Camera
    from arm5dof.vision.detections import Detections
    from arm5dof.vision.localization.common import Localization


def locator(args: argparse.Namespace) -> Callable[..., Localization]:
    """`locate` with what the command line says of objects, table, depths and errors. Raises `UserError` for heights, a
    depth image or a reach that cannot be."""
    from arm5dof.vision.io.sources import read_depth
    from arm5dof.vision.localization import locate
    from arm5dof.vision.localization.common import within_distance
    from arm5dof.vision.localization.solids import CATALOGUE_SOLIDS, Solid

    solids = {name: Solid(half, form) for name, half, form in args.height} or CATALOGUE_SOLIDS
    depth = None if args.depth is None else read_depth(args.depth)
    if args.reach is not None and not 0 <= args.reach[0] < args.reach[1]:
        raise UserError(
            "--reach takes the smallest distance and the largest, metres: not {:g} {:g}".format(*args.reach)
        )
    return partial(
        locate,
        solids=solids,
        depth=depth,
        table_height=args.table,
        box_std=args.box_std,
        depth_std=args.depth_error,
        workspace=None if args.reach is None else within_distance(*args.reach),
    )


def load_cameras(paths: Sequence[Path], hand: Sequence[float] | None) -> list[Camera]:
    """The cameras in the files, with a word on those whose errors nobody has stated. Raises `UserError` if a file holds
    none."""
    from arm5dof.vision.calibration.poses import pose_from_quaternion
    from arm5dof.vision.camera import Camera

    hand_pose = None if hand is None else pose_from_quaternion(hand)
    cameras = [Camera.load(path, hand_pose) for path in paths]
    for path, camera in zip(paths, cameras, strict=True):
        if camera.covariance is None:
            print(
                f"arm5dof: {path} does not say how well the camera is known, so the deviations leave that out; "
                "vision calibrate and vision pose write it",
                file=sys.stderr,
            )
    return cameras


def read_moments(paths: Sequence[Path], cameras: Sequence[Camera]) -> list[tuple[str | None, list[Detections]]]:
    """The names of frames, and what was detected there in each camera's image."""
    from arm5dof.vision.images import has_orientation
    from arm5dof.vision.io import detections_file

    views = [detections_file.read(path) for path in paths]
    if len(views[0]) != len(views[-1]):
        raise UserError(
            f"{paths[0]} has {len(views[0])} frames and {paths[-1]} {len(views[-1])}: give images of the same moments"
        )
    for frames, camera in zip(views, cameras, strict=True):
        for frame in frames:
            if frame.size is not None:
                check_size(frame.name, frame.size, camera)
            # Files from before that was noted leave it to the photograph, where it still is.
            looked_up = frame.turned is None and frame.name is not None and has_orientation(frame.name)
            if frame.turned or looked_up:
                raise UserError(
                    f"{frame.name} has an orientation tag, by which it was turned before it was detected in: give the "
                    "photograph itself, as the sensor saw it, in place of its detections"
                )
    moments = zip(*views, strict=True)
    return [(" + ".join(f.name for f in m if f.name) or None, [f.detections for f in m]) for m in moments]


def warn_of_viewpoint(cameras: Sequence[Camera], table_height: float) -> None:
    """Say where the shipped detector, and whatever else was trained as it was, is out of its depth."""
    from arm5dof.vision.detectors.tabletop.viewpoint import (
        MAX_DISTANCE,
        MIN_DISTANCE,
        MIN_ELEVATION,
        unlike_training,
    )

    for camera in cameras:
        if camera.has_extrinsics and (unusual := unlike_training(camera, table_height)):
            print(
                f"arm5dof: the shipped detector is for cameras {MIN_DISTANCE:g} to {MAX_DISTANCE:g} m from the table, "
                f"at least {math.degrees(MIN_ELEVATION):.0f} degrees above it, not rolled, and this one is {unusual}: "
                "do not trust what is found",
                file=sys.stderr,
            )


def note_unseen(named: Sequence[str], seen: set[str]) -> None:
    """Say which classes of known height are not seen while one of a similar name is, of which none is known."""
    for name in named:
        if name not in seen and (near := nearest(name, seen.difference(named))):
            print(f"arm5dof: --height {name}: no {name} was detected; did you mean {near!r}?", file=sys.stderr)


def check_size(name: str | None, size: tuple[int, ...], camera: Camera) -> None:
    """Raise `ImageError` unless an image of that width and height is one of the camera's."""
    from arm5dof.vision.images import ImageError

    if size != (camera.width, camera.height):
        width, height = size
        raise ImageError(f"{name} has {width}x{height} pixels and the camera {camera.width}x{camera.height}")
