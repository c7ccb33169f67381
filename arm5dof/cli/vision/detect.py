"""`arm5dof vision detect`. Everything that takes OpenCV or JAX is imported where it is used."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING

from arm5dof.cli.parser import nothing_left
from arm5dof.cli.vision import detecting

if TYPE_CHECKING:
    from arm5dof.vision.io.sinks import Write
    from arm5dof.vision.io.sources import Source

HELP = """\
Find objects of named classes in images.

SOURCE is a photograph, several, folders of them, a video, or a camera by its number: 0 is the first; or simulated, for
random scenes such as the shipped detector was trained for, simulated:20 for 20 of them.

The shipped detector finds the objects of our catalogue on a table. MODEL is a file with another:

  .pt     YOLOv5's own weights (n, s, m, l, x, release 6 and later), or what was trained from them with that code; run
          in JAX. The file is read without PyTorch, and nothing that it says is run.
  .onnx   YOLOv5, v7, v8, v10, v11, 26 or YOLOX exported as ONNX; run by OpenCV, or with --onnxruntime by ONNX Runtime
          (pip install 'arm5dof[onnx]'). Of a network that segments the boxes are used.
  .npz    weights of our detector, as arm5dof vision train writes them.

  arm5dof vision detect simulated --out found
  arm5dof vision detect bus.jpg --detector yolov5n.pt
  arm5dof vision detect photos/ --detector best.onnx --names classes.txt --out found
  arm5dof vision detect photos/ --detector yolox_nano.onnx --names coco --onnxruntime
  arm5dof vision detect clip.mp4 --detector yolov5n.pt --classes person,bus --out found
  arm5dof vision detect 0 --detector yolov5n.pt --size 320 --out found       until Ctrl-C

Without --out a table is printed. With it a new folder gets the images, or the video as MP4, with the boxes drawn in,
and detections.json: a list with an object for each frame, {"name", "time_s", "image_size", "turned", "detections"}, and
in that for each box {"class_name", "class_id", "confidence", "xyxy"}, the edges left, top, right and bottom in pixels.
Photographs are turned as their EXIF orientation tags say; "turned" is true where one says something.

Faster: a smaller --size. Too little is found: --tta, or a lower --confidence; too much: a higher one. One object is
found twice: a lower --iou, of which networks such as YOLOv10 and 26 take no notice.

An image that is damaged, or none, is named and left out; the exit status is then 1, or 2 if no image is left. If a
video breaks off or you press Ctrl-C, the frames before are written and the files are whole; the exit status is then 2,
or 130 for Ctrl-C. A camera goes on until Ctrl-C, so there the exit status is 0.
"""


def declare(commands: argparse._SubParsersAction) -> None:
    """Add `detect` to the vision commands."""
    p = commands.add_parser("detect", help="find objects in images", description=HELP)
    p.add_argument("source", nargs="+", metavar="SOURCE", help="photographs, folders, a video, a camera, or simulated")
    detecting.add_options(p)
    p.add_argument("--json", action="store_true", help="print what goes into detections.json, frame by frame")
    p.set_defaults(run=run)


def run(args: argparse.Namespace, rest: list[str]) -> int:
    """`arm5dof vision detect`."""
    nothing_left(rest, "vision detect")

    from arm5dof.vision.io.sources import open_source

    source = open_source(args.source)
    return detecting.run(args, source, _outputs(args, source))


@contextmanager
def _outputs(args: argparse.Namespace, source: Source) -> Iterator[list[Write]]:
    """What the command line asks for."""
    from arm5dof.vision.io import sinks

    with ExitStack() as stack:
        writers = []
        if args.out is not None:
            writers.append(stack.enter_context(sinks.folder(args.out, source)))
        if args.json:
            writers.append(stack.enter_context(sinks.json_list(sys.stdout)))
        elif args.out is None:
            writers.append(stack.enter_context(sinks.detection_table(sys.stdout)))
        yield writers
