"""Detection as a command does it: its options, frame after frame with a progress bar, and Ctrl-C. Everything that takes
OpenCV or JAX is imported where it is used."""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from arm5dof.errors import UserError

if TYPE_CHECKING:
    from arm5dof.runtime.progress import Bar
    from arm5dof.vision.io.sinks import Write
    from arm5dof.vision.io.sources import Source


def add_options(p: argparse.ArgumentParser) -> None:
    """Add what says which detector runs, what it is to find, and where that goes."""
    p.add_argument("--detector", type=Path, metavar="MODEL", help="a .pt, .onnx or .npz file; default: what ships")
    p.add_argument("--names", metavar="FILE", help="names of the classes, one a line, or coco; default: the model's")
    p.add_argument("--classes", type=_list, metavar="A,B,...", help="what to look for; default: every class")
    p.add_argument(
        "--confidence", type=float, default=0.25, metavar="P", help="the least confidence, 0 to 1; default 0.25"
    )
    p.add_argument(
        "--iou", type=float, default=0.45, metavar="P", help="IoU above which boxes of a class are one; default 0.45"
    )
    p.add_argument(
        "--size", type=int, metavar="PIXELS", help="side of the network's input; default: the model's, or 640"
    )
    p.add_argument("--tta", action="store_true", help="test-time augmentation of the shipped detector: twice the time")
    p.add_argument("--onnxruntime", action="store_true", help="run an .onnx by ONNX Runtime, which is faster for many")
    p.add_argument("--out", type=Path, metavar="FOLDER", help="a new folder for what was found")


def given(args: argparse.Namespace) -> list[str]:
    """Which of these options are not as they are by default."""
    p = argparse.ArgumentParser(add_help=False)
    add_options(p)
    return [f"--{name}" for name, default in vars(p.parse_args([])).items() if getattr(args, name) != default]


def run(
    args: argparse.Namespace,
    source: Source,
    outputs: AbstractContextManager[list[Write]],
    named: Sequence[str] = (),
) -> int:
    """Detect in all frames as the options say and hand each on to the outputs.

    Args:
        args: The command line.
        source: Where the frames come from.
        outputs: Where what was found goes.
        named: Classes that the command line speaks of, besides those to look for.

    Returns:
        The exit status: 1 if photographs were left out, each of which is named.

    Raises:
        UserError: The detector knows no such class, there is something wrong with all photographs; or it cannot go on,
            and what came before is kept.
    """
    if args.out is not None and args.out.exists():
        raise UserError(f"{args.out} exists: choose another --out")

    import numpy as np

    from arm5dof.runtime.progress import Bar
    from arm5dof.vision.detections import check_known
    from arm5dof.vision.detectors.loading import detect, load_detector, read_names
    from arm5dof.vision.images import ImageError, check_some_usable

    names = None if args.names is None else read_names(args.names)
    failure, total, done, told, started = None, Counter[str](), 0, 0, time.monotonic()
    with closing(source.frames), Bar("detecting", source.length, "frames") as bar:
        bar.update(0, "reading the detector")
        detector = load_detector(args.detector, names, args.confidence, args.iou, args.size, args.tta, args.onnxruntime)
        check_known(named, detector.class_names)
        results = detect(source.frames, detector, args.classes)
        bar.update(0, "starting")
        if source.live:  # A camera shall not wait while the program for the first image is compiled.
            detector(np.zeros((480, 640, 3), np.uint8))
        with outputs as writers, interruptible() as interrupts:
            try:
                for frame, found in results:
                    try:
                        for write in writers:
                            write(frame, found)
                    except ImageError as error:
                        if source.rate is not None:  # Its other frames are no better.
                            raise
                        source.unread.append(str(error))
                        continue
                    done += 1
                    told = _tell(source.unread, told, bar)
                    in_frame = Counter(found.data["class_name"].tolist())
                    total += in_frame
                    bar.update(done, _counted(in_frame))
                    if interrupts:
                        break
                check_some_usable(source.unread, done + len(source.unread))
                _tell(source.unread, told, bar)
            except UserError as error:
                if not done:
                    raise
                failure = error
    frames = "1 frame" if done == 1 else f"{done} frames"
    kept = f"{frames} before that {'printed' if args.out is None else f'in {args.out}'}"
    if failure is not None:
        raise UserError(f"{failure}; {kept}")
    if interrupts and not source.live:
        print(f"arm5dof: interrupted; {kept}", file=sys.stderr)
        return 130
    if not args.json:
        print(f"{frames} in {time.monotonic() - started:.1f} s: {_counted(total)}")
        if args.out is not None:
            print(f"written: {args.out}")
    if source.unread:
        left_out, of = len(source.unread), done + len(source.unread)
        print(f"arm5dof: {left_out} of {of} files left out, for the reasons above", file=sys.stderr)
    return int(bool(source.unread))


def _tell(lines: Sequence[str], told: int, bar: Bar) -> int:
    """Print those that have not been told yet. Returns how many have been now."""
    for line in lines[told:]:
        bar.say(f"arm5dof: {line}")
    return len(lines)


@contextmanager
def interruptible() -> Iterator[list[int]]:
    """Ctrl-C fills the list, so that the frame at hand can be finished; a second one interrupts at once."""
    interrupts: list[int] = []
    before = signal.getsignal(signal.SIGINT)

    def interrupt(number: int, _: object) -> None:
        interrupts.append(number)
        signal.signal(signal.SIGINT, before)

    if callable(before):  # It is a constant where Ctrl-C is to be ignored, as in the background.
        signal.signal(signal.SIGINT, interrupt)
    try:
        yield interrupts
    finally:
        signal.signal(signal.SIGINT, before)


def _counted(classes: Counter[str]) -> str:
    return ", ".join(f"{count} {name}" for name, count in classes.most_common()) or "nothing"


def _list(text: str) -> list[str]:
    return [name.strip() for name in text.split(",")]
