"""What a table says: right answers known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from arm5dof.envs.metrics import Error, Score
from arm5dof.sweeps import figures, results
from arm5dof.sweeps.summary import Headline, curve, estimate, summarise, table


def row(member, lr, seed, headline, status="done", episodes=10):
    return {
        **{"member": member, "ddpg.actor_lr": lr, "train.seed": seed},
        **{"status": status, "episodes": episodes, "headline": headline},
    }


ROWS = [
    row("m0", 1e-3, 0, 9.0, episodes=5),
    row("m0", 1e-3, 0, 4.0),
    row("m1", 1e-3, 1, 2.0),
    row("m2", 1e-2, 0, 5.0),
    row("m3", 1e-2, 1, 6.0),
    row("m4", 1e-1, 0, 1.0),
    row("m5", 1e-1, 1, None, "diverged"),
]
NAMES = ["ddpg.actor_lr", "train.seed"]


def test_the_interquartile_mean_leaves_out_a_quarter_at_either_end():
    assert estimate([0, 1, 2, 3, 4, 5, 6, 1000]).value == np.mean([2, 3, 4, 5])
    assert estimate([3.0]) == (3.0, pytest.approx(math.nan, nan_ok=True), pytest.approx(math.nan, nan_ok=True))
    assert math.isnan(estimate([]).value)


def test_the_interval_holds_the_truth_as_often_as_it_says():
    """95 % is what large samples would have; of eight values the bootstrap is known to be a little narrow."""
    rng = np.random.default_rng(0)
    found = [estimate(rng.normal(size=8)) for _ in range(200)]
    assert 0.80 < np.mean([e.low <= 0 <= e.high for e in found]) < 0.98
    assert estimate([1, 2, 3, 4], seed=5) == estimate([1, 2, 3, 4], seed=5)


@pytest.mark.parametrize(("higher", "order"), [(False, [1e-3, 1e-2, 1e-1]), (True, [1e-2, 1e-3, 1e-1])])
def test_the_best_comes_first_and_those_that_lost_members_last(higher, order):
    lines = summarise(ROWS, higher, NAMES)
    assert [line.settings["ddpg.actor_lr"] for line in lines] == order
    by_lr = {line.settings["ddpg.actor_lr"]: line for line in lines}
    assert by_lr[1e-3].headline.value == 3.0 and (by_lr[1e-3].seeds, by_lr[1e-3].lost) == (2, 0)
    assert by_lr[1e-3].best == ("m0" if higher else "m1")
    assert (by_lr[1e-1].seeds, by_lr[1e-1].lost, by_lr[1e-1].best) == (1, 1, "m4")


def test_a_curve_is_over_members_at_the_same_episode():
    episodes, found = curve(ROWS[:3])
    assert episodes == [5, 10] and [e.value for e in found] == [9.0, 3.0]


def test_lines_are_a_table_for_people():
    shown = table("Sweep", summarise(ROWS, False, NAMES), Headline("one_shot", Error())).text()
    assert "one_shot, mm, lower is better" in shown and "1 of 2" in shown and "3 [2, 4]" in shown


@pytest.mark.parametrize("names", [1, 2, 3])
def test_axes_are_drawn_as_points_heat_map_or_parallel_coordinates(names):
    keys = ["ddpg.actor_lr", "ddpg.noise", "ddpg.activation"][:names]
    values = {"ddpg.actor_lr": (1e-3, 1e-2), "ddpg.noise": (0.1, 0.2), "ddpg.activation": ("relu", "gelu")}
    rows = []
    for i in range(2**names):
        chosen = {key: values[key][i >> n & 1] for n, key in enumerate(keys)}
        rows.append({"member": f"m{i}", "status": "done", "headline": float(i), "episodes": 1, **chosen})
    headline = Headline("return", Score())
    figure = figures.axes_figure(summarise(rows, True, keys), headline)
    first = figure.axes[0]
    assert (len(first.collections) > 0) == (names == 2) and len(figure.axes) == (1 if names == 1 else 2)
    assert len(first.lines) == {1: 2, 2: 0, 3: 8}[names]
    assert figures.axes_figure(summarise(rows, True, []), headline) is None


def test_a_table_is_the_same_in_both_files(tmp_path):
    from pyarrow import csv, parquet

    rows = [{"member": "m0", "mark": (1, 2), "x": 1, "y": 2.5}, {"member": "m1", "mark": (3, 4), "x": 0.5, "z": "why"}]
    results.write(tmp_path, rows)
    read = parquet.read_table(tmp_path / "results.parquet").to_pylist()
    assert read[0] == {"member": "m0", "mark": "(1, 2)", "x": 1.0, "y": 2.5, "z": None}
    assert [r["x"] for r in csv.read_csv(tmp_path / "results.csv").to_pylist()] == [1.0, 0.5]
    assert {p.name for p in tmp_path.iterdir()} == {"results.csv", "results.parquet"}
