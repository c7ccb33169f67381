"""Training the shipped detector from nothing: scenes are drawn, the proposer learns from windows of them, and then the
refiner from what the proposer proposes in them."""

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
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optax.contrib
from flax import linen as nn
from flax import struct

from arm5dof.errors import UserError
from arm5dof.runtime import files, xla
from arm5dof.runtime.progress import Bar
from arm5dof.vision.detectors.tabletop.detector import propose, save_weights
from arm5dof.vision.detectors.tabletop.networks import CROP, Proposer, Refiner, cells, fold
from arm5dof.vision.detectors.tabletop.training import assignment, crops, training_set
from arm5dof.vision.detectors.tabletop.training.assignment import Losses
from arm5dof.vision.detectors.tabletop.training.crops import Candidates
from arm5dof.vision.detectors.tabletop.training.training_set import WINDOW, TrainingSet, render
from arm5dof.vision.objects import CLASS_NAMES

T = TypeVar("T")
WINDOWS, CROPS = 32, 128
"""In an update of the proposer, and of the refiner."""
UNLIKELY = 0.02
"""The refiner learns from proposals at least so likely."""
LOG_EVERY = 100
WARM_UP = 200
"""Steps over which the learning rate rises."""
RATE, DECAY = 8e-3, 0.005
"""Learning rate of Muon (Jordan et al., 2024), after the warm-up, and weight decay. The former falls along half a
cosine."""
SLOWER = 0.25
"""What has no matrices learns by Adam, at this share of the rate."""
FINAL = 0.01
"""Share of the learning rate at the end."""
CLIP = 10.0
"""Longest gradient."""
MEMORY = 0.995
"""The weights kept are an average over some 200 steps, fewer at the start (Tarvainen and Valpola, 2017)."""


@dataclass(frozen=True)
class Budget:
    """What a training takes. Raises `UserError` for what makes no training."""

    seed: int = 0
    """Of all random numbers: same seed and machine, same bits."""
    scenes: int = 3500
    """Pictures drawn."""
    proposer_steps: int = 5500
    """Updates of the proposer's weights, each from 32 windows of pictures."""
    refiner_steps: int = 5000
    """Updates of the refiner's weights, each from 128 crops."""

    def __post_init__(self) -> None:
        for name, least in (("seed", 0), ("scenes", 1), ("proposer_steps", 1), ("refiner_steps", 1)):
            if getattr(self, name) < least:
                raise UserError(f"{name} is {least} or more, not {getattr(self, name)}")


def _matrices(params: Any) -> Any:
    """Which parameters are matrices: those of convolutions too, from all that goes in to what comes out."""

    def kind(x: jax.Array) -> Any:
        return optax.contrib.MuonDimensionNumbers(tuple(range(x.ndim - 1)), x.ndim - 1) if x.ndim > 1 else None

    return jax.tree.map(kind, params)


class State(struct.PyTreeNode):
    """A network as it is and on average, and the optimiser's memory."""

    variables: dict[str, Any]
    average: dict[str, Any]
    optimiser: optax.OptState
    steps: jax.Array


class Learner:
    """The compiled update of a network. `state` is all that there is to a training.

    loss:    of one picture, from what the network answers and what it should have answered
    example: what the network takes
    """

    def __init__(
        self, network: nn.Module, loss: Callable[..., Losses], example: tuple[np.ndarray, ...], steps: int, seed: int
    ) -> None:
        warm_up = min(WARM_UP, steps // 2)
        self.rate = optax.warmup_cosine_decay_schedule(0.0, RATE, warm_up, steps, RATE * FINAL)
        muon = optax.contrib.muon(
            self.rate,
            weight_decay=DECAY,
            adam_weight_decay=DECAY / SLOWER,
            adam_learning_rate=lambda step: SLOWER * self.rate(step),
            consistent_rms=0.2,
            muon_weight_dimension_numbers=_matrices,
        )
        self._optimiser = optax.chain(optax.clip_by_global_norm(CLIP), muon)
        self._network, self._loss, self._example = network, loss, example
        self._step = jax.jit(self._update, donate_argnums=0, compiler_options=xla.fusion_emitters())
        self._first = jax.jit(self._start, compiler_options=xla.effort(0))
        self.restart(seed)

    def restart(self, seed: int) -> None:
        """Forget everything."""
        self.state = self._first(jax.random.key(seed))

    def step(self, given: tuple[np.ndarray, ...], wanted: tuple[Any, ...]) -> dict[str, jax.Array]:
        """Learn from what the network is given and what it should answer. Returns the parts of the loss."""
        self.state, parts = self._step(self.state, given, wanted)
        return parts

    def weights(self) -> dict[str, Any]:
        """Average weights, folded."""
        average = jax.device_get(self.state.average)
        return fold(average["params"], average["batch_stats"])

    def _start(self, key: jax.Array) -> State:
        variables = dict(self._network.init(key, *self._example))
        return State(variables, variables, self._optimiser.init(variables["params"]), jnp.zeros((), int))

    def _update(self, state: State, given: Any, wanted: Any) -> tuple[State, dict[str, jax.Array]]:
        def loss(params: dict[str, Any]) -> tuple[jax.Array, Any]:
            variables = {**state.variables, "params": params}
            answers, seen = self._network.apply(variables, *given, mutable=["batch_stats"])
            parts = Losses(*(part.sum() for part in jax.vmap(self._loss)(*answers, *wanted)))
            return parts.total(), (parts, seen)

        params = state.variables["params"]
        grads, (parts, seen) = jax.grad(loss, has_aux=True)(params)
        updates, optimiser = self._optimiser.update(grads, state.optimiser, params)
        variables = {"params": optax.apply_updates(params, updates), **seen}
        memory = jnp.minimum(MEMORY, (1 + state.steps) / (10 + state.steps))
        average = optax.incremental_update(variables, state.average, 1 - memory)
        worth = jnp.maximum(parts.worth, 1.0)
        report = {name: getattr(parts, name) / worth for name in ("classification", "localisation", "closeness")}
        return State(variables, average, optimiser, state.steps + 1), report


def train(out: Path, budget: Budget, workers: int | None = None) -> None:
    """Draw, learn, and leave in the new folder `out`:

    metrics.csv    for each network: steps, learning rate, and the parts of the loss, means since the last line
    weights.npz    for `TabletopDetector`
    training.json  the budget, and the seconds that drawing and learning took: written last

    Meanwhile it takes 1.2 MB a scene on the disk. Raises `UserError` if `out` exists.
    """
    if out.exists():
        raise UserError(f"{out} exists: choose another --out")
    out.mkdir(parents=True)
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix=".pictures-", dir=out) as folder:
        with Bar("drawing", budget.scenes, "scenes") as bar:
            data = render(Path(folder), budget.scenes, budget.seed, bar.update, workers)
        drawn = time.monotonic()
        learn(data, budget, out)
    seconds = {"drawing_s": round(drawn - started, 1), "learning_s": round(time.monotonic() - drawn, 1)}
    files.write_text(out / "training.json", json.dumps({**asdict(budget), **seconds}, indent=2) + "\n")


