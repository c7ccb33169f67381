"""`arm5dof vision train`. Everything that takes OpenCV or JAX is imported where it is used."""

from __future__ import annotations

import argparse
from pathlib import Path

from arm5dof.cli.vision import options
from arm5dof.errors import UserError

HELP = """\
Train the detector of tabletop things that ships with arm5dof, from nothing: random scenes are drawn in software, with
all the machine's cores; one small network learns to propose where things are, and another to look closely at what the
first proposes. On two cores that takes half an hour.

  arm5dof vision train --out runs/detector
  arm5dof vision eval --weights runs/detector/weights.npz
  arm5dof vision detect photos/ --detector runs/detector/weights.npz

The new folder gets metrics.csv as the training goes on and, at the end, weights.npz and training.json. Meanwhile the
scenes take 1.2 MB each on the disk. The same seed on the same machine gives the same bits.
"""


def declare(commands: argparse._SubParsersAction) -> None:
    """Add `train` to the vision commands."""
    raw = argparse.RawDescriptionHelpFormatter
    p = commands.add_parser("train", help="train the detector that ships", description=HELP, formatter_class=raw)
    p.add_argument("--out", type=Path, default=Path("runs/detector"), metavar="FOLDER", help="default: runs/detector")
    p.add_argument("--seed", type=int, metavar="S", help="of all random numbers; default 0")
    p.add_argument("--scenes", type=int, metavar="N", help="pictures to draw; default 3500")
    p.add_argument("--proposer-steps", type=int, metavar="N", help="updates of the first network; default 5500")
    p.add_argument("--refiner-steps", type=int, metavar="N", help="updates of the second network; default 5000")
    p.set_defaults(run=run)


def run(known: argparse.Namespace, rest: list[str]) -> None:
    """`arm5dof vision train`."""
    options.nothing_left(rest, "train")
    if known.out.exists():
        raise UserError(f"{known.out} exists: choose another --out")

    from arm5dof.vision.detectors.tabletop.training.train import Budget, train

    names = ("seed", "scenes", "proposer_steps", "refiner_steps")
    train(known.out, Budget(**{name: getattr(known, name) for name in names if getattr(known, name) is not None}))
    print(f"weights: {known.out / 'weights.npz'}")
