"""Hand-eye calibration: where a camera sits on the hand, or where it stands beside the arm.

Both are one equation of the hand's and the board's poses, which `robot_world` solves. Here is judged whether the poses
determine an answer and agree with it: all of them, all but a few, or only if the camera is mounted the other way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy import stats

from arm5dof.errors import UserError
from arm5dof.vision.calibration.robot_world import EXPECTED, Fit, inverse, predict, rotation_vectors, solve

MIN_POSES = 4
"""Three determine the solution and leave nothing to tell its error by."""

MIN_TURN_DEG = 5.0
"""How far the hand must turn about a second axis, root mean square over all pairs of poses. Turning about parallel
axes leaves the camera's place along them open."""

FARTHEST_M = 100.0
"""No hand gets so far, and no board: these are other units, or a digit too many."""

EQUAL_SPREAD = np.diag(np.square(np.repeat([np.deg2rad(0.2), 1e-3], 3)))
"""Covariance of a board's pose where none is stated."""

MAX_ROTATION_DEG, MAX_TRANSLATION_M = 3.0, 0.015
"""What is left may be so large, root mean square, and still be noise."""

SUSPECTS = 5
"""So many poses that are farthest off are tried for the worst."""

OUTLIER_CHANCE = 1e-6
"""How probable it is, at most, that among right poses one is taken for wrong, were all noise Gaussian."""


@dataclass(frozen=True)
class HandEye:
    """A hand-eye calibration. Poses are (4, 4), metres."""

    camera: np.ndarray
    """The camera's pose: in the hand's frame (eye in hand) or in the base frame (eye to hand)."""
    board: np.ndarray
    """The board's pose: in the base frame (eye in hand) or in the hand's frame (eye to hand)."""
    rotation_deg: float
    """Root mean square of what is left between the board's poses measured and explained: rotation, degrees."""
    translation_m: float
    """The same of translation, metres."""
    covariance: np.ndarray
    """Of the camera's pose, judged by what is left, (6, 6): a turn about the camera's x, y and z axes in radians, a
    shift along them in metres."""
    noise: np.ndarray
    """The noise that was estimated, (3,): a factor to the boards' deviations, then the hand's standard deviation about
    each axis, radians, and along each, metres."""
    outliers: dict[int, tuple[float, float]]
    """Poses that were left out, counted from 0, since they contradict the others: by how many degrees and metres."""

    @property
    def deviations(self) -> np.ndarray:
        """Standard deviations of the camera's pose, (6,): of the turn in degrees, of the shift in metres."""
        deviations = np.sqrt(np.diag(self.covariance))
        return np.concatenate([np.rad2deg(deviations[:3]), deviations[3:]])


def eye_in_hand(
    hands: Sequence[np.ndarray], boards: Sequence[np.ndarray], covariances: Sequence[np.ndarray] | None = None
) -> HandEye:
    """A camera on the hand looks at a board that stands still.

    Args:
        hands: The hand's poses in the base frame, (n, 4, 4), metres.
        boards: The board's poses in the camera's frame at the same moments, (n, 4, 4), metres.
        covariances: Of those, (n, 6, 6): a turn about the camera's axes at the board's origin (radians), a shift along
            them (metres). Only their ratios act on the solution. By default all are equal.

    Returns:
        The camera's pose in the hand's frame and the board's in the base frame.

    Raises:
        UserError: The poses are not such, do not determine the answer, or contradict each other.
    """
    return _judged(_Poses.read(hands, boards, covariances, on_hand=True))


def eye_to_hand(
    hands: Sequence[np.ndarray], boards: Sequence[np.ndarray], covariances: Sequence[np.ndarray] | None = None
) -> HandEye:
    """A camera that stands still looks at a board on the hand.

    Args:
        hands: As for `eye_in_hand`.
        boards: As for `eye_in_hand`.
        covariances: As for `eye_in_hand`.

    Returns:
        The camera's pose in the base frame and the board's in the hand's frame.

    Raises:
        UserError: As for `eye_in_hand`.
    """
    return _judged(_Poses.read(hands, boards, covariances, on_hand=False))


def again(
    hands: Sequence[np.ndarray],
    boards: Sequence[np.ndarray],
    covariances: Sequence[np.ndarray] | None,
    noise: np.ndarray,
    on_hand: bool,
) -> np.ndarray:
    """The camera's pose (4, 4) by poses that have been judged, with the noise that was estimated then."""
    return _Poses.read(hands, boards, covariances, on_hand).solve(noise).x


@dataclass(frozen=True)
class _Poses:
    """What `robot_world.solve` takes."""

    robot: np.ndarray
    boards: np.ndarray
    spread: np.ndarray
    on_hand: bool

    @classmethod
    def read(
        cls,
        hands: Sequence[np.ndarray],
        boards: Sequence[np.ndarray],
        covariances: Sequence[np.ndarray] | None,
        on_hand: bool,
    ) -> _Poses:
        """Checked. Raises `UserError` unless they determine an answer."""
        hand, board = _poses("hand", hands), _poses("board", boards)
        if len(hand) != len(board):
            raise UserError(f"{len(hand)} poses of the hand and {len(board)} of the board: give one of each per image")
        if len(hand) < MIN_POSES:
            raise UserError(f"{len(hand)} poses: hand-eye calibration takes {MIN_POSES} at least, better 15")
        if (second := _second_turn(hand)) < MIN_TURN_DEG:
            raise UserError(
                f"the hand turned about parallel axes only ({second:.1f} degrees about a second one, {MIN_TURN_DEG:g} "
                "are needed): turn it about another axis too, by 30 degrees or more"
            )
        spread = np.array([EQUAL_SPREAD] * len(hand)) if covariances is None else np.asarray(covariances, float)
        return cls(hand if on_hand else inverse(hand), board, spread, on_hand)

    def __getitem__(self, chosen: Sequence[int]) -> _Poses:
        index = list(chosen)
        return _Poses(self.robot[index], self.boards[index], self.spread[index], self.on_hand)

    @property
    def other_mount(self) -> _Poses:
        return _Poses(inverse(self.robot), self.boards, self.spread, not self.on_hand)

    def solve(self, noise: np.ndarray | None = None) -> Fit:
        return solve(self.robot, self.boards, self.spread, self.on_hand, noise)


