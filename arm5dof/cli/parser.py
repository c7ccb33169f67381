"""What all commands share: a parser whose errors are one clear line, and types of arguments."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any, NoReturn

from arm5dof.errors import UserError


class Parser(argparse.ArgumentParser):
    """One clear line for a bad command line, as for all other bad input, no guessing at shortened options, and
    descriptions that keep their lines."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        fixed = {"allow_abbrev": False, "formatter_class": argparse.RawDescriptionHelpFormatter}
        super().__init__(*args, **{**kwargs, **fixed})

    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message} (see {self.prog} --help)")


def positive(text: str) -> int:
    """A whole number above zero."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not a positive whole number")
    return value


def natural(text: str) -> int:
    """A whole number from zero."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} is negative")
    return value


def nothing_left(rest: Sequence[str], command: str) -> None:
    """Raise `UserError` if the command line has something that its command does not know."""
    if rest:
        raise UserError(f"unexpected argument {rest[0]!r} (see arm5dof {command} --help)")
