"""The one exception that users cause and can mend."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class UserError(Exception):
    """Bad input. Its text is one line: what is wrong and what to do. The command line prints it and exits with 2."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))


class DivergedError(Exception):
    """A training came to numbers that are not finite. The command line prints it and exits with 1."""


class FolderGoneError(Exception):
    """The folder of a run went away while it was trained. The command line prints it and exits with 1."""


class Terminated(KeyboardInterrupt):
    """A request to end (SIGTERM, as clusters send it), which is obeyed where it loses nothing."""


def nearest(name: str, valid: Iterable[str]) -> str | None:
    """The valid name that is most like another, if any is."""
    return next(iter(difflib.get_close_matches(name, list(valid), n=1)), None)


def nearest_hint(name: str, valid: Iterable[str]) -> str:
    """What to say of a name that is none of the valid ones."""
    near = nearest(name, valid)
    return f"did you mean {near!r}?" if near else f"valid are {', '.join(valid)}"
