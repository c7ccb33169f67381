"""Train every member of a sweep: from what was asked for to jobs, from jobs to a table and what it says."""

from __future__ import annotations

import contextlib
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Protocol

import jax

from arm5dof.errors import UserError
from arm5dof.runtime import files
from arm5dof.sweeps import groups, report, results, spec
from arm5dof.sweeps.folder import Sweep
from arm5dof.sweeps.local import ATTEMPTS, Jobs, LocalExecutor
from arm5dof.sweeps.results import Row
from arm5dof.sweeps.spec import Member, Spec
from arm5dof.sweeps.worker import DONE, FAILED, Ending, Job, ended, finish
from arm5dof.training.loggers import make_loggers
from arm5dof.training.loop import Reporter, Silent
from arm5dof.training.run import free_folder

WRITE_EVERY_S = 20.0
"""The table is written this often at most while members end, and at the end."""


def sweep(
    asked: str | Path | Mapping[str, Any] | Spec,
    out: str | Path | None = None,
    *,
    executor: Literal["local", "ray"] = "local",
    workers: int | None = None,
    address: str | None = None,
    resume: bool = False,
    reporter: Reporter | None = None,
    loggers: str | Iterable[str] = (),
) -> Sweep:
    """Train every member of a sweep, and put what was measured into one table.

    Args:
        asked: A TOML file, or the name of one that ships, or what such a file says as nested dictionaries.
        out: The sweep's folder; the first free one of `runs/sweep`, `runs/sweep-2`, ... if None.
        executor: local: processes of this machine, one for each core or GPU; ray: tasks of a Ray cluster.
        workers: How many members or chunks to train at once; None for as many as there are cores or GPUs.
        address: Of a Ray cluster; None for one that is at hand or else a local one.
        resume: Go on with the sweep in `out`, of which nothing is done twice.
        reporter: Told how it goes: members done, and the best so far.
        loggers: Where the curves of each member go besides its folder: "tensorboard", "wandb", or both.

    Returns:
        The sweep.

    Raises:
        UserError: Something of what is asked for cannot be trained, the folder exists or is of another sweep, or the
            cluster cannot be reached; nothing has been started then.

    >>> import tempfile
    >>> from arm5dof import sweep
    >>> folder = tempfile.TemporaryDirectory()
    >>> budget = {"episodes": 2, "num_envs": 2, "evaluate_every": 2, "checkpoint_every": 2, "updates_per_step": 1}
    >>> tiny = {**budget, "targets": 100, "refinements": 1}  # Seconds: far from enough.
    >>> done = sweep({"base": "kinematic.toml", "axes": {"actor_lr": [1e-3, 1e-2]}, "fixed": tiny}, f"{folder.name}/s")
    >>> [row["status"] for row in done.table], len(done.summary()), done.best.config.task
    (['done', 'done'], 2, 'reach')
    """
    reporter, names = reporter or Silent(), tuple(loggers.split(",") if isinstance(loggers, str) else loggers)
    make_loggers(names)  # What they lack is said at once; each member has its own.
    asked = asked if isinstance(asked, Spec) else spec.parse(asked) if isinstance(asked, Mapping) else spec.read(asked)
    if asked.base.task.startswith("__main__:"):
        raise UserError(f"the task {asked.base.task} lives in the main program: put it into a file of its own")
    folder = free_folder("sweep") if out is None else Path(out)
    if folder.exists() and not resume:
        raise UserError(f"{folder} exists: choose another folder, or resume the sweep that is in it")
    known = Sweep.open(folder) if folder.exists() else None
    if known is not None and not known.spec.same_as(asked):
        raise UserError(f"{folder} holds the results of another sweep: choose another folder")
    with contextlib.ExitStack() as stack:
        runner: Executor
        if executor == "ray":
            from arm5dof.sweeps.ray_executor import RayExecutor

            runner = stack.enter_context(RayExecutor(workers, address))
        else:
            runner = LocalExecutor(workers, _gpus())
        planned = groups.grouped(_examples(asked))
        sizes = [groups.chunk_size(group, 1 if runner.gpus else runner.workers) for group in planned]
        if not runner.gpus:
            sizes = [1] * len(planned)
        reporter.say(f"{folder}: {_told(asked, planned, max(sizes), runner.workers)}")
        current = known or Sweep.create(asked, folder)
        with current.locked() as descriptor:
            current.spec = asked
            files.write_text(folder / "sweep.toml", asked.dumps())
            if asked.search is None:
                jobs: Jobs = Queue(current, planned, sizes, names)
            else:
                from arm5dof.sweeps.search import Trials

                jobs = Trials(current, names)
            if isinstance(runner, LocalExecutor):
                runner.keep_open = descriptor
            _drive(current, runner, jobs, reporter)
    return current


class Executor(Protocol):
    """Who runs jobs."""

    workers: int
    gpus: int

    def run(self, jobs: Jobs, lost: Callable[[Job], None]) -> Iterator[Job]:
        """Do all jobs, and yield each when it has ended; `lost` is told of one that was given up."""
        ...


