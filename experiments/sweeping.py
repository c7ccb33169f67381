"""What a sweep costs beside `arm5dof train`, and that nothing is lost whatever is killed.

    python experiments/sweeping.py speed          16 members of kinematic.toml against 16 runs, one after the other
    python experiments/sweeping.py kills          the driver killed at five random moments, and the table compared
    python experiments/sweeping.py many           1,000 members of a small program: seconds a member, memory
    python experiments/sweeping.py gpu            64 members of kinematic.toml on one GPU against one
    python experiments/sweeping.py speed --tiny   the same with a budget of a minute, to try this script

Everything is left in runs/sweeping/, and what was found in results/sweeping_WHAT.md, but for --tiny.
"""

from __future__ import annotations

import argparse
import platform
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil

from arm5dof import Run, Sweep
from arm5dof.runtime import files, xla

RESULTS = Path(__file__).parent / "results"
OUT = Path("runs") / "sweeping"
RATES, SEEDS = (1e-3, 2e-3, 5e-3, 1e-2), (0, 1, 2, 3)
TINY = {
    **{"episodes": 10, "num_envs": 5, "evaluate_every": 5, "checkpoint_every": 5, "episode_length": 32},
    **{"targets": 100, "interim_targets": 100, "updates_per_step": 8, "refinements": 0, "replay_capacity": 4096},
}
COMMAND = [sys.executable, "-m", "arm5dof"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("speed", "kills", "many", "gpu"))
    parser.add_argument("--tiny", action="store_true")
    arguments = parser.parse_args()
    shutil.rmtree(OUT / arguments.what, ignore_errors=True)
    (OUT / arguments.what).mkdir(parents=True)
    title, measure = {
        "speed": ("A sweep of 16 members beside 16 runs", speed),
        "kills": ("A sweep that was killed five times", kills),
        "many": ("A thousand members of a small program", many),
        "gpu": ("A sweep of 64 members on one GPU beside one of a single member", gpu),
    }[arguments.what]
    found = measure(OUT / arguments.what, arguments.tiny)
    command = f"Command: `python experiments/sweeping.py {arguments.what}`. {machine(arguments.what)}."
    print(found)
    if not arguments.tiny:
        files.write_text(RESULTS / f"sweeping_{arguments.what}.md", f"# {title}\n\n{command}\n\n{found}\n")


def speed(out: Path, tiny: bool) -> str:
    """Wall time of both, programs compiled and kept by one short run before, and how far their results are apart."""
    settings = TINY if tiny else {}
    options = [f"--{name.replace('_', '-')}={value}" for name, value in settings.items()]
    rates, seeds = (RATES[:2], SEEDS[:1]) if tiny else (RATES, SEEDS)
    started = time.monotonic()
    for rate in rates:
        for seed in seeds:
            own = [f"--actor-lr={rate}", f"--seed={seed}", "--out", str(out / f"{rate}-{seed}")]
            subprocess.run([*COMMAND, "train", "kinematic.toml", *options, *own], check=True, stderr=subprocess.DEVNULL)
    alone = time.monotonic() - started
    started = time.monotonic()
    subprocess.run(sweep_command(out, {"actor_lr": list(rates), "seed": list(seeds)}, settings), check=True)
    together = time.monotonic() - started
    worst, met = 0.0, 0.0
    for run in Sweep.open(out / "sweep").runs.values():
        same = Run.open(out / f"{run.config.ddpg.actor_lr}-{run.config.train.seed}")
        worst = max(worst, *(abs(a - b) for a, b in zip(run.metrics["reward"], same.metrics["reward"], strict=True)))
        ours, theirs = (one.evaluations[-1]["one_shot"]["within"]["10"] for one in (run, same))
        met = max(met, abs(ours - theirs))
    return (
        f"One after the other {alone:.0f} s, as a sweep {together:.0f} s: **{together / alone:.2f}** of the time, with "
        f"compilation and evaluations.\nThe curves of rewards differ by {worst:.2g} at most, the shares within 10 mm "
        f"at the end by {met:.2g} points."
    )


