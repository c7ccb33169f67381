"""Hand-eye calibration: where a camera sits on the hand, or where it stands beside the arm.

Both are the equation A_i X = Z B_i^-1 of the robot's poses A_i and the board's poses B_i in the camera's frame. The
start is the closed form of Shah (2013), "Solving the robot-world/hand-eye calibration problem using the Kronecker
product", J. Mechanisms and Robotics 5(3): rotations by a singular value decomposition, then translations by linear
least squares. Gauss-Newton steps on what the camera measured then weigh rotations and translations by their noise, as
the closed form cannot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.calibration.poses import pose_matrix

MIN_POSES = 4
"""Three determine the solution and leave nothing to tell its error by."""

MIN_TURN_DEG = 5.0
"""How far the hand must turn about a second axis, root mean square over all pairs of poses. Turning about parallel
axes leaves the camera's place along them open."""

ROTATION_NOISE_DEG, TRANSLATION_NOISE_M = 0.2, 1e-3
"""Noise of a board's pose in the camera's frame, per axis. Only their ratio acts on the solution."""

CONTRADICTION = 15.0
"""So many times that noise, root mean square, is no noise."""

STEPS = 20


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

    @property
    def deviations(self) -> np.ndarray:
        """Standard deviations of the camera's pose, (6,): of the turn in degrees, of the shift in metres."""
        deviations = np.sqrt(np.diag(self.covariance))
        return np.concatenate([np.rad2deg(deviations[:3]), deviations[3:]])


def eye_in_hand(hands: Sequence[np.ndarray], boards: Sequence[np.ndarray]) -> HandEye:
    """A camera on the hand looks at a board that stands still.

    Args:
        hands: The hand's poses in the base frame, (n, 4, 4), metres.
        boards: The board's poses in the camera's frame at the same moments, (n, 4, 4), metres.

    Returns:
        The camera's pose in the hand's frame and the board's in the base frame.

    Raises:
        UserError: The poses are not such, do not determine the answer, or contradict each other.
    """
    return _solve(_poses("hand", hands), _poses("board", boards))


def eye_to_hand(hands: Sequence[np.ndarray], boards: Sequence[np.ndarray]) -> HandEye:
    """A camera that stands still looks at a board on the hand.

    Args:
        hands: As for `eye_in_hand`.
        boards: As for `eye_in_hand`.

    Returns:
        The camera's pose in the base frame and the board's in the hand's frame.

    Raises:
        UserError: As for `eye_in_hand`.
    """
    return _solve(_inverse(_poses("hand", hands)), _poses("board", boards))


def _solve(robot: np.ndarray, boards: np.ndarray) -> HandEye:
    """The poses X and Z with robot_i X boards_i = Z for all i, as well as that can be."""
    if len(robot) != len(boards):
        raise UserError(f"{len(robot)} poses of the hand and {len(boards)} of the board: give one of each per image")
    if len(robot) < MIN_POSES:
        raise UserError(f"{len(robot)} poses: hand-eye calibration takes {MIN_POSES} at least, better 15")
    _check_motion(robot)
    x, z = _closed_form(robot, boards)
    weights = np.repeat([1 / np.deg2rad(ROTATION_NOISE_DEG), 1 / TRANSLATION_NOISE_M], 3)
    for _ in range(STEPS):
        residual, jacobian = _linearize(robot, boards, x, z)
        system, right = jacobian * weights[:, None], residual * weights
        step = np.linalg.lstsq(system.reshape(-1, 12), -right.reshape(-1), rcond=None)[0]
        x, z = _moved(x, step[:6]), _moved(z, step[6:])
        if np.abs(step).max() < 1e-12:
            break
    residual, jacobian = _linearize(robot, boards, x, z)
    rotation, translation = (float(np.sqrt(np.square(part).mean())) for part in np.split(residual, 2, axis=1))
    if rotation > np.deg2rad(CONTRADICTION * ROTATION_NOISE_DEG) or translation > CONTRADICTION * TRANSLATION_NOISE_M:
        raise UserError(
            f"the poses contradict each other by {np.rad2deg(rotation):.1f} degrees and {1e3 * translation:.0f} mm: "
            "give metres, the hand's poses in the base frame, the board's in the camera's frame, in the same order"
        )
    system = (jacobian * weights[:, None]).reshape(-1, 12)
    variance = np.square(residual * weights).sum() / (residual.size - 12)
    return HandEye(
        camera=x,
        board=z,
        rotation_deg=float(np.rad2deg(rotation)),
        translation_m=translation,
        covariance=np.linalg.inv(system.T @ system)[:6, :6] * variance,
    )


