"""`arm5dof export`."""

from __future__ import annotations

import argparse
from pathlib import Path

from arm5dof.cli.parser import nothing_left

HELP = """\
Write a run's policy to one small file: its settings, its networks, and the robot's MJCF. It answers as the run does,
but cannot be trained on.

  arm5dof export runs/reach_pose policy.zip
"""


def declare(commands: argparse._SubParsersAction) -> None:
    """Add `export` to the commands."""
    p = commands.add_parser("export", help="write a run's policy to one small file", description=HELP)
    p.add_argument("folder", type=Path, metavar="RUN")
    p.add_argument("path", type=Path, metavar="OUT.zip")
    p.set_defaults(run=run)


def run(args: argparse.Namespace, rest: list[str]) -> None:
    """`arm5dof export`."""
    nothing_left(rest, "export")
    from arm5dof.cli.vision.options import writable

    writable(args.path, (".zip",))
    from arm5dof.training.policy_file import save_policy
    from arm5dof.training.run import Run

    save_policy(Run.open(args.folder), args.path)
    print(f"{args.path}: {args.path.stat().st_size / 1e3:.0f} kB")
