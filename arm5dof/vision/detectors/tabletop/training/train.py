"""Training the shipped detector from nothing: scenes are rendered, the proposer learns from windows of them, and then
the refiner from what the proposer proposes in them."""

from __future__ import annotations

import csv
import io
import json
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, Protocol, TypeVar

import jax
import numpy as np

from arm5dof.errors import UserError
from arm5dof.runtime import files
from arm5dof.vision.detectors.tabletop.detector import propose
from arm5dof.vision.detectors.tabletop.networks import CROP, Proposer, Refiner, cell_centers
from arm5dof.vision.detectors.tabletop.training.crop_batches import Candidates, crop_batch, label_proposals
from arm5dof.vision.detectors.tabletop.training.learner import Learner
from arm5dof.vision.detectors.tabletop.training.losses import proposer_losses, refiner_losses
from arm5dof.vision.detectors.tabletop.training.training_set import TrainingSet, render_training_set
from arm5dof.vision.detectors.tabletop.training.window_batches import WINDOW, window_batch
from arm5dof.vision.detectors.tabletop.weights import save_weights
from arm5dof.vision.objects import CLASS_NAMES

T = TypeVar("T")
Stage = Literal["rendering", "proposer", "proposing", "refiner"]

WINDOWS, CROPS = 32, 128
"""In an update of the proposer, and of the refiner."""
CANDIDATE_FLOOR = 0.02
"""The refiner learns from proposals at least so likely."""
LOG_EVERY = 100


class Progress(Protocol):
    """What is called as a training goes on."""

    def __call__(self, stage: Stage, done: int, total: int, note: str = "") -> object:
        """So many of all scenes (of `rendering` and `proposing`) or updates (of `proposer` and `refiner`) are done."""


def no_progress(stage: Stage, done: int, total: int, note: str = "") -> None:
    """Tell nobody."""


@dataclass(frozen=True)
class Budget:
    """What a training takes. Raises `UserError` for what makes no training."""

    seed: int = 0
    """Of all random numbers: same seed and machine, same bits."""
    scenes: int = 3500
    """Images rendered."""
    proposer_steps: int = 5500
    """Updates of the proposer's weights, each from 32 windows of images."""
    refiner_steps: int = 5000
    """Updates of the refiner's weights, each from 128 crops."""

    def __post_init__(self) -> None:
        for name, least in (("seed", 0), ("scenes", 1), ("proposer_steps", 1), ("refiner_steps", 1)):
            if getattr(self, name) < least:
                raise UserError(f"{name} is {least} or more, not {getattr(self, name)}")


def train(out: Path, budget: Budget, progress: Progress = no_progress, workers: int | None = None) -> None:
    """Render scenes, learn, and leave in a new folder

    - `metrics.csv`: for each network steps, learning rate, and the parts of the loss, means since the last line
    - `weights.npz`: for `TabletopDetector`
    - `training.json`: the budget, and the seconds that rendering and learning took; written last.

    Args:
        out: The folder. Meanwhile it takes 1.2 MB a scene on the disk.
        budget: The seed and how much of everything.
        progress: Called as the training goes on.
        workers: Processes that render; None for one a core.

    Raises:
        UserError: The folder exists, there is nothing to find in the scenes, or the loss does not stay finite.
    """
    if out.exists():
        raise UserError(f"{out} exists: choose another folder")
    out.mkdir(parents=True)
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix=".images-", dir=out) as folder:
        rendered = partial(progress, "rendering", total=budget.scenes)
        rendered(0)
        data = render_training_set(Path(folder), budget.scenes, budget.seed, rendered, workers)
        drawn = time.monotonic()
        learn(data, budget, out, progress)
    seconds = {"drawing_s": round(drawn - started, 1), "learning_s": round(time.monotonic() - drawn, 1)}
    files.write_text(out / "training.json", json.dumps({**asdict(budget), **seconds}, indent=2) + "\n")


def learn(data: TrainingSet, budget: Budget, out: Path, progress: Progress = no_progress) -> None:
    """Learn from a training set: writes `weights.npz` and `metrics.csv` into the folder `out`."""
    log = Log(out / "metrics.csv")
    proposer = learn_to_propose(data, budget, log, progress)
    candidates = propose_candidates(data, proposer, progress)
    refiner = learn_to_refine(data, candidates, budget, log, progress)
    save_weights(out / "weights.npz", {"proposer": proposer, "refiner": refiner}, CLASS_NAMES)


