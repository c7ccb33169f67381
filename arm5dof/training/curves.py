"""A run's curves in its folder: `metrics.csv`, a row an epoch, and `evaluations.json`."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from arm5dof.errors import UserError
from arm5dof.runtime import files
from arm5dof.training.trainer import Counters

METRICS, EVALUATIONS = "metrics.csv", "evaluations.json"


def read_rows(folder: Path) -> list[dict[str, Any]]:
    """The complete rows, counters as whole numbers. Raises `UserError` for what is no number."""
    path = folder / METRICS
    if not path.exists():
        return []
    with undamaged(path), open(path, newline="", encoding="utf-8") as handle:
        rows = [row for row in csv.DictReader(handle) if all(row.values()) and None not in row]
        return [{k: int(v) if k in Counters._fields else float(v) for k, v in row.items()} for row in rows]


def write_rows(folder: Path, rows: list[dict[str, Any]]) -> None:
    """Replace the rows."""
    with files.replacing(folder / METRICS) as temporary, open(temporary, "w", newline="") as handle:
        if rows:
            writer = csv.DictWriter(handle, rows[0])
            writer.writeheader()
            writer.writerows(rows)


@contextmanager
def appending(folder: Path, rows: list[dict[str, Any]]) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Rewrite the rows that the checkpoint knows, then append: what a kill cut off in mid-line is gone."""
    write_rows(folder, rows)
    with open(folder / METRICS, "a", newline="") as handle:

        def write(row: dict[str, Any]) -> None:
            writer = csv.DictWriter(handle, row)
            if handle.tell() == 0:
                writer.writeheader()
            writer.writerow(row)
            handle.flush()

        yield write


def read_evaluations(folder: Path) -> list[dict[str, Any]]:
    """The evaluations. Raises `UserError` for what is none."""
    path = folder / EVALUATIONS
    if not path.exists():
        return []
    with undamaged(path):
        found = _numbers(json.loads(path.read_text(encoding="utf-8")))
        return [{**e, "steps": int(e["steps"])} for e in found]


def _numbers(value: Any) -> Any:
    """What was read from JSON, NaN where it has null."""
    if isinstance(value, dict):
        return {name: _numbers(inner) for name, inner in value.items()}
    if isinstance(value, list):
        return [_numbers(inner) for inner in value]
    return math.nan if value is None else value


def write_evaluations(folder: Path, evaluations: list[dict[str, Any]]) -> None:
    """Replace the evaluations."""
    files.write_text(folder / EVALUATIONS, files.to_json(evaluations, indent=1) + "\n")


@contextmanager
def undamaged(path: Path) -> Iterator[None]:
    """Raise `UserError` for what goes wrong when a file of a run is read."""
    try:
        yield
    except (ValueError, KeyError, TypeError, csv.Error) as error:
        reason = f"{type(error).__name__}: {error}"
        raise UserError(f"{path} is damaged ({reason}): take it from a copy of the run") from None
