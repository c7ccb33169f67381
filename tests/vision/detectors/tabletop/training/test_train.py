"""A training goes through its stages, tells how far it is, and leaves its files."""

import csv
import json

import numpy as np
import pytest
from helpers.tabletop_weights import zeros

from arm5dof.errors import UserError
from arm5dof.vision.detectors.tabletop.training import train as training
from arm5dof.vision.detectors.tabletop.training.train import Budget, prefetched, train
from arm5dof.vision.detectors.tabletop.weights import load_weights
from arm5dof.vision.objects import CLASS_NAMES


class Learns:
    """Stands for a `Learner`: its loss is what it is told to be, and its weights are zeros."""

    loss = 0.5

    def __init__(self, network, losses, example, steps, seed):
        self._name = type(network).__name__.lower()
        self.rate = lambda step: 0.1

    def step(self, inputs, targets):
        return {"classification": self.loss, "localisation": 0.25, "closeness": 0.0}

    def weights(self):
        return zeros(self._name)


@pytest.fixture
def learns(monkeypatch):
    monkeypatch.setattr(training, "Learner", Learns)
    monkeypatch.setattr(training, "CLASS_NAMES", ("a", "b", "c"))
    monkeypatch.setattr(training, "LOG_EVERY", 2)


def test_stages_and_files(learns, tmp_path):
    told = []
    budget = Budget(seed=0, scenes=3, proposer_steps=5, refiner_steps=4)
    train(tmp_path / "out", budget, lambda stage, done, total, note="": told.append((stage, done, total, note)), 1)
    assert list(dict.fromkeys(stage for stage, *_ in told)) == ["rendering", "proposer", "proposing", "refiner"]
    for stage, total in {"rendering": 3, "proposer": 5, "proposing": 3, "refiner": 4}.items():
        done = [d for s, d, t, _ in told if s == stage and t == total]
        assert done[0] == 0 and done == sorted(done) and done[-1] == total
    assert told[-1][3] == "loss 0.750"

    assert {path.name for path in (tmp_path / "out").iterdir()} == {"metrics.csv", "training.json", "weights.npz"}
    rows = list(csv.DictReader((tmp_path / "out" / "metrics.csv").open()))
    assert [(row["network"], row["step"]) for row in rows] == [
        *[("proposer", step) for step in "245"],
        *[("refiner", step) for step in "24"],
    ]
    assert {"seconds", "learning_rate", "classification", "localisation", "closeness"} < set(rows[0])
    record = json.loads((tmp_path / "out" / "training.json").read_text())
    assert record["scenes"] == 3 and record["drawing_s"] > 0 and record["learning_s"] >= 0
    assert load_weights(tmp_path / "out" / "weights.npz")[1] == ("a", "b", "c") != CLASS_NAMES
    with pytest.raises(UserError, match="exists: choose another folder"):
        train(tmp_path / "out", budget)


def test_a_loss_that_is_not_finite_ends_it(learns, tmp_path, monkeypatch):
    monkeypatch.setattr(Learns, "loss", np.nan)
    with pytest.raises(UserError, match="proposer's loss is no longer finite after 2 steps"):
        train(tmp_path / "out", Budget(scenes=3, proposer_steps=5, refiner_steps=4), workers=1)


def test_prefetching_keeps_the_order():
    with prefetched(lambda step: step**2, 4) as squares:
        assert list(squares) == [1, 4, 9, 16]
