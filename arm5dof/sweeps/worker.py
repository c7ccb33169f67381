"""What trains members: a function that executors call wherever they like, and a process that calls it.

A member is trained by `training.run`, into a run folder like any other. Beside it `NAME.json` says how it ended, once
it has: that and the run folders are all that a sweep's results are made of. Started as `python -m
arm5dof.sweeps.worker` this reads jobs from standard input, a line of JSON each, and answers each with a line; it ends
when whoever started it does.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import shutil
import sys
import threading
import time
import tomllib
from collections.abc import Callable, Hashable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax

from arm5dof.errors import DivergedError, UserError
from arm5dof.runtime import files, xla
from arm5dof.sweeps.groups import shape
from arm5dof.sweeps.spec import Member
from arm5dof.training import config, curves, loop
from arm5dof.training.config import Config
from arm5dof.training.loop import Silent
from arm5dof.training.run import Run
from arm5dof.training.trainer import Trainer

PATIENCE_S = 20.0
DONE, DIVERGED, FAILED, PRUNED = "done", "diverged", "failed", "pruned"


@dataclass(frozen=True)
class Job:
    """Members of one program shape to train, side by side in one program or one after the other."""

    folder: str
    """Where their run folders go."""
    members: tuple[tuple[str, str], ...]
    """Names, and configurations as TOML."""
    group: int = 0
    """Number of their program shape."""
    together: bool = False
    """Whether they are one program, which pays on a GPU."""
    trial: tuple[str, int] | None = None
    """The file of a search and the number of its trial that these are the seeds of: whether to prune it is asked."""
    loggers: tuple[str, ...] = ()
    """Where curves go besides the run folders; see `training.loggers`."""

    @staticmethod
    def of(folder: Path, members: list[Member], **others: Any) -> Job:
        """A job for some members."""
        return Job(str(folder), tuple((m.name, config.dumps(m.config)) for m in members), **others)

    def dumps(self) -> str:
        """One line."""
        return json.dumps(asdict(self))

    @staticmethod
    def loads(line: str) -> Job:
        """From that line."""
        values = json.loads(line)
        trial = values["trial"] and tuple(values["trial"])
        members, loggers = tuple(map(tuple, values["members"])), tuple(values["loggers"])
        return Job(**{**values, "members": members, "trial": trial, "loggers": loggers})


class PrunedError(Exception):
    """A member was told to stop early."""


class Worker:
    """Trains jobs. It keeps the compiled program of the last program shape, and of no other: memory stays flat."""

    def __init__(self) -> None:
        self._shape: Hashable = None
        self._trainer: Trainer | None = None

    def work(self, job: Job) -> None:
        """Train the members of a job that have not ended yet, and leave beside each how it ended."""
        folder = Path(job.folder)
        if job.together and len(job.members) > 1:
            from arm5dof.sweeps.population import train_together

            todo = [(name, _built(text)) for name, text in job.members if not ended(folder, name)]
            if todo:
                ending = attempt(lambda: train_together(self._program(todo[0][1]), folder, todo, job.loggers))
                for name in [name for name, _ in todo if not ended(folder, name)]:
                    finish(folder, name, ending)
            return
        decided = ""
        for number, (name, text) in enumerate(job.members):
            found = ended(folder, name)
            if found is None and decided:
                found = finish(folder, name, Ending(PRUNED, decided))
            elif found is None:
                stop = None
                if job.trial is not None:
                    from arm5dof.sweeps.search import should_stop

                    stop = should_stop(*job.trial, number)
                train = partial(self._train, folder / name, _built(text), stop, job.loggers)
                found = finish(folder, name, attempt(train))
            if job.trial is not None and found.status != DONE:
                decided = f"{name} {found.status}"

    def _program(self, settings: Config) -> Trainer:
        """A training program for configurations of a shape: the one at hand if it is of that."""
        wanted = shape(settings)
        if self._trainer is None or wanted != self._shape:
            if self._trainer is not None:
                self._trainer = None
                jax.clear_caches()
            self._trainer, self._shape = Trainer(config.make_env(settings), settings), wanted
        return self._trainer

    def _train(
        self, folder: Path, settings: Config, stop: Callable[[Run], bool] | None, loggers: Sequence[str]
    ) -> None:
        """As `training.loop.train` does, or `resume` where there is a run."""
        if folder.exists():
            opened = Run.open(folder)
            if opened.config != settings:
                raise UserError(f"{folder} is a run of another configuration: move it away")
            made = Trainer(opened.env, settings)  # With the robot that it was begun with.
        else:
            for leftover in folder.parent.glob(f".{folder.name}-*"):  # Of one that was killed while it made its folder.
                shutil.rmtree(leftover, ignore_errors=True)
            made = self._program(settings).again(settings)
            opened = Run.create(settings, folder, made.env)
        _wait_until_free(opened)
        loop.resume(opened, _Stopping(opened, stop) if stop else None, made, loggers)


def _wait_until_free(opened: Run) -> None:
    """A worker whose sweep was killed holds its run a little longer."""
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        with contextlib.suppress(UserError), opened.locked():
            return
        time.sleep(0.1)


class _Stopping(Silent):
    """A reporter that ends a training where an evaluation says so."""

    def __init__(self, opened: Run, stop: Callable[[Run], bool]) -> None:
        self._run, self._stop, self._seen = opened, stop, 0

    def update(self, done: int, note: str = "", later: float = 0.0) -> None:
        path = self._run.folder / curves.EVALUATIONS
        seen = path.stat().st_mtime_ns if path.exists() else 0
        if seen != self._seen:
            self._seen = seen
            if self._stop(self._run):
                raise PrunedError(f"behind others at episode {done}")


class Ending(NamedTuple):
    """How a member ended, and why if not well."""

    status: str
    reason: str = ""


def attempt(train: Callable[[], object]) -> Ending:
    """Train, and say how it ended. Whatever it raises is its own affair."""
    try:
        train()
    except DivergedError as error:
        return Ending(DIVERGED, str(error))
    except PrunedError as error:
        return Ending(PRUNED, str(error))
    except Exception as error:  # The user's own task, XLA and the disk may raise anything.
        kind = "" if isinstance(error, UserError) else f"{type(error).__name__}: "
        return Ending(FAILED, " ".join(f"{kind}{error}".split())[:300])
    return Ending(DONE)


def finish(folder: Path, name: str, ending: Ending) -> Ending:
    """Leave beside a member how it ended."""
    files.write_text(folder / f"{name}.json", json.dumps(ending._asdict()) + "\n")
    return ending


def ended(folder: Path, name: str) -> Ending | None:
    """How a member ended, or None if it has not."""
    try:
        found = Ending(**json.loads((folder / f"{name}.json").read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError, RecursionError):
        return None
    return found if found.status in (DONE, DIVERGED, FAILED, PRUNED) and isinstance(found.reason, str) else None


def _built(text: str) -> Config:
    return config.build(tomllib.loads(text))


def main() -> None:
    """Read jobs, train them, answer; end at once when standard input does."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # What libraries print is no answer.
    xla.enable_compilation_cache()
    jobs: queue.Queue[str] = queue.Queue()

    def listen() -> None:
        for line in sys.stdin:
            jobs.put(line)
        os._exit(0)  # Whoever asked is gone, however: nobody would take the rest. Runs are resumed.

    threading.Thread(target=listen, daemon=True).start()
    worker = Worker()
    while True:
        line = jobs.get()
        worker.work(Job.loads(line))
        answers.write("done\n")
        answers.flush()


if __name__ == "__main__":
    main()
