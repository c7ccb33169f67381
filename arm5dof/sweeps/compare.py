"""Runs and sweeps side by side: one table and one figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from arm5dof.errors import UserError
from arm5dof.runtime.tables import Table
from arm5dof.sweeps import figures, results
from arm5dof.sweeps.folder import Sweep
from arm5dof.sweeps.spec import SEED, Member
from arm5dof.sweeps.summary import Headline, estimate, spelled_estimate
from arm5dof.sweeps.worker import DONE
from arm5dof.training.report import STYLE, save
from arm5dof.training.run import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Comparison:
    """Runs and sweeps side by side, in the order in which they were named.

    Attributes:
        headline: What they are judged by.
        curves: The rows of each run's evaluations, or of each configuration's members, by label.
    """

    def __init__(self, headline: Headline, curves: figures.Curves) -> None:
        self.headline, self.curves = headline, curves

    @property
    def table(self) -> Table:
        """A line for each run and each configuration of a sweep: the last evaluation of each member."""
        lines = []
        for label, rows in self.curves.items():
            last = {str(row["member"]): row for row in rows}.values()
            measured = [row for row in last if row.get("headline") is not None and row["status"] == DONE]
            counts = [_most(measured, name) for name in ("episodes", "updates", "seconds")]
            value = estimate(row["headline"] for row in measured)
            lines.append([label, str(len(measured)), *counts, spelled_estimate(value)])
        return Table("Comparison", ("of", "seeds", "episodes", "updates", "seconds", self.headline.label), lines)

    def figure(self) -> Figure:
        """How they learnt."""
        import matplotlib

        with matplotlib.rc_context(STYLE):  # type: ignore[arg-type]
            return figures.learning(self.curves, self.headline)

    def save(self, path: str | Path) -> None:
        """Write the figure as PNG."""
        save(self.figure(), Path(path))

    def __repr__(self) -> str:
        return self.table.text()

    def _repr_html_(self) -> str:
        return self.table.html()


def compare(*folders: str | Path) -> Comparison:
    """Put runs and sweeps side by side.

    Args:
        folders: Folders of runs and of sweeps.

    Raises:
        UserError: A folder is neither, has no evaluation yet, or its task is judged by something else.

    >>> import tempfile
    >>> from arm5dof import compare, load_config, train
    >>> folder = tempfile.TemporaryDirectory()
    >>> budget = {"episodes": 2, "num_envs": 2, "evaluate_every": 2, "checkpoint_every": 2, "updates_per_step": 1}
    >>> config = load_config("kinematic.toml", targets=100, refinements=1, **budget)  # Seconds: far from enough.
    >>> found = compare(train(config, f"{folder.name}/one").folder)  # Or several, and sweeps.
    >>> found.table.header
    ('of', 'seeds', 'episodes', 'updates', 'seconds', 'one_shot, mm, lower is better')
    """
    if not folders:
        raise UserError("compare takes folders of runs and sweeps")
    headline: Headline | None = None
    curves: dict[str, Sequence[Mapping[str, Any]]] = {}
    for path in map(Path, folders):
        judged, found = _curves(path)
        if headline is not None and judged != headline:
            raise UserError(f"{path} is judged by {judged.label}, and {folders[0]} by {headline.label}")
        headline = judged
        for label, rows in found.items():
            if label in curves:
                raise UserError(f"{label} is named twice")
            if not any(row.get("headline") is not None for row in rows):
                continue
            curves[label] = rows
        if not any(label in curves for label in found):
            raise UserError(f"{path} has no evaluation yet: resume it")
    assert headline is not None
    return Comparison(headline, curves)


def _most(rows: Sequence[Mapping[str, Any]], name: str) -> str:
    """The greatest of what rows have; nothing is known of a run's seconds once its metrics are lost."""
    known = [row[name] for row in rows if row[name] is not None]
    return f"{max(known):g}" if known else "-"


def _curves(path: Path) -> tuple[Headline, figures.Curves]:
    """What a folder is judged by, and its curves by label."""
    if (path / "sweep.json").is_file():
        opened = Sweep.open(path)
        rows = opened.table
        return opened.headline, figures.curves(rows, opened.summary(rows), f"{path}: ")
    if not (path / "run.json").is_file():
        raise UserError(f"{path} is neither a run nor a sweep: give folders that arm5dof train or sweep left")
    run = Run.open(path)
    headline = Headline.of(run.config)
    member = Member(path.name, {SEED: run.config.train.seed}, run.config)
    rows = results.member_rows(path.absolute().parent, member, "", headline)
    return headline, {str(path): [{**row, "status": DONE} for row in rows]}