def _judged(poses: _Poses) -> HandEye:
    """The solution, unless it is none."""
    own, other = (_left(each.solve().residual) for each in (poses, poses.other_mount))
    if other[0] < own[0] / 2 and other[1] < own[1] / 2:
        mount = "beside the arm (eye to hand)" if poses.on_hand else "on the hand (eye in hand)"
        raise UserError(
            f"the poses contradict each other by {_said(*own)}, and only by {_said(*other)} if the camera is {mount}: "
            "is it that, or are the hand's poses inverted?"
        )
    fit, wrong = _without_outliers(poses)
    rotation, translation = _left(fit.residual)
    if 4 * len(wrong) > len(poses.robot) or rotation > MAX_ROTATION_DEG or translation > MAX_TRANSLATION_M:
        raise UserError(
            f"the poses contradict each other by {_said(*own)}: give metres, the hand's poses in the base frame, the "
            "board's in the camera's frame, in the same order"
        )
    return HandEye(fit.x, fit.z, rotation, translation, fit.covariance[:6, :6], fit.noise, wrong)


def _without_outliers(poses: _Poses) -> tuple[Fit, dict[int, tuple[float, float]]]:
    """A fit to all poses that agree, and what the others, up to a quarter, lack."""
    kept, out = list(range(len(poses.robot))), list[int]()
    while len(kept) > MIN_POSES and 4 * (len(out) + 1) <= len(poses.robot):
        # Without the worst the others agree best. The noise is fixed, or the worst one's would hide it.
        suspects = [kept[i] for i in np.argsort(-_squares(poses[kept].solve(EXPECTED)))[:SUSPECTS]]
        rests = [[i for i in kept if i != k] for k in suspects]
        rests = [rest for rest in rests if _second_turn(poses.robot[rest]) >= MIN_TURN_DEG]
        if not rests:
            break
        rest = min(rests, key=lambda rest: _squares(poses[rest].solve(EXPECTED)).sum())
        out += set(kept) - set(rest)
        kept = rest
    while True:  # Those that are no worse than chance would have it are taken back.
        fit = poses[kept].solve()
        limit = 6 * stats.f.isf(OUTLIER_CHANCE / len(poses.robot), 6, 6 * len(kept) - 12)
        residual, scatter = predict(fit, *vars(poses[out]).values()) if out else (np.zeros((0, 6)), np.zeros((0, 6, 6)))
        off = np.einsum("ni,nij,nj->n", residual, np.linalg.inv(scatter), residual) > limit
        if off.all():
            return fit, {k: _left(one[None]) for k, one in sorted(zip(out, residual, strict=True))}
        kept += [k for k, wrong in zip(out, off, strict=True) if not wrong]
        out = [k for k, wrong in zip(out, off, strict=True) if wrong]


def _squares(fit: Fit) -> np.ndarray:
    """How far each pose is off, (n,), squared, in units of the noise that is expected of a hand."""
    return np.square(fit.residual / np.repeat(EXPECTED[1:], 3)).sum(1)


def _left(residual: np.ndarray) -> tuple[float, float]:
    """Root mean squares over axes and poses (n, 6): degrees and metres."""
    rotation, translation = (float(np.sqrt(np.square(part).mean())) for part in np.split(residual, 2, axis=1))
    return float(np.rad2deg(rotation)), translation


def _said(rotation_deg: float, translation_m: float) -> str:
    return f"{rotation_deg:.1f} degrees and {1e3 * translation_m:.0f} mm"


def _second_turn(robot: np.ndarray) -> float:
    """How far poses turned about a second axis, root mean square over all pairs, degrees."""
    first, second = np.array(list(combinations(robot[:, :3, :3], 2))).swapaxes(0, 1)
    turns = rotation_vectors(first.swapaxes(1, 2) @ second)
    spread = np.linalg.eigvalsh(turns.T @ turns / len(turns))
    return float(np.rad2deg(np.sqrt(max(0.0, spread[1]))))


def _poses(what: str, poses: Sequence[np.ndarray]) -> np.ndarray:
    array = np.asarray(poses, float)
    if array.ndim != 3 or array.shape[1:] != (4, 4) or not np.isfinite(array).all():
        raise UserError(f"the {what}'s poses are not finite matrices of shape (n, 4, 4)")
    turns = array[:, :3, :3]
    rigid = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max((1, 2)) < 1e-4
    bad = np.flatnonzero(~rigid | (np.linalg.det(turns) < 0) | (array[:, 3] != (0, 0, 0, 1)).any(1))
    if len(bad):
        raise UserError(f"pose {bad[0] + 1} of the {what} is no rotation and translation")
    away = np.abs(array[:, :3, 3]).max(1)
    if (away > FARTHEST_M).any():
        i = int(np.argmax(away > FARTHEST_M))
        raise UserError(f"pose {i + 1} of the {what} is {away[i]:.3g} m away: give metres")
    return array
