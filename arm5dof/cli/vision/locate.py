"""`arm5dof vision locate`."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from arm5dof.cli.parser import nothing_left
from arm5dof.cli.vision import detecting, options
from arm5dof.errors import UserError, nearest
from arm5dof.runtime import files

if TYPE_CHECKING:
    from arm5dof.vision.camera import Camera
    from arm5dof.vision.detections import Detections
    from arm5dof.vision.frames import Frame
    from arm5dof.vision.io.sinks import Write
    from arm5dof.vision.io.sources import Source
    from arm5dof.vision.localization.common import Localization

HELP = """\
Tell where objects are, in the arm's base frame.

SOURCE is what vision detect takes: a photograph, several, folders of them, a video, or a camera by its number; or
simulated, for random scenes, whose cameras are known. Objects are detected first, by the shipped detector or
--detector. Or it is the JSON that vision detect wrote; - reads that from a pipe.

  arm5dof vision locate simulated:5 --out placed
  arm5dof vision locate photo.jpg --camera posed.yml
  arm5dof vision locate clip.mp4 --camera posed.yml --detector best.onnx --height cup=0.045 --out placed
  arm5dof vision locate 0 --camera posed.yml --out placed        until Ctrl-C
  arm5dof vision locate found/detections.json --camera posed.yml --height cup=0.045 --height orange=0.035:ball

The camera file must have the camera's pose: see arm5dof vision pose and hand-eye. A camera on the hand takes the hand's
pose at the moment of the photograph with --hand.

--height NAME=METRES says how high the center of a NAME is above the table, half its height as it lies there. How wide
it is does not matter, but its form does: NAME=METRES:block is the default and means anything with the same outline all
the way up, :ball what is rounded above and below, :cone what is pointed. Without any --height, objects are those of the
simulated table, whose heights are known.

There are three ways. By one image: objects stand on the table, and where the line of sight meets it is where they are.
By a depth image that shows what the camera shows, which rests less on the boxes and on the table's height:

  arm5dof vision locate photo.jpg --camera posed.yml --depth depth.png

By two images of the same moment, each with its camera. Objects need not stand on the table:

  arm5dof vision locate left.json right.json --camera left.yml --camera right.yml --height cup=0.045

Printed are millimetres, and standard deviations that follow from those of the cameras, the boxes (--box-std), the depth
image (--depth-error) and the heights (half a millimetre), and from how objects are turned, which no box tells. With
--json: a list of frames, {"name", "objects"}, and in that for each detection {"class_name", "confidence", "position",
"covariance", "reason"}, metres and square metres in the base frame; what cannot be located has null for both, and a
reason. Of images there are also each frame's "time_s", "image_size" and "turned", and each object's "class_id" and
"xyxy", as in vision detect.

