"""The task and the accuracy protocol of the comparison, the same for everybody, in plain NumPy.

An action in [-1, 1]^5 is a pose: joint targets inside the arm's limits, reached at once (the paper's kinematic
setting). The reward is minus the distance between end effector and goal in metres, an episode is 160 steps with one
goal, and its end is a time limit. Goals are the forward kinematics of joint angles drawn uniformly inside the limits.
"""

from __future__ import annotations

import csv
import os
import time
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np

EPISODE = 160
DOF = 5
D1, A3, A4, D5 = 0.045, 0.120, 0.145, 0.030
"""Table 1, metres."""

BAR = 95.5
"""Percentage of targets within 10 mm at which a run is over: the paper's mean after 400 episodes."""

_model = mujoco.MjModel.from_xml_path(str(Path(__file__).parents[2] / "mjcf" / "arm5.xml"))
LOWER, UPPER = np.array([_model.joint(f"theta_{k + 1}").range for k in range(DOF)]).T


def to_joints(actions, xp=np):
    """Actions (..., 5) in [-1, 1] to joint angles in radians. `xp` is NumPy or jax.numpy."""
    return LOWER + (xp.clip(actions, -1, 1) + 1) / 2 * (UPPER - LOWER)


def forward(q, xp=np):
    """Joint angles (..., 5) in radians to the end effector (..., 3) in metres, by Table 1."""
    theta12, theta34 = q[..., 0] + q[..., 1], q[..., 2] + q[..., 3]
    c, s = xp.cos(theta12), xp.sin(theta12)
    r = A4 * xp.cos(theta34) + A3 * xp.cos(q[..., 2])
    z = A4 * xp.sin(theta34) + A3 * xp.sin(q[..., 2])
    return xp.stack([s * D5 + r * c, r * s - c * D5, D1 + z], axis=-1)


def scaled(points, xp=np):
    """Points (..., 3) in metres as a network likes them: relative to the shoulder, in units of the arm's length."""
    return (points - xp.array([0, 0, D1])) / (A3 + A4 + D5)


def sample_goals(rng: np.random.Generator, count: int) -> np.ndarray:
    """Reachable points, (count, 3) metres."""
    return forward(rng.uniform(LOWER, UPPER, (count, DOF)))


TARGETS = sample_goals(np.random.default_rng(20_000), 10_000).astype(np.float32)
"""What everybody is judged on, (10_000, 3) metres. No trainer draws from this stream."""


def since_start() -> float:
    """Seconds since this process was started, imports included (Linux)."""
    ticks = int(Path("/proc/self/stat").read_text().rsplit(")", 1)[1].split()[19])
    return time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")


class Record:
    """The learning curve of one run, a CSV file: `seconds` since the process was started, imports and compilation
    included and the measurements themselves excluded, for everybody alike; `transitions`; `median_mm` and
    `within_10mm` (percent) of the distances by which one deterministic answer misses the targets.

    The file gets its name by `finish`; until then it ends in `.part`.
    """

    def __init__(self, path: Path, minutes: float, transitions: float) -> None:
        self.path, self.minutes, self.transitions = path, minutes, transitions
        self.measuring = 0.0
        self.last = 0.0
        path.parent.mkdir(parents=True, exist_ok=True)
        self.part = path.with_suffix(".csv.part")
        self._write("w", ["seconds", "transitions", "median_mm", "within_10mm"])

    @property
    def seconds(self) -> float:
        return since_start() - self.measuring

    @property
    def due(self) -> bool:
        """Whether a measurement is due. They come closer than the width of a line on a logarithmic axis."""
        return self.seconds > 1.03 * self.last

    def measure(self, transitions: int, answer: Callable[[np.ndarray], np.ndarray]) -> bool:
        """Add a line. `answer` takes goals (n, 3) in metres to actions (n, 5). Returns whether the run is over."""
        self.last = seconds = self.seconds
        error = 1e3 * np.linalg.norm(forward(to_joints(np.asarray(answer(TARGETS)))) - TARGETS, axis=-1)
        median, within = float(np.median(error)), float(100 * (error <= 10).mean())
        self._write("a", [f"{seconds:.2f}", transitions, f"{median:.3f}", f"{within:.2f}"])
        print(
            f"{seconds:8.1f} s {transitions:10d} transitions {median:8.2f} mm {within:6.2f} % within 10 mm", flush=True
        )
        self.measuring += self.seconds - seconds
        return within >= BAR or seconds > 60 * self.minutes or transitions >= self.transitions

    def finish(self) -> None:
        self.part.replace(self.path)

    def _write(self, mode: str, row: list) -> None:
        with open(self.part, mode, newline="") as handle:
            csv.writer(handle).writerow(row)
