"""What a sweep leaves for people: tables, figures, and the best configuration with its policy."""

from __future__ import annotations

import os
from collections.abc import Callable

from arm5dof.errors import UserError
from arm5dof.runtime import files
from arm5dof.sweeps import figures, results, summary
from arm5dof.sweeps.folder import Sweep
from arm5dof.training import config, report
from arm5dof.training.policy_file import save_policy
from arm5dof.training.run import Run


def write(current: Sweep, say: Callable[[str], object]) -> None:
    """Write everything beside the members, each file whole or not at all.

    Args:
        current: The sweep.
        say: Told what could not be written.
    """
    rows = current.table
    if not results.write(current.folder, rows):
        say("no results.parquet: it takes pip install 'arm5dof[sweep]'")
    lines = current.summary(rows)
    found = summary.table(f"Sweep {current.folder.name}", lines, current.headline)
    files.write_text(current.folder / "summary.md", f"# {found.title}\n\n{found.markdown()}\n")
    for name, figure in figures.drawn(rows, lines, current.headline).items():
        report.save(figure, current.folder / f"{name}.png")
    best = next((line.best for line in lines if line.best), None)
    if best is not None:
        _write_best(current, best, say)


def _write_best(current: Sweep, best: str, say: Callable[[str], object]) -> None:
    opened = Run.open(current.members_folder / best)
    files.write_text(current.folder / "best.toml", config.dumps(opened.config))
    temporary = current.folder / ".best.zip"
    temporary.unlink(missing_ok=True)
    try:
        save_policy(opened, temporary)
        os.replace(temporary, current.folder / "best.zip")
    except UserError as error:
        say(f"no best.zip: {error}")
