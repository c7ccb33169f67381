"""A run and its folder: `config.toml`, `metrics.csv`, `evaluations.json`, `checkpoints/`, figures and `report.md`."""

from __future__ import annotations

import csv
import fcntl
import json
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax

from arm5dof.arm import load_arm
from arm5dof.envs import Reach
from arm5dof.errors import UserError
from arm5dof.runtime import files
from arm5dof.runtime.progress import Bar
from arm5dof.training import config, evaluate, report
from arm5dof.training import trainer as training
from arm5dof.training.checkpoint import Checkpoints
from arm5dof.training.config import Config
from arm5dof.training.policy import Policy


@dataclass(frozen=True)
class Run:
    """One run's folder and configuration."""

    folder: Path
    config: Config

    @staticmethod
    def create(settings: Config, folder: Path) -> Run:
        """Make the folder, whole or not at all. Raises `UserError` if it exists: runs never overwrite each other."""
        if folder.exists():
            raise UserError(f"{folder} exists: choose another --out, or go on with it by --resume {folder}")
        folder.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
        try:
            temporary.chmod(0o755)
            (temporary / "config.toml").write_text(config.dumps(settings), encoding="utf-8")
            temporary.rename(folder)
        except OSError:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
        return Run(folder, settings)

    @staticmethod
    def open(folder: Path) -> Run:
        """A run that exists. Raises `UserError` if the folder is none."""
        path = folder / "config.toml"
        if not path.is_file():
            raise UserError(f"{folder} is no run: it has no config.toml; a run is what arm5dof train leaves behind")
        return Run(folder, config.load(path.resolve()))

    @property
    def metrics_file(self) -> Path:
        return self.folder / "metrics.csv"

    def policy(self) -> Policy:
        """The policy of the newest checkpoint."""
        trainer = make_trainer(self.config)
        networks = self.checkpoints().restore_networks(trainer.like.networks)
        return Policy(trainer.env, trainer.agent, self.config.ddpg, networks)

    def checkpoints(self) -> Checkpoints:
        folder = self.folder / "checkpoints"
        if not folder.is_dir():
            raise UserError(f"{self.folder} has no checkpoint yet: train it further with --resume {self.folder}")
        return Checkpoints(folder, read_only=True)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the run for one process. The kernel lets go of the lock when the process ends, however it ends."""
        with open(self.folder / ".lock", "w") as handle:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise UserError(f"{self.folder} is being trained by another process") from None
            yield


def make_trainer(settings: Config) -> training.Trainer:
    """The training program that a configuration describes. Raises `UserError` if there is something wrong with it."""
    return training.Trainer(Reach(load_arm(settings.env.arm, settings.env.site), settings.env), settings)


def train(run: Run, trainer: training.Trainer | None = None) -> list[dict[str, Any]]:
    """Train a run to its end, from its newest checkpoint if it has one; `trainer` is its training program, if it has
    been made already. Returns its evaluations."""
    with run.locked():
        return _train(run, trainer or make_trainer(run.config))


def _train(run: Run, trainer: training.Trainer) -> list[dict[str, Any]]:
    budget = run.config.train
    checkpoints = Checkpoints(run.folder / "checkpoints")
    length = run.config.env.episode_length
    with Bar("training", budget.episodes, "episodes") as bar:
        bar.update(0, "compiling")
        if checkpoints.latest is None:
            bar.say(
                f"replay buffer: {run.config.ddpg.replay_capacity} transitions, {trainer.replay_bytes / 1e6:.1f} MB"
            )
            trainer.start()
        else:
            trainer.state = checkpoints.restore(trainer.like)
            bar.say(f"resuming {run.folder} at episode {trainer.counters.episodes}")
        at = trainer.counters
        rows = _read_rows(run.metrics_file, at.steps)
        evaluations = _read_evaluations(run.folder / "evaluations.json", at.steps)
        before = float(rows[-1]["seconds"]) if rows else 0.0
        started = time.monotonic()

        with _appending(run.metrics_file, rows) as write:
            while True:
                at = trainer.counters
                due = at.steps > 0 and at.steps % (budget.evaluate_every // budget.num_envs * length) == 0
                if (due or trainer.finished) and all(e["steps"] != at.steps for e in evaluations):
                    evaluations.append(_evaluate(run, trainer, bar))
                    files.write_text(run.folder / "evaluations.json", json.dumps(evaluations, indent=1) + "\n")
                if trainer.finished:
                    break
                metrics = trainer.advance()
                at, seconds = trainer.counters, time.monotonic() - started
                rows.append(training.row(at, before + seconds, metrics))
                write(rows[-1])
                bar.update(at.episodes, _note(rows, metrics))
                if at.steps % (budget.checkpoint_every // budget.num_envs * length) == 0 or trainer.finished:
                    checkpoints.save(trainer.state)
        report.write(run.folder, run.config, rows, evaluations)
    return evaluations


def _evaluate(run: Run, trainer: training.Trainer, bar: Bar) -> dict[str, Any]:
    protocol, at = run.config.evaluate, trainer.counters
    targets = protocol.targets if trainer.finished else protocol.interim_targets
    show = lambda done: bar.update(at.episodes, f"evaluating {done}/{targets} targets")
    show(0)
    results, normalised = evaluate.evaluate(
        trainer.policy(), targets, protocol.refinements, progress=show, seed=run.config.train.seed
    )
    name = report.headline(run.config)
    bar.say(
        f"episode {at.episodes}: {results[name]['within']['10']:.2f} % within 10 mm, "
        f"median {results[name]['median_mm']:.2f} mm ({name}, {targets} unseen targets)"
    )
    return {**at._asdict(), "targets": targets, "normalised": normalised, **results}


def _note(rows: list[dict[str, Any]], metrics: dict[str, float]) -> str:
    """Rates over the last few epochs, and the policy's mean error."""
    recent = rows[-6:]
    if len(recent) < 2:
        return ""
    first, last = recent[0], recent[-1]
    elapsed = max(float(last["seconds"]) - float(first["seconds"]), 1e-9)
    rate = {name: (float(last[name]) - float(first[name])) / elapsed for name in ("env_steps", "updates")}
    return (
        f"{rate['env_steps']:.0f} env steps/s  {rate['updates']:.0f} updates/s  "
        f"error {1e3 * metrics['policy_distance']:.1f} mm"
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


def _read_rows(path: Path, steps: int) -> list[dict[str, Any]]:
    """The complete rows up to a checkpoint."""
    if not path.exists():
        return []
    with open(path, newline="") as handle:
        rows = [row for row in csv.DictReader(handle) if all(row.values()) and None not in row]
    return [row for row in rows if int(row["steps"]) <= steps]


def _read_evaluations(path: Path, steps: int) -> list[dict[str, Any]]:
    if not path.exists():
        return []
    return [found for found in json.loads(path.read_text()) if found["steps"] <= steps]


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
