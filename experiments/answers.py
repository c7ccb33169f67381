"""Answers a robot can use: straight lines without a jump of a joint, and what is out of reach.

    pip install mink daqp          the yardstick; without it, ours alone
    python experiments/answers.py RUN [RUN ...]      runs of the reach task; into results/answers.md

Lines have 100 points 2 mm apart, from a random reachable point in a random direction, and count where each point alone
can be reached. mink follows the first of them from our first answer, each point begun where the one before ended.
Out of reach is beside the nearest that least squares (scipy) finds from the four nearest of 200,000 random poses.
"""

from __future__ import annotations

import argparse
import platform
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
from scipy.optimize import least_squares

from arm5dof import Policy, Run
from arm5dof.envs.paths import JUMP
from arm5dof.runtime import files, xla
from arm5dof.runtime.progress import Bar
from arm5dof.runtime.tables import Table

RESULTS = Path(__file__).parent / "results"
LINES, POINTS, APART, BY_MINK, STEPS = 1000, 100, 2e-3, 100, 20
FAR, BEYOND, POSES = 100, (1.05, 1.2), 200_000
CLOSE = 1e-3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    rows = []
    for folder in parser.parse_args().runs:
        policy = Run.open(folder).policy()
        beyond = [out_of_reach(policy, share) for share in BEYOND]
        rows.append([folder.name, str(policy.env.arm.dof), *lines(policy), *beyond])
        print(rows[-1], flush=True)
    header = ("arm", "joints", "lines", "followed", "of the first", "by mink", *(f"{s:g} of the reach" for s in BEYOND))
    command = f"Command: `python experiments/answers.py RUN ...`. {platform.machine()} CPU, {xla.cores()} cores."
    explained = (
        f"Followed: every point within 1 mm, no joint that moves by more than {JUMP} rad from one to the next.\n"
        f"Out of reach: how much farther than the nearest possible, worst of {FAR} points; how many miss by more than\n"
        "1.1 times that and 2 mm."
    )
    table = Table("", header, rows).markdown()
    text = f"# Lines and what is out of reach\n\n{command}\n{explained}\n\n{table}\n"
    print(text)
    files.write_text(RESULTS / "answers.md", text)


def lines(policy: Policy) -> list[str]:
    """How many lines there are, and how many of them ours and mink follow."""
    arm, rng = policy.env.arm, np.random.default_rng(0)
    starts = np.asarray(jax.vmap(arm.forward)(arm.sample(jax.random.key(1), (4 * LINES,))))
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
    theirs = by_mink(arm, found[:BY_MINK], firsts)
    share = lambda good: f"{100 * np.mean(good):.1f} %"
    return [str(len(found)), share(ours), share(ours[:BY_MINK]), share(theirs) if theirs else "not installed"]


def by_mink(arm: Any, found: np.ndarray, firsts: list[np.ndarray]) -> list[bool]:
    """Which lines mink follows from given poses at their beginnings."""
    try:
        import mink
    except ImportError:
        return []
    model, good = arm.mj_model, []
    site = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_SITE, arm.site)
    task = mink.FrameTask(site, frame_type="site", position_cost=1.0, orientation_cost=0.0, lm_damping=1e-6)
    configuration, limits = mink.Configuration(model), [mink.ConfigurationLimit(model)]
    for line, first in zip(found, firsts, strict=False):
        q = model.qpos0.copy()
        q[arm.qpos] = first
        configuration.update(q)
        poses, errors = [], []
        for point in line:
            task.set_target(mink.SE3.from_translation(point))
            for _ in range(STEPS):
                velocity = mink.solve_ik(configuration, [task], 1.0, solver="daqp", damping=1e-6, limits=limits)
                configuration.integrate_inplace(velocity, 1.0)
                error = np.linalg.norm(task.compute_error(configuration)[:3])
                if error <= CLOSE / 10:
                    break
            poses.append(configuration.q[arm.qpos].copy())
            errors.append(error)
        good.append(max(errors) <= CLOSE and float(np.abs(np.diff(poses, axis=0)).max()) <= JUMP)
    return good


def out_of_reach(policy: Policy, share: float) -> str:
    """Points in random directions at a share of the reach: ours beside the nearest possible."""
    arm = policy.env.arm
    away = np.random.default_rng(1).normal(size=(FAR, 3))
    points = arm.origin + share * arm.measured_reach * away / np.linalg.norm(away, axis=1, keepdims=True)
    ours = np.asarray(policy.solve(points, corrections=10).errors["distance"])
    poses = np.asarray(arm.sample(jax.random.key(1), (POSES,)), float)
    reached = np.asarray(jax.vmap(arm.forward)(poses))
    forward, slope = jax.jit(arm.forward), jax.jit(jax.jacfwd(arm.forward))
    inside = 1e-6 * (arm.upper - arm.lower)
    best = []
    for point in points:
        near = np.argsort(np.linalg.norm(reached - point, axis=1))[:4]
        fits = [
            least_squares(
                lambda q, point=point: np.asarray(forward(q)) - point,
                np.clip(poses[i], arm.lower + inside, arm.upper - inside),
                lambda q: np.asarray(slope(q)),
                (arm.lower, arm.upper),
            )
            for i in near
        ]
        best.append(np.sqrt(2 * min(fit.cost for fit in fits)))
    bad = (ours > 1.1 * np.array(best) + 2e-3).sum()
    return f"{1e3 * (ours - best).max():.1f} mm, {bad} of {FAR}"


if __name__ == "__main__":
    main()
