"""Trainings that are compared with one that nothing happened to: how they are started, and what they came to."""

from __future__ import annotations

import csv
import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from readers import ROOT, SETTINGS

TRAIN = ["train", "kinematic.toml", *SETTINGS]
MORE = "--episodes=20"
LIMIT_S = 600


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
    rows = hashlib.sha256(json.dumps(curves(run)).encode()).hexdigest()
    digests = {name: record[name]["sha256"] for name in ("networks", "training")}
    return {
        "step": step.name,
        **digests,
        "rows": rows,
        "evaluations": [e | {"run": None} for e in json.loads((run / "evaluations.json").read_text())],
    }


def curves(run: Path) -> list[dict[str, str]]:
    """A training's curves without the clock and the run's id."""
    with open(run / "metrics.csv", newline="") as file:
        return [{k: v for k, v in row.items() if k not in ("seconds", "run")} for row in csv.DictReader(file)]


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
