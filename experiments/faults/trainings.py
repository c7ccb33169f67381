"""Whole trainings in odd places, under odd settings, that are killed, that see NaN, and that find no room: they end
with the digits of one that nothing happened to, or are refused in one line before they begin."""

from __future__ import annotations

import csv
import ctypes
import hashlib
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from readers import ROOT, SETTINGS

TRAIN = ["train", "kinematic.toml", *SETTINGS]
MORE = "--episodes=20"
LIMIT_S = 600
PR_CAPBSET_DROP = 24


class Case(NamedTuple):
    """What came of one case."""

    name: str
    good: bool
    told: str


Cases = Iterator[Case]


def environment(**changes: str | None) -> dict[str, str]:
    """This process's environment with some variables changed, or taken away."""
    every = {**os.environ, "PYTHONPATH": str(ROOT), **changes}
    return {name: value for name, value in every.items() if value is not None}


def fingerprint(run: Path) -> dict[str, Any]:
    """What a training has come to, bit for bit: digests of its newest checkpoint, its curves without the clock, and its
    evaluations, whichever run that is."""
    step = max((p for p in (run / "checkpoints").iterdir() if p.name.isdigit()), key=lambda p: int(p.name))
    record = json.loads((step / "record" / "metadata").read_text())
    with open(run / "metrics.csv", newline="") as file:
        rows = [{k: v for k, v in row.items() if k not in ("seconds", "run")} for row in csv.DictReader(file)]
    curves = hashlib.sha256(json.dumps(rows).encode()).hexdigest()
    digests = {name: record[name]["sha256"] for name in ("networks", "training")}
    return {
        "step": step.name,
        **digests,
        "rows": curves,
        "evaluations": [e | {"run": None} for e in json.loads((run / "evaluations.json").read_text())],
    }


Result = tuple[Any, str, str]
"""The status of a command, what it printed and what it said."""


def cycles(lists: Sequence[Sequence[Sequence[str]]], cwd: Path, env: dict[str, str], **more: Any) -> list[list[Result]]:
    """Run lists of commands in one process, each list until a command is refused. Returns what came of each command."""
    piped = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    command = [sys.executable, str(Path(__file__).with_name("cycle.py"))]
    process = subprocess.Popen(command, **{"cwd": cwd, "env": env, **piped, **more})
    try:
        printed, said = process.communicate(json.dumps(lists).encode(), LIMIT_S * len(lists))
    except subprocess.TimeoutExpired:
        process.kill()
        printed, said = process.communicate()
        said = b"it hangs"
    found: list[list[Result]] = [[] for _ in lists]
    for line in printed.decode().splitlines():
        number, *result = json.loads(line)
        found[number].append(tuple(result))
    for one, commands in zip(found, lists, strict=True):  # A process that died has less to tell.
        if len(one) < len(commands) and (not one or one[-1][0] in (0, 1)):
            one.append((f"died with {process.returncode}", "", said.decode(errors="replace")))
    return found


def cycle(commands: Sequence[Sequence[str]], cwd: Path, env: dict[str, str], **more: Any) -> list[Result]:
    """One list of commands."""
    return cycles([commands], cwd, env, **more)[0]


def refused(result: tuple[Any, str, str]) -> bool:
    """Whether it is a refusal in one line."""
    status, _, said = result
    ours = [line for line in said.splitlines() if line.startswith("arm5dof: ")]
    return status == 2 and bool(ours) and "Traceback" not in said


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


LONGER = [*TRAIN, "--episodes=100"]


