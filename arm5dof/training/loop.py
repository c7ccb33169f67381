"""Training a run to its end: epochs, and between them rows, evaluations and checkpoints."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, Protocol

import jax

from arm5dof.envs import Task
from arm5dof.runtime import files
from arm5dof.training import curves, evaluate, report, trainer
from arm5dof.training.checkpoint import Checkpoints
from arm5dof.training.config import Config, make_env
from arm5dof.training.loggers import Logger, logging, make_loggers
from arm5dof.training.run import Run, free_folder
from arm5dof.training.trainer import Trainer


class Reporter(Protocol):
    """Who is told how a training goes. `arm5dof.runtime.progress.Bar` is one."""

    def update(self, done: int, note: str = "", later: float = 0.0) -> None:
        """So many episodes are done; the evaluations to come take so many seconds, as far as is known."""
        ...

    def say(self, line: str) -> None:
        """Something happened that is worth a line."""
        ...


class Silent:
    """A reporter that tells nobody."""

    def update(self, done: int, note: str = "", later: float = 0.0) -> None: ...

    def say(self, line: str) -> None: ...


def train(
    settings: Config,
    folder: str | Path | None = None,
    reporter: Reporter | None = None,
    loggers: str | Iterable[str | Logger] = (),
) -> Run:
    """Train a new run to its end.

    Args:
        settings: Its configuration, from `load_config`.
        folder: The run's folder, which must not exist; the first free one of `runs/<task>`, `runs/<task>-2`, ... if
            None.
        reporter: Told how it goes.
        loggers: Where its curves go, such as `["tensorboard", "wandb"]`, or loggers of your own; see
            `arm5dof.training.loggers`.

    Returns:
        The run.

    Raises:
        UserError: The configuration cannot be trained, a logger is missing, or the folder exists.

    >>> import tempfile
    >>> from arm5dof import load_config, train
    >>> folder = tempfile.TemporaryDirectory()
    >>> budget = {"episodes": 2, "num_envs": 2, "evaluate_every": 2, "checkpoint_every": 2, "updates_per_step": 1}
    >>> config = load_config("kinematic.toml", targets=100, refinements=1, **budget)  # Seconds: far from enough.
    >>> run = train(config, f"{folder.name}/short")
    >>> run.evaluations[-1]["episodes"], run.metrics["env_steps"][-1], (run.folder / "report.md").exists()
    (2, 320.0, True)
    """
    # What is wrong with loggers, robot or budget is said before a folder exists.
    ready, made = make_loggers(loggers), make_trainer(settings)
    run = Run.create(settings, folder or free_folder(settings.task.rpartition(":")[2]), made.env)
    return resume(run, reporter, made, ready)


def make_trainer(settings: Config) -> Trainer:
    """The training program that a configuration describes. Raises `UserError` if there is something wrong with it."""
    made = Trainer(make_env(settings), settings)
    made.check()
    return made


def resume(
    run: Run,
    reporter: Reporter | None = None,
    made: Trainer | None = None,
    loggers: str | Iterable[str | Logger] = (),
) -> Run:
    """Train a run to its end, from its newest checkpoint if it has one. `Run.extend` gives it a longer budget before.

    Args:
        run: The run.
        reporter: Told how it goes.
        made: Its training program, if it has been made already.
        loggers: Where its curves go, as for `train`: whole, whoever logged what went before.

    Raises:
        UserError: Its checkpoint is damaged or was made with other settings, a logger is missing, or another process
            trains it.
        FolderGoneError: Its folder was moved or removed meanwhile.

    >>> import tempfile
    >>> from arm5dof import Run, load_config, resume
    >>> folder = tempfile.TemporaryDirectory()
    >>> run = Run.create(load_config("kinematic.toml", episodes=400), f"{folder.name}/run")
    >>> longer = run.extend(episodes=800)
    >>> resume(longer, loggers=["tensorbord"])  # Said before anything is trained.
    Traceback (most recent call last):
    arm5dof.errors.UserError: no logger 'tensorbord': did you mean 'tensorboard'?
    """
    ready = make_loggers(loggers)
    with run.locked() as check_folder, closing(run.checkpoints()) as checkpoints:
        reporter = reporter or Silent()
        # What no longer fits is said before a trainer is made of it.
        if changed := checkpoints.check():
            told = ", ".join(f"{name} {before} -> {now}" for name, (before, now) in changed.items())
            reporter.say(f"changed since the last checkpoint: {told}")
        _train(run, made or run.trainer(), checkpoints, reporter, ready, check_folder)
    return run


def _train(
    run: Run,
    made: Trainer,
    checkpoints: Checkpoints,
    reporter: Reporter,
    loggers: list[Logger],
    check_folder: Callable[[], None],
) -> None:
    budget = run.config.train
    reporter.update(0, "compiling")
    if checkpoints.latest is None:
        reporter.say(f"replay buffer: {run.config.ddpg.replay_capacity} transitions, {made.replay_bytes / 1e6:.1f} MB")
        made.start()
    else:
        made.state = checkpoints.restore(made.like)
        reporter.say(f"resuming {run.folder} at episode {made.counters.episodes}")
    at = made.counters
    rows = [row for row in curves.read_rows(run.folder) if row["steps"] <= at.steps]
    evaluations = [e for e in run.evaluations if e["steps"] <= at.steps]
    with files.undamaged(run.folder / curves.EVALUATIONS, curves.REMEDY):
        for found in evaluations:
            _ = made.env.failure(found), found[made.env.headline]
    if at.steps and (not rows or rows[-1]["steps"] < at.steps):
        reporter.say(f"{run.folder / curves.METRICS} lacks what was trained before episode {at.episodes}")
    measure = Evaluations(run, made, reporter)
    before = rows[-1]["seconds"] if rows else 0.0
    started = time.monotonic()

    if not made.finished:
        checkpoints.check_room()
    with ExitStack() as stack:
        # Nothing of the run changes before all that can be refused has been.
        with run.keeping():
            write = stack.enter_context(curves.appending(run.folder, rows))
        log = stack.enter_context(logging(run, loggers, rows, evaluations))
        try:
            while True:
                at = made.counters
                due = made.due(at, budget.evaluate_every)
                if (due or made.finished) and all(e["steps"] != at.steps for e in evaluations):
                    evaluations.append(measure())
                    check_folder()
                    curves.write_evaluations(run.folder, evaluations)
                    log.evaluation(evaluations[-1])
                if made.finished:
                    break
                metrics = made.advance()
                check_folder()
                at, seconds = made.counters, time.monotonic() - started
                rows.append(trainer.row(at, before + seconds, metrics))
                write(rows[-1])
                log.epoch(rows[-1])
                reporter.update(at.episodes, _note(made.env, rows, metrics), measure.seconds_to_come)
                if made.due(at, budget.checkpoint_every) or made.finished:
                    checkpoints.save(made.state)
        except KeyboardInterrupt:
            check_folder()
            _save_at_once(made, checkpoints)
            raise
    check_folder()
    report.write(run.folder, run.config, made.env, rows, evaluations)


def _save_at_once(made: Trainer, checkpoints: Checkpoints) -> None:
    """Save what has been trained since the last checkpoint, unless the interrupt came in the middle of an epoch, which
    takes the state before it."""
    lost = any(leaf.is_deleted() for leaf in jax.tree.leaves(made.state))
    if not lost and made.counters.steps > (checkpoints.latest or 0):
        checkpoints.save(made.state)


class Evaluations:
    """The evaluations of a run, one after the other, and how long those take that are still to come."""

    def __init__(self, run: Run, made: Trainer, reporter: Reporter) -> None:
        self.run, self.made, self.reporter = run, made, reporter
        self.pace = 0.0
        """Seconds a target took of late; 0 before the first evaluation."""

    def __call__(self) -> dict[str, Any]:
        """Measure the policy as it is now: what was found, with the counters."""
        at, env = self.made.counters, self.made.env
        protocol = self.run.config.evaluate
        targets = protocol.targets if self.made.finished else protocol.interim_targets
        started, first = time.monotonic(), 0

        def show(done: int) -> None:
            nonlocal started, first
            if done > first:
                self.pace = (time.monotonic() - started) / (done - first)
            if not first:  # What comes before also compiles.
                started, first = time.monotonic(), done
            later = self.pace * (targets - done) + self.seconds_to_come
            self.reporter.update(at.episodes, f"evaluating {done}/{targets} targets", later)

        show(0)
        results = evaluate.evaluate(self.made.policy(), targets, self.run.config.train.seed, show)
        self.reporter.say(
            f"episode {at.episodes}: {env.metrics[env.headline].text(results[env.headline])} "
            f"({env.headline}, {results['counts'].get(env.headline, targets)} unseen targets)"
        )
        return {**at._asdict(), "targets": targets, **results}

    @property
    def seconds_to_come(self) -> float:
        """After the one that is due now."""
        if self.made.finished:
            return 0.0
        protocol = self.run.config.evaluate
        return self.pace * (protocol.targets + self.made.evaluations_between * protocol.interim_targets)


def _note(env: Task, rows: list[dict[str, Any]], metrics: dict[str, float]) -> str:
    """Rates over the last few epochs, and what there is to watch of the policy or else the reward."""
    recent = rows[-6:]
    if len(recent) < 2:
        return ""
    first, last = recent[0], recent[-1]
    elapsed = max(float(last["seconds"]) - float(first["seconds"]), 1e-9)
    rate = {name: (float(last[name]) - float(first[name])) / elapsed for name in ("env_steps", "updates")}
    watched = {name: env.metrics[name] for name in metrics if name in env.metrics and name.startswith("policy_")}
    shown = [f"{name.removeprefix('policy_')} {m.scale * metrics[name]:.1f} {m.unit}" for name, m in watched.items()]
    return "  ".join(
        [
            f"{rate['env_steps']:.0f} env steps/s  {rate['updates']:.0f} updates/s",
            *(shown or [f"reward {metrics['reward']:.3g}"]),
        ]
    )
