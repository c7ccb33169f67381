"""Files: the ones shipped with the package, and writing that never leaves half of one."""

from __future__ import annotations

import csv
import json
import math
import os
import shutil
import tempfile
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import resources
from pathlib import Path
from typing import Any

from arm5dof.errors import UserError

PACKAGE = Path(str(resources.files("arm5dof")))


def find(folder: str, name: str | Path) -> Path | None:
    """A file the user named, or one of that name in a shipped folder (`mjcf`, `experiments`); None if neither is.

    Raises `UserError` where a bare name means either of two that differ.
    """
    own, ours = Path(name), shipped_file(folder, name)
    if not own.is_file():
        return ours
    if ours is not None and name == own.name and own.read_bytes() != ours.read_bytes():
        raise UserError(f"{name} is a file here and one that ships, and they differ: for the one here say ./{name}")
    return own


def shipped_file(folder: str, name: str | Path) -> Path | None:
    """The file of that name in a shipped folder, or None."""
    return next((root / name for root in _roots(folder) if (root / name).is_file()), None)


def shipped(folder: str, suffix: str) -> list[str]:
    """Names of the files that ship in a folder, for error messages and help."""
    return sorted({path.name for root in _roots(folder) if root.is_dir() for path in root.glob(f"*{suffix}")})


def _roots(folder: str) -> tuple[Path, Path]:
    """An installed wheel carries the folders inside the package, a checkout beside it."""
    return PACKAGE / folder, PACKAGE.parent / folder


@contextmanager
def undamaged(path: Path, remedy: str = "take it from a copy") -> Iterator[None]:
    """Raise `UserError` for what goes wrong when a file is read and taken for what it should be."""
    try:
        yield
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror or error}") from None
    except (ValueError, TypeError, LookupError, ArithmeticError, AttributeError, RecursionError, csv.Error) as error:
        reason = f"{type(error).__name__}: {error}"
        raise UserError(f"{path} is damaged ({reason}): {remedy}") from None


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file. Raises `UserError` if it is none."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror or error}") from None
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} is not valid TOML: {error}") from None


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary name beside `path` that takes its place when the block succeeds and vanishes when it fails."""
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o666 & ~_umask())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def making(folder: Path) -> Iterator[Path]:
    """A temporary folder beside `folder` that takes its name when the block succeeds and vanishes when it fails. Raises
    `UserError` if `folder` exists."""
    if folder.exists():
        raise UserError(f"{folder} exists: choose another name")
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        yield temporary
        temporary.chmod(0o777 & ~_umask())
        temporary.rename(folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def to_json(value: Any, indent: int | None = None) -> str:
    """As JSON, which has no numbers for infinity and for what is no number: null stands for them."""
    return json.dumps(_finite(value), indent=indent, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _finite(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
