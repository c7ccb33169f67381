"""`arm5dof vision train`. Everything that takes OpenCV or JAX is imported where it is used."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from arm5dof.cli.parser import nothing_left
from arm5dof.errors import UserError

if TYPE_CHECKING:
    from arm5dof.runtime.progress import Bar
    from arm5dof.vision.detectors.tabletop.training.train import Progress, Stage

HELP = """\
Train the detector of tabletop objects that ships with arm5dof, from nothing: random scenes are rendered in software,
with all the machine's cores; one small network learns to propose where objects are, and another to refine what the
first proposes. On two cores that takes half an hour.

  arm5dof vision train --out runs/detector
  arm5dof vision eval --weights runs/detector/weights.npz
  arm5dof vision detect photos/ --detector runs/detector/weights.npz

The new folder gets metrics.csv as the training goes on and, at the end, weights.npz and training.json. Meanwhile the
scenes take 1.2 MB each on the disk. The same seed on the same machine gives the same bits.
"""

BARS = {
    "rendering": ("rendering", "scenes"),
    "proposer": ("learning: proposer", "steps"),
    "proposing": ("proposing", "scenes"),
    "refiner": ("learning: refiner", "steps"),
}
"""What the bar of each stage says, and what it counts."""


def declare(commands: argparse._SubParsersAction) -> None:
    """Add `train` to the vision commands."""
    p = commands.add_parser("train", help="train the detector that ships", description=HELP)
    p.add_argument("--out", type=Path, default=Path("runs/detector"), metavar="FOLDER", help="default: runs/detector")
    p.add_argument("--seed", type=int, metavar="S", help="of all random numbers; default 0")
    p.add_argument("--scenes", type=int, metavar="N", help="images to render; default 3500")
    p.add_argument("--proposer-steps", type=int, metavar="N", help="updates of the first network; default 5500")
    p.add_argument("--refiner-steps", type=int, metavar="N", help="updates of the second network; default 5000")
    p.set_defaults(run=run)


def run(args: argparse.Namespace, rest: list[str]) -> None:
    """`arm5dof vision train`."""
    nothing_left(rest, "vision train")
    if args.out.exists():
        raise UserError(f"{args.out} exists: choose another --out")

    from arm5dof.vision.detectors.tabletop.training.train import Budget, train

    names = ("seed", "scenes", "proposer_steps", "refiner_steps")
    budget = Budget(**{name: getattr(args, name) for name in names if getattr(args, name) is not None})
    with _bars() as progress:
        train(args.out, budget, progress)
    print(f"weights: {args.out / 'weights.npz'}")


@contextmanager
def _bars() -> Iterator[Progress]:
    """A progress bar for each stage of a training, one after the other."""
    from arm5dof.runtime.progress import Bar

    bar: Bar | None = None
    with ExitStack() as stack:

        def progress(stage: Stage, done: int, total: int, note: str = "") -> None:
            nonlocal bar
            what, unit = BARS[stage]
            if bar is None or bar.what != what:
                stack.close()
                bar = stack.enter_context(Bar(what, total, unit))
            bar.update(done, note)

        yield progress
