"""A run and its folder, which holds all that it takes to go on or to answer, anywhere:

`config.toml`, `run.json` (id, versions), `model.mjb.gz` and `model.zip` (the robot), `metrics.csv`, `evaluations.json`,
`checkpoints/`, `learning.png` and `report.md`; with loggers `tensorboard/`, `wandb/` and `wandb.json`.
"""

from __future__ import annotations

import fcntl
import json
import os
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

from arm5dof.envs import Task
from arm5dof.errors import FolderGoneError, UserError
from arm5dof.runtime import files
from arm5dof.runtime.tables import Table
from arm5dof.training import config, curves, evaluate, robot
from arm5dof.training.checkpoint import Checkpoints
from arm5dof.training.checkpoint_folder import names_in
from arm5dof.training.config import Config, make_env
from arm5dof.training.policy import Policy
from arm5dof.training.trainer import Trainer

VERSIONS = ("arm5dof", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "mujoco", "mujoco-mjx", "numpy")


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
            record = {curves.RUN: uuid.uuid4().hex, "versions": versions, "device": device(), "model": model}
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
        values = files.read_toml(path)
        settings = config.build(values, str(path))
        stated = {f"{section}.{name}" for section, given in values.items() for name in given}
        return Run(folder, settings, frozenset(settings.flat().keys() - stated))

    def extend(self, **changes: Any) -> Run:
        """The run with a longer budget, or others of its settings that may change, which its `config.toml` keeps from
        now on; with those of `extended`, from when it is resumed.

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
        with self.locked():
            longer = self.extended(**changes)
            with longer.keeping():
                return longer

    def extended(self, **changes: Any) -> Run:
        """The same, and nothing is written: `config.toml` keeps them once `resume` has begun."""
        settings = config.override(self.config, changes)
        before, now, others = self.config.flat(), settings.flat(), config.may_change(self.config)
        changed = {name for name in before if now[name] != before[name]}
        if shaped := sorted(changed - others.keys()):
            raise UserError(
                f"{self.folder} was made with {', '.join(f'{name} = {before[name]!r}' for name in shaped)}: leave out "
                f"{', '.join(shaped)}; what may change is {', '.join(others)}"
            )
        extended = Run(self.folder, settings, self.left_open - changed)
        made, checkpoints = extended.trainer(), extended.checkpoints(read_only=True)
        checkpoints.check()
        done = (checkpoints.latest or 0) * settings.train.num_envs // made.env.episode_length
        if settings.train.episodes < done and "train.episodes" in changed:
            raise UserError(
                f"{self.folder} has trained {done} episodes, more than {settings.train.episodes}: give {done} or "
                "more, or train a new run"
            )
        return extended

    @contextmanager
    def keeping(self) -> Iterator[None]:
        """Where `config.toml` says something else, let it say what the run's configuration is, once the block succeeds:
        what that takes of the disk is taken before."""
        if Run.open(self.folder).config == self.config:
            yield
            return
        with files.replacing(self.folder / "config.toml") as temporary:
            temporary.write_text(config.dumps(self.config, self.left_open), encoding="utf-8")
            yield

    @cached_property
    def env(self) -> Task:
        """The environment, with the robot that the run was made for, whatever happened to its MJCF since."""
        digests = self.record["model"]
        env = make_env(self.config, robot.kept(self.folder, self.record["versions"]["mujoco"], digests))
        if env.mj_model is not None and not digests:
            path = self.folder / "run.json"
            raise UserError(f"{path} is damaged (it names no robot): take it from a copy of the run")
        return env

    @cached_property
    def record(self) -> dict[str, dict[str, str]]:
        """What `run.json` says: `versions` of what made the run, and digests of the files of its robot, `model`. Raises
        `UserError` if it is damaged."""
        path = self.folder / "run.json"
        with files.undamaged(path, "take it from a copy of the run"):
            found = json.loads(path.read_text(encoding="utf-8"))
            record = {name: dict(found[name]) for name in ("versions", "model")}
            if {type(value) for values in record.values() for value in values.values()} - {str}:
                raise TypeError("versions and digests are text")
            _ = record["versions"]["mujoco"]
            return record

    def trainer(self) -> Trainer:
        """The run's training program."""
        return Trainer(self.env, self.config)

    @property
    def has_checkpoint(self) -> bool:
        """Whether there is one to answer with and to go on from. Raises `UserError` if that cannot be read."""
        return bool(names_in(self.folder / "checkpoints"))

    def policy(self) -> Policy:
        """The policy of the newest checkpoint. Raises `UserError` if there is none, it cannot be read, or it was made
        with other settings."""
        if not self.has_checkpoint:
            raise UserError(f"{self.folder} has no checkpoint yet: resume it")
        checkpoints = self.checkpoints(read_only=True)
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
        """The columns of `metrics.csv`, an epoch each: counters, seconds, and means over the epoch in SI units. Raises
        `UserError` if it is damaged or of another run."""
        rows = curves.read_rows(self.folder)
        return {name: [float(row[name]) for row in rows] for name in (rows[0] if rows else ())}

    @property
    def evaluations(self) -> list[dict[str, Any]]:
        """The evaluations so far: counters, `targets`, and what `evaluate` returns. Raises `UserError` as `metrics`."""
        return curves.read_evaluations(self.folder, config.task_class(self.config.task).metrics)

    def checkpoints(self, read_only: bool = False) -> Checkpoints:
        """The run's checkpoints, which know what they were made with and what of that may change."""
        fixed, budget = config.fixed(self.config), config.may_change(self.config)
        return Checkpoints(self.folder / "checkpoints", fixed, budget, read_only, self.left_open)

    @contextmanager
    def locked(self) -> Iterator[Callable[[], None]]:
        """Hold the run for one process. The kernel lets go of the lock when the process ends, however it ends.

        Yields:
            What raises `FolderGoneError` once the folder is no longer where it was: whoever writes there would make
            another.
        """
        path = self.folder / ".lock"

        def check() -> None:
            if not path.exists() or not os.path.samestat(path.stat(), os.fstat(handle.fileno())):
                raise FolderGoneError(
                    f"{self.folder} was moved or removed while it was trained: nothing more of it is kept"
                )

        with open(path, "w") as handle:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise UserError(f"{self.folder} is being trained by another process") from None
            yield check

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
