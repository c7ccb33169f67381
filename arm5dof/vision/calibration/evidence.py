"""What each view says of a camera's intrinsics: how well they are known, and whether one camera took all views.

Corners of one photograph are off together, by its blur, its light and what the lens model lacks: their errors say less
than so many independent ones would. Views are independent. So how far the views disagree tells how well the intrinsics
are known, and whether two groups of them disagree more than views of one camera do, tells that there are two.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

TWO_CAMERAS = 40.0
"""F-statistic of two cameras against one from which on there are two. The most favourable division of OpenCV's
photographs, all or some, reaches 23, of drawn ones of one camera 6; with cameras 2 % apart it is 60 and more."""

MANY = 20
"""From so many views on the threshold grows with their number, as that statistic does for views of one camera: the more
there are, the more ways to divide them."""

SMALLEST = 2
"""Views in a group, at least."""

STARTS = 8
"""Divisions of the views that are improved, the most promising ones."""


class Evidence(NamedTuple):
    """What n views say of p intrinsics, the board's pose being free in each, near the intrinsics that fit them best."""

    scores: np.ndarray
    """Half the derivative of each view's squared residuals, (n, p)."""
    information: np.ndarray
    """Half the second derivative, (n, p, p)."""
    squares: float
    """The sum of squared residuals, pixels^2."""
    spare: int
    """Residuals less the poses' parameters."""


def evidence(views: Iterable[tuple[np.ndarray, np.ndarray]]) -> Evidence:
    """Gather what views say.

    Args:
        views: Residuals (m,), pixels, and their derivatives by p intrinsics and six parameters of the board's pose,
            (m, p + 6), of each view where intrinsics and poses fit all views best. Any lens model will do.

    Returns:
        What they say of the intrinsics.
    """
    scores, information, squares, spare = [], [], 0.0, 0
    for residual, jacobian in views:
        lens, pose = np.split(jacobian, [-6], axis=1)
        # What of an error in the intrinsics the board's pose cannot make good.
        left = lens - pose @ np.linalg.lstsq(pose, lens, rcond=None)[0]
        scores.append(left.T @ residual)
        information.append(left.T @ left)
        squares += float(residual @ residual)
        spare += len(residual) - 6
    return Evidence(np.array(scores), np.array(information), squares, spare)


def intrinsics_covariance(found: Evidence) -> np.ndarray:
    """How well views tell the intrinsics, by how far they disagree.

    The sum over views of the outer products of what each moves the intrinsics by: the jackknife to first order, known
    as the sandwich or cluster-robust covariance (Liang and Zeger, Biometrika 73, 1986). A dozen views estimate p x p
    numbers badly, and in some direction always agree by chance; so p - 1 views more are counted in that are off as
    independent errors of the corners would have it. They weigh nothing where views are many, and with 13 views true
    intrinsics lie in the ellipsoids as often as they should.

    Args:
        found: What n views say of p intrinsics, n being 2 or more.

    Returns:
        (p, p).
    """
    n, p = found.scores.shape
    scale, whole = _scaled(found)
    inverse = np.linalg.inv(whole)
    steps = found.scores / scale @ inverse
    independent = inverse * found.squares / (found.spare - p)
    return (n / (n - 1) * steps.T @ steps + (p - 1) / n * independent) / np.outer(scale, scale)


def odd_views(found: Evidence) -> tuple[list[int], int | None]:
    """The views that another camera took than the rest.

    Args:
        found: What n views say.

    Returns:
        Indices of the smaller group where two cameras fit far better than one, none where one camera took all; and of
        a single view where that alone makes most of the difference.
    """
    n, p = found.scores.shape
    if n < 2 * SMALLEST or found.spare <= 2 * p:
        return [], None
    scale, whole = _scaled(found)
    information = found.information / np.outer(scale, scale)
    scores = found.scores / scale
    scores = scores - information @ np.linalg.solve(whole, scores.sum(0))  # As if at the very minimum.
    group, gain = _best_division(scores, information)
    left = (found.squares - gain) / (found.spare - 2 * p)
    if gain / p <= TWO_CAMERAS * max(1, n / MANY) * left:
        return [], None
    alone = _gains(scores, information, np.eye(n, dtype=bool))
    smaller = [int(i) for i in np.flatnonzero(group if 2 * group.sum() <= n else ~group)]
    return smaller, int(alone.argmax()) if alone.max() > gain / 2 else None


def _scaled(found: Evidence) -> tuple[np.ndarray, np.ndarray]:
    """What intrinsics are divided by to be alike, (p,), and the information of all views on those, (p, p)."""
    whole = found.information.sum(0)
    scale = np.sqrt(np.diag(whole))
    return scale, whole / np.outer(scale, scale)


def _gains(scores: np.ndarray, information: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """By how much squared residuals shrink, (g,), if groups of views (g, n) have a camera of their own and the others
    have another. Scores sum to zero."""
    score = groups @ scores
    ours = np.einsum("gi,ijk->gjk", groups.astype(float), information) + 1e-12 * np.eye(scores.shape[1])
    theirs = information.sum(0) - ours + 2e-12 * np.eye(scores.shape[1])
    steps = sum(np.linalg.solve(each, score[..., None])[..., 0] for each in (ours, theirs))
    return (score * steps).sum(-1)


def _best_division(scores: np.ndarray, information: np.ndarray) -> tuple[np.ndarray, float]:
    """The division of the views into two groups, (n,) bool, that shrinks squared residuals most, and by how much."""
    n = len(scores)
    # Views of two cameras lie on both sides along one of the main directions in which views disagree.
    _, axes = np.linalg.eigh(scores.T @ scores)
    steps = np.linalg.solve(information + 1e-3 * information.mean(0), scores[..., None])[..., 0]
    ranks = np.argsort(np.argsort(np.concatenate([scores @ axes, steps @ axes], axis=1), axis=0), axis=0)
    groups = np.concatenate([size > ranks.T for size in range(SMALLEST, n - SMALLEST + 1)])
    gains = _gains(scores, information, groups)
    best = np.argsort(-gains)[:STARTS]
    groups, gains = groups[best], gains[best]
    while True:
        moved = (groups[:, None] ^ np.eye(n, dtype=bool)).reshape(-1, n)
        size = moved.sum(-1)
        moved = moved[(size >= SMALLEST) & (size <= n - SMALLEST)]
        more = _gains(scores, information, moved)
        best = np.argsort(-more)[:STARTS]
        if more[best[0]] <= gains.max() * (1 + 1e-9):
            return groups[gains.argmax()], float(gains.max())
        groups, gains = moved[best], more[best]
