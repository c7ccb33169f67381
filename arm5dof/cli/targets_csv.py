"""Targets and answers as CSV."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

from arm5dof.errors import UserError


def read(path: Path) -> list[list[float]]:
    """Targets (n, 3) in metres from the columns x, y and z of a file. Raises `UserError` on anything else."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as handle:
            reader = csv.DictReader(handle)
            if not {"x", "y", "z"} <= set(reader.fieldnames or ()):
                raise UserError(f"{path} needs a header with x, y and z (metres)")
            targets = []
            for row in reader:
                try:
                    targets.append([float(row[axis]) for axis in "xyz"])
                except (TypeError, ValueError):
                    raise UserError(f"{path}, line {reader.line_num}: x, y and z must be numbers") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path} is not a CSV file: {error}") from None
    if not targets:
        raise UserError(f"{path} holds no targets")
    return targets


def write(rows: list[dict[str, Any]], tolerance_mm: float) -> str:
    """The text of a file with a row for each answer: target, joint angles in radians, error and whether it counts."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["x", "y", "z", *rows[0]["joints_rad"], "error_mm", "reached"])
    for row in rows:
        angles = [f"{value:.7f}" for value in row["joints_rad"].values()]
        writer.writerow([*row["target_m"], *angles, f"{row['error_mm']:.4f}", int(row["error_mm"] <= tolerance_mm)])
    return text.getvalue()
