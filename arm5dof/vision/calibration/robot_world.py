"""The equation A_i X = Z B_i^-1 of hand-eye calibration, solved as well as the noise of both sides allows.

The start is the closed form of Shah (2013), "Solving the robot-world/hand-eye calibration problem using the Kronecker
product", J. Mechanisms and Robotics 5(3): rotations by a singular value decomposition, then translations by linear
least squares. Gauss-Newton steps on what the camera measured follow, each view weighed by what its board's pose and the
hand's are worth. How noisy the hand is, nobody says: its variances, and the factor by which the boards' are stated too
small, are those that make the residuals most likely, with allowance for what fitting took out of them (REML; Patterson
and Thompson 1971, Biometrika 58(3)).
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import minimize

from arm5dof.vision.calibration.poses import pose_matrix

EXPECTED = np.array([1.0, np.deg2rad(0.2), 1e-3])
"""What is expected of the noise until residuals tell: the factor of the boards' deviations, and the hand's noise about
and along each axis, radians and metres."""

LEAST, MOST = np.array([1e-3, 1e-6, 1e-7]), np.array([1e3, 1.0, 1.0])
"""Bounds of the same."""

STEPS = 30

FARTHEST = 1.0
"""Radians or metres. Where poses agree, the closed form is nearer than that; a longer step leads nowhere."""


class Fit(NamedTuple):
    """X and Z, and how well they are known."""

    x: np.ndarray
    """(4, 4), metres."""
    z: np.ndarray
    """(4, 4), metres."""
    residual: np.ndarray
    """What separates the boards' measured poses from those that X and Z explain, (n, 6): rotation vectors and metres in
    the camera's frame."""
    covariance: np.ndarray
    """Of X and Z, (12, 12): each a turn about its own axes in radians and a shift along them in metres."""
    noise: np.ndarray
    """As in `EXPECTED`, (3,)."""


def solve(
    robot: np.ndarray, boards: np.ndarray, spread: np.ndarray, on_hand: bool, noise: np.ndarray | None = None
) -> Fit:
    """Find X and Z.

    Args:
        robot: A, (n, 4, 4), metres: the hand's poses if the camera is on it, else their inverses.
        boards: B, (n, 4, 4), metres: the board's poses in the camera's frame.
        spread: Their covariances, (n, 6, 6): a turn about the camera's axes at the board's origin (radians), a shift
            along them (metres).
        on_hand: Whether the camera is on the hand.
        noise: As in `EXPECTED`, (3,), if it is known; otherwise it is estimated.

    Returns:
        The fit.
    """
    x, z = _closed_form(robot, boards)
    settled, noise = noise is not None, EXPECTED if noise is None else noise
    for _ in range(STEPS):
        residual, jacobian = _linearize(robot, boards, x, z)
        parts = _parts(robot, x, z, spread, on_hand)
        if not settled:
            before, noise = noise, _estimate_noise(residual, jacobian, parts, noise)
            settled = bool((np.abs(np.log(noise / before)) < 1e-2).all())
        step, covariance, _ = _step(residual, jacobian, _scatter(parts, noise))
        if np.abs(step).max() > FARTHEST:
            break
        x, z = _moved(x, step[:6]), _moved(z, step[6:])
        if settled and (np.square(step) < 1e-8 * np.diag(covariance)).all():
            break
    return Fit(x, z, _linearize(robot, boards, x, z)[0], covariance, noise)


