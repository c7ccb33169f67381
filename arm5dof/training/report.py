"""What a run shows people: how it learnt, as a figure, and a report with what was measured."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import TYPE_CHECKING, Any

from arm5dof.envs import Task
from arm5dof.runtime import files
from arm5dof.training.evaluate import tables

# Drawing is imported where something is drawn: a run's first step need not wait for it.
if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from arm5dof.training.config import Config

INK, BLUE, ORANGE = "#22252b", "#2a6fb0", "#e8722c"
STYLE: dict[str, Any] = {
    "font.size": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "savefig.dpi": 150,
}


def write(
    folder: Path, config: Config, env: Task, rows: list[dict[str, Any]], evaluations: list[dict[str, Any]]
) -> None:
    """Write `learning.png` and `report.md` into a run's folder.

    Args:
        folder: The run's folder.
        config: Its configuration.
        env: Its environment.
        rows: The rows of `metrics.csv`.
        evaluations: What was measured on the way and at the end.
    """
    import matplotlib

    with matplotlib.rc_context(STYLE):  # type: ignore[arg-type]
        save(learning(env, rows, evaluations), folder / "learning.png")
    files.write_text(folder / "report.md", markdown(folder.name, config, env, rows, evaluations))


def learning(env: Task, rows: list[dict[str, Any]], evaluations: list[dict[str, Any]]) -> Figure:
    """Mean reward of each epoch against episodes, exploration included; and the task's headline on unseen targets."""
    figure, axes = axes_over_episodes("mean reward of a step, exploration included")
    episodes = [float(row["env_steps"]) / env.episode_length for row in rows]
    axes.plot(episodes, [float(row["reward"]) for row in rows], color=BLUE, lw=1.5)
    metric = env.metrics[env.headline]
    right = axes.twinx()
    right.grid(False)
    right.spines["right"].set_visible(True)
    values = [metric.number(e[env.headline]) for e in evaluations]
    right.plot([e["episodes"] for e in evaluations], values, "o-", color=ORANGE, alpha=0.8)
    right.set_ylabel(
        f"{env.headline}, unseen targets {f'({metric.unit})' if metric.unit else ''}".strip(), color=ORANGE
    )
    axes.set_title("Learning", loc="left", color=INK)
    return figure


def markdown(
    title: str, config: Config, env: Task, rows: list[dict[str, Any]], evaluations: list[dict[str, Any]]
) -> str:
    """`report.md`."""
    final, seconds = evaluations[-1], f"{float(rows[-1]['seconds']):.0f} s" if rows else "an unknown time"
    resets = sum(float(row["nonfinite"]) for row in rows)
    settings = "\n".join(f"| {name} | {value} |" for name, value in config.flat().items())
    explained = inspect.getdoc(env.evaluate) or ""
    return f"""# {title}

Task {config.task}: {final["episodes"]} episodes of {env.episode_length} steps ({final["env_steps"]} transitions),
{final["updates"]} updates, seed {config.train.seed};
{seconds} with compilation and evaluations on the way.
Environments reset for non-finite physics: {resets:.0f}.

## Measured on {final["targets"]} unseen targets

{tables(env.metrics, final)}

{explained}

![learning](learning.png)

## Settings

| setting | value |
| --- | --- |
{settings}
"""


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, atomically."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    with files.replacing(path) as temporary:
        FigureCanvasAgg(figure).print_figure(str(temporary))


def axes_over_episodes(label: str) -> tuple[Figure, Any]:
    """A figure and its axes, episodes to the right."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4.5), layout="constrained")
    axes = figure.add_subplot()
    axes.set_xlabel("episodes")
    axes.set_ylabel(label)
    return figure, axes