With --out a new folder gets positions.json, which is that list, and the images, or the video as MP4, in which each box
has its class and x, y and z in millimetres, or the reason. An image that is damaged, or not of the camera's size, is
named and left out; the exit status is then 1, or 2 if no image is left. An interrupted or damaged video leaves whole
files of the frames before, as with vision detect.
"""


def declare(commands: argparse._SubParsersAction) -> None:
    """Add `locate` to the vision commands."""
    p = commands.add_parser("locate", help="tell where objects are", description=HELP)
    p.add_argument(
        "source", nargs="+", metavar="SOURCE", help="photographs, folders, a video, a camera, simulated; or JSON"
    )
    p.add_argument(
        "--camera", type=Path, action="append", default=[], metavar="CAMERA.yml", help="a camera with a pose; or two"
    )
    p.add_argument(
        "--height",
        type=_height,
        action="append",
        default=[],
        metavar="NAME=METRES[:FORM]",
        help="of the center of a class of objects above the table; repeatable; default: those of the simulated table",
    )
    p.add_argument("--table", type=float, default=0.0, metavar="METRES", help="height of the table; default 0")
    p.add_argument(
        "--box-std", type=float, default=1.0, metavar="PIXELS", help="standard deviation of a box's edges; default 1"
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
        help="standard deviation of the error that all depths of an object share; default 0.002",
    )
    detecting.add_options(p)
    p.add_argument("--json", action="store_true", help="print JSON")
    p.set_defaults(run=run)


def run(args: argparse.Namespace, rest: list[str]) -> int:
    """`arm5dof vision locate`."""
    nothing_left(rest, "vision locate")
    if not math.isfinite(args.table):
        raise UserError(f"--table takes a height in metres, not {args.table:g}")
    if not 0 <= args.depth_error < math.inf:
        raise UserError(f"--depth-error takes metres, such as 0.002, not {args.depth_error:g}")
    if len(args.camera) == 2 and (args.hand or args.depth):
        raise UserError("--hand and --depth go with one camera: leave them out, or the second camera")
    listed = [_is_list(given) for given in args.source]
    if any(listed) and not all(listed):
        raise UserError("images and DETECTIONS.json do not go together: give one or the other")
    return _run_on_lists(args) if any(listed) else _run_on_images(args)


def _run_on_images(args: argparse.Namespace) -> int:
    """Detect in images, and locate what is found."""
    from arm5dof.vision.detectors.loading import is_tabletop
    from arm5dof.vision.io.sources import image_files, open_source

    source = open_source(args.source, upright=False)
    if source.has_cameras and (args.camera or args.hand or args.depth):
        raise UserError("simulated scenes come with their cameras: leave out --camera, --hand and --depth")
    if not source.has_cameras and len(args.camera) != 1:
        remedy = "two go with two DETECTIONS.json" if args.camera else "arm5dof vision pose writes one"
        raise UserError(f"give one --camera CAMERA.yml with the camera's pose: {remedy}")
    if args.depth and source.length != 1:
        raise UserError(f"{args.depth} is the depth image of one frame: give the one image that goes with it")
    cameras, locate = _load_cameras(args.camera, args.hand), _locator(args)
    if source.rate is None and not source.has_cameras:
        options.say_untagged(image_files([Path(given) for given in args.source]))
    if is_tabletop(args.detector):
        _warn_of_viewpoint(cameras, args.table)

    def place(frame: Frame, found: Detections) -> Localization:
        camera = frame.camera or cameras[0]
        _check_size(frame.name, frame.image.shape[1::-1], camera)
        return locate(found, camera)

    named = [name for name, *_ in args.height]
    return detecting.run(args, source, _outputs(args.out, args.json, source, place), named)


@contextmanager
def _outputs(
    out: Path | None, as_json: bool, source: Source, place: Callable[[Frame, Detections], Localization]
) -> Iterator[list[Write]]:
    """What the command line asks for, as one function that locates objects first."""
    from arm5dof.vision.io import localizations, sinks

    with ExitStack() as stack:
        asked: list[Write] = []
        if out is not None:
            how = "positions.json", localizations.frame_as_json, localizations.draw
            asked.append(stack.enter_context(sinks.folder(out, source, *how)))
        if as_json:
            asked.append(stack.enter_context(sinks.json_list(sys.stdout, localizations.frame_as_json)))
        elif out is None:
            asked.append(stack.enter_context(localizations.localization_table(sys.stdout)))

        def write(frame: Frame, found: Detections) -> None:
            located = place(frame, found)
            for each in asked:
                each(frame, located)

        yield [write]


def _run_on_lists(args: argparse.Namespace) -> int:
    """Locate what was detected before."""
    if len(args.source) != len(args.camera) or len(args.camera) > 2:
        raise UserError("give one DETECTIONS.json and its --camera, or two and theirs in the same order")
    if needless := detecting.given(args):
        raise UserError(f"leave out {', '.join(needless)}: that takes images, and DETECTIONS.json has none")

    from arm5dof.runtime.progress import Bar
    from arm5dof.vision.io import localizations

    cameras, answers = _load_cameras(args.camera, args.hand), []
    moments = _read_moments([Path(given) for given in args.source], cameras)
    if args.depth and len(moments) != 1:
        raise UserError(f"{args.depth} is the depth image of one frame, and {args.source[0]} has {len(moments)}")
    locate = _locator(args)
    _note_unseen(
        [name for name, *_ in args.height], {name for _, views in moments for v in views for name in v.class_names}
    )
    with Bar("locating", len(moments), "frames") as bar:
        bar.update(0, "starting")
        for name, found in moments:
            answers.append((name, locate(found, cameras)))
            bar.update(len(answers), name or "")
    if not args.height:
        _warn_of_viewpoint(cameras, args.table)
    if args.json:
        print(files.to_json([localizations.as_json(*answer) for answer in answers]))
    else:
        print("\n".join(localizations.as_text(*answer) for answer in answers))
    return 0


def _locator(args: argparse.Namespace) -> Callable[..., Localization]:
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


def _load_cameras(paths: Sequence[Path], hand: Sequence[float] | None) -> list[Camera]:
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


def _read_moments(paths: Sequence[Path], cameras: Sequence[Camera]) -> list[tuple[str | None, list[Detections]]]:
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
                _check_size(frame.name, frame.size, camera)
            # Files from before that was noted leave it to the photograph, where it still is.
            looked_up = frame.turned is None and frame.name is not None and has_orientation(frame.name)
            if frame.turned or looked_up:
                raise UserError(
                    f"{frame.name} has an orientation tag, by which it was turned before it was detected in: give the "
                    "photograph itself, as the sensor saw it, in place of its detections"
                )
    moments = zip(*views, strict=True)
    return [(" + ".join(f.name for f in m if f.name) or None, [f.detections for f in m]) for m in moments]


def _warn_of_viewpoint(cameras: Sequence[Camera], table_height: float) -> None:
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


def _note_unseen(named: Sequence[str], seen: set[str]) -> None:
    """Say which classes of known height are not seen while one of a similar name is, of which none is known."""
    for name in named:
        if name not in seen and (near := nearest(name, seen.difference(named))):
            print(f"arm5dof: --height {name}: no {name} was detected; did you mean {near!r}?", file=sys.stderr)


def _check_size(name: str | None, size: tuple[int, ...], camera: Camera) -> None:
    """Raise `ImageError` unless an image of that width and height is one of the camera's."""
    from arm5dof.vision.images import ImageError

    if size != (camera.width, camera.height):
        width, height = size
        raise ImageError(f"{name} has {width}x{height} pixels and the camera {camera.width}x{camera.height}")


def _is_list(given: str) -> bool:
    """Whether it is JSON, by its name or its beginning, and so no image."""
    path = Path(given)
    if given == "-" or path.suffix.lower() == ".json" or path.is_fifo():
        return True
    if not path.is_file():
        return False
    with open(path, "rb") as file:
        return file.read(64).lstrip().startswith(b"[")


def _height(text: str) -> tuple[str, float, str]:
    name, _, rest = text.rpartition("=")
    number, _, form = rest.partition(":")
    try:
        return name, float(number), form or "block"
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no NAME=METRES, such as cube=0.015") from None
