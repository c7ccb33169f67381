"""How well a camera is known: the covariance of what calibration estimates, in the order of `Camera.perturbed`.

Standard deviations alone will not do. Errors of the focal length, the distortion and the pose hang together, and most
of what they do to a pixel cancels; taken one by one they would make a camera look several times worse than it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from arm5dof.vision.calibration.boards import Corners
from arm5dof.vision.calibration.corner_noise import corner_covariance
from arm5dof.vision.calibration.evidence import evidence, intrinsics_covariance
from arm5dof.vision.camera import Camera


def add_intrinsics_covariance(camera: Camera, views: Sequence[Corners], boards: Sequence[np.ndarray]) -> Camera:
    """The covariance of a camera's intrinsics, by how far the views disagree.

    Args:
        camera: It was calibrated from the views.
        views: Corners in n photographs.
        boards: The boards' poses in the camera's frame, (4, 4) each, estimated together with the camera.

    Returns:
        The camera with a covariance; that of its pose is zero.
    """
    lens = intrinsics_covariance(evidence(linearize(camera, *seen) for seen in zip(views, boards, strict=True)))
    covariance = np.zeros((len(lens) + 6, len(lens) + 6))
    covariance[:-6, :-6] = lens
    return camera.replace(covariance=covariance)


def add_pose(camera: Camera, solve: Callable[[Camera], np.ndarray], noise: np.ndarray) -> Camera:
    """A camera's pose, and the covariance of both: what errors of the intrinsics do to the pose is found by solving
    again.

    Args:
        camera: With the covariance of its intrinsics, or with none.
        solve: Finds a camera's pose, (4, 4), camera to base frame.
        noise: The pose's covariance were the intrinsics exact, (6, 6): a rotation (radians) and a shift (metres) in the
            camera's own frame.

    Returns:
        The camera with extrinsics and, if that of its intrinsics is known, their covariance.
    """
    pose = solve(camera)
    placed = camera.with_pose(pose[:3, :3], pose[:3, 3])
    if camera.covariance is None:
        return placed
    lens = np.asarray(camera.covariance, float)[:-6, :-6]
    follows = np.zeros((6, len(lens)))
    for i, deviation in enumerate(np.sqrt(np.diag(lens))):
        if deviation:
            error = np.zeros(len(lens) + 6)
            error[i] = deviation
            more, less = (_step(pose, solve(camera.perturbed(sign * error))) for sign in (1, -1))
            follows[:, i] = (more - less) / (2 * deviation)
    both = lens @ follows.T
    return placed.replace(covariance=np.block([[lens, both], [both.T, follows @ both + noise]]))


def pose_covariance(camera: Camera, corners: Corners, board: np.ndarray, independent: bool = False) -> np.ndarray:
    """How well corners tell a camera's pose beside a board, by what separates them from where they should be seen.

    Args:
        camera: What saw them.
        corners: Where.
        board: The board's pose in the camera's frame, (4, 4).
        independent: Take their errors for independent, which in photographs they are not.

    Returns:
        (6, 6): a rotation (radians) and a shift (metres) in the camera's own frame.
    """
    residual, jacobian = linearize(camera, corners, board)
    by_pose = jacobian[:, -6:]
    if independent:
        return np.linalg.inv(by_pose.T @ by_pose) * (residual @ residual) / (len(residual) - 6)
    by_corners = np.linalg.pinv(by_pose)
    return by_corners @ corner_covariance(corners.points, residual, by_pose) @ by_corners.T


def placement_covariance(placement_std: tuple[float, float], board: np.ndarray) -> np.ndarray:
    """What errors of a board's place do to the pose of the camera that sees it.

    Args:
        placement_std: Standard deviations of the board's position (metres) and rotation (radians), along and about each
            axis.
        board: The board's pose in the camera's frame, (4, 4).

    Returns:
        (6, 6): a rotation (radians) and a shift (metres) in the camera's own frame.
    """
    turn = board[:3, :3]
    x, y, z = board[:3, 3]
    lever = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    # The turn of a board at its place moves a camera that sees it there.
    carry = np.block([[turn, np.zeros((3, 3))], [lever @ turn, turn]])
    return carry @ np.diag(np.repeat(np.square(placement_std[::-1]), 3)) @ carry.T


def linearize(camera: Camera, corners: Corners, board: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What separates the n corners of a board at the pose `board` (4, 4) in the camera's frame from where they were
    seen, (2n,) pixels, and its derivative by the errors that `Camera.perturbed` takes, (2n, m)."""
    turn, _ = cv2.Rodrigues(board[:3, :3])
    pixels, by_lens, by_place = camera.model.project(corners.points, turn, board[:3, 3], camera.opencv)
    by_point = by_place[:, 3:].reshape(-1, 2, 3)
    x, y, z = (corners.points @ board[:3, :3].T + board[:3, 3]).T
    o = np.zeros_like(x)
    cross = np.array([[o, -z, y], [z, o, -x], [-y, x, o]]).transpose(2, 0, 1)
    # When the camera turns and shifts, what it sees does the opposite.
    by_pose = np.concatenate([by_point @ cross, -by_point], axis=2).reshape(-1, 6)
    residual = (pixels - corners.pixels).ravel()
    return residual, np.concatenate([by_lens, by_pose], axis=1)


def _step(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The small turn and shift (6,) that lead from one pose to another, in the frame of the first."""
    move = np.linalg.inv(start) @ end
    return np.concatenate([cv2.Rodrigues(move[:3, :3])[0].ravel(), move[:3, 3]])
