"""Whole trainings in odd places and under odd settings: they end with the digits of one in a plain place, or are
refused in one line before they begin."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from readers import ROOT
from trainings import MORE, TRAIN, Case, Cases, Result, cycle, cycles, environment, fingerprint, refused


def commands(place: str, out: str) -> list[list[str]]:
    """A training with files in a folder, and what is asked of it afterwards."""
    file = lambda name: f"{place}/{name}"
    robot = "arm7.xml" if "\\" in place else file("robot.xml")  # MuJoCo takes a backslash for a slash.
    run = f"./{out}" if out.startswith("--") else out  # As for any command.
    return [
        [*TRAIN, f"--arm={robot}", f"--out={out}"],
        ["train", f"--resume={out}", MORE],
        ["solve", run, f"--csv={file('targets.csv')}", f"--out={file('answers.csv')}"],
        ["vision", "locate", file("found.json"), f"--camera={file('camera.yml')}", "--json"],
        ["vision", "detect", file("small.png"), f"--detector={file('net.onnx')}", "--json"],
        ["vision", "detect", file("clip.mp4"), f"--detector={file('net.onnx')}", "--json"],
    ]


FILES = ("targets.csv", "found.json", "camera.yml", "small.png", "net.onnx", "clip.mp4")
PATHS = (
    *("sweep[lr=0.1]", "[", "a]b[", "back\\slash", "two words", " before", "after ", "na\u00efve", "\u6f22\u5b57"),
    *("\U0001f916", "q'uote", 'dou"ble', "-dash", "--dashes", "*", "what?", "{brace}", "$HOME", "~", "~nobody"),
    *("%s%d%02d.png", "[/b]", "[bold red]x", "new\nline", "tab\there", "x" * 200, "y" * 255, "deep/" * 60 + "er"),
    *("link/in", "100%", "a:b", "a;b|c&d", "#hash", "a,b", "1e5", "nan", "@file", "a=b", ".hidden", "..x", "con.toml"),
    *("e\u0301", "\u202ertl", os.fsdecode(b"not-\xff-utf8")),
)  # fmt: skip


def paths(work: Path, sound: Path, say: Callable[[int, int], None]) -> Cases:
    """A training, its resumption and answers, in folders of awkward names."""
    here = work / "paths"
    (here / "somewhere").mkdir(parents=True)
    (here / "link").symlink_to("somewhere")

    names, places = ["plain", *PATHS], []
    for name in names:
        folder = here / ("in" + name)
        try:
            folder.mkdir(parents=True)
        except OSError:  # Too long with what is before it.
            folder = here / "files" / str(len(name))
            folder.mkdir(parents=True, exist_ok=True)
        for file in FILES:
            shutil.copy(sound / "common" / file, folder / file)
        shutil.copy(ROOT / "mjcf" / "arm7.xml", folder / "robot.xml")
        places.append(folder)

    def some(numbers: Sequence[int]) -> Iterator[tuple[str, list[Result], Any]]:
        relative = [os.path.relpath(places[i], here) for i in numbers]
        lists = [commands(place, names[i]) for i, place in zip(numbers, relative, strict=True)]
        for i, place, found in zip(numbers, relative, cycles(lists, here, environment()), strict=True):
            answers = places[i] / "answers.csv"
            seen = [printed.replace(json.dumps(place)[1:-1], "") for _, printed, _ in found[3:]]
            whole = len(found) > 1 and found[1][0] in (0, 1)
            came_to = fingerprint(here / names[i]) if whole else None
            yield names[i], found, (came_to, answers.read_text() if answers.exists() else "", seen)

    groups = [range(i, min(i + 8, len(names))) for i in range(0, len(names), 8)]
    yield from _compared(some, groups, len(names), say, lambda name: (here / name).exists())


def _compared(
    some: Callable[[Any], Iterator[tuple[str, list[Result], Any]]],
    groups: Sequence[Any],
    total: int,
    say: Callable[[int, int], None],
    left: Callable[[str], bool],
) -> Cases:
    """Cases beside the first of them."""
    right: Any = None
    with ThreadPoolExecutor(2) as pool:
        results = (one for group in pool.map(lambda group: list(some(group)), groups) for one in group)
        for i, (name, found, came_to) in enumerate(results):
            say(i + 1, total)
            status, _, said = found[-1]
            told = " ".join(str(said).split())[-300:]
            if status in (0, 1):
                right = came_to if i == 0 else right
                good = came_to == right
                yield Case(name, good, "same digits" if good else f"OTHER DIGITS: {came_to} {right}")
            elif len(found) == 1:
                good = refused(found[-1]) and not left(name)
                yield Case(name, good, f"refused: {told}" if good else f"{status}, before the first step: {told}")
            else:
                yield Case(
                    name, refused(found[-1]) and len(found) > 3, f"trained; command {len(found)} is refused: {told}"
                )


VARIABLES = """HOME=|HOME|HOME=/nonexistent|XDG_CACHE_HOME=|XDG_CACHE_HOME=relative|XDG_CACHE_HOME=/proc/none
JAX_PLATFORMS=cuda|JAX_PLATFORMS=cpu|JAX_PLATFORMS=nonsense|JAX_ENABLE_X64=1|JAX_ENABLE_X64=maybe
JAX_NUMPY_RANK_PROMOTION=raise|JAX_NUMPY_RANK_PROMOTION=warn|JAX_NUMPY_DTYPE_PROMOTION=strict|JAX_DEBUG_NANS=1
JAX_DEBUG_INFS=1|JAX_DISABLE_JIT=1|JAX_DEFAULT_PRNG_IMPL=rbg|JAX_THREEFRY_PARTITIONABLE=0|JAX_ENABLE_CUSTOM_PRNG=1
JAX_DEFAULT_MATMUL_PRECISION=bfloat16|JAX_CHECK_TRACER_LEAKS=1|JAX_TRACEBACK_FILTERING=off|JAX_TRANSFER_GUARD=disallow
JAX_COMPILATION_CACHE_DIR=/proc/none|JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS=x|JAX_LOG_COMPILES=1
XLA_FLAGS=--nonsense|XLA_FLAGS=words|LC_ALL=C|LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0 PYTHONIOENCODING=ascii
LC_ALL=xx_XX LANG=xx_XX.UTF-8|PYTHONHASHSEED=7|PYTHONOPTIMIZE=2|PYTHONWARNINGS=error|PYTHONDEVMODE=1|COLUMNS=1|COLUMNS=x
NO_COLOR=1|FORCE_COLOR=1|TERM=dumb|TERM|OMP_NUM_THREADS=1|OMP_NUM_THREADS=x|MUJOCO_GL=nonsense|MUJOCO_GL=egl
TMPDIR=/nonexistent|TMPDIR=/proc|MPLBACKEND=nonsense|MPLCONFIGDIR=/proc/none|PATH=|TZ=nonsense|TF_CPP_MIN_LOG_LEVEL=x"""
"""Settings of the environment; a name alone is taken away."""


def environments(work: Path, sound: Path, say: Callable[[int, int], None]) -> Cases:
    """The same under odd variables of the environment."""
    here = work / "environment"
    (here / "files").mkdir(parents=True)
    for file in FILES:
        shutil.copy(sound / "common" / file, here / "files" / file)
    shutil.copy(ROOT / "mjcf" / "arm7.xml", here / "files" / "robot.xml")
    cases: dict[str, dict[str, str | None]] = {"as it is": {}}
    for words in VARIABLES.replace("\n", "|").split("|"):
        pairs = (word.partition("=") for word in words.split())
        cases[words] = {name: value if equals else None for name, equals, value in pairs}
    numbers = {name: i for i, name in enumerate(cases)}

    def one(name: str) -> Iterator[tuple[str, list[Result], Any]]:
        folder = here / str(numbers[name])
        shutil.copytree(here / "files", folder)
        found = cycle(commands(".", "run")[:4], folder, environment(**cases[name]))
        answers = folder / "answers.csv"
        came_to = fingerprint(folder / "run") if len(found) > 1 and found[1][0] in (0, 1) else None
        seen = [printed for _, printed, _ in found[3:]]
        yield name, found, (came_to, answers.read_text() if answers.exists() else "", seen)

    left = lambda name: (here / str(numbers[name]) / "run").exists()
    yield from _compared(one, list(cases), len(cases), say, left)
