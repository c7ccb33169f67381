"""Trainings that are killed, or asked to end, at random moments, and go on; and one in which physics is NaN."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from trainings import TRAIN, Case, Cases, curves, environment, fingerprint

LONGER = [*TRAIN, "--episodes=100"]
QUIET = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}


def signals(work: Path, seed: int, say: Callable[[int, int], None], kills: int = 20, ends: int = 10) -> Cases:
    """A training that is killed, or asked to end, at random moments, and goes on."""
    here = work / "signals"
    here.mkdir()
    command = lambda *words: [sys.executable, "-m", "arm5dof", *words]
    quiet = {**QUIET, "cwd": here, "env": environment()}
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
        moment, ended = moments[number], True
        while ended:  # Before the signal, if the machine has become faster: another one is signalled earlier.
            shutil.rmtree(out, ignore_errors=True)
            process = subprocess.Popen(command(*LONGER, f"--out={out.name}"), **quiet)
            try:
                _, said = process.communicate(timeout=moment)
                moment /= 2
            except subprocess.TimeoutExpired:
                ended = False
                process.send_signal(kind)
                _, said = process.communicate()
        name = f"{kind.name} at {moment:.1f} of {lasts:.1f} s"
        # Of one that died, a child that MuJoCo's imports have started may complain.
        if process.returncode not in (-kind, 128 + kind, 0, 1) or (process.returncode >= 0 and b"Traceback" in said):
            return Case(name, False, f"status {process.returncode}: {said.decode()[-300:]}")
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
    own = environment(JAX_ENABLE_COMPILATION_CACHE="false")  # Kept programs are found by the source, which is the same.
    quiet = {**QUIET, "cwd": here, "env": own}
    command = [sys.executable, "-c", INJECT]
    started = [subprocess.Popen([*command, str(n), *words, f"--out={n}"], **quiet) for n in (0, 1)]
    said = [process.communicate()[1].decode() for process in started]
    say(4, 4)
    if any(process.returncode for process in started):
        yield Case("NaN in 1 of 100 environments", False, " ".join(said)[-300:])
        return
    every = [curves(here / str(n)) for n in (0, 1)]
    lost, steps = [sum(float(row["nonfinite"]) for row in rows) for rows in every], int(every[1][-1]["env_steps"])
    told = f"{lost[0]:.0f} without, {lost[1]:.0f} of {steps} with"
    yield Case("steps that led to NaN", lost == [0, steps / 100], told)
    without, with_nan = (json.loads((here / str(n) / "evaluations.json").read_text())[-1] for n in (0, 1))
    for protocol in ("one_shot", "refined", "episode"):
        a, b = (e[protocol]["within"]["10"] for e in (without, with_nan))
        yield Case(f"{protocol}, within 10 mm", abs(a - b) <= 1, f"{a:.2f} % without, {b:.2f} % with NaN in 1 of 100")
