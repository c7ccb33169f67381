"""The command line: `arm5dof arm | train | eval | solve | export | sweep | compare | grasp | vision`.

Declaring commands must be quick, so whatever takes JAX, MuJoCo or OpenCV is imported where it is used.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence

from arm5dof import __version__
from arm5dof.cli import arm, compare, evaluate, export, grasp, solve, sweep, train, vision
from arm5dof.cli.parser import Parser
from arm5dof.errors import UserError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command. Returns the exit status: 0, 1 for what came to nothing, 2 for bad input, 130 when interrupted."""
    warnings.showwarning = lambda message, *_, **__: print(f"arm5dof: {message}", file=sys.stderr)
    try:
        parser = make_parser()
        args, rest = parser.parse_known_args(arguments)
        if args.command is None:
            parser.print_help()
            return 0
        from arm5dof.runtime import xla  # Asks for versions, which takes as long as all else that help needs.

        xla.enable_compilation_cache()
        xla.check_platform()
        return int(args.run(args, rest) or 0)
    except UserError as error:
        print(f"arm5dof: {error}", file=sys.stderr)
    except OSError as error:
        place = f": {error.filename}" if error.filename else ""
        print(f"arm5dof: {error.strerror or error}{place}; what was complete is kept", file=sys.stderr)
    except KeyboardInterrupt:
        print("arm5dof: interrupted; a training goes on with arm5dof train --resume RUN", file=sys.stderr)
        return 130
    return 2


def make_parser() -> Parser:
    """The parser of all commands."""
    parser = Parser(prog="arm5dof", description="Train and ask vision-guided robot arms in JAX and MJX.")
    parser.add_argument("--version", action="version", version=f"arm5dof {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=Parser)
    arm.declare(commands)
    train.declare(commands)
    evaluate.declare(commands)
    solve.declare(commands)
    export.declare(commands)
    sweep.declare(commands)
    compare.declare(commands)
    grasp.declare(commands)
    vision.declare(
        commands.add_parser("vision", help="cameras: calibrate, pose, detect, locate", description="What the arm sees.")
    )
    return parser
