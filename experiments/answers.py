"""The answers of trained policies held against other solvers (`solvers.py`, where it says what to install).

    python experiments/answers.py lines RUN [RUN ...]      straight lines without a jump of a joint, beside mink
    python experiments/answers.py reach RUN [RUN ...]      what is out of reach, beside the nearest possible
    python experiments/answers.py speed RUN [RUN ...]      success and answers a second; with nothing else running

A RUN is a run of the reach task, say runs/reach. The tables go into results/answers_*.md.
"""

from __future__ import annotations

import argparse
import platform
import time
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scipy.optimize import least_squares
from solvers import CLOSE, RESTARTS, SOLVERS, Mink, Solver

from arm5dof import Policy, Run
from arm5dof.envs.paths import JUMP
from arm5dof.runtime import files, xla
from arm5dof.runtime.progress import Bar
from arm5dof.runtime.tables import Table

RESULTS = Path(__file__).parent / "results"
LINES, POINTS, APART, BY_MINK = 1000, 100, 2e-3, 100
FAR, BEYOND, POSES = 100, (1.05, 1.2), 200_000
BATCHES, MILLION, ONE_BY_ONE, REPEATS = (1, 100, 10_000), 1_000_000, 300, 5
TABLES = {
    "lines": (
        "Straight lines",
        ("arm", "joints", "lines", "followed", f"the first {BY_MINK}", "those by mink"),
        f"Each of {POINTS} points, {1e3 * APART:g} mm apart, from a random reachable point in a random "
        f"direction, where each point alone can be reached. Followed: every point within 1 mm, and no joint "
        f"moves by more than {JUMP} rad from one to the next. mink starts at our first answer, and at each "
        f"point where the one before ended.",
    ),
    "reach": (
        "Out of reach",
        ("arm", "joints", *(f"{share:g} of the reach" for share in BEYOND)),
        f"{FAR} points in random directions, beside the nearest that least squares (scipy) finds from the four "
        f"nearest of {POSES:,} random poses: how much farther ours is at worst, and how many miss by more than "
        f"1.1 times that and 2 mm.",
    ),
    "speed": (
        "Positions, beside other solvers",
        ("arm", "joints", "", "within 1 mm and limits", *(f"answers/s, {n:,} at once" for n in (*BATCHES, MILLION))),
        f"Targets are forward kinematics of uniform poses. Medians of {REPEATS}, a million once. Others start "
        f"at the home pose, and again from up to {RESTARTS} random ones. mink and TRAC-IK solve one after the "
        f"other, {ONE_BY_ONE} here; TRAC-IK is asked for the whole pose, which is harder: its Python interface "
        f"takes no position alone.",
    ),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=TABLES)
    parser.add_argument("runs", type=Path, nargs="+")
    arguments = parser.parse_args()
    measure = {"lines": lines, "reach": reach, "speed": speed}[arguments.kind]
    rows = []
    for folder in arguments.runs:
        policy = Run.open(folder).policy()
        for row in measure(policy):
            rows.append([folder.name, str(policy.env.arm.dof), *row])
            print(rows[-1], flush=True)
    title, header, explained = TABLES[arguments.kind]
    machine = f"{platform.machine()} CPU, {xla.cores()} cores"
    command = f"Command: `python experiments/answers.py {arguments.kind} RUN ...`. {machine}."
    text = f"# {title}\n\n{command}\n{explained}\n\n{Table('', header, rows).markdown()}\n"
    print(text)
    files.write_text(RESULTS / f"answers_{arguments.kind}.md", text)