def learn(data: TrainingSet, budget: Budget, out: Path) -> None:
    """Learn from a training set; writes `weights.npz` and `metrics.csv` into the folder `out`."""
    log = Log(out / "metrics.csv")
    proposer = learn_to_propose(data, budget, log)
    found = proposals(data, proposer)
    refiner = learn_to_refine(data, found, budget, log)
    save_weights(out / "weights.npz", {"proposer": proposer, "refiner": refiner}, CLASS_NAMES)


def learn_to_propose(data: TrainingSet, budget: Budget, log: Log) -> dict[str, Any]:
    """The weights of the proposer."""
    loss = partial(assignment.proposed, middles=cells(WINDOW, WINDOW))
    example = (np.zeros((1, WINDOW, WINDOW, 3), np.uint8),)
    learner = Learner(Proposer(training=True), loss, example, budget.proposer_steps, budget.seed)
    make = lambda step: training_set.batch(data, (budget.seed, 0, step), WINDOWS)
    return _learn(learner, make, budget.proposer_steps, "proposer", log)


def learn_to_refine(data: TrainingSet, found: Candidates, budget: Budget, log: Log) -> dict[str, Any]:
    """The weights of the refiner."""
    example = np.zeros((1, CROP, CROP, 3), np.uint8), np.ones(1, np.float32)
    network = Refiner(len(CLASS_NAMES), training=True)
    learner = Learner(network, assignment.refined, example, budget.refiner_steps, budget.seed)
    make = lambda step: crops.batch(data, found, (budget.seed, 1, step), CROPS)
    return _learn(learner, make, budget.refiner_steps, "refiner", log)


def proposals(data: TrainingSet, weights: dict[str, Any]) -> Candidates:
    """What the proposer proposes in the pictures that it has learnt from."""
    some = []
    with Bar("proposing", len(data.pictures), "scenes") as bar:
        for scene, picture in enumerate(data.pictures):
            some.append(crops.candidates(data, scene, *propose(weights, picture, UNLIKELY)))
            bar.update(scene + 1)
    return Candidates(*(np.concatenate([getattr(one, name) for one in some]) for name in asdict(some[0])))


def _learn(learner: Learner, make: Callable[[int], tuple[Any, Any]], steps: int, name: str, log: Log) -> dict[str, Any]:
    """The network's weights after so many steps; `make` gives what to learn from in each."""
    parts: list[dict[str, jax.Array]] = []
    with Bar(f"learning: {name}", steps, "steps") as bar, ahead(make, steps) as batches:
        for step, given in enumerate(batches, 1):
            parts.append(learner.step(*given))
            if step % LOG_EVERY == 0 or step == steps:
                means = {part: float(np.mean([one[part] for one in parts])) for part in parts[0]}
                if not np.isfinite(list(means.values())).all():
                    raise UserError(f"the {name}'s loss is no longer finite after {step} steps: draw more scenes")
                log.write(network=name, step=step, learning_rate=float(learner.rate(step - 1)), **means)
                parts.clear()
                bar.update(step, f"loss {sum(means.values()):.3f}")
    return learner.weights()


class Log:
    """A CSV file that is complete at any time."""

    def __init__(self, path: Path) -> None:
        self._path, self._rows, self._started = path, list[dict[str, Any]](), time.monotonic()

    def write(self, **row: Any) -> None:
        """Add a row."""
        numbers = {name: f"{v:.6g}" if isinstance(v, float) else v for name, v in row.items()}
        self._rows.append({"seconds": round(time.monotonic() - self._started, 1), **numbers})
        text = io.StringIO()
        writer = csv.DictWriter(text, self._rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(self._rows)
        files.write_text(self._path, text.getvalue())


@contextmanager
def ahead(make: Callable[[int], T], count: int) -> Iterator[Iterator[T]]:
    """What `make` gives for 1 to `count`, each made while the one before is used."""

    def ordered() -> Iterator[T]:
        next_ = thread.submit(make, 1)
        for step in range(1, count + 1):
            ready = next_.result()
            next_ = thread.submit(make, step + 1)
            yield ready

    with ThreadPoolExecutor(1) as thread:
        yield ordered()
