"""`arm5dof vision locate`. Everything that takes OpenCV or JAX is imported where it is used."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from itertools import starmap
from pathlib import Path
from typing import TYPE_CHECKING

from arm5dof.cli.vision import detecting, locating, options
from arm5dof.errors import UserError

if TYPE_CHECKING:
    from arm5dof.vision.camera import Camera
    from arm5dof.vision.detections import Detections
    from arm5dof.vision.frames import Frame
    from arm5dof.vision.io.sinks import Write
    from arm5dof.vision.io.sources import Source
    from arm5dof.vision.localization.locate import Located

HELP = """\
Tell where things are, in the arm's base frame.

SOURCE is what vision detect takes: a photograph, several, folders of them, a video, or a camera by its number; or
simulated, for random scenes, whose cameras are known. Things are detected first, by the shipped detector or --detector.
Or it is the JSON that vision detect wrote; - reads that from a pipe.

  arm5dof vision locate simulated:5 --out placed
  arm5dof vision locate photo.jpg --camera posed.yml
  arm5dof vision locate clip.mp4 --camera posed.yml --detector best.onnx --height cup=0.045 --out placed
  arm5dof vision locate 0 --camera posed.yml --out placed        until Ctrl-C
  arm5dof vision locate found/detections.json --camera posed.yml --height cup=0.045 --height orange=0.035:ball

The camera file must have the camera's pose: see arm5dof vision pose and hand-eye. A camera on the hand takes the hand's
pose at the moment of the photograph with --hand.

--height NAME=METRES says how high the middle of a NAME is above the table, half its height as it lies there. How wide
it is does not matter, but its form does: NAME=METRES:block is the default and means anything with the same outline all
the way up, :ball what is rounded above and below, :cone what is pointed. Without any --height, things are those of the
simulated table, whose heights are known.

There are three ways. By one picture: things stand on the table, and where the line of sight meets it is where they are.
By a depth image that shows what the camera shows, which rests less on the boxes and on the table's height:

  arm5dof vision locate photo.jpg --camera posed.yml --depth depth.png

By two pictures of the same moment, each with its camera. Things need not stand on the table:

  arm5dof vision locate left.json right.json --camera left.yml --camera right.yml --height cup=0.045

Printed are millimetres, and standard deviations that follow from those of the cameras, the boxes (--pixels), the depth
image (--depth-error) and the heights (half a millimetre). With --json: a list of frames, {"name", "things"}, and in
that for each detection {"class_name", "confidence", "position", "covariance", "reason"}, metres and square metres in
the base frame; what cannot be located has null for both, and a reason. Of images there are also each frame's "time_s"
and "image_size", and each thing's "class_id" and "xyxy", as in vision detect.

