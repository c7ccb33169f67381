"""`arm5dof vision ...`: one module a command. Each declares its options in `declare` and does its work in `run`.

Declaring must be quick, so everything that takes OpenCV, MuJoCo or JAX is imported where it is used.
"""

from __future__ import annotations

import argparse

from arm5dof.cli.vision import calibrate, detect, doctor, hand_eye, locate, pose, train
from arm5dof.cli.vision import eval as evaluate

COMMANDS = (calibrate, pose, hand_eye, detect, locate, train, evaluate, doctor)


def declare(parser: argparse.ArgumentParser) -> None:
    """Add the vision commands to the parser of `arm5dof vision`."""
    parser.set_defaults(run=lambda args, rest: parser.print_help())
    commands = parser.add_subparsers(metavar="COMMAND")
    for command in COMMANDS:
        command.declare(commands)
