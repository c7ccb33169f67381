"""`arm5dof eval`."""

from __future__ import annotations

import argparse
from pathlib import Path

from arm5dof.cli.parser import natural, nothing_left, positive

HELP = """\
Measure a policy on targets that it has never seen, or on episodes where its task has no targets.

  arm5dof eval runs/reach
  arm5dof eval runs/reach --targets 100000 --seed 1 --json
"""


def declare(commands: argparse._SubParsersAction) -> None:
    """Add `eval` to the commands."""
    p = commands.add_parser("eval", help="measure a policy's accuracy", description=HELP)
    p.add_argument("run_folder", type=Path, metavar="RUN", help="a run's folder")
    p.add_argument("--targets", type=positive, help="how many; default: as configured (10,000)")
    p.add_argument("--seed", type=natural, default=0, help="of the targets; default 0")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(run=run)


def run(args: argparse.Namespace, rest: list[str]) -> None:
    """`arm5dof eval`."""
    nothing_left(rest, "eval")
    from arm5dof.runtime import files
    from arm5dof.runtime.progress import Bar
    from arm5dof.training.evaluate import tables
    from arm5dof.training.run import Run

    opened = Run.open(args.run_folder)
    with Bar("evaluating", args.targets or opened.config.evaluate.targets, "targets") as bar:
        results = opened.evaluate(args.targets, args.seed, bar.update)
    metrics = opened.env.metrics
    shown = {name: found for name, found in results.items() if name in metrics or (name == "counts" and found)}
    print(files.to_json(shown) if args.json else tables(metrics, shown))
