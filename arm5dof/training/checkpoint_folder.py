"""The folder of a run's checkpoints: what is there, whether another one fits, and a path that orbax understands."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from arm5dof.errors import UserError

SPECIAL = frozenset("*?[]\\")


def names_in(folder: Path) -> list[str]:
    """The names of the checkpoints in a folder, whole or not. Raises `UserError` if it is there and cannot be read."""
    try:
        return sorted((path.name for path in folder.iterdir() if path.name.isdigit()), key=int)
    except FileNotFoundError:
        return []
    except OSError as error:
        raise UserError(
            f"the checkpoints in {folder} cannot be read ({error.strerror}): take them from a copy of the run, or make "
            "them readable"
        ) from None


def check_room(folder: Path, newest: Path) -> None:
    """Raise `UserError` unless another checkpoint like the newest can be written: a copy of that one is, for once."""
    try:
        with tempfile.TemporaryDirectory(prefix=".room-", dir=folder) as place:
            for number, path in enumerate(path for path in newest.rglob("*") if path.is_file()):
                shutil.copyfile(path, Path(place) / str(number))
    except OSError as error:
        raise UserError(f"cannot write a checkpoint to {folder} ({error.strerror}): nothing was changed") from None


@contextmanager
def plain(folder: Path, create: bool) -> Iterator[Path]:
    """A path to a folder without the characters that orbax takes for patterns and tensorstore for separators: the
    folder's own, or a link to it."""
    if not SPECIAL & set(str(folder)):
        yield folder
        return
    if create:
        folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="arm5dof-") as place:
        if SPECIAL & set(place):
            raise UserError(f"checkpoints need a folder for temporary files without any of {' '.join(sorted(SPECIAL))}")
        link = Path(place) / "checkpoints"
        link.symlink_to(folder, target_is_directory=True)
        yield link
