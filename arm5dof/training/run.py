"""A run and its folder, which holds all that it takes to go on or to answer, anywhere:

`config.toml`, `run.json` (versions), `model.mjb.gz` and `model.zip` (the robot), `metrics.csv`, `evaluations.json`,
`checkpoints/`, `learning.png` and `report.md`; with loggers `tensorboard/`, `wandb/` and `wandb.json`.
"""

from __future__ import annotations

import csv
import fcntl
import json
import time
import tomllib
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import cached_property
from importlib import metadata
from pathlib import Path
from typing import Any, Protocol

import jax

from arm5dof.envs import Task
from arm5dof.errors import UserError
from arm5dof.runtime import files
from arm5dof.runtime.tables import Table
from arm5dof.training import config, evaluate, report, robot, trainer
from arm5dof.training.checkpoint import Checkpoints
from arm5dof.training.config import Config, make_env
from arm5dof.training.loggers import Logger, logging, make_loggers
from arm5dof.training.policy import Policy
from arm5dof.training.trainer import Trainer

VERSIONS = ("arm5dof", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "mujoco", "mujoco-mjx", "numpy")


class Reporter(Protocol):
    """Who is told how a training goes. `arm5dof.runtime.progress.Bar` is one."""

    def update(self, done: int, note: str = "") -> None:
        """So many episodes are done."""
        ...

    def say(self, line: str) -> None:
        """Something happened that is worth a line."""
        ...


class Silent:
    """A reporter that tells nobody."""

    def update(self, done: int, note: str = "") -> None: ...

    def say(self, line: str) -> None: ...


