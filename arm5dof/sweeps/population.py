"""Members of one program shape side by side in one program: `jax.vmap` over seeds and the agent's numbers. It pays on a
GPU; on a CPU a batch of small matrix products is slower than one after the other. What a member leaves behind is a run
folder like any other; its numbers are those of training it alone within the reordering of sums."""

from __future__ import annotations

import functools
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from arm5dof.ddpg import Training
from arm5dof.runtime import xla
from arm5dof.sweeps.worker import DIVERGED, DONE, Ending, finish
from arm5dof.training import curves, report, trainer
from arm5dof.training.checkpoint import Checkpoints
from arm5dof.training.config import Config
from arm5dof.training.evaluate import evaluate_together
from arm5dof.training.loggers import Log, Logger, logging, make_loggers
from arm5dof.training.policy import Policy
from arm5dof.training.run import Run
from arm5dof.training.trainer import Counters, Trainer

SAVE_EVERY_S = 60.0
"""Seconds between checkpoints on the way: those of many members take longer than a GPU takes to train them on."""


class Population:
    """Trainings of one program shape in step, one entry of a leading axis each.

    Args:
        program: The training program of any of them.
        settings: Their configurations, which differ by the agent's numbers and the seed alone.
    """

    state: Training

    def __init__(self, program: Trainer, settings: Sequence[Config]) -> None:
        self.program, self.settings = program, settings
        self._numbers = jax.tree.map(lambda *x: jnp.array(x, jnp.float32), *(s.ddpg for s in settings))
        self._keys = jnp.stack([jax.random.key(s.train.seed) for s in settings])
        self._init, self._epoch, self._watched = _programs(program)

    def start(self) -> None:
        """Begin new trainings."""
        self.state = self._init(self._numbers, self._keys)

    def restore(self, states: Sequence[Training]) -> None:
        """Go on from states that all have taken the same steps."""
        self.state = jax.tree.map(lambda *x: jnp.stack(x), *states)

    def advance(self) -> list[dict[str, float]]:
        """One epoch. Returns the metrics of each; see `Trainer.advance`."""
        self.state, metrics = self._epoch(self._numbers, self.state)
        found = jax.device_get({**metrics, **self._watched(self.policies(), self._keys)})
        return [{name: float(values[i]) for name, values in found.items()} for i in range(len(self.settings))]

    def policies(self) -> Policy:
        """All policies, with a leading axis."""
        return Policy(self.program.env, self.program.agent, self._numbers, self.state.networks)

    def evaluate(self, targets: int) -> list[dict[str, Any]]:
        """Measure each policy."""
        return evaluate_together(self.policies(), targets, [s.train.seed for s in self.settings])

    def members(self) -> Iterator[Training]:
        """The states of all, one after the other, brought from the device at once."""
        state = jax.device_get(self.state)
        return (jax.tree.map(lambda x, i=i: x[i], state) for i in range(len(self.settings)))

    @property
    def counters(self) -> Counters:
        """How far each is."""
        steps, updates = int(self.state.steps[0]), int(self.state.updates[0])
        env_steps = steps * self.settings[0].train.num_envs
        return Counters(steps, env_steps // self.program.env.episode_length, env_steps, updates)


@functools.lru_cache(1)
def _programs(program: Trainer) -> tuple[Any, Any, Any]:
    """`init`, `epoch` and `watch` of many, kept from chunk to chunk."""
    steps, agent, env = program.config.train.epoch_steps, program.agent, program.env

    def watched(policy: Policy, key: jax.Array) -> dict[str, jax.Array]:
        return env.watch(policy, jax.random.fold_in(key, trainer.WATCHED))

    def epoch(numbers: Any, state: Training) -> tuple[Training, dict[str, jax.Array]]:
        return agent.epoch(numbers, state, steps)

    return (
        jax.jit(jax.vmap(agent.init), compiler_options=xla.effort(0)),
        jax.jit(jax.vmap(epoch), donate_argnums=1, compiler_options=xla.effort(2)),
        jax.jit(jax.vmap(watched)),
    )


class _Folder(NamedTuple):
    """A member and what its run folder gets."""

    name: str
    run: Run
    checkpoints: Checkpoints
    rows: list[dict[str, Any]]
    evaluations: list[dict[str, Any]]
    loggers: list[Logger]


def train_together(
    program: Trainer, folder: Path, members: Sequence[tuple[str, Config]], loggers: Sequence[str] = ()
) -> None:
    """Train members to their end, from their newest checkpoints if they have some, and leave how each ended.

    Args:
        program: The training program of any of them.
        folder: Where their run folders are, or go.
        members: Names and configurations of one program shape.
        loggers: Where the curves of each go besides its folder.

    Raises:
        UserError: A folder is of another configuration or damaged, or trained by another process.
    """
    with ExitStack() as stack:
        at: dict[int | None, list[_Folder]] = {}
        for name, settings in members:
            place = folder / name
            run = Run.open(place) if place.exists() else Run.create(settings, place, program.env)
            stack.enter_context(run.locked())
            kept = run.checkpoints()
            stack.callback(kept.close)
            kept.check()
            at.setdefault(kept.latest, []).append(_Folder(name, run, kept, [], [], make_loggers(loggers)))
        for steps, alike in at.items():  # A sweep that was killed while it wrote checkpoints left some behind others.
            _train(Population(program, [m.run.config for m in alike]), folder, alike, steps)


def _train(population: Population, folder: Path, members: list[_Folder], steps: int | None) -> None:
    program = population.program
    if steps is None:
        population.start()
    else:
        population.restore([member.checkpoints.restore(program.like) for member in members])
        for member in members:
            member.rows.extend(row for row in curves.read_rows(member.run.folder) if row["steps"] <= steps)
            member.evaluations.extend(e for e in member.run.evaluations if e["steps"] <= steps)
    before = max((member.rows[-1]["seconds"] for member in members if member.rows), default=0.0)
    started = time.monotonic()
    alive = dict(enumerate(members))
    with ExitStack() as stack:
        logs = [stack.enter_context(logging(m.run, m.loggers, m.rows, m.evaluations)) for m in members]
        _train_on(population, folder, alive, logs, before - started)
    for member in alive.values():
        report.write(member.run.folder, member.run.config, program.env, member.rows, member.evaluations)
        finish(folder, member.name, Ending(DONE))


def _train_on(
    population: Population, folder: Path, alive: dict[int, _Folder], logs: Sequence[Log], offset: float
) -> None:
    """Train to the end, or until nobody is alive. `offset` makes seconds of training of the clock."""
    program, settings = population.program, population.settings[0]
    budget, saved = settings.train, time.monotonic()
    while alive:
        at = population.counters
        finished = at.steps >= program.total_steps
        due = program.due(at, budget.evaluate_every)
        lacking = [n for n, m in alive.items() if all(e["steps"] != at.steps for e in m.evaluations)]
        if (due or finished) and lacking:
            protocol = settings.evaluate
            targets = protocol.targets if finished else protocol.interim_targets
            found = population.evaluate(targets)
            for number in lacking:
                alive[number].evaluations.append({**at._asdict(), "targets": targets, **found[number]})
                curves.write_evaluations(alive[number].run.folder, alive[number].evaluations)
                logs[number].evaluation(alive[number].evaluations[-1])
        if finished:
            break
        metrics = population.advance()
        at, seconds = population.counters, offset + time.monotonic()
        for number, member in list(alive.items()):
            if lost := trainer.not_finite(metrics[number]):
                finish(folder, member.name, Ending(DIVERGED, f"{lost} by episode {at.episodes}"))
                del alive[number]
                continue
            member.rows.append(trainer.row(at, seconds, metrics[number]))
            logs[number].epoch(member.rows[-1])
        finished = at.steps >= program.total_steps
        if finished or (program.due(at, budget.checkpoint_every) and time.monotonic() > saved + SAVE_EVERY_S):
            for number, state in enumerate(population.members()):
                if number in alive:
                    curves.write_rows(alive[number].run.folder, alive[number].rows)
                    alive[number].checkpoints.save(state)
            saved = time.monotonic()
