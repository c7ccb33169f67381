"""Damaged inputs for every reader, in processes that are watched.

A worker reads one input after another, by the command line's own `main`. One that takes too long, or dies, is a fault,
and another takes its place. Every input follows from the seed, its reader and its number alone.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import selectors
import shutil
import subprocess
import sys
import time
import traceback
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import psutil
import readers

PATIENCE_S = 10.0
"""Of a processor, for one input; twelve times that by the clock, for other processes are there too."""
WARM_UP_S = 300.0
"""For the first input that a worker gets: programs are compiled."""
MEMORY = 4 * 2**30
"""Bytes from which a worker is exchanged for a new one, for programs stay in memory."""
FAULTS = ("traceback", "hang", "died", "pickle", "lost", "litter", "unclear", "not JSON")
"""What must not be: an error's traceback; more than ten seconds; a process that dies; a pickle that is run; an input
that is changed; an output that is left half; a refusal without its line, or with others; JSON that is none."""

BAR = re.compile(r"[a-z][a-z :]*: \d+/\d+ ")
"""A line of a progress bar."""
FOREIGN = re.compile(r"WARN|libpng|JPEG|TIFF|Warning:|[Ee]rror\b")
"""What is said by libraries that have not been asked."""


class Outcome(NamedTuple):
    """What came of one input."""

    reader: str
    number: int
    kind: str
    """`answered`, `refused`, or one of the faults."""
    seconds: float
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
            str(Path(__file__)),
            str(folder),
            str(sound),
            str(seed),
            str(ours[0]),
            str(theirs[1]),
        ]
        canary = str(folder.parent / readers.CANARY)
        environment = {**os.environ, "PYTHONPATH": str(readers.ROOT), "FAULTS_CANARY": canary}
        self.process = subprocess.Popen(
            command, pass_fds=(ours[0], theirs[1]), stdin=subprocess.DEVNULL, env=environment, cwd=folder
        )
        os.close(ours[0])
        os.close(theirs[1])
        self.task: tuple[str, int] | None = None
        self.fresh, self._text = True, b""

    def give(self, task: tuple[str, int]) -> None:
        """Hand over an input."""
        self.task, self._since, self._used = task, time.monotonic(), self._cpu()
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
        self._text, self.task, self.fresh = b"", None, False
        return outcome

    def overdue(self) -> Outcome | None:
        """That it takes too long, if it does."""
        if self.task is None:
            return None
        used, passed = self._cpu() - self._used, time.monotonic() - self._since
        if max(used, passed / 12) < (WARM_UP_S if self.fresh else PATIENCE_S):
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


def campaign(inputs: int, only: Sequence[str], seed: int, workers: int, work: Path) -> Iterator[Outcome]:
    """Read all inputs, and yield what came of each."""
    sound = prepare(work)
    waiting = plan(inputs, only)[::-1]
    pool = [Worker(work / f"w{i}", seed, sound) for i in range(workers)]
    busy = 0
    while waiting or busy:
        for i, worker in enumerate(pool):
            if worker.task is None and waiting:
                if not worker.fresh and worker.is_large:
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
    worker = Worker(work / "w0", seed, prepare(work))
    worker.give((reader, number))
    outcome = None
    while outcome is None:
        outcome = worker.take()
    worker.close()
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


# The worker's side.


def work(folder: Path, sound: Path, seed: int, asks: int, answers: int) -> None:
    """Read inputs until nobody asks for more."""
    from arm5dof.cli import main as cli

    readers.shorten()
    _keep_policies()
    said = os.open(folder / "said", os.O_RDWR | os.O_CREAT | os.O_TRUNC)
    os.dup2(said, 2)
    out = os.open(folder / "printed", os.O_RDWR | os.O_CREAT | os.O_TRUNC)
    os.dup2(out, 1)
    for line in os.fdopen(asks):
        reader, number = json.loads(line)
        for file in (1, 2):
            os.ftruncate(file, 0)
            os.lseek(file, 0, os.SEEK_SET)
        started = time.monotonic()
        kind, told = _one(cli.main, folder, sound, seed, reader, number)
        os.write(answers, (json.dumps([kind, time.monotonic() - started, told]) + "\n").encode())


def _one(main: Any, folder: Path, sound: Path, seed: int, reader: str, number: int) -> tuple[str, str]:
    how, rng = readers.READERS[reader], np.random.default_rng([seed, zlib.crc32(reader.encode()), number])
    given, outputs = folder / "in", folder / "out"
    for place in (given, outputs):
        shutil.rmtree(place, ignore_errors=True)
    outputs.mkdir()
    shutil.copytree(readers.pick(rng, sorted((sound / reader).iterdir())), given)
    if how.damaged:
        readers.damage(rng, given, how.damaged, sound)
    words = how.command(given, outputs / "out", rng)
    before = _digests(given)
    canary = folder.parent / readers.CANARY
    (folder / "words").write_text(json.dumps(words))
    status: Any = None
    try:
        status = main(words)
    except readers.Began:
        status = 0
    except SystemExit as end:
        status = end.code
    except BaseException:
        return "traceback", traceback.format_exc()[-1500:]
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
    printed, said = ((folder / name).read_text(errors="replace") for name in ("printed", "said"))
    if canary.exists():
        canary.unlink()
        return "pickle", said
    if "Traceback" in said:
        return "traceback", said[-1500:]
    after = _digests(given)
    if changed := [name for name in before if after.get(name) != before[name] and (how.kept or name not in after)]:
        return "lost", f"{words}: {changed}"
    if status == 2 and how.damaged and reader != "targets" and (left := [path.name for path in outputs.iterdir()]):
        return "litter", f"{words}: {left}: {said}"
    strange = [line for line in said.splitlines() if not line.startswith("arm5dof: ") and not BAR.match(line)]
    strange = [line for line in strange if status == 2 or FOREIGN.search(line)]
    if status not in (0, 1, 2) or strange or (status == 2 and "arm5dof: " not in said):
        return "unclear", f"{words}: status {status}, said: {' / '.join(strange) or said}"
    if status == 0 and "--json" in words and printed.strip() and "--help" not in words and "-h" not in words:
        try:
            json.loads(printed, parse_constant=_refuse)
        except ValueError:
            return "not JSON", printed[:500]
    return ("refused" if status == 2 else "answered"), said[-300:]


def _refuse(word: str) -> float:
    raise ValueError(word)


def _digests(folder: Path) -> dict[str, str]:
    """What is in a folder's files, by name."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.name != ".lock":
            found[str(path.relative_to(folder))] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def _keep_policies() -> None:
    """A policy of a sound run is restored once, not for every file of targets."""
    from arm5dof.training.run import Run

    made: dict[str, Any] = {}
    restore = Run.policy

    def policy(run: Run) -> Any:
        key = json.dumps(_digests(run.folder))
        if key not in made:
            found = restore(run)
            if len(made) > 3:
                return found
            made[key] = found
        return made[key]

    Run.policy = policy  # type: ignore[method-assign]


if __name__ == "__main__":
    where, seeds, seed_text, asked, answered = sys.argv[1:]
    work(Path(where), Path(seeds), int(seed_text), int(asked), int(answered))