@dataclass(frozen=True, repr=False)
class Run:
    """One run's folder and configuration.

    >>> import tempfile
    >>> from arm5dof import Run, load_config
    >>> folder = tempfile.TemporaryDirectory()
    >>> run = Run.create(load_config("kinematic.toml", seed=3), f"{folder.name}/begun")
    >>> Run.open(f"{folder.name}/begun").config.train.seed, run.env.action_size, run.evaluations
    (3, 5, [])
    """

    folder: Path
    config: Config
    left_open: frozenset[str] = frozenset()
    """Full names of settings that its `config.toml` leaves open: those that came with a later version."""

    @staticmethod
    def create(settings: Config, folder: str | Path, env: Task | None = None) -> Run:
        """Make a run's folder, whole or not at all.

        Args:
            settings: Its configuration.
            folder: A folder that does not exist yet: runs never overwrite each other.
            env: The environment, if it has been made from these settings already.

        Raises:
            UserError: The folder exists, or the environment cannot be made.
        """
        folder = Path(folder)
        env = env or make_env(settings)
        with files.making(folder) as temporary:
            (temporary / "config.toml").write_text(config.dumps(settings), encoding="utf-8")
            model = robot.keep(temporary, env)
            versions = {name: metadata.version(name) for name in VERSIONS}
            record = {"versions": versions, "device": device(), "model": model}
            (temporary / "run.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
        return Run(folder, settings)

    @staticmethod
    def open(folder: str | Path) -> Run:
        """A run that exists. What its `config.toml` leaves open is as the settings' classes have it.

        Raises:
            UserError: The folder is no run, or its task cannot be imported.
        """
        folder = Path(folder)
        path = folder / "config.toml"
        if not path.is_file() or not (folder / "run.json").is_file():
            raise UserError(
                f"{folder} is no run: it has no config.toml and run.json; a run is what arm5dof train leaves behind"
            )
        try:
            values = tomllib.loads(path.read_text(encoding="utf-8"))
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise UserError(f"{path} is not valid TOML: {error}") from None
        settings = config.build(values, str(path))
        stated = {f"{section}.{name}" for section, given in values.items() for name in given}
        return Run(folder, settings, frozenset(settings.flat().keys() - stated))

    def extend(self, **changes: Any) -> Run:
        """The run with a longer budget, or others of its settings that may change. Its `config.toml` keeps them.

        Step sizes, noise and the share of random actions are functions of the share of the budget that is done. A
        longer budget stretches them: 400 of 400 episodes become 400 of 800, and they rise again to where they stand
        half-way.

        Args:
            changes: Values by name, as `load_config` takes them: `episodes=800`.

        Raises:
            UserError: A setting is unknown, invalid or one that may not change, the run is beyond the budget already,
                its checkpoint cannot be used, or another process trains it. The run is as it was.

        >>> import tempfile
        >>> from arm5dof import Run, load_config
        >>> folder = tempfile.TemporaryDirectory()
        >>> run = Run.create(load_config("kinematic.toml", episodes=400), f"{folder.name}/run")
        >>> run.extend(episodes=800).config.train.episodes, Run.open(run.folder).config.train.episodes
        (800, 800)
        """
        settings = config.override(self.config, changes)
        before, now, others = self.config.flat(), settings.flat(), config.may_change(self.config)
        changed = {name for name in before if now[name] != before[name]}
        if shaped := sorted(changed - others.keys()):
            raise UserError(
                f"{self.folder} was made with {', '.join(f'{name} = {before[name]!r}' for name in shaped)}: leave out "
                f"{', '.join(shaped)}; what may change is {', '.join(others)}"
            )
        extended = Run(self.folder, settings, self.left_open - changed)
        with self.locked():
            made, checkpoints = extended.trainer(), extended._checkpoints(read_only=True)
            checkpoints.check()
            done = (checkpoints.latest or 0) * settings.train.num_envs // made.env.episode_length
            if settings.train.episodes < done and "train.episodes" in changed:
                raise UserError(
                    f"{self.folder} has trained {done} episodes, more than {settings.train.episodes}: give {done} or "
                    "more, or train a new run"
                )
            files.write_text(self.folder / "config.toml", config.dumps(settings, extended.left_open))
        return extended

    @cached_property
    def env(self) -> Task:
        """The environment, with the robot that the run was made for, whatever happened to its MJCF since."""
        path = self.folder / "run.json"
        with _undamaged(path):
            record = json.loads(path.read_text(encoding="utf-8"))
            version, digests = str(record["versions"]["mujoco"]), dict(record["model"])
        env = make_env(self.config, robot.kept(self.folder, version, digests))
        if env.mj_model is not None and not digests:
            raise UserError(f"{path} is damaged (it names no robot): take it from a copy of the run")
        return env

    def trainer(self) -> Trainer:
        """The run's training program."""
        return Trainer(self.env, self.config)

    @property
    def has_checkpoint(self) -> bool:
        """Whether there is one to answer with and to go on from."""
        return any(path.name.isdigit() for path in (self.folder / "checkpoints").glob("*"))

    def policy(self) -> Policy:
        """The policy of the newest checkpoint. Raises `UserError` if there is none, or it was made with other
        settings."""
        if not self.has_checkpoint:
            raise UserError(f"{self.folder} has no checkpoint yet: resume it")
        checkpoints = self._checkpoints(read_only=True)
        checkpoints.check()
        made = self.trainer()
        networks = checkpoints.restore_networks(made.like.networks)
        return Policy(made.env, made.agent, self.config.ddpg, networks)

    def evaluate(
        self, targets: int | None = None, seed: int = 0, progress: Callable[[int], object] | None = None
    ) -> dict[str, Any]:
        """Measure the newest policy; see `arm5dof.training.evaluate.evaluate`. `targets` as configured if None."""
        return evaluate.evaluate(self.policy(), targets or self.config.evaluate.targets, seed, progress)

    @property
    def metrics(self) -> dict[str, list[float]]:
        """The columns of `metrics.csv`, an epoch each: counters, seconds, and means over the epoch in SI units."""
        rows = _read_rows(self.folder / "metrics.csv")
        return {name: [float(row[name]) for row in rows] for name in (rows[0] if rows else ())}

    @property
    def evaluations(self) -> list[dict[str, Any]]:
        """The evaluations so far: counters, `targets`, and what `evaluate` returns."""
        return _read_evaluations(self.folder / "evaluations.json")

    def _checkpoints(self, read_only: bool = False) -> Checkpoints:
        fixed, budget = config.fixed(self.config), config.may_change(self.config)
        return Checkpoints(self.folder / "checkpoints", fixed, budget, read_only, self.left_open)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the run for one process. The kernel lets go of the lock when the process ends, however it ends."""
        with open(self.folder / ".lock", "w") as handle:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise UserError(f"{self.folder} is being trained by another process") from None
            yield

    def _table(self) -> Table:
        task = config.task_class(self.config.task)
        rows = [
            (str(e["episodes"]), str(e["targets"]), name, metric.text(e[name]))
            for e in self.evaluations
            for name, metric in task.metrics.items()
            if name in e
        ]
        return Table(f"Run {self.folder}, task {self.config.task}", ("episodes", "targets", "metric", "value"), rows)

    def __repr__(self) -> str:
        return self._table().text()

    def _repr_html_(self) -> str:
        return self._table().html()


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
    with run.locked(), closing(run._checkpoints()) as checkpoints:
        reporter = reporter or Silent()
        # What no longer fits is said before a trainer is made of it.
        if changed := checkpoints.check():
            told = ", ".join(f"{name} {before} -> {now}" for name, (before, now) in changed.items())
            reporter.say(f"changed since the last checkpoint: {told}")
        _train(run, made or run.trainer(), checkpoints, reporter, ready)
    return run


def _train(run: Run, made: Trainer, checkpoints: Checkpoints, reporter: Reporter, loggers: list[Logger]) -> None:
    budget, length = run.config.train, made.env.episode_length
    reporter.update(0, "compiling")
    if checkpoints.latest is None:
        reporter.say(f"replay buffer: {run.config.ddpg.replay_capacity} transitions, {made.replay_bytes / 1e6:.1f} MB")
        made.start()
    else:
        made.state = checkpoints.restore(made.like)
        reporter.say(f"resuming {run.folder} at episode {made.counters.episodes}")
    at = made.counters
    rows = [row for row in _read_rows(run.folder / "metrics.csv") if int(row["steps"]) <= at.steps]
    evaluations = [e for e in run.evaluations if e["steps"] <= at.steps]
    before = float(rows[-1]["seconds"]) if rows else 0.0
    started = time.monotonic()

    with _appending(run.folder / "metrics.csv", rows) as write, logging(run, loggers, rows, evaluations) as log:
        while True:
            at = made.counters
            due = at.steps > 0 and at.steps % (budget.evaluate_every // budget.num_envs * length) == 0
            if (due or made.finished) and all(e["steps"] != at.steps for e in evaluations):
                evaluations.append(_evaluate(run, made, reporter))
                files.write_text(run.folder / "evaluations.json", json.dumps(evaluations, indent=1) + "\n")
                log.evaluation(evaluations[-1])
            if made.finished:
                break
            metrics = made.advance()
            at, seconds = made.counters, time.monotonic() - started
            rows.append(trainer.row(at, before + seconds, metrics))
            write(rows[-1])
            log.epoch(rows[-1])
            reporter.update(at.episodes, _note(made.env, rows, metrics))
            if at.steps % (budget.checkpoint_every // budget.num_envs * length) == 0 or made.finished:
                checkpoints.save(made.state)
    report.write(run.folder, run.config, made.env, rows, evaluations)


def _evaluate(run: Run, made: Trainer, reporter: Reporter) -> dict[str, Any]:
    protocol, at, env = run.config.evaluate, made.counters, made.env
    targets = protocol.targets if made.finished else protocol.interim_targets
    show = lambda done: reporter.update(at.episodes, f"evaluating {done}/{targets} targets")
    show(0)
    results = evaluate.evaluate(made.policy(), targets, run.config.train.seed, show)
    reporter.say(
        f"episode {at.episodes}: {env.metrics[env.headline].text(results[env.headline])} "
        f"({env.headline}, {targets} unseen targets)"
    )
    return {**at._asdict(), "targets": targets, **results}


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


@contextmanager
def _appending(path: Path, rows: list[dict[str, Any]]) -> Iterator[Any]:
    """Rewrite the rows that the checkpoint knows, then append: what a kill cut off in mid-line is gone."""
    with files.replacing(path) as temporary, open(temporary, "w", newline="") as handle:
        if rows:
            writer = csv.DictWriter(handle, rows[0])
            writer.writeheader()
            writer.writerows(rows)
    with open(path, "a", newline="") as handle:

        def write(row: dict[str, Any]) -> None:
            writer = csv.DictWriter(handle, row)
            if handle.tell() == 0:
                writer.writeheader()
            writer.writerow(row)
            handle.flush()

        yield write


def _read_rows(path: Path) -> list[dict[str, Any]]:
    """The complete rows. Raises `UserError` for what is no number."""
    if not path.exists():
        return []
    with _undamaged(path), open(path, newline="", encoding="utf-8") as handle:
        rows = [row for row in csv.DictReader(handle) if all(row.values()) and None not in row]
        for row in rows:
            _ = int(row["steps"]), [float(value) for value in row.values()]
        return rows


def _read_evaluations(path: Path) -> list[dict[str, Any]]:
    if not path.exists():
        return []
    with _undamaged(path):
        return [{**e, "steps": int(e["steps"])} for e in json.loads(path.read_text(encoding="utf-8"))]


@contextmanager
def _undamaged(path: Path) -> Iterator[None]:
    """Raise `UserError` for what goes wrong when a file of a run is read."""
    try:
        yield
    except (ValueError, KeyError, TypeError, csv.Error) as error:
        reason = f"{type(error).__name__}: {error}"
        raise UserError(f"{path} is damaged ({reason}): take it from a copy of the run") from None


def free_folder(name: str) -> Path:
    """`runs/<name>`, or the first of `runs/<name>-2`, `-3`, ... that does not exist."""
    folder, count = Path("runs") / name, 1
    while folder.exists():
        count += 1
        folder = Path("runs") / f"{name}-{count}"
    return folder


def device() -> str:
    """What this process computes on."""
    first = jax.devices()[0]
    return f"{first.device_kind} ({first.platform})"