def signals(work: Path, seed: int, say: Callable[[int, int], None], kills: int = 20, ends: int = 10) -> Cases:
    """A training that is killed, or asked to end, at random moments, and goes on."""
    here = work / "signals"
    here.mkdir()
    command = lambda *words: [sys.executable, "-m", "arm5dof", *words]
    quiet = {
        "stdin": subprocess.DEVNULL,
        "stdout": subprocess.DEVNULL,
        "stderr": subprocess.PIPE,
        "cwd": here,
        "env": environment(),
    }
    subprocess.run(command(*LONGER, "--out=first"), **quiet, check=False)  # Programs are compiled and kept.
    started = time.monotonic()
    both = [subprocess.Popen(command(*LONGER, f"--out={name}"), **quiet) for name in ("whole", "again")]
    for process in both:
        process.communicate()
    lasts, right = time.monotonic() - started, fingerprint(here / "whole")
    moments = np.random.default_rng(seed).uniform(0.05, 1.0, kills + ends) * lasts

    def one(number: int) -> Case:
        kind = signal.SIGKILL if number < kills else signal.SIGTERM
        out = here / str(number)
        process = subprocess.Popen(command(*LONGER, f"--out={out.name}"), **quiet)
        try:
            _, said = process.communicate(timeout=moments[number])
        except subprocess.TimeoutExpired:
            process.send_signal(kind)
            _, said = process.communicate()
        name = f"{kind.name} at {moments[number]:.1f} of {lasts:.1f} s"
        if b"Traceback" in said:
            return Case(name, False, said.decode()[-300:])
        rows = out / "metrics.csv"
        at = rows.read_text().splitlines()[-1].split(",")[1] if rows.exists() and rows.stat().st_size else "no"
        words = ["train", f"--resume={out.name}"] if out.exists() else [*LONGER, f"--out={out.name}"]
        end = subprocess.run(command(*words), **quiet, check=False)
        if end.returncode not in (0, 1):
            return Case(name, False, end.stderr.decode()[-300:])
        same = fingerprint(out) == right
        stray = [path.name for path in here.iterdir() if path.name.startswith(f".{out.name}-")]
        told = f"status {process.returncode}, at {at} episodes; {'same bits' if same else 'OTHER BITS'}"
        return Case(name, same, f"{told}{' ' + str(stray) if stray else ''}")

    with ThreadPoolExecutor(2) as pool:
        for i, case in enumerate(pool.map(one, range(kills + ends))):
            say(i + 1, kills + ends)
            yield case


INJECT = """
import sys
import jax.numpy as jnp
from arm5dof.envs.vector import VectorEnv
step, broken = VectorEnv.step, int(sys.argv.pop(1))
VectorEnv.step = lambda self, state, action: step(self, state, action.at[:broken].set(jnp.nan))
from arm5dof.cli.main import main
sys.exit(main())
"""


def nan(work: Path, say: Callable[[int, int], None]) -> Cases:
    """Physics that is NaN at every step in one of a hundred environments, for a whole training."""
    here = work / "nan"
    here.mkdir()
    words = ["train", "kinematic.toml", "--num-envs=100", "--evaluate-every=400", "--checkpoint-every=400"]
    quiet = {"cwd": here, "env": environment(), "stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    command = [sys.executable, "-c", INJECT]
    started = [subprocess.Popen([*command, str(n), *words, f"--out={n}"], **quiet) for n in (0, 1)]
    said = [process.communicate()[1].decode() for process in started]
    say(1, 1)
    if any(process.returncode for process in started):
        yield Case("NaN in 1 of 100 environments", False, " ".join(said)[-300:])
        return
    without, with_nan = (json.loads((here / str(n) / "evaluations.json").read_text())[-1] for n in (0, 1))
    for protocol in ("one_shot", "refined", "episode"):
        a, b = (e[protocol]["within"]["10"] for e in (without, with_nan))
        yield Case(f"{protocol}, within 10 mm", abs(a - b) <= 1, f"{a:.2f} % without, {b:.2f} % with NaN in 1 of 100")


def _humble() -> None:
    """Take from root what lets it write and read all: CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH."""
    for capability in (1, 2):
        ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, capability, 0, 0, 0)


