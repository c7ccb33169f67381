"""A sweep's table: a row for each member and evaluation, rebuilt from the run folders, which are the truth."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from arm5dof.runtime import files
from arm5dof.sweeps.spec import Member
from arm5dof.sweeps.summary import Headline
from arm5dof.sweeps.worker import ended
from arm5dof.training.run import Run

VERSIONS = ("arm5dof", "jax", "jaxlib", "mujoco")
COUNTERS = ("steps", "episodes", "env_steps", "updates", "targets")
MISSING, RUNNING = "missing", "running"
Row = dict[str, Any]


def member_rows(folder: Path, member: Member, revision: str, headline: Headline) -> list[Row]:
    """The rows of one member, one without measurements if it has not been evaluated.

    Args:
        folder: Where the run folders are.
        member: The member.
        revision: The git revision at which its sweep was begun.
        headline: What members are judged by.

    Returns:
        Rows by column: `member`, the settings that vary, `status`, `reason`, `revision`, versions, counters, `seconds`
        since its training began (compilation and evaluations included), `headline`, the number by which members are
        judged, and every metric in the unit that its name says, in SI units below `means`.

    Raises:
        UserError: A file of its run is damaged.
    """
    ending = ended(folder, member.name)
    begun = (folder / member.name / "run.json").is_file()
    row: Row = {"member": member.name, **member.settings}
    row["status"] = ending.status if ending else RUNNING if begun else MISSING
    row["reason"] = ending.reason if ending else ""
    row["revision"] = revision
    if not begun:
        return [row]
    opened = Run(folder / member.name, member.config)
    row |= {name: opened.record["versions"].get(name, "") for name in VERSIONS}
    found, seconds = opened.evaluations, _seconds(opened)
    return [{**row, **_measured(e, seconds, headline)} for e in found] or [row]


def _seconds(opened: Run) -> dict[int, float]:
    metrics = opened.metrics
    return dict(zip(map(int, metrics.get("steps", [])), metrics.get("seconds", []), strict=True))


def _measured(evaluation: Mapping[str, Any], seconds: Mapping[int, float], headline: Headline) -> Row:
    counters = {name: evaluation[name] for name in COUNTERS}
    judged = evaluation.get(headline.name)
    number = None if judged is None else headline.metric.number(judged)
    rest = _flat({name: value for name, value in evaluation.items() if name not in COUNTERS})
    return {**counters, "seconds": seconds.get(int(evaluation["steps"])), "headline": number, **rest}


def _flat(values: Mapping[str, Any], prefix: str = "") -> Row:
    """Nested values by dotted names."""
    found: Row = {}
    for name, value in values.items():
        found |= _flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return found


def columns(rows: Iterable[Row]) -> list[str]:
    """The names of all columns, in the order in which rows have them."""
    return list(dict.fromkeys(name for row in rows for name in row))


def write(folder: Path, rows: list[Row]) -> bool:
    """Write `results.csv`, and `results.parquet` where pyarrow is installed; each is replaced whole. Returns whether it
    is."""
    names = columns(rows)
    text = io.StringIO()
    writer = csv.DictWriter(text, names)
    writer.writeheader()
    writer.writerows(rows)
    files.write_text(folder / "results.csv", text.getvalue())
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        return False
    table = pyarrow.table({name: _column([row.get(name) for row in rows]) for name in names})
    with files.replacing(folder / "results.parquet") as temporary:
        parquet.write_table(table, temporary)
    return True


def _column(values: list[Any]) -> list[Any]:
    """Values of one type: whole numbers beside others are numbers, all else that is mixed is text."""
    kinds = {type(value) for value in values if value is not None}
    if len(kinds) < 2 and not kinds & {tuple, list}:
        return values
    if kinds == {int, float}:
        return [None if value is None else float(value) for value in values]
    return [None if value is None else str(value) for value in values]
