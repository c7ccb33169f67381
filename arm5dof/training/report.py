"""What a run shows people: the paper's Figures 7 and 8, its Table 2, and a report that holds them together."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from arm5dof.runtime import files
from arm5dof.training.evaluate import table

# Drawing is imported where something is drawn: a run's first step need not wait for it.
if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from arm5dof.training.config import Config

PAPER_TABLE_2 = {
    "Min": {100: 3.0, 200: 24.0, 300: 63.0, 400: 93.0},
    "Max": {100: 22.0, 200: 61.0, 300: 89.0, 400: 98.0},
    "Mean": {100: 12.5, 200: 42.33, 300: 76.0, 400: 95.5},
}
"""The paper's Table 2: IK solver accuracy in percent after 100 to 400 episodes. It names no tolerance."""

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


def headline(config: Config) -> str:
    """The accuracy a run is judged by: the episode where the servos move the arm, one answer where they do not."""
    return "episode" if config.env.dynamics == "servo" else "one_shot"


def write(folder: Path, config: Config, rows: list[dict[str, Any]], evaluations: list[dict[str, Any]]) -> None:
    """Write the figures and `report.md` into a run's folder."""
    import matplotlib

    curve = {
        name: np.array([float(row[name]) for row in rows]) for name in ("env_steps", "distance", "policy_distance")
    }
    with matplotlib.rc_context(STYLE):  # type: ignore[arg-type]
        save(figure_7(curve, config.env.episode_length), folder / "figure_7_reward.png")
        save(figure_8(curve, config.env.episode_length, evaluations), folder / "figure_8_error.png")
    files.write_text(folder / "report.md", markdown(folder.name, config, rows, evaluations))


Curve = Mapping[str, np.ndarray] | np.ndarray
"""Columns of `metrics.csv` by name, as a dictionary or a structured array."""


def figure_7(curve: Curve, episode_length: int) -> Figure:
    """The paper's Figure 7: reward (Eq. 7) against episodes, 0 at its first value and 1 at no distance."""
    figure, axes = _axes("normalised reward")
    _plot(axes, curve, episode_length, lambda distance, first: 1 - distance / first)
    axes.set_ylim(-0.02, 1.02)
    axes.set_title("Reward (Figure 7)", loc="left", color=INK)
    axes.legend(frameon=False, loc="lower right")
    return figure


def figure_8(curve: Curve, episode_length: int, evaluations: list[dict[str, Any]]) -> Figure:
    """The paper's Figure 8: distance between end effector and object against episodes, normalised by its first
    value; and the error of one answer of the policy in millimetres, its median on unseen targets as dots."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    figure, axes = _axes("normalised error")
    _plot(axes, curve, episode_length, lambda distance, first: distance / first)
    axes.set_ylim(0, 1.05)
    axes.set_title("Distance between end effector and object (Figure 8)", loc="left", color=INK)
    right = axes.twinx()
    right.grid(False)
    right.spines["right"].set_visible(True)
    right.semilogy(curve["env_steps"] / episode_length, 1e3 * curve["policy_distance"], color=ORANGE, alpha=0.6)
    median = [e["one_shot"]["median_mm"] for e in evaluations]
    right.semilogy([e["episodes"] for e in evaluations], median, "o", color=ORANGE)
    right.set_ylabel("error of one answer, mm (dots: test median)", color=ORANGE)
    right.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    right.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    right.yaxis.set_minor_formatter(NullFormatter())
    axes.legend(frameon=False, loc="upper right")
    return figure


def _plot(axes: Any, curve: Curve, episode_length: int, normalise: Callable[..., np.ndarray]) -> None:
    """Both distances, while exploring and without noise, normalised by the first one while exploring."""
    episodes, first = curve["env_steps"] / episode_length, curve["distance"][0]
    exploring, policy = normalise(curve["distance"], first), normalise(curve["policy_distance"], first)
    axes.plot(episodes, exploring, color=BLUE, alpha=0.35, lw=1.5, label="while exploring, noise included")
    axes.plot(episodes, policy, color=BLUE, lw=2, label="the policy without noise")


def table_2(config: Config, evaluations: list[dict[str, Any]]) -> str:
    """The paper's Table 2 and, below it, this run's share within 10 mm and its normalised accuracy."""
    name, columns = headline(config), [e["episodes"] for e in evaluations]
    lines = [
        "| accuracy | " + " | ".join(f"{episodes} episodes" for episodes in columns) + " |",
        "| --- |" + " ---: |" * len(columns),
    ]
    for row, cells in PAPER_TABLE_2.items():
        lines.append(f"| paper, {row} | " + " | ".join(f"{cells[e]:g} %" if e in cells else "" for e in columns) + " |")
    ours = {
        f"**this run, within 10 mm ({name})**": [e[name]["within"]["10"] for e in evaluations],
        "this run, normalised": [e["normalised"] for e in evaluations],
    }
    lines += [f"| {row} | " + " | ".join(f"{value:.2f} %" for value in cells) + " |" for row, cells in ours.items()]
    return "\n".join(lines)


def markdown(title: str, config: Config, rows: list[dict[str, Any]], evaluations: list[dict[str, Any]]) -> str:
    """`report.md`."""
    last, final = rows[-1], evaluations[-1]
    resets = sum(float(row["nonfinite"]) for row in rows)
    return f"""# {title}

{last["episodes"]} episodes of {config.env.episode_length} steps ({last["env_steps"]} transitions),
{last["updates"]} updates, {config.env.dynamics} dynamics, seed {config.train.seed};
{float(last["seconds"]):.0f} s with compilation and evaluations on the way.
Environments reset for non-finite physics: {resets:.0f}.

## Accuracy on {final["targets"]} unseen targets

{table({name: final[name] for name in ("one_shot", "refined", "episode")})}

`one_shot`: one answer, by forward kinematics.
`refined`: asked again {config.evaluate.refinements} times with the target shifted by the error seen.
`episode`: the last step of an episode from a random pose.

## Table 2

{table_2(config, evaluations)}

The paper states no tolerance for its accuracy. "Normalised" is the share of the initial distance that is gone at the
end of an episode, on average.

![normalised reward](figure_7_reward.png)

![normalised error](figure_8_error.png)
"""


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, atomically."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    with files.replacing(path) as temporary:
        FigureCanvasAgg(figure).print_figure(str(temporary))


def _axes(label: str) -> tuple[Figure, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4.5), layout="constrained")
    axes = figure.add_subplot()
    axes.set_xlabel("episodes")
    axes.set_ylabel(label)
    return figure, axes