def targets(arm: Any, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Uniform poses (n, dof) and where they lead, (n, 3) metres."""
    poses = arm.sample(jax.random.key(1), (n,))
    return np.asarray(poses), np.asarray(jax.vmap(arm.forward)(poses))


def lines(policy: Policy) -> list[list[str]]:
    """How many lines there are, and how many of them ours and mink follow."""
    arm, rng = policy.env.arm, np.random.default_rng(0)
    starts = targets(arm, 4 * LINES)[1]
    away = rng.normal(size=starts.shape)
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    found = starts[:, None] + APART * np.arange(POINTS)[:, None] * away[:, None]
    met = np.asarray(policy.solve(found.reshape(-1, 3), corrections=10).errors["distance"]) <= CLOSE
    found = found[met.reshape(len(found), POINTS).all(1)][:LINES]
    ours, firsts = [], []
    with Bar("lines", len(found), "lines") as bar:
        for done, line in enumerate(found):
            path = policy.path(line)
            ours.append(bool((np.asarray(path.errors["distance"]) <= CLOSE).all() and not path.jumps.any()))
            firsts.append(np.asarray(path.q[0]))
            bar.update(done + 1)
    share = lambda good: f"{100 * np.mean(good):.1f} %"
    return [[str(len(found)), share(ours), share(ours[:BY_MINK]), by_mink(arm, found[:BY_MINK], firsts)]]


def by_mink(arm: Any, found: np.ndarray, firsts: list[np.ndarray]) -> str:
    """The share of lines that mink follows from given poses at their beginnings."""
    try:
        mink = Mink(arm)
    except ImportError:
        return "not installed"
    good = []
    for line, first in zip(found, firsts, strict=False):
        poses, errors = mink.follow(line, first)
        good.append(errors.max() <= CLOSE and float(np.abs(np.diff(poses, axis=0)).max()) <= JUMP)
    return f"{100 * np.mean(good):.1f} %"


def reach(policy: Policy) -> list[list[str]]:
    """Points in random directions beyond the reach: ours beside the nearest possible."""
    arm = policy.env.arm
    poses, reached = targets(arm, POSES)
    forward, slope = jax.jit(arm.forward), jax.jit(jax.jacfwd(arm.forward))
    inside = 1e-6 * (arm.upper - arm.lower)

    def possible(point: np.ndarray) -> float:
        fits = [
            least_squares(
                lambda q: np.asarray(forward(q)) - point,
                np.clip(poses[i], arm.lower + inside, arm.upper - inside),
                lambda q: np.asarray(slope(q)),
                (arm.lower, arm.upper),
            )
            for i in np.argsort(np.linalg.norm(reached - point, axis=1))[:4]
        ]
        return float(np.sqrt(2 * min(fit.cost for fit in fits)))

    row = []
    away = np.random.default_rng(1).normal(size=(FAR, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    for share in BEYOND:
        points = arm.origin + share * arm.measured_reach * away
        ours = np.asarray(policy.solve(points, corrections=10).errors["distance"])
        best = np.array([possible(point) for point in points])
        row.append(f"{1e3 * (ours - best).max():.1f} mm, {(ours > 1.1 * best + 2e-3).sum()} of {FAR}")
    return [row]


def speed(policy: Policy) -> list[list[str]]:
    """One answer of the policy, corrected ones, and those of other solvers."""
    arm, rows = policy.env.arm, []
    poses, goals = targets(arm, MILLION)
    for label, corrections in (("ours, one answer", 0), ("ours, corrected", 10)):
        ask = partial(policy.solve, corrections=corrections)
        met = np.asarray(ask(goals[: BATCHES[-1]]).errors["distance"]) <= CLOSE
        took = [
            answers_a_second(lambda n, ask=ask: jax.block_until_ready(ask(goals[:n])), n) for n in (*BATCHES, MILLION)
        ]
        rows.append([label, f"{100 * met.mean():.2f} %", *took])
    for kind in SOLVERS:
        try:
            solver: Solver = kind(arm)
        except ImportError:
            rows.append([f"{kind.__name__}: not installed", *"-----"])
            continue
        batched = kind.__name__ == "Pyroki"
        n = BATCHES[-1] if batched else ONE_BY_ONE
        q = solver(poses[:n], goals[:n])
        miss = np.linalg.norm(np.asarray(jax.vmap(arm.forward)(q)) - goals[:n], axis=1)
        beyond = np.maximum(arm.stops[:, 0] - q, q - arm.stops[:, 1]).max(1)
        met = (miss <= CLOSE) & (beyond <= CLOSE)
        run = lambda n, solver=solver: solver(poses[:n], goals[:n])
        took = [answers_a_second(run, n) for n in BATCHES] if batched else 3 * [answers_a_second(run, ONE_BY_ONE)]
        rows.append([solver.title, f"{100 * met.mean():.2f} %", *took, "-"])
    return rows


def answers_a_second(solve: Any, n: int) -> str:
    """By the median of several calls for n goals, compiled before."""
    solve(n)
    took = []
    for _ in range(1 if n == MILLION else REPEATS):
        started = time.perf_counter()
        solve(n)
        took.append(time.perf_counter() - started)
    return f"{n / np.median(took):,.0f}"


if __name__ == "__main__":
    main()
