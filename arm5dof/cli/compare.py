"""`arm5dof compare`."""

from __future__ import annotations

import argparse
from pathlib import Path

from arm5dof.cli.parser import nothing_left

HELP = """\
Put runs and sweeps side by side, in one table and one figure: of a sweep every configuration, over its seeds.

  arm5dof compare runs/reach runs/reach-2
  arm5dof compare runs/my_sweep runs/reach --figure comparison.png
"""


def declare(commands: argparse._SubParsersAction) -> None:
    """Add `compare` to the commands."""
    p = commands.add_parser("compare", help="put runs and sweeps side by side", description=HELP)
    p.add_argument("folders", nargs="+", metavar="RUN|SWEEP", help="folders of runs and sweeps")
    p.add_argument("--figure", type=Path, metavar="FILE.png", help="write how they learnt, as a figure")
    p.set_defaults(run=run)


def run(args: argparse.Namespace, rest: list[str]) -> None:
    """`arm5dof compare`."""
    nothing_left(rest, "compare")
    from arm5dof.sweeps.compare import compare

    found = compare(*args.folders)
    print(found)
    if args.figure:
        found.save(args.figure)
        print(f"figure: {args.figure}")
