"""Where the paper's arm has to be to grasp at a place, in closed form: the yardstick of what physics allows."""

from __future__ import annotations

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from arm5dof.arm.kinematics import inverse
from arm5dof.arm.kinematics.dh import D5
from arm5dof.grasp.scene import TabletopScene

TOOL = 0.062
"""From `ee` to `grasp` along the tool, metres."""
TILTS = np.deg2rad(sorted(range(-30, 31, 5), key=abs))
"""Of the tool from straight down, least first."""


def joints_above(scene: TabletopScene, position: np.ndarray, heights: np.ndarray) -> np.ndarray | None:
    """Joint positions (k, 5) that put the site `grasp` at heights (k,), metres, above a point (2,) of the table, all on
    one branch, with the tool as near to straight down as can be; None where there are none."""
    limits = np.stack([scene.arm.lower, scene.arm.upper], 1)
    best: tuple[float, np.ndarray] | None = None
    for tilt in TILTS:
        theta = np.concatenate([_solve(position, heights, tilt - np.pi / 2, side, limits) for side in (1, -1)], 1)
        for path in theta.transpose(1, 0, 2):
            if np.isfinite(path).all() and np.abs(np.diff(path, axis=0)).max(initial=0) < 0.35:
                elbow = float(np.sin(path[:, 2]).min())
                if best is None or elbow > best[0]:
                    best = elbow, path
        if best is not None:
            return best[1]
    return None


def _solve(position: np.ndarray, heights: np.ndarray, pitch: float, side: int, limits: np.ndarray) -> np.ndarray:
    """All branches, (k, 4, 5), that reach with the tool in front of the arm or, on the other side, behind; NaN where
    they break the limits or would turn the tool the other way around."""
    along = side * np.sqrt(max(position @ position - D5**2, 0))
    azimuth = np.arctan2(position[1], position[0]) + np.arctan2(D5, along)
    direction = np.array([np.cos(azimuth) * np.cos(pitch), np.sin(azimuth) * np.cos(pitch), np.sin(pitch)])
    wrist = np.array([[*position, height] for height in heights]) - TOOL * direction
    with jax.enable_x64(True):
        solutions = _inverse()(jnp.asarray(wrist), jnp.full(len(heights), pitch), jnp.asarray(limits))
    theta = np.asarray(solutions.theta)
    off = theta[..., :2].sum(-1) - azimuth
    same = np.abs((off + np.pi) % (2 * np.pi) - np.pi) < 1e-6
    return np.where((np.asarray(solutions.valid) & same)[..., None], theta, np.nan)


@cache
def _inverse() -> Any:
    return jax.jit(inverse)
