"""Ours and the peers, one after the other on this machine: time and transitions to 95.5 % within 10 mm.

    python experiments/peers/compare.py --peers-python PATH [--seeds 3] [--minutes 5] [--only sbx-TD3 ...] [--again]

Runs in our own environment; `--peers-python` is the interpreter of the peers' (requirements.txt). Learning curves are
left in experiments/results/peers/*.csv, and those that are there already are not run again; the table and the figure,
experiments/results/peers.md and peers.png, are made from all of them.
"""

from __future__ import annotations

import argparse
import csv
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from peer import SETTINGS
from task import BAR

from arm5dof.training.report import BLUE, INK, ORANGE, STYLE

HERE = Path(__file__).parent
RESULTS = HERE.parent / "results"
CURVES = RESULTS / "peers"

STATE = ["critic_input=state", "critic_form=distance", "critic_lr=3e-3", "critic_width=128", "critic_depth=3"]
"""A critic that sees joint angles and action, no more than the peers' do: it has to learn the arm's kinematics."""
OURS = {
    "ours-cold": [],
    "ours-warm": [],
    "ours-state": ["--episodes=100", "--num-envs=50", "--set", *STATE],
}
COLOURS = {"ours": ORANGE, "sbx": BLUE, "rejax": "#3a8f5c", "brax": "#8a5ab5"}
DASHES = {"TD3": "-", "SAC": "--", "DDPG": ":", "cold": "-", "warm": "--", "state": ":"}

Curve = dict[str, np.ndarray]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peers-python", default="", help="the interpreter of the peers' environment")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--minutes", type=float, default=5, help="a peer's budget")
    parser.add_argument("--only", nargs="*", choices=[*OURS, *SETTINGS], default=[*OURS, *SETTINGS])
    parser.add_argument("--again", action="store_true", help="run what is there already, too")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as cache:
        for seed in range(arguments.seeds):
            for name in arguments.only:
                if arguments.again or not curve_file(name, seed).exists():
                    train(name, seed, arguments, Path(cache))
    curves = {name: found for name in [*OURS, *SETTINGS] if (found := read(name))}
    (RESULTS / "peers.md").write_text(markdown(curves))
    with matplotlib.rc_context(STYLE):
        figure(curves).savefig(RESULTS / "peers.png")


def curve_file(name: str, seed: int) -> Path:
    return CURVES / f"{name}-{seed}.csv"


def train(name: str, seed: int, arguments: argparse.Namespace, cache: Path) -> None:
    """One run in its own process. Nobody starts with a warm compilation cache, except for `ours-warm`."""
    common = ["--out", curve_file(name, seed), "--seed", str(seed)]
    if name in OURS:
        command = [sys.executable, HERE / "ours.py", *common, *OURS[name]]
    elif arguments.peers_python:
        command = [arguments.peers_python, HERE / "peer.py", name, *common, "--minutes", str(arguments.minutes)]
    else:
        raise SystemExit(f"{name} needs --peers-python: the interpreter of an environment made from requirements.txt")
    print(f"== {name}, seed {seed}", flush=True)
    shutil.rmtree(cache)
    cache.mkdir()
    for _ in range(2 if name == "ours-warm" else 1):
        environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(cache)}
        subprocess.run(command, env=environment, check=name in OURS)


def read(name: str) -> list[Curve]:
    """All finished runs of that name, by seed."""
    curves = []
    for path in sorted(CURVES.glob(f"{name}-[0-9]*.csv")):
        with open(path, newline="") as handle:
            rows = list(csv.DictReader(handle))
        curves.append({key: np.array([float(row[key]) for row in rows]) for key in rows[0]})
    return curves


def reached(curve: Curve, column: str) -> float:
    """Seconds or transitions to the bar; infinity if it was not reached."""
    there = curve["within_10mm"] >= BAR
    return float(curve[column][there.argmax()]) if there.any() else np.inf


def markdown(curves: dict[str, list[Curve]]) -> str:
    """Medians over seeds, in brackets the best and the worst seed, and how many times ours is ahead of each."""
    need = {
        name: {c: [reached(r, c) for r in runs] for c in ("seconds", "transitions")} for name, runs in curves.items()
    }
    lines = [
        f"# Peers: time and transitions to {BAR:g} % of 10,000 targets within 10 mm by one answer",
        "",
        f"Command: `python experiments/peers/compare.py`. {os.cpu_count()} x {platform.machine()} CPU. Seconds since",
        "the start of the process, imports and compilation included, measurements excluded. Median of the seeds, in",
        "brackets the best and the worst; `-`: not reached in the time a peer was given, which its best share shows.",
        "Times ours: as much as `ours-cold` needs.",
        "",
        "| | seeds | seconds | times ours | transitions | times ours | best share |",
        "| --- | ---: |" + " ---: |" * 5,
    ]
    for name, runs in curves.items():
        cells = []
        for column in ("seconds", "transitions"):
            values = np.array(need[name][column])
            cells.append(f"{show(np.median(values))} ({show(values.min())} to {show(values.max())})")
            ours = np.median(need["ours-cold"][column]) if "ours-cold" in need else np.nan
            cells.append(times(runs, column, values, ours))
        best = max(runs, key=lambda run: run["within_10mm"].max())
        at = best["within_10mm"].argmax()
        share = f"{best['within_10mm'][at]:.2f} % at {best['seconds'][at]:.0f} s"
        lines.append(f"| {name} | {len(runs)} | {' | '.join(cells)} | {share} |")
    return "\n".join(lines) + "\n"


def show(value: float) -> str:
    return f"{value:.4g}" if value < 1e4 else f"{value:,.0f}" if np.isfinite(value) else "-"


def times(runs: list[Curve], column: str, values: np.ndarray, ours: float) -> str:
    """How many times as much as ours; at least as much as was spent where the bar was not reached."""
    if np.isfinite(np.median(values)):
        return f"{np.median(values) / ours:.1f}"
    return f"> {np.median([run[column][-1] for run in runs]) / ours:.1f}"


def figure(curves: dict[str, list[Curve]]) -> Figure:
    """Accuracy against wall clock and against transitions, all seeds."""
    chart = Figure(figsize=(11, 4.4), layout="constrained")
    FigureCanvasAgg(chart)
    left, right = chart.subplots(1, 2, sharey=True)
    for axes, column, label in ((left, "seconds", "seconds since the start"), (right, "transitions", "transitions")):
        for name, runs in curves.items():
            library, kind = name.split("-")
            for k, run in enumerate(runs):
                style = {"color": COLOURS[library], "ls": DASHES[kind], "lw": 2 if library == "ours" else 1.3}
                axes.plot(run[column], run["within_10mm"], alpha=0.85, label=None if k else name, **style)
        axes.axhline(BAR, color=INK, lw=0.8, ls=(0, (1, 2)))
        axes.set_xscale("log")
        axes.set_xlabel(label)
    left.set_ylabel("targets within 10 mm, %")
    left.set_title(f"One answer, 10,000 targets; dotted: {BAR:g} %", loc="left", color=INK)
    right.legend(frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
    return chart


if __name__ == "__main__":
    main()
