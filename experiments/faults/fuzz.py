"""Damaged inputs for every reader, in processes that are watched.

A worker reads one input after another, by the command line's own `main`. One that takes too long, or dies, is a fault,
and another takes its place. Every input follows from the seed, its reader and its number alone.
"""

from __future__ import annotations

import json
import os
import selectors
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import psutil
import readers

PATIENCE_S = 10.0
"""Of a processor, for one input: seconds by the clock say little where other processes run. What takes longer may only
have compiled programs, so that it is read once more, and is a hang if it takes that long again."""
LIMIT_S = 90.0
"""Of a processor, programs and all; three times that by the clock, for what waits without end."""
MEMORY = 4 * 2**30
"""Bytes from which a worker is exchanged for a new one, for programs stay in memory."""
FAULTS = ("traceback", "hang", "died", "pickle", "lost", "litter", "unclear", "not JSON")
"""What must not be: an error's traceback; more than ten seconds; a process that dies; a pickle that is run; an input
that is changed; an output that is left half; a refusal without its line, or with others; JSON that is none."""


class Outcome(NamedTuple):
    """What came of one input."""

    reader: str
    number: int
    kind: str
    """`answered`, `refused`, or one of the faults."""
    seconds: float
    """Of a processor."""
    told: str
    """What was said, or what is wrong."""


def plan(inputs: int, only: Sequence[str]) -> list[tuple[str, int]]:
    """Which inputs there are: readers by their shares, all readers at once."""
    chosen = {name: one.share for name, one in readers.READERS.items() if not only or name in only}
    counts = {name: max(1, round(inputs * share / sum(chosen.values()))) for name, share in chosen.items()}
    every = [((i + 0.5) / count, name, i) for name, count in counts.items() for i in range(count)]
    return [(name, i) for _, name, i in sorted(every)]


class Worker:
    """A process that reads inputs."""

    def __init__(self, folder: Path, seed: int, sound: Path) -> None:
        self.folder = folder
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        ours, theirs = os.pipe(), os.pipe()
        self._ask, self.answers = ours[1], theirs[0]
        command = [
            sys.executable,
            str(Path(__file__).with_name("reading.py")),
            str(folder),
            str(sound),
            str(seed),
            str(ours[0]),
            str(theirs[1]),
        ]
        canary = str(folder.parent / readers.CANARY)
        environment = {
            **os.environ,
            "PYTHONPATH": str(readers.ROOT),
            "FAULTS_CANARY": canary,
            "PYTHONFAULTHANDLER": "1",
        }
        self.process = subprocess.Popen(
            command, pass_fds=(ours[0], theirs[1]), stdin=subprocess.DEVNULL, env=environment, cwd=folder
        )
        os.close(ours[0])
        os.close(theirs[1])
        self.task: tuple[str, int] | None = None
        self._repeated, self._text = False, b""

    def give(self, task: tuple[str, int], repeated: bool = False) -> None:
        """Hand over an input."""
        self.task, self._repeated, self._since, self._used = task, repeated, time.monotonic(), self._cpu()
        os.write(self._ask, (json.dumps(task) + "\n").encode())

    def take(self) -> Outcome | None:
        """What came of it, if that is known."""
        assert self.task is not None
        part = os.read(self.answers, 1 << 20)
        if not part:
            return self._ended("died", f"signal {-self.process.wait()}")
        self._text += part
        if not self._text.endswith(b"\n"):
            return None
        outcome = Outcome(*self.task, *json.loads(self._text))
        self._text = b""
        if outcome.seconds > PATIENCE_S:
            if not self._repeated:
                return self.give(self.task, repeated=True)
            outcome = outcome._replace(kind="hang", told=f"{outcome.seconds:.0f} s of a processor, twice")
        self.task = None
        return outcome

    def overdue(self) -> Outcome | None:
        """That it takes too long, if it does."""
        if self.task is None:
            return None
        used, passed = self._cpu() - self._used, time.monotonic() - self._since
        if max(used, passed / 3) < LIMIT_S:
            return None
        self.process.kill()
        return self._ended("hang", f"{used:.0f} s of a processor, {passed:.0f} s by the clock")

    def _ended(self, kind: str, why: str) -> Outcome:
        assert self.task is not None
        said = (self.folder / "said").read_text(errors="replace")[-600:] if (self.folder / "said").exists() else ""
        return Outcome(*self.task, kind, time.monotonic() - self._since, f"{why}: {' '.join(said.split())}")

    def _cpu(self) -> float:
        try:
            used = psutil.Process(self.process.pid).cpu_times()
            return float(used.user + used.system)
        except psutil.Error:
            return 0.0

    @property
    def is_large(self) -> bool:
        """Whether it holds too much memory to go on."""
        return psutil.Process(self.process.pid).memory_info().rss > MEMORY

    def close(self) -> None:
        """End it."""
        self.process.kill()
        self.process.wait()
        os.close(self._ask)
        os.close(self.answers)


