"""`arm5dof vision detect`. Everything that takes OpenCV or JAX is imported where it is used."""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from arm5dof.errors import UserError
from arm5dof.vision import options

if TYPE_CHECKING:
    from arm5dof.vision.outputs import Write
    from arm5dof.vision.sources import Source

HELP = """\
Find objects of named classes in images.

SOURCE is a photograph, several, folders of them, a video, or a camera by its number: 0 is the first; or simulated, for
random scenes such as the shipped detector was trained for, simulated:20 for 20 of them.

The shipped detector finds the things of our catalogue on a table. MODEL is a file with another:

  .pt     YOLOv5's own weights (n, s, m, l, x, release 6 and later), or what was trained from them with that code; run
          in JAX. The file is read without PyTorch, and nothing that it says is run.
  .onnx   YOLOv5, v7, v8, v11 or YOLOX exported as ONNX, without suppression; run by OpenCV.
  .npz    weights of our detector, as arm5dof vision train writes them.

  arm5dof vision detect simulated --out found
  arm5dof vision detect bus.jpg --detector yolov5n.pt
  arm5dof vision detect photos/ --detector best.onnx --names classes.txt --out found
  arm5dof vision detect clip.mp4 --detector yolov5n.pt --classes person,bus --out found
  arm5dof vision detect 0 --detector yolov5n.pt --size 320 --out found       until Ctrl-C

Without --out a table is printed. With it a new folder gets the images, or the video as MP4, with the boxes drawn in,
and detections.json: a list with an object for each frame, {"name", "time_s", "image_size", "detections"}, and in that
for each box {"class_name", "class_id", "confidence", "xyxy"}, the edges left, top, right and bottom in pixels.

Faster: a smaller --size. Too little is found: --careful, or a lower --confidence; too much: a higher one. One thing is
found twice: a lower --iou.

If an image is damaged, a video breaks off or you press Ctrl-C, the frames before are written and the files are whole;
the exit status is then 2, or 130 for Ctrl-C. A camera goes on until Ctrl-C, so there the exit status is 0.
"""


def declare(commands: argparse._SubParsersAction) -> None:
    """Add `detect` to the vision commands."""
    raw = argparse.RawDescriptionHelpFormatter
    p = commands.add_parser("detect", help="find objects in images", description=HELP, formatter_class=raw)
    p.add_argument("source", nargs="+", metavar="SOURCE", help="photographs, folders, a video, a camera, or simulated")
    p.add_argument("--detector", type=Path, metavar="MODEL", help="a .pt, .onnx or .npz file; default: what ships")
    p.add_argument("--names", type=Path, metavar="FILE", help="names of the classes, one a line; default: the model's")
    p.add_argument("--classes", type=_list, metavar="A,B,...", help="what to look for; default: every class")
    p.add_argument("--confidence", type=float, default=0.25, metavar="P", help="how sure to be, 0 to 1; default 0.25")
    p.add_argument(
        "--iou", type=float, default=0.45, metavar="P", help="overlap at which boxes of a class are one; default 0.45"
    )
    p.add_argument(
        "--size", type=int, metavar="PIXELS", help="side of the network's input; default: the model's, or 640"
    )
    p.add_argument("--careful", action="store_true", help="the shipped detector looks three times, in twice the time")
    p.add_argument("--out", type=Path, metavar="FOLDER", help="a new folder for what was found")
    p.add_argument("--json", action="store_true", help="print what goes into detections.json, frame by frame")
    p.set_defaults(run=run)


def run(known: argparse.Namespace, rest: list[str]) -> int:
    """`arm5dof vision detect`."""
    options.nothing_left(rest, "detect")
    if known.out is not None and known.out.exists():
        raise UserError(f"{known.out} exists: choose another --out")

    import numpy as np

    from arm5dof.progress import Bar
    from arm5dof.vision.detect import detect, load, read_names
    from arm5dof.vision.sources import open_source

    names = None if known.names is None else read_names(known.names)
    source = open_source(known.source)
    failure, seen, done, started = None, Counter[str](), 0, time.monotonic()
    with closing(source.frames), Bar("detecting", source.length, "frames") as bar:
        bar.update(0, "reading the detector")
        detector = load(known.detector, names, known.confidence, known.iou, known.size, known.careful)
        results = detect(source.frames, detector, known.classes)
        bar.update(0, "starting")
        if source.live:  # A camera shall not wait while the program for the first image is compiled.
            detector(np.zeros((480, 640, 3), np.uint8))
        with _outputs(known, source) as outputs, _interruptible() as interrupts:
            try:
                for frame, found in results:
                    for write in outputs:
                        write(frame, found)
                    done += 1
                    here = Counter(found.data["class_name"].tolist())
                    seen += here
                    bar.update(done, _counted(here))
                    if interrupts:
                        break
            except UserError as error:
                if not done:
                    raise
                failure = error
    frames = "1 frame" if done == 1 else f"{done} frames"
    kept = f"{frames} before that {'printed' if known.out is None else f'in {known.out}'}"
    if failure is not None:
        raise UserError(f"{failure}; {kept}")
    if interrupts and not source.live:
        print(f"arm5dof: interrupted; {kept}", file=sys.stderr)
        return 130
    if not known.json:
        print(f"{frames} in {time.monotonic() - started:.1f} s: {_counted(seen)}")
        if known.out is not None:
            print(f"written: {known.out}")
    return 0


@contextmanager
def _outputs(known: argparse.Namespace, source: Source) -> Iterator[list[Write]]:
    """What the command line asks for."""
    from arm5dof.vision import outputs

    with ExitStack() as stack:
        asked = []
        if known.out is not None:
            asked.append(stack.enter_context(outputs.folder(known.out, source)))
        if known.json:
            asked.append(stack.enter_context(outputs.json_list(sys.stdout)))
        elif known.out is None:
            asked.append(stack.enter_context(outputs.table(sys.stdout)))
        yield asked


@contextmanager
def _interruptible() -> Iterator[list[int]]:
    """Ctrl-C fills the list, so that the frame at hand can be finished; a second one interrupts at once."""
    interrupts: list[int] = []
    before = signal.getsignal(signal.SIGINT)

    def ask(number: int, _: object) -> None:
        interrupts.append(number)
        signal.signal(signal.SIGINT, before)

    if before is signal.default_int_handler:  # It is another where Ctrl-C is to be ignored, as in the background.
        signal.signal(signal.SIGINT, ask)
    try:
        yield interrupts
    finally:
        signal.signal(signal.SIGINT, before)


def _counted(classes: Counter[str]) -> str:
    return ", ".join(f"{count} {name}" for name, count in classes.most_common()) or "nothing"


def _list(text: str) -> list[str]:
    return [name.strip() for name in text.split(",")]