class Queue:
    """The jobs of a grid that are left to do, by program shape: a worker stays with its own while that has some, and
    then goes where the fewest are."""

    def __init__(
        self, current: Sweep, planned: Sequence[groups.Group], sizes: Sequence[int], loggers: tuple[str, ...]
    ) -> None:
        self._waiting: dict[int, list[Job]] = {}
        self._given = Counter[int]()
        for number, (group, size) in enumerate(zip(planned, sizes, strict=True)):
            left = [m for m in group.members if _is_left(current.members_folder, m.name)]
            chunks = [left[i : i + size] for i in range(0, len(left), size)]
            shared = {"group": number, "together": size > 1, "loggers": loggers}
            jobs = [Job.of(current.members_folder, chunk, **shared) for chunk in chunks]
            if jobs:
                self._waiting[number] = jobs[::-1]

    def next(self, group: int | None) -> Job | None:
        """See `Jobs`."""
        if not self._waiting:
            return None
        if group not in self._waiting:
            group = min(self._waiting, key=lambda number: (self._given[number], number))
        self._given[group] += 1
        job = self._waiting[group].pop()
        if not self._waiting[group]:
            del self._waiting[group]
        return job

    def ended(self, job: Job) -> None:
        """See `Jobs`."""


def _is_left(folder: Path, name: str) -> bool:
    """Whether a member has not ended; one that failed is tried anew: what it failed of may be gone."""
    found = ended(folder, name)
    if found is not None and found.status == FAILED:
        (folder / f"{name}.json").unlink()
    return found is None or found.status == FAILED


def _examples(asked: Spec) -> list[Member]:
    """The members of a grid; of a search one for each value that an axis is known to have."""
    if asked.search is None:
        return asked.members
    first = {name: (axis.values or (axis.low,))[0] for name, axis in asked.axes.items()}
    return [
        asked.member("trial", {**first, name: value})
        for name, axis in asked.axes.items()
        for value in (axis.values or (axis.low, axis.high))
    ]


def _told(asked: Spec, planned: Sequence[groups.Group], chunk: int, workers: int) -> str:
    """What is going to happen, in one line."""
    count = sum(len(group.members) for group in planned)
    what = f"{count} members" if asked.search is None else f"{asked.search.trials} trials"
    if asked.search is not None and len(asked.seeds) > 1:
        what += f" of {len(asked.seeds)} seeds"
    programs = f"{len(planned)} program{'s' * (len(planned) > 1)}"
    largest = max(group.member_bytes for group in planned) / 1e6
    chunks = f", up to {chunk} in one program" if chunk > 1 else ""
    return f"{what}, {programs}, {largest:.0f} MB a member{chunks}, {workers} worker{'s' * (workers > 1)}"


def _drive(current: Sweep, runner: Executor, jobs: Jobs, reporter: Reporter) -> None:
    """Run all jobs, and keep the table."""
    folder = current.members_folder
    rows: dict[str, list[Row]] = {}
    known = {member.name: member for member in current.members}
    best: tuple[float, str] | None = None
    sign = -1 if current.headline.metric.higher_is_better else 1
    written = time.monotonic()

    def lost(job: Job) -> None:
        for name, _ in job.members:
            if ended(folder, name) is None:
                finish(folder, name, Ending(FAILED, f"its worker died {ATTEMPTS} times"))

    def take(member: Member) -> None:
        nonlocal best
        rows[member.name] = found = current.rows(member)
        if found[-1]["status"] == DONE and found[-1].get("headline") is not None:
            candidate = (sign * found[-1]["headline"], member.name)
            best = min(best, candidate) if best else candidate

    def show() -> None:
        note = ""
        if best is not None:
            metric = current.headline.metric
            note = f"best {current.headline.name} {sign * best[0]:.4g} {metric.unit}".rstrip() + f" ({best[1]})"
        if unwell := sum(found[-1]["status"] in (FAILED, "diverged") for found in rows.values()):
            note += f", {unwell} failed or diverged"
        reporter.update(len(rows), note)

    for member in known.values():
        if ended(folder, member.name):
            take(member)
    show()
    for job in runner.run(jobs, lost):
        jobs.ended(job)
        for name, _ in job.members:
            if name not in known:  # Of a trial that is new.
                known |= {member.name: member for member in current.members}
            take(known[name])
            ending = ended(folder, name)
            if ending and ending.status != DONE:
                reporter.say(f"{name} {ending.status}: {ending.reason}")
        show()
        if time.monotonic() - written > WRITE_EVERY_S:
            results.write(current.folder, [row for name in sorted(rows) for row in rows[name]])
            written = time.monotonic()
    report.write(current, reporter.say)


def _gpus() -> int:
    """How many GPUs there are. Asking takes no share of their memory, which is for the workers."""
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    return len(jax.devices()) if jax.default_backend() == "gpu" else 0