def prepare(work: Path) -> Path:
    """Sound inputs, made in a process of their own. Returns their folder."""
    sound = work / "sound"
    if not sound.exists():
        code = "import pathlib, sys, sound; sound.prepare(pathlib.Path(sys.argv[1]))"
        path = os.pathsep.join((str(readers.ROOT), str(Path(__file__).parent)))
        environment = {**os.environ, "PYTHONPATH": path, "FAULTS_CANARY": str(work / readers.CANARY)}
        command = [sys.executable, "-c", code, str(sound)]
        subprocess.run(command, env=environment, check=True, cwd=work, stdout=subprocess.DEVNULL)
    return sound


def campaign(tasks: Sequence[tuple[str, int]], seed: int, workers: int, work: Path) -> Iterator[Outcome]:
    """Read inputs, and yield what came of each."""
    sound = prepare(work)
    waiting = list(tasks)[::-1]
    pool = [Worker(work / f"w{i}", seed, sound) for i in range(workers)]
    busy = 0
    while waiting or busy:
        for i, worker in enumerate(pool):
            if worker.task is None and waiting:
                if worker.is_large:
                    worker.close()
                    worker = pool[i] = Worker(worker.folder, seed, sound)
                worker.give(waiting.pop())
                busy += 1
        with selectors.DefaultSelector() as selector:
            for i, worker in enumerate(pool):
                selector.register(worker.answers, selectors.EVENT_READ, i)
            ready = {key.data for key, _ in selector.select(1.0)}
        for i, worker in enumerate(pool):
            if worker.task is None:
                continue
            outcome = worker.take() if i in ready else worker.overdue()
            if outcome is not None:
                busy -= 1
                if outcome.kind in ("died", "hang"):
                    worker.close()
                    pool[i] = Worker(worker.folder, seed, sound)
                yield outcome
    for worker in pool:
        worker.close()


def again(reader: str, number: int, seed: int, work: Path) -> Outcome:
    """What comes of one input."""
    [outcome] = campaign([(reader, number)], seed, 1, work)
    return outcome


def table(outcomes: Sequence[Outcome]) -> str:
    """What came of all inputs, as Markdown."""
    counts = {name: Counter(o.kind for o in outcomes if o.reader == name) for name in readers.READERS}
    counts = {name: count for name, count in counts.items() if count}
    counts["**all**"] = sum(counts.values(), Counter())
    lines = [
        f"| reader | inputs | answered | refused | {' | '.join(FAULTS)} |",
        f"| --- | {' | '.join(['---:'] * (3 + len(FAULTS)))} |",
    ]
    for name, count in counts.items():
        cells = [count.total(), count["answered"], count["refused"], *(count[kind] for kind in FAULTS)]
        lines.append(f"| {name} | {' | '.join(map(str, cells))} |")
    faults = [o for o in outcomes if o.kind in FAULTS]
    lines += ["", *(f"- {o.reader}:{o.number} {o.kind}: `{o.told[-300:]}`" for o in faults[:100])]
    return "\n".join(lines).strip()
