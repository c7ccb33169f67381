"""A run's curves in its folder: `metrics.csv`, a row an epoch, and `evaluations.json`.

Each row and evaluation bears the id that is in the folder's `run.json`, so that those of another run are noticed. Runs
of before there were ids have none, and neither have their curves.
"""

from __future__ import annotations

import csv
import itertools
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Set
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from arm5dof.envs.metrics import Metric
from arm5dof.errors import UserError
from arm5dof.runtime import files
from arm5dof.training.trainer import Counters

METRICS, EVALUATIONS = "metrics.csv", "evaluations.json"
REMEDY = "take it from a copy of the run, or remove it to go on without what it held"
RUN = "run"
"""The name of the id, in `run.json` too."""


def read_rows(folder: Path) -> list[dict[str, Any]]:
    """The rows that are complete, as the last of a run that is trained or was killed need not be; counters as whole
    numbers. Raises `UserError` for anything else."""
    path = folder / METRICS
    if not path.exists():
        return []
    with files.undamaged(path, REMEDY):
        text = path.read_bytes().decode()
        lines = csv.reader(text[: text.rfind("\n") + 1].splitlines())
        names = next(lines, [])
        rows: list[dict[str, Any]] = [dict(zip(names, line, strict=True)) for line in lines]
        ids = {row.pop(RUN, None) for row in rows}
        found = [{k: int(v) if k in Counters._fields else float(v) for k, v in row.items()} for row in rows]
        _check_counters(found)
        for row in found:
            _ = row["seconds"], row["reward"], row["nonfinite"]
    _check_ids(ids, path)
    return found


def write_rows(folder: Path, rows: list[dict[str, Any]]) -> None:
    """Replace the rows."""
    with files.replacing(folder / METRICS) as temporary, open(temporary, "w", newline="") as handle:
        if rows:
            mark = _mark(folder)
            writer = csv.DictWriter(handle, rows[0] | mark)
            writer.writeheader()
            writer.writerows(row | mark for row in rows)


@contextmanager
def appending(folder: Path, rows: list[dict[str, Any]]) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Rewrite the rows that the checkpoint knows, then append: what a kill cut off in mid-line is gone."""
    write_rows(folder, rows)
    mark = _mark(folder)
    with open(folder / METRICS, "a", newline="") as handle:

        def write(row: dict[str, Any]) -> None:
            writer = csv.DictWriter(handle, row | mark)
            if handle.tell() == 0:
                writer.writeheader()
            writer.writerow(row | mark)
            handle.flush()

        yield write


def read_evaluations(folder: Path, metrics: Mapping[str, Metric]) -> list[dict[str, Any]]:
    """The evaluations, in which the task's metrics are as they summarise. Raises `UserError` for anything else."""
    path = folder / EVALUATIONS
    if not path.exists():
        return []
    with files.undamaged(path, REMEDY):
        found = _numbers(json.loads(path.read_text(encoding="utf-8")))
        if not isinstance(found, list):
            raise TypeError("it is no list")
        ids = {evaluation.pop(RUN, None) for evaluation in found}
        _check_counters(found)
        for evaluation in found:
            if not evaluation["targets"] > 0:
                raise ValueError("there were no targets")
            sum(evaluation["means"].values())
            for name in evaluation.keys() & metrics.keys():
                metric, summary = metrics[name], evaluation[name]
                float(metric.number(summary)), metric.cells(summary), metric.text(summary)
    _check_ids(ids, path)
    return found


def _check_counters(found: Iterable[Mapping[str, Any]]) -> None:
    """Raise `ValueError`, or what comes of it, for rows whose counters are no whole numbers that grow."""
    counted = [[row[name] for name in Counters._fields] for row in found]
    if any(type(value) is not int or value < 0 for counters in counted for value in counters):
        raise ValueError("a counter is no whole number")
    if any(now[0] <= before[0] for before, now in itertools.pairwise(counted)):
        raise ValueError("steps do not grow")


def _numbers(value: Any) -> Any:
    """What was read from JSON, NaN where it has null."""
    if isinstance(value, dict):
        return {name: _numbers(inner) for name, inner in value.items()}
    if isinstance(value, list):
        return [_numbers(inner) for inner in value]
    return math.nan if value is None else value


def write_evaluations(folder: Path, evaluations: list[dict[str, Any]]) -> None:
    """Replace the evaluations."""
    mark = _mark(folder)
    files.write_text(folder / EVALUATIONS, files.to_json([e | mark for e in evaluations], indent=1) + "\n")


def _mark(folder: Path) -> dict[str, str]:
    """The run's id, by its name; nothing where it has none."""
    path = folder / "run.json"
    if not path.exists():
        return {}
    with files.undamaged(path, "take it from a copy of the run"):
        found = json.loads(path.read_text(encoding="utf-8"))
        return {RUN: str(found[RUN])} if RUN in found else {}


def _check_ids(ids: Set[str | None], path: Path) -> None:
    """Raise `UserError` if rows or evaluations have others than the run's."""
    if ids - {_mark(path.parent).get(RUN)}:
        raise UserError(f"{path} is of another run: {REMEDY}")
