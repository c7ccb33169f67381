"""How far an arm really reaches, by its own kinematics, in NumPy."""

from __future__ import annotations

import numpy as np

from arm5dof.arm.chain import Link

STARTS, SWEEPS = 64, 60


def measure_reach(chain: tuple[Link, ...], lower: np.ndarray, upper: np.ndarray) -> float:
    """The largest distance between the first joint's anchor and the end effector within the joint limits, metres.

    Seen from one joint, all others at rest, the best position is known in closed form: a hinge turns the end effector
    to the side that the anchor is not on, a slide goes to one of its ends. Joint after joint in turns, from many
    random poses, always the same, the distance can only grow; the largest counts.
    """
    q = _random(lower, upper, STARTS)
    anchor = chain[0].offset
    best = 0.0
    for _ in range(SWEEPS):
        for k in reversed(range(len(q))):
            ahead = carry(chain, q, k + 1, len(q), chain[-1].offset[:, None])
            behind = _back(chain, q, k, anchor[:, None])
            if chain[k].slides:
                far = [((ahead + np.array([[0], [0], [z]]) - behind) ** 2).sum(0) for z in (lower[k], upper[k])]
                q[k] = np.where(far[0] > far[1], lower[k], upper[k])
            else:
                away = np.arctan2(-behind[1], -behind[0]) - np.arctan2(ahead[1], ahead[0])
                q[k] = _nearest_turn(away, lower[k], upper[k])
        now = float(np.linalg.norm(points(chain, q.T) - anchor, axis=1).max())
        if now - best < 1e-7 * now:
            break
        best = now
    return max(best, now)


def moves(chain: tuple[Link, ...], lower: np.ndarray, upper: np.ndarray) -> bool:
    """Whether the joints bring the end effector to more than one point."""
    found = points(chain, _random(lower, upper, 8).T)
    return bool(np.ptp(found, axis=0).max() > 1e-6)


def points(chain: tuple[Link, ...], q: np.ndarray) -> np.ndarray:
    """Where joint positions (n, dof) bring the end effector, (n, 3) metres in the world frame."""
    return carry(chain, q.T, 0, q.shape[1], chain[-1].offset[:, None]).T


def carry(chain: tuple[Link, ...], q: np.ndarray, first: int, last: int, p: np.ndarray) -> np.ndarray:
    """Points (3, n) in front of joint `last` as the frame behind joint `first - 1` has them, at q (dof, n)."""
    p = np.broadcast_to(p, (3, q.shape[1]))
    for k in reversed(range(first, last)):
        p = chain[k].offset[:, None] + chain[k].rotation @ _moved(chain[k].slides, q[k], p)
    return p


def _back(chain: tuple[Link, ...], q: np.ndarray, last: int, p: np.ndarray) -> np.ndarray:
    """Points (3, n) of the world as the frame of joint `last` has them, before it turns or slides."""
    p = np.broadcast_to(p, (3, q.shape[1]))
    for k in range(last + 1):
        p = chain[k].rotation.T @ (p - chain[k].offset[:, None])
        p = p if k == last else _moved(chain[k].slides, -q[k], p)
    return p


def _moved(slides: bool, q: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Points (3, n) turned about z, or shifted along it."""
    x, y, z = p
    if slides:
        return np.stack([x, y, z + q])
    c, s = np.cos(q), np.sin(q)
    return np.stack([c * x - s * y, s * x + c * y, z])


def _nearest_turn(angle: np.ndarray, lower: float, upper: float) -> np.ndarray:
    """Of what is within the limits, the angles that are nearest to others modulo a turn."""
    middle = (lower + upper) / 2
    near = middle + (angle - middle + np.pi) % (2 * np.pi) - np.pi
    return np.clip(near, lower, upper)


def _random(lower: np.ndarray, upper: np.ndarray, n: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(lower, upper, (n, len(lower))).T.copy()
