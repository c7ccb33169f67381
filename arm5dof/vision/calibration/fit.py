"""What OpenCV makes of views of a board: a camera, whatever it is worth."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.calibration.boards import Board, Corners
from arm5dof.vision.calibration.covariance import add_intrinsics_covariance
from arm5dof.vision.calibration.views import BoardView, board_error, board_pose
from arm5dof.vision.camera import Camera
from arm5dof.vision.lens import EXACT

COUNT_FLAGS = {4: cv2.CALIB_FIX_K3, 5: 0, 8: cv2.CALIB_RATIONAL_MODEL}
"""OpenCV's flags for so many distortion coefficients."""


@dataclass(frozen=True)
class Calibration:
    """What a calibration found."""

    camera: Camera
    """Without extrinsics; with the covariance of its intrinsics."""
    rms: float
    """Root mean square of the reprojection error, pixels."""
    deviations: np.ndarray
    """Standard deviations of the `intrinsics`, (4 + coefficients,): by how far the views disagree or, after `fit`
    of a pinhole, OpenCV's, for which the errors of all corners are independent."""
    errors: dict[str, float]
    """Root mean square reprojection error of every view used, pixels."""
    outliers: dict[str, float]
    """The same for the views left out, under the calibration of the others."""
    copies: dict[str, str] = field(default_factory=dict)
    """Photographs left out because they are there twice, and of which each is a copy."""

    @property
    def names(self) -> list[str]:
        """What is estimated, in OpenCV's order: pixels, then distortion coefficients without a unit."""
        return ["fx", "fy", "cx", "cy", *self.camera.model.names[: len(self.camera.distortion)]]

    @property
    def intrinsics(self) -> np.ndarray:
        """The values that `deviations` belong to."""
        matrix = np.asarray(self.camera.matrix)
        return np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *np.asarray(self.camera.distortion)])

    def save(self, path: Path, board: Board) -> None:
        """Write the camera as `Camera.save` does, with notes on how it was calibrated."""
        notes = {
            "nframes": len(self.errors),
            "board": str(board),
            "square_size": board.square,
            "avg_reprojection_error": self.rms,
            "intrinsics_standard_deviations": self.deviations.reshape(-1, 1),
        }
        self.camera.save(path, notes)


def fit(
    views: Sequence[BoardView], size: tuple[int, int], coefficients: int = 5, flags: int = 0, lens: str = "pinhole"
) -> Calibration:
    """OpenCV's calibration of these views as they are, whatever they are worth.

    Args:
        views: A board in several photographs.
        size: Width and height of the photographs, pixels.
        coefficients: How many distortion coefficients to estimate: 4, 5 or 8; 4 of a fisheye lens.
        flags: OpenCV's, besides those.
        lens: The lens model, `pinhole` or `fisheye`.

    Returns:
        The camera without extrinsics and without a covariance; no outliers.

    Raises:
        UserError: OpenCV cannot calibrate a fisheye lens with these views.
    """
    names = [view.name for view in views]
    if lens == "fisheye":
        camera, errors = _fit_fisheye([view.corners for view in views], size, flags)
        covariance = np.asarray(camera.covariance)[:8, :8]
        rms = np.sqrt(np.average(np.square(errors), weights=[len(view.corners.points) for view in views]))
        deviations = np.sqrt(np.diag(covariance))
        return Calibration(
            camera.replace(covariance=None), float(rms), deviations, dict(zip(names, errors, strict=True)), {}
        )
    start = np.eye(3) if flags & cv2.CALIB_FIX_ASPECT_RATIO else None  # The ratio that is to be kept.
    rms, matrix, distortion, _, _, deviations, _, errors = cv2.calibrateCameraExtended(  # type: ignore[call-overload]
        [view.corners.points for view in views],
        [view.corners.pixels for view in views],
        size,
        start,
        None,
        flags=flags | COUNT_FLAGS[coefficients],
    )
    return Calibration(
        Camera(matrix, distortion.ravel()[:coefficients], np.eye(3), np.zeros(3), *size, has_extrinsics=False),
        float(rms),
        deviations.ravel()[: 4 + coefficients],
        {name: float(error) for name, error in zip(names, errors.ravel(), strict=True)},
        {},
    )


def _fit_fisheye(views: Sequence[Corners], size: tuple[int, int], flags: int) -> tuple[Camera, list[float]]:
    """A fisheye camera with the covariance of its intrinsics, and the errors of the views."""
    points, pixels = [corners.points for corners in views], [corners.pixels for corners in views]
    _, by_pinhole, *_ = cv2.calibrateCamera(points, pixels, size, None, None, flags=cv2.CALIB_RATIONAL_MODEL)
    focal = max(size) / np.pi  # As if it showed a half turn.
    by_angle = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]])
    found = []
    # OpenCV's own start leads nowhere where a lens is wide. Its solution without new extrinsics is none.
    flags |= cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_SKEW | cv2.CALIB_RECOMPUTE_EXTRINSIC
    for start in (by_pinhole, by_angle):
        with suppress(cv2.error):
            rms, matrix, distortion, *_ = cv2.fisheye.calibrate(
                [each[None].astype(float) for each in points],
                [each[None].astype(float) for each in pixels],
                size,
                start,
                np.zeros(4),
                flags=flags,
                criteria=EXACT,
            )
            found.append((rms, matrix, distortion))
    if not found:
        raise UserError(
            "OpenCV cannot calibrate a fisheye lens with these views: leave out those in which the board is seen from "
            "a side or fills the image to its edges"
        )
    _, matrix, distortion = min(found, key=lambda each: each[0])
    camera = Camera(matrix, distortion.ravel(), np.eye(3), np.zeros(3), *size, has_extrinsics=False, lens="fisheye")
    known = add_intrinsics_covariance(camera, views, [board_pose(camera, corners) for corners in views])
    return known, [board_error(camera, corners) for corners in views]
