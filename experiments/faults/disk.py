"""No room, no permission, files of another run: what is refused is one line, nothing is lost, and what goes on later
ends with the same bits."""

from __future__ import annotations

import ctypes
import resource
import shutil
import subprocess
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from trainings import MORE, TRAIN, Case, Cases, Result, cycles, environment, fingerprint, refused

SIZES_KB = (40, 100, 200, 400, 700)
"""Of disks that get full."""
LIMITS_KB = (1, 20, 60)
"""Of the largest file that may be written."""
SOLVE = ("solve", "{}", "--target", "0.1", "0", "0.2", "--json")
RESUME = ("train", "--resume={}", MORE)
CLOSED: tuple[tuple[str, int, tuple[str, ...]], ...] = (
    ("..", 0o500, (*TRAIN, "--out={}/../new")),
    *((name, 0o500, RESUME) for name in (".", "checkpoints")),
    *((name, 0, RESUME) for name in ("checkpoints", "config.toml", "metrics.csv")),
    (".", 0o500, SOLVE),
    *((name, 0, SOLVE) for name in (".", "checkpoints", "run.json", "model.mjb.gz")),
    ("evaluations.json", 0, ("compare", "{}")),
)
"""What of a run is closed, to which mode, and what is tried then."""
EXCHANGED = ("config.toml", "run.json", "model.mjb.gz", "model.zip", "metrics.csv", "evaluations.json", "checkpoints")
OF_A_CHECKPOINT = ("", "/networks", "/training", "/record")
GROWS = (".lock", "metrics.csv")
"""What a training that goes on writes to first."""
PR_CAPBSET_DROP = 24


def disk(work: Path, say: Callable[[int, int], None]) -> Cases:
    """Everything about files that are not as they should be. Cases of one kind share a process, which is quicker."""
    here = work / "disk"
    here.mkdir()
    other = [*TRAIN, "--seed=1"]
    made = _each(here, [*TRAIN, "--out=whole"], [*other, "--out=other"], [*other, "--arm=arm7.xml", "--out=arm7"])
    shutil.copytree(here / "whole", here / "longer")
    longer, answer = _each(here, _filled(RESUME, "longer"), _filled(SOLVE, "whole"))
    assert all(status in (0, 1) for status, _, _ in (*made, longer, answer)), (made, longer, answer)
    checkpoint = f"checkpoints/{fingerprint(here / 'whole')['step']}"
    exchanged = [*EXCHANGED, *(checkpoint + part for part in OF_A_CHECKPOINT)]
    total = len(SIZES_KB) + len(LIMITS_KB) + len(CLOSED) + 2 * len(exchanged)
    parts = (_full(here), _limited(here), _forbidden(here, answer[1]), _exchanged(here, answer[1], exchanged))
    for done, case in enumerate(case for part in parts for case in part):
        say(done + 1, total)
        yield case


def _each(here: Path, *commands: Sequence[str], **more: Any) -> list[Result]:
    """What comes of commands, one after the other, whatever comes of those before."""
    return [found[0] for found in cycles([[command] for command in commands], here, environment(), **more)]


def _filled(words: Sequence[str], run: object) -> list[str]:
    return [word.replace("{}", str(run)) for word in words]


def _full(here: Path) -> Cases:
    """Disks that get full, and then larger."""
    places = [here / f"{size}k" for size in SIZES_KB]
    for place, size in zip(places, SIZES_KB, strict=True):
        place.mkdir()
        if not _mounted(place, size):
            yield Case(f"a disk of {size} kB", False, "not tried: it needs root, and mount")
    places = [place for place in places if place.is_mount()]
    try:
        found = _each(here, *([*TRAIN, f"--out={place}/run"] for place in places))
        assert all(_mounted(place, 100_000, "-o", "remount") for place in places)
        for place, case in zip(places, _go_on(here, [place / "run" for place in places], found), strict=True):
            yield case._replace(name=f"a disk of {place.name}B")
    finally:
        for place in places:
            subprocess.run(["umount", str(place)], check=False)


def _mounted(place: Path, size: int, *more: str) -> bool:
    command = ["mount", *more, "-t", "tmpfs", "-o", f"size={size}k", "tmpfs", str(place)]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