def _closed_form(robot: np.ndarray, boards: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """X and Z by Shah's method. For all i vec(R_X) = (R_Bi kron R_Ai^T) vec(R_Z), so both are singular vectors of the
    mean of those products."""
    mean = np.mean([np.kron(b[:3, :3], a[:3, :3].T) for a, b in zip(robot, boards, strict=True)], axis=0)
    left, _, right_t = np.linalg.svd(mean)
    x, z = np.eye(4), np.eye(4)
    sign = np.sign(np.linalg.det(left[:, 0].reshape(3, 3)))
    x[:3, :3] = _nearest_rotation(sign * left[:, 0].reshape(3, 3).T)
    z[:3, :3] = _nearest_rotation(sign * right_t[0].reshape(3, 3).T)
    # R_A (R_X t_B + t_X) + t_A = t_Z is linear in t_X and t_Z.
    system = np.concatenate([np.concatenate([a[:3, :3], -np.eye(3)], axis=1) for a in robot])
    right = [-a[:3, 3] - a[:3, :3] @ x[:3, :3] @ b[:3, 3] for a, b in zip(robot, boards, strict=True)]
    shifts = np.linalg.lstsq(system, np.concatenate(right), rcond=None)[0]
    x[:3, 3], z[:3, 3] = shifts[:3], shifts[3:]
    return x, z


def _linearize(robot: np.ndarray, boards: np.ndarray, x: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What separates the boards' measured poses from those that X and Z explain, (n, 6), rotation vector and metres
    in the camera's frame; and its derivative, (n, 6, 12), by the moves of X and Z that `_moved` makes."""
    explained = _inverse(robot @ x) @ z
    turn, shift = explained[:, :3, :3], explained[:, :3, 3]
    residual = np.concatenate(
        [_rotation_vectors(turn @ boards[:, :3, :3].transpose(0, 2, 1)), shift - boards[:, :3, 3]], 1
    )
    jacobian = np.zeros((len(robot), 6, 12))
    jacobian[:, :3, :3], jacobian[:, 3:, 3:6] = -np.eye(3), -np.eye(3)
    jacobian[:, 3:, :3] = _cross(shift)
    jacobian[:, :3, 6:9], jacobian[:, 3:, 9:] = turn, turn
    return residual, jacobian


def _moved(pose: np.ndarray, step: np.ndarray) -> np.ndarray:
    """A pose after a small move (6,), rotation vector and metres, in its own frame."""
    return pose @ pose_matrix(cv2.Rodrigues(step[:3])[0], step[3:])


def _check_motion(robot: np.ndarray) -> None:
    """Raise `UserError` unless the hand turned about two axes."""
    turns = [_rotation_vectors((a[:3, :3].T @ b[:3, :3])[None])[0] for a, b in combinations(robot, 2)]
    spread = np.sqrt(np.linalg.eigvalsh(np.mean([np.outer(turn, turn) for turn in turns], axis=0)))
    second = np.rad2deg(spread[1])
    if second < MIN_TURN_DEG:
        raise UserError(
            f"the hand turned about parallel axes only ({second:.1f} degrees about a second one, {MIN_TURN_DEG:g} are "
            "needed): turn it about another axis too, by 30 degrees or more"
        )


def _poses(what: str, poses: Sequence[np.ndarray]) -> np.ndarray:
    array = np.asarray(poses, float)
    if array.ndim != 3 or array.shape[1:] != (4, 4) or not np.isfinite(array).all():
        raise UserError(f"the {what}'s poses are not finite matrices of shape (n, 4, 4)")
    turns = array[:, :3, :3]
    rigid = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max((1, 2)) < 1e-4
    bad = np.flatnonzero(~rigid | (np.linalg.det(turns) < 0) | (array[:, 3] != (0, 0, 0, 1)).any(1))
    if len(bad):
        raise UserError(f"pose {bad[0] + 1} of the {what} is no rotation and translation")
    return array


def _inverse(poses: np.ndarray) -> np.ndarray:
    result = np.zeros_like(poses)
    turns = poses[..., :3, :3].swapaxes(-1, -2)
    result[..., :3, :3] = turns
    result[..., :3, 3] = -(turns @ poses[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1
    return result


def _rotation_vectors(turns: np.ndarray) -> np.ndarray:
    return np.array([cv2.Rodrigues(turn)[0].ravel() for turn in turns]).reshape(-1, 3)


def _cross(vectors: np.ndarray) -> np.ndarray:
    """Matrices (n, 3, 3) that take the cross product with vectors (n, 3) from the left."""
    x, y, z = vectors.T
    o = np.zeros_like(x)
    return np.array([[o, -z, y], [z, o, -x], [-y, x, o]]).transpose(2, 0, 1)


def _nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    left, _, right = np.linalg.svd(matrix)
    return left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
