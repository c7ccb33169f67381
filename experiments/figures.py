"""The paper's Figures 7 and 8 and its Table 2, from a run of the reach task.

python experiments/figures.py runs/reach         figure_7_reward.png and figure_8_error.png in the run's folder
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from arm5dof import Run
from arm5dof.training.report import BLUE, INK, ORANGE, STYLE, axes_over_episodes, save

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAPER_TABLE_2 = {
    "Min": {100: 3.0, 200: 24.0, 300: 63.0, 400: 93.0},
    "Max": {100: 22.0, 200: 61.0, 300: 89.0, 400: 98.0},
    "Mean": {100: 12.5, 200: 42.33, 300: 76.0, 400: 95.5},
}
"""The paper's Table 2: IK solver accuracy in percent after 100 to 400 episodes. It names no tolerance."""


def main() -> None:
    import matplotlib

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run_folder", type=Path, metavar="RUN")
    run = Run.open(parser.parse_args().run_folder)
    with matplotlib.rc_context(STYLE):  # type: ignore[arg-type]
        save(figure_7(run), run.folder / "figure_7_reward.png")
        save(figure_8(run), run.folder / "figure_8_error.png")
    print(table_2(run))


def figure_7(run: Run) -> Figure:
    """The paper's Figure 7: reward (Eq. 7) against episodes, 0 at its first value and 1 at no distance."""
    figure, axes = axes_over_episodes("normalised reward")
    _plot(axes, run, lambda distance, first: 1 - distance / first)
    axes.set_ylim(-0.02, 1.02)
    axes.set_title("Reward (Figure 7)", loc="left", color=INK)
    axes.legend(frameon=False, loc="lower right")
    return figure


def figure_8(run: Run) -> Figure:
    """The paper's Figure 8: distance between end effector and object against episodes, normalised by its first
    value; and the error of one answer of the policy in millimetres, its median on unseen targets as dots."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    figure, axes = axes_over_episodes("normalised error")
    _plot(axes, run, lambda distance, first: distance / first)
    axes.set_ylim(0, 1.05)
    axes.set_title("Distance between end effector and object (Figure 8)", loc="left", color=INK)
    right = axes.twinx()
    right.grid(False)
    right.spines["right"].set_visible(True)
    right.semilogy(_episodes(run), 1e3 * np.array(run.metrics["policy_distance"]), color=ORANGE, alpha=0.6)
    median = [e["one_shot"]["median_mm"] for e in run.evaluations]
    right.semilogy([e["episodes"] for e in run.evaluations], median, "o", color=ORANGE)
    right.set_ylabel("error of one answer, mm (dots: test median)", color=ORANGE)
    right.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    right.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    right.yaxis.set_minor_formatter(NullFormatter())
    axes.legend(frameon=False, loc="upper right")
    return figure


def table_2(run: Run) -> str:
    """The paper's Table 2 and, below it, this run's share within 10 mm and its normalised accuracy: the share of the
    initial distance that is gone at the end of an episode, on average."""
    name, evaluations = run.env.headline, run.evaluations
    columns = [e["episodes"] for e in evaluations]
    lines = [
        "| accuracy | " + " | ".join(f"{episodes} episodes" for episodes in columns) + " |",
        "| --- |" + " ---: |" * len(columns),
    ]
    for row, cells in PAPER_TABLE_2.items():
        lines.append(f"| paper, {row} | " + " | ".join(f"{cells[e]:g} %" if e in cells else "" for e in columns) + " |")
    ours = {
        f"**this run, within 10 mm ({name})**": [e[name]["within"]["10"] for e in evaluations],
        "this run, normalised": [normalised(e) for e in evaluations],
    }
    lines += [f"| {row} | " + " | ".join(f"{value:.2f} %" for value in cells) + " |" for row, cells in ours.items()]
    return "\n".join(lines)


def normalised(evaluation: dict[str, Any]) -> float:
    """Share of the initial distance that is gone at the end of an episode, on average, percent. The paper gives no
    tolerance; this is the reading that its Figure 8 of normalised errors suggests."""
    return 100 * (1 - evaluation["means"]["episode"] / evaluation["means"]["initial"])


def _episodes(run: Run) -> np.ndarray:
    return np.array(run.metrics["env_steps"]) / run.env.episode_length


def _plot(axes: Any, run: Run, normalise: Callable[..., np.ndarray]) -> None:
    """Both distances, while exploring and without noise, normalised by the first one while exploring."""
    distance, policy = (np.array(run.metrics[name]) for name in ("distance", "policy_distance"))
    exploring, without_noise = normalise(distance, distance[0]), normalise(policy, distance[0])
    axes.plot(_episodes(run), exploring, color=BLUE, alpha=0.35, lw=1.5, label="while exploring, noise included")
    axes.plot(_episodes(run), without_noise, color=BLUE, lw=2, label="the policy without noise")


if __name__ == "__main__":
    main()