def disk(work: Path, say: Callable[[int, int], None]) -> Cases:
    """No room, no permission, and files of another run."""
    here = work / "disk"
    here.mkdir()
    env, run = (
        environment(),
        lambda *words, **more: cycle([list(words)], more.pop("cwd", here), more.pop("env", env), **more)[0],
    )
    plans: list[Callable[[], Cases]] = []
    assert run(*TRAIN, "--out=whole")[0] in (0, 1)
    assert run(*TRAIN, "--seed=1", "--out=other")[0] in (0, 1)
    assert run(*TRAIN, "--seed=1", "--arm=arm7.xml", "--out=arm7")[0] in (0, 1)
    right = fingerprint(here / "whole")
    shutil.copytree(here / "whole", here / "longer")
    assert run("train", "--resume=longer", MORE)[0] in (0, 1)
    longer = fingerprint(here / "longer")
    solve = ("solve", "whole", "--target", "0.1", "0", "0.2", "--json")
    answer = run(*solve)[1]

    def full(kilobytes: int) -> Cases:
        place = here / f"{kilobytes}k"
        place.mkdir()
        size = lambda k: [
            "mount",
            *(["-o", "remount"] if place.is_mount() else []),
            "-t",
            "tmpfs",
            "-o",
            f"size={k}k",
            "tmpfs",
            str(place),
        ]
        if subprocess.run(size(kilobytes), capture_output=True, check=False).returncode:
            return
        try:
            found = run(*TRAIN, f"--out={place}/run")
            told = " ".join(found[2].split())[-200:]
            good = refused(found) or found[0] in (0, 1)
            subprocess.run(size(100_000), check=True)
            again = (
                run("train", f"--resume={place}/run") if (place / "run").exists() else run(*TRAIN, f"--out={place}/run")
            )
            same = again[0] in (0, 1) and fingerprint(place / "run") == right
            yield Case(
                f"a disk of {kilobytes} kB",
                good and same,
                f"{told}; with room again {'same bits' if same else again[2][-200:]}",
            )
        finally:
            subprocess.run(["umount", str(place)], check=False)

    def limited(kilobytes: int) -> Cases:
        out = f"limit{kilobytes}"
        limit = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (kilobytes * 1024, -1))
        found = run(*TRAIN, f"--out={out}", preexec_fn=limit, env=environment(JAX_ENABLE_COMPILATION_CACHE="true"))
        again = run("train", f"--resume={out}") if (here / out).exists() else run(*TRAIN, f"--out={out}")
        same = again[0] in (0, 1) and fingerprint(here / out) == right
        told = " ".join(found[2].split())[-200:]
        yield Case(
            f"files of {kilobytes} kB at most",
            (refused(found) or found[0] in (0, 1)) and same,
            f"{told}; without a limit {'same bits' if same else again[2][-200:]}",
        )

    def forbidden(name: str, mode: int, *words: str) -> Cases:
        copy = here / f"forbidden{len(list(here.glob('forbidden*')))}"
        shutil.copytree(here / "whole", copy / "whole")
        every = [copy, *copy.rglob("*")]
        target = copy / name
        target.chmod(mode)
        grows = (".lock", "config.toml", "metrics.csv")  # Of a training that goes on.
        before = {p: p.stat().st_mtime_ns for p in every if p.is_file() and p.name not in grows}
        found = run(*words, cwd=copy, preexec_fn=_humble)
        target.chmod(0o755)
        lost = [str(p) for p, when in before.items() if not p.exists() or p.stat().st_mtime_ns != when]
        good = (refused(found) and not lost) or (found[0] in (0, 1) and words[0] == "solve" and found[1] == answer)
        told = f"status {found[0]}: {' '.join((found[2] or found[1]).split())[-200:]}"
        told += f" LOST {lost}" if lost else ""
        yield Case(f"{' '.join(words[:2])}, {name} of mode {mode:o}", good, told)

    def exchanged(name: str, donor: str) -> Cases:
        copy = here / f"exchanged{len(list(here.glob('exchanged*')))}"
        shutil.copytree(here / "whole", copy)
        place, other = copy / name, here / donor / name
        shutil.rmtree(place) if place.is_dir() else place.unlink()
        shutil.copytree(other, place) if other.is_dir() else shutil.copy(other, place)
        answered = run("solve", copy.name, *solve[2:])
        resumed = run("train", f"--resume={copy.name}", MORE)
        good = (refused(answered) or answered[1] == answer) and (refused(resumed) or fingerprint(copy) == longer)
        told = [
            f"{what} {r[0]}: {' '.join(r[2].split())[-150:]}" for what, r in (("solve", answered), ("resume", resumed))
        ]
        yield Case(f"{name} of another run ({donor})", good, "; ".join(told))

    plans += [lambda k=k: full(k) for k in (40, 100, 200, 400, 700)]
    plans += [lambda k=k: limited(k) for k in (1, 20, 60)]
    resume = ("train", "--resume=whole", MORE)
    closed: tuple[tuple[str, int, tuple[str, ...]], ...] = (
        *((".", 0o500, (*TRAIN, "--out=new")), ("whole", 0o500, resume), ("whole/checkpoints", 0o500, resume)),
        *(("whole", 0o500, solve), ("whole", 0, solve)),
        *(("whole/checkpoints", 0, resume), ("whole/config.toml", 0, resume), ("whole/run.json", 0, solve)),
        *(("whole/checkpoints", 0, solve), ("whole/metrics.csv", 0, resume)),
        *(("whole/evaluations.json", 0, ("compare", "whole")), ("whole/model.mjb.gz", 0, solve)),
    )  # fmt: skip
    for place, mode, words in closed:
        plans.append(lambda place=place, mode=mode, words=words: forbidden(place, mode, *words))
    step = "checkpoints/" + right["step"]
    names = (
        "config.toml",
        "run.json",
        "model.mjb.gz",
        "model.zip",
        "checkpoints",
        step,
        f"{step}/networks",
        f"{step}/training",
        f"{step}/record",
        "metrics.csv",
        "evaluations.json",
    )
    plans += [lambda n=n, d=d: exchanged(n, d) for n in names for d in ("other", "arm7")]
    for i, plan in enumerate(plans):
        yield from plan()
        say(i + 1, len(plans))
