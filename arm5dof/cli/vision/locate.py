"""`arm5dof vision locate`."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from arm5dof.cli.parser import nothing_left
from arm5dof.cli.vision import detecting, options, placing
from arm5dof.errors import UserError

if TYPE_CHECKING:
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
    cameras, locate = placing.load_cameras(args.camera, args.hand), placing.locator(args)
    if source.rate is None and not source.has_cameras:
        options.say_untagged(image_files([Path(given) for given in args.source]))
    if is_tabletop(args.detector):
        placing.warn_of_viewpoint(cameras, args.table)

    def place(frame: Frame, found: Detections) -> Localization:
        camera = frame.camera or cameras[0]
        placing.check_size(frame.name, frame.image.shape[1::-1], camera)
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

    from arm5dof.runtime import files
    from arm5dof.runtime.progress import Bar
    from arm5dof.vision.io import localizations

    cameras, answers = placing.load_cameras(args.camera, args.hand), []
    moments = placing.read_moments([Path(given) for given in args.source], cameras)
    if args.depth and len(moments) != 1:
        raise UserError(f"{args.depth} is the depth image of one frame, and {args.source[0]} has {len(moments)}")
    locate = placing.locator(args)
    placing.note_unseen(
        [name for name, *_ in args.height], {name for _, views in moments for v in views for name in v.class_names}
    )
    with Bar("locating", len(moments), "frames") as bar:
        bar.update(0, "starting")
        for name, found in moments:
            answers.append((name, locate(found, cameras)))
            bar.update(len(answers), name or "")
    if not args.height:
        placing.warn_of_viewpoint(cameras, args.table)
    if args.json:
        print(files.to_json([localizations.as_json(*answer) for answer in answers]))
    else:
        print("\n".join(localizations.as_text(*answer) for answer in answers))
    return 0


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
