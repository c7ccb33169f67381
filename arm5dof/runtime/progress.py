"""Progress that people can watch: a live bar on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from datetime import timedelta
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
)
from rich.text import Text

from arm5dof.errors import Terminated

LINE_EVERY_S = 10.0

PATIENCE_S = 2.0
"""What takes less needs no bar."""


class Bar:
    """A progress bar on stderr with rate, ETA and a note; where stderr is no terminal, a line every ten seconds.

    `total` is None where nobody knows it: then there is no ETA. A request to end (SIGTERM) is raised by the next
    `update` as `Terminated`.
    """

    def __init__(self, what: str, total: int | None, unit: str, done: int = 0) -> None:
        self.what, self.total, self.unit, self.done = what, total, unit, done
        self._first, self._started, self._printed = done, time.monotonic(), time.monotonic()
        self._console = Console(stderr=True)
        self._progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn(unit),
            _Rate(),
            TextColumn("{task.fields[note]}", style="cyan", markup=False),
            TimeElapsedColumn(),
            _Remaining(),
            console=self._console,
            disable=not self._console.is_terminal,
            transient=True,
            # Rich would send what is printed meanwhile to stderr: right on one terminal, wrong into a file or pipe.
            redirect_stdout=sys.stdout is not None and sys.stdout.isatty(),
        )
        self._task = self._progress.add_task(what, total=total, completed=done, note="", later=0.0)
        self._before: Any = None
        self._asked_to_end = False

    def __enter__(self) -> Bar:
        self._progress.start()
        on_main_thread = threading.current_thread() is threading.main_thread()
        if on_main_thread and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
            self._before = signal.signal(signal.SIGTERM, self._terminate)
        return self

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            signal.signal(signal.SIGTERM, self._before)
        self._progress.stop()

    def _terminate(self, *_: object) -> None:
        self._asked_to_end = True

    def update(self, done: int, note: str = "", later: float = 0.0) -> None:
        """Move to `done` and show a note. What else there is to do takes so many seconds, which the ETA counts."""
        if self._asked_to_end:
            raise Terminated
        self.done = done
        self._progress.update(self._task, completed=done, note=note, later=later)
        now = time.monotonic()
        if not self._console.is_terminal and now - self._printed > LINE_EVERY_S:
            self._printed = now
            rate = max(done - self._first, 1) / (now - self._started)
            of, eta = "", ""
            if self.total is not None:
                left = (self.total - done) / rate + later
                of, eta = f"/{self.total}", f"  ETA {left:.0f} s" if left > 0 else ""
            self.say(f"{self.what}: {done}{of} {self.unit}  {_per_second(rate)}  {note}{eta}")

    def say(self, line: str) -> None:
        """Print a line above the bar."""
        self._console.print(line, highlight=False, markup=False, soft_wrap=True)


@contextmanager
def late_bar(what: str, total: int, unit: str) -> Iterator[Callable[[int, str], None]]:
    """A function that takes how much is done and a note; there is a bar only once that has gone on for two seconds."""
    started, bar = time.monotonic(), None
    with ExitStack() as stack:

        def update(done: int, note: str) -> None:
            nonlocal bar
            if bar is None and time.monotonic() - started > PATIENCE_S:
                bar = stack.enter_context(Bar(what, total, unit))
            if bar is not None:
                bar.update(done, note)

        yield update


class _Remaining(ProgressColumn):
    """When it will be done; nothing once it is, or while nobody knows."""

    max_refresh = 0.5

    def render(self, task: Task) -> Text:
        left = 0.0 if task.finished else task.time_remaining
        if left is None or not (left := left + task.fields["later"]):
            return Text("")
        return Text(f"ETA {timedelta(seconds=round(left))}", style="progress.remaining")


class _Rate(ProgressColumn):
    """How fast it went of late."""

    def render(self, task: Task) -> Text:
        return Text(_per_second(task.speed) if task.speed else "", style="progress.data.speed")


def _per_second(rate: float) -> str:
    return f"{rate:.1f}/s" if rate >= 1 else f"{rate:.3f}/s"
