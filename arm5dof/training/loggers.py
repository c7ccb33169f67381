"""Where a run's curves go besides its own folder: TensorBoard, Weights & Biases, or any object with three methods.

Curves are named `train/...`, a point an epoch, and `evaluation/...`, over the transitions so far (`env_steps`).
"""

from __future__ import annotations

import json
import os
import time
import uuid
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from arm5dof.errors import UserError, nearest_hint
from arm5dof.runtime import files

if TYPE_CHECKING:
    from arm5dof.training.run import Run

Values = dict[str, float]
Point = tuple[int, Values]
"""Transitions so far, and numbers by the names of their curves."""


class Logger(Protocol):
    """Something that keeps curves. What it raises is a warning to the user, and the end of that logger alone."""

    def start(self, run: Run, history: Sequence[Point]) -> None:
        """A training begins or goes on.

        Args:
            run: The run, with its folder and configuration.
            history: Its curves so far, in order. Whatever else an earlier process logged of this run is void: it comes
                after the checkpoint from which the training goes on.
        """
        ...

    def log(self, step: int, values: Values) -> None:
        """The next point. `step` may be that of the last one."""
        ...

    def close(self) -> None:
        """The training has ended, one way or another; also called where `start` has failed."""
        ...


def make_loggers(names: str | Iterable[str | Logger]) -> list[Logger]:
    """Loggers by name. They open nothing before they are started, so that what they lack is known before a run begins.

    Args:
        names: Any of `tensorboard` and `wandb`, or loggers of one's own; text is a list with commas.

    Raises:
        UserError: There is none of that name, its extra is not installed, or it is not logged in.

    >>> from arm5dof.training.loggers import make_loggers
    >>> make_loggers("tensorbord")
    Traceback (most recent call last):
    arm5dof.errors.UserError: no logger 'tensorbord': did you mean 'tensorboard'?
    """
    if isinstance(names, str):
        names = [name.strip() for name in names.split(",")]
    return [_make(name) if isinstance(name, str) else name for name in dict.fromkeys(names)]


def _make(name: str) -> Logger:
    if name not in LOGGERS:
        raise UserError(f"no logger {name!r}: {nearest_hint(name, LOGGERS)}")
    try:
        return LOGGERS[name]()
    except ImportError as error:
        raise UserError(f"{name} is not installed ({error}): pip install 'arm5dof[{name}]'") from None


class Log:
    """The loggers of one training. One that fails is left out from then on."""

    def __init__(self, run: Run, loggers: Iterable[Logger]) -> None:
        self._run, self._loggers = run, list(loggers)

    def __bool__(self) -> bool:
        return bool(self._loggers)

    def epoch(self, row: Mapping[str, Any]) -> None:
        """Log a row of `metrics.csv`."""
        self._each("log", *_point("train", row))

    def evaluation(self, evaluation: Mapping[str, Any]) -> None:
        """Log an entry of `evaluations.json`."""
        self._each("log", *_point("evaluation", evaluation))

    def _each(self, method: str, *args: Any) -> None:
        for logger in list(self._loggers):
            try:
                getattr(logger, method)(*args)
            except Exception as error:  # Another's code, files and network.
                self._loggers.remove(logger)
                reason = (str(error) or type(error).__name__).strip().splitlines()[0]
                warnings.warn(
                    f"{self._run.folder} is no longer logged by {type(logger).__name__} ({reason})", stacklevel=3
                )
                with suppress(Exception):
                    logger.close()


@contextmanager
def logging(
    run: Run, loggers: Iterable[Logger], rows: Iterable[Mapping[str, Any]], evaluations: Iterable[Mapping[str, Any]]
) -> Iterator[Log]:
    """Start loggers for a training, and close them when the block ends.

    Args:
        run: The run.
        loggers: From `make_loggers`.
        rows: The rows of `metrics.csv` with which the training goes on.
        evaluations: The same of `evaluations.json`.
    """
    log = Log(run, loggers)
    try:
        if log:
            points = [*(_point("train", row) for row in rows), *(_point("evaluation", e) for e in evaluations)]
            log._each("start", run, sorted(points, key=lambda point: point[0]))
        yield log
    finally:
        log._each("close")