With --out a new folder gets positions.json, which is that list, and the images, or the video as MP4, in which each box
has its class and x, y and z in millimetres, or the reason. An interrupted or damaged source leaves whole files of the
frames before, as with vision detect.
"""


def declare(commands: argparse._SubParsersAction) -> None:
    """Add `locate` to the vision commands."""
    raw = argparse.RawDescriptionHelpFormatter
    p = commands.add_parser("locate", help="tell where things are", description=HELP, formatter_class=raw)
    p.add_argument(
        "source", nargs="+", metavar="SOURCE", help="photographs, folders, a video, a camera, simulated; or JSON"
    )
    locating.add_options(p)
    detecting.add_options(p)
    p.add_argument("--json", action="store_true", help="print JSON")
    p.set_defaults(run=run)


def run(known: argparse.Namespace, rest: list[str]) -> int:
    """`arm5dof vision locate`."""
    options.nothing_left(rest, "locate")
    locating.check(known)
    listed = [_is_list(given) for given in known.source]
    if any(listed) and not all(listed):
        raise UserError("images and DETECTIONS.json do not go together: give one or the other")
    return _of_lists(known) if any(listed) else _of_frames(known)


def _of_frames(known: argparse.Namespace) -> int:
    """Detect in images, and place what is found."""
    from arm5dof.vision.io.sources import open_source

    source = open_source(known.source)
    if source.drawn and (known.camera or known.hand or known.depth):
        raise UserError("simulated scenes come with their cameras: leave out --camera, --hand and --depth")
    if not source.drawn and len(known.camera) != 1:
        remedy = "two go with two DETECTIONS.json" if known.camera else "arm5dof vision pose writes one"
        raise UserError(f"give one --camera CAMERA.yml with the camera's pose: {remedy}")
    if known.depth and source.length != 1:
        raise UserError(f"{known.depth} is the depth image of one frame: give the one image that goes with it")
    cameras, method = locating.cameras(known), locating.method(known)

    def place(frame: Frame, found: Detections) -> Located:
        camera = frame.camera or cameras[0]
        locating.check_size(frame.name, frame.image.shape[1::-1], camera)
        return method([found], [camera])

    return detecting.run(known, source, _outputs(known, source, place))


@contextmanager
def _outputs(
    known: argparse.Namespace, source: Source, place: Callable[[Frame, Detections], Located]
) -> Iterator[list[Write]]:
    """What the command line asks for, as one function that places things first."""
    from arm5dof.vision.io import placed
    from arm5dof.vision.io import sinks as outputs

    def table(frame: Frame, found: Located) -> None:
        at = "" if frame.time is None else f" at {frame.time:.2f} s"
        print(placed.table(frame.name + at, found), flush=True)

    with ExitStack() as stack:
        asked: list[Write] = []
        if known.out is not None:
            how = "positions.json", placed.frame_as_json, placed.draw
            asked.append(stack.enter_context(outputs.folder(known.out, source, *how)))
        if known.json:
            asked.append(stack.enter_context(outputs.json_list(sys.stdout, placed.frame_as_json)))
        elif known.out is None:
            asked.append(table)

        def write(frame: Frame, found: Detections) -> None:
            located = place(frame, found)
            for each in asked:
                each(frame, located)

        yield [write]


def _of_lists(known: argparse.Namespace) -> int:
    """Place what was found before."""
    if len(known.source) != len(known.camera) or len(known.camera) > 2:
        raise UserError("give one DETECTIONS.json and its --camera, or two and theirs in the same order")
    if needless := detecting.given(known):
        raise UserError(f"leave out {', '.join(needless)}: that takes images, and DETECTIONS.json has none")

    from arm5dof.runtime.progress import Bar
    from arm5dof.vision.io import placed

    cameras, answers = locating.cameras(known), []
    moments = _moments([Path(given) for given in known.source], cameras)
    if known.depth and len(moments) != 1:
        raise UserError(f"{known.depth} is the depth image of one frame, and {known.source[0]} has {len(moments)}")
    method = locating.method(known)
    with Bar("locating", len(moments), "frames") as bar:
        bar.update(0, "starting")
        for name, found in moments:
            answers.append((name, method(found, cameras)))
            bar.update(len(answers), name or "")
    rows = [placed.as_json(*answer) for answer in answers]
    print(json.dumps(rows) if known.json else "\n".join(starmap(placed.table, answers)))
    return 0


def _moments(paths: Sequence[Path], cameras: Sequence[Camera]) -> list[tuple[str | None, list[Detections]]]:
    """The names of frames, and what each camera's picture shows there."""
    from arm5dof.vision.io import detections_file

    views = [detections_file.read(path) for path in paths]
    if len(views[0]) != len(views[-1]):
        raise UserError(
            f"{paths[0]} has {len(views[0])} frames and {paths[-1]} {len(views[-1])}: give pictures of the same moments"
        )
    for frames, camera in zip(views, cameras, strict=True):
        for frame in frames:
            if frame.size is not None:
                locating.check_size(frame.name, frame.size, camera)
    moments = zip(*views, strict=True)
    return [(" + ".join(f.name for f in m if f.name) or None, [f.detections for f in m]) for m in moments]


def _is_list(given: str) -> bool:
    """Whether it is JSON, by its name or its beginning, and so no image."""
    path = Path(given)
    if given == "-" or path.suffix.lower() == ".json" or path.is_fifo():
        return True
    if not path.is_file():
        return False
    with open(path, "rb") as file:
        return file.read(64).lstrip().startswith(b"[")
