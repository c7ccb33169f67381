"""A sweep and its folder: `sweep.toml` (all that it was asked for), `sweep.json` (where it was begun), `members/` (a
run folder each, and how it ended), `results.csv` and `results.parquet`, `summary.md`, figures, and of the best
configuration `best.toml` and `best.zip`."""

from __future__ import annotations

import fcntl
import json
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from arm5dof.errors import UserError
from arm5dof.runtime import files
from arm5dof.runtime.tables import Table
from arm5dof.sweeps import figures, results, spec, summary
from arm5dof.sweeps.results import Row
from arm5dof.sweeps.spec import Member, Spec
from arm5dof.sweeps.summary import Headline, Line
from arm5dof.training.run import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PATIENCE_S = 20.0
"""Workers of a sweep that was killed end a little later than it did."""


class Sweep:
    """A sweep's folder and what it was asked for.

    Attributes:
        folder: The folder.
        spec: What it was asked for.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from arm5dof import Sweep
    >>> from arm5dof.sweeps.spec import parse
    >>> asked = parse({"base": "kinematic.toml", "axes": {"noise": [0.1, 0.2], "seed": {"count": 2}}})
    >>> folder = tempfile.TemporaryDirectory()
    >>> begun = Sweep.create(asked, Path(folder.name) / "noise")
    >>> [(row["member"], row["ddpg.noise"], row["train.seed"], row["status"]) for row in begun.table][:2]
    [('m0000', 0.1, 0, 'missing'), ('m0001', 0.1, 1, 'missing')]
    """

    def __init__(self, folder: Path, asked: Spec) -> None:
        self.folder, self.spec = folder, asked

    @staticmethod
    def open(folder: str | Path) -> Sweep:
        """A sweep that exists. Raises `UserError` if the folder is none."""
        folder = Path(folder)
        path = folder / "sweep.toml"
        if not path.is_file() or not (folder / "sweep.json").is_file():
            raise UserError(f"{folder} is no sweep: it has no sweep.toml and sweep.json")
        return Sweep(folder, spec.read(path.absolute()))

    @staticmethod
    def create(asked: Spec, folder: Path) -> Sweep:
        """Make a sweep's folder, whole or not at all. Raises `UserError` if it exists."""
        with files.making(folder) as temporary:
            (temporary / "sweep.toml").write_text(asked.dumps(), encoding="utf-8")
            (temporary / "sweep.json").write_text(json.dumps({"revision": _revision()}) + "\n", encoding="utf-8")
            (temporary / "members").mkdir()
        return Sweep(folder, asked)

    @property
    def members_folder(self) -> Path:
        """Where the run folders are."""
        return self.folder / "members"

    @property
    def members(self) -> list[Member]:
        """Its members; of a search those of the trials so far."""
        if self.spec.search is None:
            return self._all
        from arm5dof.sweeps import search

        return search.members(self.spec, self.folder)

    @cached_property
    def _all(self) -> list[Member]:
        return self.spec.members

    @property
    def runs(self) -> dict[str, Run]:
        """The members that have been begun, by name, each a run like any other."""
        begun = [m.name for m in self.members if (self.members_folder / m.name / "run.json").is_file()]
        return {name: Run.open(self.members_folder / name) for name in begun}

    @property
    def table(self) -> list[Row]:
        """A row for each member and evaluation, by column; see `rows`."""
        return [row for member in self.members for row in self.rows(member)]

    def rows(self, member: Member) -> list[Row]:
        """The rows of one member; see `results.member_rows`."""
        return results.member_rows(self.members_folder, member, self._revision, self.headline)

    @cached_property
    def _revision(self) -> str:
        path = self.folder / "sweep.json"
        with files.undamaged(path, "take it from a copy of the sweep"):
            return str(json.loads(path.read_text(encoding="utf-8"))["revision"])

    @cached_property
    def headline(self) -> Headline:
        """What members are judged by: the base experiment's."""
        return Headline.of(self.spec.base)

    def summary(self, rows: list[Row] | None = None) -> list[Line]:
        """Configurations from the best to the worst, over their seeds.

        Args:
            rows: The table, if it is at hand.
        """
        higher = self.headline.metric.higher_is_better
        rows = self.table if rows is None else rows
        return summary.summarise(rows, higher, self.spec.axes, self.spec.sample_seed)

    def figures(self) -> dict[str, Figure]:
        """Its figures: `learning`, how configurations learnt, and `axes`, what the axes are worth, if it has some."""
        rows = self.table
        return figures.drawn(rows, self.summary(rows), self.headline)

    @property
    def best(self) -> Run:
        """The best run of the best configuration. Raises `UserError` if no member has been evaluated."""
        lines = [line for line in self.summary() if line.best]
        if not lines:
            raise UserError(f"{self.folder}: no member has come to its end yet")
        return Run.open(self.members_folder / str(lines[0].best))

    def _table(self) -> Table:
        return summary.table(f"Sweep {self.folder}", self.summary(), self.headline)

    def __repr__(self) -> str:
        return self._table().text()

    def _repr_html_(self) -> str:
        return self._table().html()

    @contextmanager
    def locked(self) -> Iterator[int]:
        """Hold the sweep for one process and its workers; yields what workers are to keep open."""
        with open(self.folder / ".lock", "w") as handle:
            started = time.monotonic()
            while True:
                try:
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                except OSError:
                    if time.monotonic() - started > PATIENCE_S:
                        raise UserError(f"{self.folder} is being run by another process") from None
                    time.sleep(0.1)
            yield handle.fileno()


def _revision() -> str:
    """The git revision of the working directory, marked where it has changes; empty outside of one."""
    git = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        return subprocess.run(git, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""