def kills(out: Path, tiny: bool) -> str:
    """The table of a sweep killed five times, against that of one that never was."""
    settings = {**TINY, "episodes": 10 if tiny else 50}
    axes = {"actor_lr": list(RATES), "seed": [0, 1]}
    subprocess.run(sweep_command(out / "whole", axes, settings), check=True)
    done: list[int] = []
    command, moments = [*sweep_command(out / "killed", axes, settings), "--resume"], random.Random()
    for _ in range(5):
        started = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        time.sleep(moments.uniform(5, 25))
        started.send_signal(signal.SIGKILL)
        started.wait()
        done.append(len(list((out / "killed/sweep/members").glob("*.json"))))
        print(f"killed with {done[-1]} of 8 members at their end")
    subprocess.run(command, check=True)
    tables = [table(out / name / "sweep") for name in ("whole", "killed")]
    same = "The table is that" if tables[0] == tables[1] else "THE TABLE IS NOT THAT"
    at = ", ".join(map(str, done))
    return (
        f"Killed (SIGKILL) when {at} of 8 members were done. {same} of a sweep never killed, of {len(tables[0])} rows."
    )


def table(folder: Path) -> list[dict]:
    """A sweep's table without how long it took."""
    rows = Sweep.open(folder).table
    return [{name: value for name, value in row.items() if name not in ("seconds", "revision")} for row in rows]


def many(out: Path, tiny: bool) -> str:
    """Seconds a member, and the workers' memory, as the sweep goes on."""
    lines = ["| members | s a member so far | MB of the driver and of each worker |", "| ---: | ---: | --- |"]
    count = 40 if tiny else 1000
    started, last = time.monotonic(), 0
    process = subprocess.Popen(sweep_command(out, {"seed": {"count": count}}, TINY), stderr=subprocess.DEVNULL)
    while process.poll() is None:
        time.sleep(1)
        done = len(list((out / "sweep" / "members").glob("*.json")))
        if done >= last + count // 10:
            last = done
            try:
                workers = psutil.Process(process.pid).children()
                memory = [round(p.memory_info().rss / 1e6) for p in (psutil.Process(process.pid), *workers)]
            except psutil.Error:
                memory = []
            each, used = f"{(time.monotonic() - started) / done:.2f}", ", ".join(map(str, memory))
            lines.append(f"| {done} | {each} | {used} |")
            print(lines[-1])
    rows, took = len(Sweep.open(out / "sweep").table), time.monotonic() - started
    return "\n".join([*lines, "", f"One table of {rows} rows, after {took:.0f} s."])


def gpu(out: Path, tiny: bool) -> str:
    """Wall time of a sweep of 64 members and of one of a single member, each with its compilation and evaluations."""
    settings, seeds = (TINY, 2) if tiny else ({}, 16)
    lines = ["| members | s | within 10 mm, one answer: median, least |", "| ---: | ---: | --- |"]
    took = []
    for name, axes in (("one", {"seed": [0]}), ("many", {"actor_lr": list(RATES), "seed": {"count": seeds}})):
        started = time.monotonic()
        subprocess.run(sweep_command(out / name, axes, settings), check=True)
        took.append(time.monotonic() - started)
        runs = Sweep.open(out / name / "sweep").runs.values()
        within = sorted(run.evaluations[-1]["one_shot"]["within"]["10"] for run in runs)
        lines.append(f"| {len(runs)} | {took[-1]:.0f} | {within[len(within) // 2]:.2f} %, {within[0]:.2f} % |")
    return "\n".join([*lines, "", f"All together take **{took[1] / took[0]:.2f}** times one."])


def machine(what: str) -> str:
    """Where it was measured."""
    if what == "gpu":
        asked = "import jax; print(jax.devices()[0].device_kind, 'jax', jax.__version__)"
        return subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True).stdout.strip()
    return f"{platform.machine()} CPU, {xla.cores()} cores"


def sweep_command(out: Path, axes: dict, settings: dict) -> list[str]:
    """The command of a sweep of kinematic.toml."""
    import tomli_w

    out.mkdir(exist_ok=True)
    (out / "sweep.toml").write_text(tomli_w.dumps({"base": "kinematic.toml", "axes": axes, "fixed": settings}))
    return [*COMMAND, "sweep", str(out / "sweep.toml"), "--out", str(out / "sweep")]


if __name__ == "__main__":
    main()
