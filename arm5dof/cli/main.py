"""The command line: `arm5dof arm | train | eval | solve | export | sweep | compare | grasp | vision`.

Declaring commands must be quick, so whatever takes JAX, MuJoCo or OpenCV is imported where it is used.
"""

from __future__ import annotations

import errno
import os
import sys
import traceback
import warnings
from collections.abc import Sequence
from pathlib import Path

from arm5dof import __version__
from arm5dof.cli import arm, compare, evaluate, export, grasp, interrupts, solve, sweep, train, vision
from arm5dof.cli.parser import Parser
from arm5dof.errors import DivergedError, FolderGoneError, Terminated, UserError

NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command. Returns the exit status: 0, 1 for what came to nothing, 2 for bad input, and as shells have it 130
    when interrupted, 143 when asked to end, 141 when nobody reads what is printed."""
    warnings.showwarning = lambda message, *_, **__: print(f"arm5dof: {message}", file=sys.stderr)
    try:
        words = sys.argv[1:] if arguments is None else arguments
        if unreadable := next((word for word in words if not _is_text(word)), None):
            raise UserError(f"{unreadable!r} is no UTF-8: rename what it names")
        parser = make_parser()
        args, rest = parser.parse_known_args(words)
        if args.command is None:
            parser.print_help()
            return 0
        os.environ["MPLBACKEND"] = "agg"  # Figures are written, never shown, whatever notebooks are told to use.
        from arm5dof.runtime import xla  # Asks for versions, which takes as long as all else that help needs.

        xla.enable_compilation_cache()
        xla.check_platform()
        status = int(args.run(args, rest) or 0)
        if sys.stdout is not None:  # As it is where it was closed (>&-).
            sys.stdout.flush()
        return status
    except UserError as error:
        print(f"arm5dof: {error}", file=sys.stderr)
    except (DivergedError, FolderGoneError) as error:
        print(f"arm5dof: {error}", file=sys.stderr)
        return 1
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Or Python says more when it ends.
        return 141
    except OSError as error:
        place = f": {error.filename}" if error.filename else ""
        kept = "; what was complete is kept" if error.errno in NO_ROOM else ""
        print(f"arm5dof: {error.strerror or error}{place}{kept}", file=sys.stderr)
    except Exception as error:
        if not (asked := _unimportable(error)):
            raise
        print(f"arm5dof: {' '.join(str(error).split())}: mend or unset {asked}", file=sys.stderr)
    except KeyboardInterrupt as stop:
        interrupts.handled()
        print(f"arm5dof: {str(stop) or 'interrupted'}", file=sys.stderr)
        return 143 if isinstance(stop, Terminated) else 130
    return 2


def _is_text(word: str) -> bool:
    """Whether it is UTF-8, and so can be printed and kept in files."""
    try:
        word.encode()
    except UnicodeEncodeError:
        return False
    return True


def _unimportable(error: Exception) -> str:
    """The variables of the environment for which JAX or MuJoCo cannot be imported, if that is what happened."""
    frames = {Path(frame.filename).parts[-3:-1] for frame in traceback.extract_tb(error.__traceback__)}
    for module, prefix in (("jax", "JAX_"), ("mujoco", "MUJOCO_GL")):
        if module not in sys.modules and any(module in parts for parts in frames):
            given = {name: f"{name}={value}" for name, value in os.environ.items() if name.startswith(prefix)}
            named = [told for name, told in given.items() if name.lower() in str(error).lower()]
            return ", ".join(named or given.values())
    return ""


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