def learn_to_propose(data: TrainingSet, budget: Budget, log: Log, progress: Progress = no_progress) -> dict[str, Any]:
    """The proposer's weights, batch normalization folded in."""
    losses = partial(proposer_losses, centers=cell_centers(WINDOW, WINDOW))
    example = (np.zeros((1, WINDOW, WINDOW, 3), np.uint8),)
    learner = Learner(Proposer(training=True), losses, example, budget.proposer_steps, budget.seed)
    batch = lambda step: window_batch(data, (budget.seed, 0, step), WINDOWS)
    return _learn(learner, batch, budget.proposer_steps, "proposer", log, progress)


def learn_to_refine(
    data: TrainingSet, candidates: Candidates, budget: Budget, log: Log, progress: Progress = no_progress
) -> dict[str, Any]:
    """The refiner's weights, batch normalization folded in."""
    example = np.zeros((1, CROP, CROP, 3), np.uint8), np.ones(1, np.float32)
    network = Refiner(len(CLASS_NAMES), training=True)
    learner = Learner(network, refiner_losses, example, budget.refiner_steps, budget.seed)
    batch = lambda step: crop_batch(data, candidates, (budget.seed, 1, step), CROPS)
    return _learn(learner, batch, budget.refiner_steps, "refiner", log, progress)


def propose_candidates(data: TrainingSet, weights: dict[str, Any], progress: Progress = no_progress) -> Candidates:
    """What the proposer proposes in the images that it has learned from."""
    by_scene: list[Candidates] = []
    progress("proposing", 0, len(data.images))
    for scene, image in enumerate(data.images):
        by_scene.append(label_proposals(data, scene, *propose(weights, image, CANDIDATE_FLOOR)))
        progress("proposing", scene + 1, len(data.images))
    return Candidates(*(np.concatenate([getattr(one, name) for one in by_scene]) for name in asdict(by_scene[0])))


def _learn(
    learner: Learner,
    batch: Callable[[int], tuple[Any, Any]],
    steps: int,
    name: Literal["proposer", "refiner"],
    log: Log,
    progress: Progress,
) -> dict[str, Any]:
    """The network's weights after so many steps, each from a batch."""
    parts: list[dict[str, jax.Array]] = []
    progress(name, 0, steps)
    with prefetched(batch, steps) as batches:
        for step, (inputs, targets) in enumerate(batches, 1):
            parts.append(learner.step(inputs, targets))
            if step % LOG_EVERY == 0 or step == steps:
                means = {part: float(np.mean([one[part] for one in parts])) for part in parts[0]}
                if not np.isfinite(list(means.values())).all():
                    raise UserError(f"the {name}'s loss is no longer finite after {step} steps: render more scenes")
                log.write(network=name, step=step, learning_rate=float(learner.rate(step - 1)), **means)
                parts.clear()
                progress(name, step, steps, f"loss {sum(means.values()):.3f}")
    return learner.weights()


class Log:
    """A CSV file that is complete at any time."""

    def __init__(self, path: Path) -> None:
        self._path, self._rows, self._started = path, list[dict[str, Any]](), time.monotonic()

    def write(self, **row: Any) -> None:
        """Add a row; `seconds` since the beginning come first."""
        numbers = {name: f"{v:.6g}" if isinstance(v, float) else v for name, v in row.items()}
        self._rows.append({"seconds": round(time.monotonic() - self._started, 1), **numbers})
        text = io.StringIO()
        writer = csv.DictWriter(text, self._rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(self._rows)
        files.write_text(self._path, text.getvalue())


@contextmanager
def prefetched(make: Callable[[int], T], count: int) -> Iterator[Iterator[T]]:
    """What `make` returns for 1 to `count`, each made while the one before is used."""

    def in_order() -> Iterator[T]:
        upcoming = thread.submit(make, 1)
        for step in range(1, count + 1):
            ready = upcoming.result()
            upcoming = thread.submit(make, step + 1)
            yield ready

    with ThreadPoolExecutor(1) as thread:
        yield in_order()