def _limited(here: Path) -> Cases:
    """Files that may not grow."""
    runs = [here / f"limit{size}" for size in LIMITS_KB]
    found = []
    for run, size in zip(runs, LIMITS_KB, strict=True):
        limit = lambda size=size: resource.setrlimit(resource.RLIMIT_FSIZE, (size * 1024, -1))
        found += _each(here, [*TRAIN, f"--out={run}"], preexec_fn=limit)
    for size, case in zip(LIMITS_KB, _go_on(here, runs, found), strict=True):
        yield case._replace(name=f"files of {size} kB at most")


def _go_on(here: Path, runs: Sequence[Path], found: Sequence[Result]) -> Iterator[Case]:
    """Trainings for which there was no room, once there is some."""
    again = _each(here, *(["train", f"--resume={run}"] if run.exists() else [*TRAIN, f"--out={run}"] for run in runs))
    right = fingerprint(here / "whole")
    for run, first, second in zip(runs, found, again, strict=True):
        same = second[0] in (0, 1) and fingerprint(run) == right
        told = f"{_said(first)}; with room {'same bits' if same else _said(second)}"
        yield Case("", (refused(first) or first[0] in (0, 1)) and same, told)


def _said(result: Result) -> str:
    """What came of a command, shortly."""
    status, _, said = result
    lines = [line for line in said.splitlines() if line.startswith("arm5dof: ")]
    return "done" if status in (0, 1) else f"{status}, {' '.join(lines or said.split())}"


def _forbidden(here: Path, answer: str) -> Cases:
    """Files and folders that may not be read or written."""
    runs, before = [here / "forbidden" / str(i) / "whole" for i in range(len(CLOSED))], []
    for run, (name, mode, _) in zip(runs, CLOSED, strict=True):
        shutil.copytree(here / "whole", run)
        before.append({p: p.stat().st_mtime_ns for p in run.rglob("*") if p.is_file() and p.name not in GROWS})
        (run / name).chmod(mode)
    tried = [_filled(words, run) for run, (_, _, words) in zip(runs, CLOSED, strict=True)]
    found = _each(here, *tried, preexec_fn=_humble)
    for run, (name, _, _) in zip(runs, CLOSED, strict=True):
        run.chmod(0o755)
        (run / name).chmod(0o755)
    for (name, mode, words), result, times in zip(CLOSED, found, before, strict=True):
        lost = [str(p) for p, when in times.items() if not p.exists() or p.stat().st_mtime_ns != when]
        answered = words[0] == "solve" and result[0] == 0 and result[1] == answer
        told = _said(result) + (f" LOST {lost}" if lost else "")
        yield Case(f"{words[0]}, {name} of mode {mode:o}", (refused(result) or answered) and not lost, told)


def _humble() -> None:
    """Take from root what lets it write and read all: CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH."""
    for capability in (1, 2):
        ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, capability, 0, 0, 0)


def _exchanged(here: Path, answer: str, names: Sequence[str]) -> Cases:
    """Files of another training, of the same arm and of another: they are refused, or change nothing."""
    plan = [(name, donor) for name in names for donor in ("other", "arm7")]
    copies = [here / "exchanged" / str(i) for i in range(len(plan))]
    for copy, (name, donor) in zip(copies, plan, strict=True):
        shutil.copytree(here / "whole", copy)
        place, theirs = copy / name, here / donor / name
        shutil.rmtree(place) if place.is_dir() else place.unlink()
        shutil.copytree(theirs, place) if theirs.is_dir() else shutil.copy(theirs, place)
    found = _each(here, *(_filled(words, copy) for copy in copies for words in (SOLVE, RESUME)))
    longer = fingerprint(here / "longer")
    for i, (copy, (name, donor)) in enumerate(zip(copies, plan, strict=True)):
        solved, resumed = found[2 * i : 2 * i + 2]
        good = (refused(solved) or solved[:2] == (0, answer)) and (refused(resumed) or fingerprint(copy) == longer)
        told = f"solve {_said(solved)}; resume {_said(resumed)}"
        yield Case(f"{name} of another run ({donor})", good, told)