def predict(
    fit: Fit, robot: np.ndarray, boards: np.ndarray, spread: np.ndarray, on_hand: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Hold poses that were not used against a fit.

    Args:
        fit: What `solve` found from others.
        robot: As for `solve`.
        boards: As for `solve`.
        spread: As for `solve`.
        on_hand: As for `solve`.

    Returns:
        Their residuals, (n, 6), and the covariances of these, (n, 6, 6).
    """
    residual, jacobian = _linearize(robot, boards, fit.x, fit.z)
    scatter = _scatter(_parts(robot, fit.x, fit.z, spread, on_hand), fit.noise)
    return residual, scatter + jacobian @ fit.covariance @ jacobian.swapaxes(1, 2)


def _parts(robot: np.ndarray, x: np.ndarray, z: np.ndarray, spread: np.ndarray, on_hand: bool) -> np.ndarray:
    """What the covariance of each residual is made of, (3, n, 6, 6): the board's pose, and the hand's turn and shift by
    one radian and one metre, which act at the hand's origin."""
    camera_to_fixed = inverse(robot @ x)
    hand = np.broadcast_to(inverse(x), robot.shape) if on_hand else camera_to_fixed
    lever = (camera_to_fixed @ z)[:, :3, 3] - hand[:, :3, 3]
    turn, shift = np.zeros((2, len(robot), 6, 3))
    turn[:, :3], turn[:, 3:], shift[:, 3:] = np.eye(3), -_cross(lever), np.eye(3)
    return np.array([spread, turn @ turn.swapaxes(1, 2), shift @ shift.swapaxes(1, 2)])


def _scatter(parts: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """The residuals' covariances, (n, 6, 6)."""
    return np.tensordot(np.square(noise), parts, 1)


def _step(
    residual: np.ndarray, jacobian: np.ndarray, scatter: np.ndarray
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """The step (12,) of weighted least squares, its covariance, and the weights (n, 6, 6) without and with the
    Jacobian (n, 6, 12)."""
    weight = np.linalg.inv(scatter)
    weighed = weight @ jacobian
    covariance = np.linalg.inv(jacobian.reshape(-1, 12).T @ weighed.reshape(-1, 12))
    return -covariance @ (weighed.reshape(-1, 12).T @ residual.reshape(-1)), covariance, (weight, weighed)


def _estimate_noise(residual: np.ndarray, jacobian: np.ndarray, parts: np.ndarray, start: np.ndarray) -> np.ndarray:
    """The noise that makes the residuals most likely."""
    flat = parts.reshape(3, -1)

    def unlikely(logs: np.ndarray) -> tuple[float, np.ndarray]:
        """Twice the negative logarithm of the restricted likelihood, but for a constant, and its derivative."""
        squares = np.exp(2 * logs)
        scatter = (squares @ flat).reshape(parts.shape[1:])
        step, covariance, (weight, weighed) = _step(residual, jacobian, scatter)
        rest = residual + jacobian @ step
        left = (weight @ rest[..., None])[..., 0]
        value = np.linalg.slogdet(scatter)[1].sum() - np.linalg.slogdet(covariance)[1] + (left * rest).sum()
        free = weight - weighed @ covariance @ weighed.swapaxes(1, 2) - left[:, :, None] * left[:, None]
        return float(value), 2 * squares * (flat @ free.ravel())

    bounds = np.log([LEAST, MOST]).T
    found = minimize(unlikely, np.log(start), jac=True, method="L-BFGS-B", bounds=bounds, options={"ftol": 1e-7})
    return np.exp(found.x)


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
    explained = inverse(robot @ x) @ z
    turn, shift = explained[:, :3, :3], explained[:, :3, 3]
    residual = np.concatenate(
        [rotation_vectors(turn @ boards[:, :3, :3].transpose(0, 2, 1)), shift - boards[:, :3, 3]], 1
    )
    jacobian = np.zeros((len(robot), 6, 12))
    jacobian[:, :3, :3], jacobian[:, 3:, 3:6] = -np.eye(3), -np.eye(3)
    jacobian[:, 3:, :3] = _cross(shift)
    jacobian[:, :3, 6:9], jacobian[:, 3:, 9:] = turn, turn
    return residual, jacobian


def _moved(pose: np.ndarray, step: np.ndarray) -> np.ndarray:
    """A pose after a small move (6,), rotation vector and metres, in its own frame."""
    return pose @ pose_matrix(cv2.Rodrigues(step[:3])[0], step[3:])


def inverse(poses: np.ndarray) -> np.ndarray:
    """Inverses of poses (..., 4, 4)."""
    result = np.zeros_like(poses)
    turns = poses[..., :3, :3].swapaxes(-1, -2)
    result[..., :3, :3] = turns
    result[..., :3, 3] = -(turns @ poses[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1
    return result


def rotation_vectors(turns: np.ndarray) -> np.ndarray:
    """Rotation vectors (n, 3) of rotation matrices (n, 3, 3)."""
    return np.array([cv2.Rodrigues(turn)[0].ravel() for turn in turns]).reshape(-1, 3)


def _cross(vectors: np.ndarray) -> np.ndarray:
    """Matrices (n, 3, 3) that take the cross product with vectors (n, 3) from the left."""
    x, y, z = vectors.T
    o = np.zeros_like(x)
    return np.array([[o, -z, y], [z, o, -x], [-y, x, o]]).transpose(2, 0, 1)


def _nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    left, _, right = np.linalg.svd(matrix)
    return left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