def _point(prefix: str, row: Mapping[str, Any]) -> Point:
    """The numbers of a row, which may be text as in a CSV file, and of what is nested in it."""

    def flat(prefix: str, row: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
        for name, value in row.items():
            if isinstance(value, Mapping):
                yield from flat(f"{prefix}/{name}", value)
            elif name not in ("steps", "env_steps"):
                with suppress(ValueError, TypeError):
                    yield f"{prefix}/{name}", float(value)

    return int(row["env_steps"]), dict(flat(prefix, row))


class TensorBoard:
    """Events in the run's folder `tensorboard/`: `tensorboard --logdir runs` shows all runs.

    They are written anew from the run's own records whenever a training goes on, so that the curves are whole and
    nothing is in them twice, however the last process ended.
    """

    def __init__(self) -> None:
        import tensorboard.summary.writer.record_writer  # noqa: F401

        self._writer: Any = None
        self._void: list[Path] = []

    def start(self, run: Run, history: Sequence[Point]) -> None:
        from tensorboard.compat.proto.event_pb2 import SessionLog
        from tensorboard.plugins.hparams.summary_v2 import hparams_pb
        from tensorboard.summary.writer.record_writer import RecordWriter

        folder = run.folder / "tensorboard"
        folder.mkdir(exist_ok=True)
        before = list(folder.glob("events.out.tfevents.*"))
        # In this thread, and flushed at once: what fails does so here and now. Names sort by age.
        self._writer = RecordWriter(open(folder / f"events.out.tfevents.{time.time_ns()}", "wb"))
        self._write(file_version="brain.Event:2")
        self._write(session_log=SessionLog(status=SessionLog.START))  # A TensorBoard that is open forgets the curves.
        self._write(summary=hparams_pb(_plain(run)))
        for step, values in history:
            self.log(step, values)
        self._void = before

    def log(self, step: int, values: Values) -> None:
        from tensorboard.compat.proto.summary_pb2 import Summary

        curves = [Summary.Value(tag=name, simple_value=value) for name, value in values.items()]
        self._write(step=step, summary=Summary(value=curves))

    def _write(self, **event: Any) -> None:
        from tensorboard.compat.proto.event_pb2 import Event

        self._writer.write(Event(wall_time=time.time(), **event).SerializeToString())
        self._writer.flush()

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()
        for path in self._void:  # Only now: a TensorBoard that is open has to have gone on to the new file.
            path.unlink(missing_ok=True)


class Wandb:
    """A run of Weights & Biases, in the project of `WANDB_PROJECT` or else `arm5dof`; offline if `WANDB_MODE` says so.

    The run's folder keeps its name there, and what it has been sent, in `wandb.json`: a training that goes on sends
    what is new. What was sent stays: of an earlier process, points after its last checkpoint too, which differ if the
    budget has been changed before the training went on.
    """

    def __init__(self) -> None:
        import wandb

        self._run: Any = None
        if wandb.setup().settings.mode in ("online", "run", "shared"):
            try:
                wandb.login()
            except Exception as error:
                raise UserError(
                    f"wandb cannot be used ({str(error).splitlines()[0]}): run wandb login, or set WANDB_MODE=offline"
                ) from None

    def start(self, run: Run, history: Sequence[Point]) -> None:
        import wandb

        self._path = run.folder / "wandb.json"
        if self._path.exists():
            with files.undamaged(self._path, "remove it to send the curves to a new run of Weights & Biases"):
                found = json.loads(self._path.read_text(encoding="utf-8"))
                sent = {str(kind): int(step) for kind, step in found["sent"].items()}
                self._kept: dict[str, Any] = {"id": str(found["id"]), "points": int(found["points"]), "sent": sent}
        else:
            self._kept = {"id": uuid.uuid4().hex[:8], "points": 0, "sent": {}}
        self._run = wandb.init(
            project=os.environ.get("WANDB_PROJECT", "arm5dof"),
            name=run.folder.name,
            dir=run.folder,
            id=self._kept["id"],
            resume="allow",
            config=_plain(run),
            # The members of a population train in one process, each a run of its own.
            settings=wandb.Settings(console="off", quiet=True, reinit="create_new"),
        )
        self._run.define_metric("*", step_metric="env_steps")
        self._keep()
        for step, values in history:
            self.log(step, values)

    def log(self, step: int, values: Values) -> None:
        kind = next(iter(values)).partition("/")[0]
        if step <= self._kept["sent"].get(kind, -1):
            return
        # Steps of its own count points: those of a training repeat, and Weights & Biases would drop the second.
        self._run.log({"env_steps": step, **values}, step=self._kept["points"], commit=True)
        self._kept["points"] += 1
        self._kept["sent"][kind] = step
        self._keep()

    def _keep(self) -> None:
        files.write_text(self._path, json.dumps(self._kept) + "\n")

    def close(self) -> None:
        if self._run is not None:
            self._run.finish()


LOGGERS: dict[str, type[TensorBoard] | type[Wandb]] = {"tensorboard": TensorBoard, "wandb": Wandb}


def _plain(run: Run) -> dict[str, bool | int | float | str]:
    """A run's settings by their full names, tuples as text."""
    plain = lambda value: value if isinstance(value, (bool, int, float, str)) else str(value)
    return {name: plain(value) for name, value in run.config.flat().items()}
