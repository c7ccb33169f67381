"""Inverse kinematics for positions beside mink, a solver that takes steps by quadratic programs: success and speed.

    pip install mink daqp
    python experiments/solvers.py RUN [RUN ...]      runs of the reach task, say runs/reach; into results/solvers.md

Both get the same targets, forward kinematics of uniform poses, and the same robot from the run. mink starts at the home
pose and takes up to `STEPS` steps; where that fails, it starts again up to `RESTARTS` times from a random pose.
"""

from __future__ import annotations

import argparse
import platform
import time
from functools import partial
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np

from arm5dof import Policy, Run
from arm5dof.runtime import files, xla
from arm5dof.runtime.tables import Table

RESULTS = Path(__file__).parent / "results"
BATCHES, MILLION = (1, 100, 10_000), 1_000_000
STEPS, RESTARTS, ONE_BY_ONE, REPEATS = 50, 3, 300, 5
CLOSE = 1e-3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    rows = []
    for folder in parser.parse_args().runs:
        policy = Run.open(folder).policy()
        rows += [[folder.name, str(policy.env.arm.dof), *row] for row in (*ours(policy), by_mink(policy))]
        print(rows[-3:], flush=True)
    header = ("arm", "joints", "", "within 1 mm", *(f"answers/s, {n:,} at once" for n in (*BATCHES, MILLION)))
    command = f"Command: `python experiments/solvers.py RUN ...`. {platform.machine()} CPU, {xla.cores()} cores."
    text = f"# Positions, beside mink\n\n{command} Medians of {REPEATS}.\n\n{Table('', header, rows).markdown()}\n"
    print(text)
    files.write_text(RESULTS / "solvers.md", text)


def targets(arm: Any, n: int) -> np.ndarray:
    """Forward kinematics of uniform poses, (n, 3) metres."""
    return np.asarray(jax.vmap(arm.forward)(arm.sample(jax.random.key(1), (n,))))


def ours(policy: Policy) -> list[list[str]]:
    """One answer of the policy, and corrected ones."""
    goals, rows = targets(policy.env.arm, MILLION), []
    for label, corrections in (("one answer", 0), ("corrected", 10)):
        ask = partial(policy.solve, corrections=corrections)
        solve = lambda n, ask=ask: jax.block_until_ready(ask(goals[:n]))
        met = np.asarray(solve(BATCHES[-1]).errors["distance"]) <= CLOSE
        speeds = []
        for n in (*BATCHES, MILLION):
            solve(n)
            took = []
            for _ in range(1 if n == MILLION else REPEATS):
                started = time.perf_counter()
                solve(n)
                took.append(time.perf_counter() - started)
            speeds.append(f"{n / np.median(took):,.0f}")
        rows.append([f"ours, {label}", f"{100 * met.mean():.2f} %", *speeds])
    return rows


def by_mink(policy: Policy) -> list[str]:
    """mink, which solves one after the other."""
    try:
        import mink
    except ImportError:
        return ["mink: not installed", *"----", "-"]
    arm = policy.env.arm
    model, rng = arm.mj_model, np.random.default_rng(0)
    task = mink.FrameTask(
        mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_SITE, arm.site),
        frame_type="site",
        position_cost=1.0,
        orientation_cost=0.0,
        lm_damping=1e-6,
    )
    configuration, limits = mink.Configuration(model), [mink.ConfigurationLimit(model)]
    goals, met = targets(arm, ONE_BY_ONE), []
    started = time.perf_counter()
    for goal in goals:
        task.set_target(mink.SE3.from_translation(goal))
        for attempt in range(1 + RESTARTS):
            q = model.qpos0.copy()
            q[arm.qpos] = rng.uniform(arm.lower, arm.upper) if attempt else arm.home
            configuration.update(q)
            for _ in range(STEPS):
                velocity = mink.solve_ik(configuration, [task], 1.0, solver="daqp", damping=1e-6, limits=limits)
                configuration.integrate_inplace(velocity, 1.0)
                error = np.linalg.norm(task.compute_error(configuration)[:3])
                if error <= CLOSE / 10:
                    break
            if error <= CLOSE:
                break
        met.append(error <= CLOSE)
    speed = f"{ONE_BY_ONE / (time.perf_counter() - started):,.0f}"
    return [f"mink {mink.__version__}", f"{100 * np.mean(met):.2f} %", speed, speed, speed, "-"]


if __name__ == "__main__":
    main()
