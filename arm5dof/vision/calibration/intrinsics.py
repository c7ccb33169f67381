"""Calibration of a camera from photographs of a board.

A small reprojection error alone proves nothing: a single photograph fits better than thirteen do, with a focal length
that is wrong by half. So a calibration is judged by the standard deviations of what it estimated, and by how many
different views it rests on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision import images
from arm5dof.vision.calibration.boards import Board, Corners
from arm5dof.vision.calibration.covariance import add_intrinsics_covariance, linearize
from arm5dof.vision.calibration.evidence import evidence, odd_views
from arm5dof.vision.calibration.views import (
    MIN_VIEWS,
    BoardView,
    BoardViews,
    apart,
    board_error,
    board_pose,
    distinct,
)
from arm5dof.vision.camera import Camera

SAME_VIEW = 0.02
"""Views whose corners are closer than this share of the image's diagonal, on average, are one view."""

MAX_DEVIATION = 0.005
"""The largest standard deviation of a focal length that is accepted, as a share of it; and of the principal point, as
a share of the image's larger side."""

OUTLIER = 3.0
"""A view whose error under the others' calibration is so many times their median is not of the same camera, or has
wrong corners."""

FEW = 2
"""So many views that do not fit are left out; more that fit each other are of another camera."""

DISAGREEMENT = 2.5
"""The error of all views together may be so many times what each leaves with intrinsics of its own: 1.2 times for
OpenCV's photographs, four times where half of them are of another camera and so none stands out."""

INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""What is estimated, in OpenCV's order: pixels, then distortion coefficients without a unit."""

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
    """Standard deviations of the intrinsics named by `INTRINSICS`, (4 + coefficients,): by how far the views disagree
    or, after `fit`, OpenCV's, for which the errors of all corners are independent."""
    errors: dict[str, float]
    """Root mean square reprojection error of every view used, pixels."""
    outliers: dict[str, float]
    """The same for the views left out, under the calibration of the others."""
    copies: dict[str, str] = field(default_factory=dict)
    """Photographs left out because they are there twice, and of which each is a copy."""

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


def calibrate(views: BoardViews, coefficients: int = 5) -> Calibration:
    """Calibrate a camera, leaving out views that do not fit the others.

    Args:
        views: What `find_views` found.
        coefficients: How many distortion coefficients to estimate: 4, 5, or 8 for wide lenses.

    Returns:
        The camera without extrinsics, and how well it is known.

    Raises:
        UserError: The views are too few, too much alike or too contradictory to tell the camera's intrinsics.
    """
    kept, copies = distinct(views.found)
    kept, outliers, result = _of_one_camera(kept, views.size, coefficients)
    _check_different(kept, views)
    _check_agreement(kept, result)
    seen = [view.corners for view in kept]
    camera = add_intrinsics_covariance(result.camera, seen, [board_pose(result.camera, corners) for corners in seen])
    result = replace(
        result,
        camera=camera,
        deviations=np.sqrt(np.diag(np.asarray(camera.covariance))[:-6]),
        outliers={view.name: board_error(camera, view.corners) for view in outliers},
        copies=copies,
    )
    _check_deviations(result)
    return result


def fit(views: Sequence[BoardView], size: tuple[int, int], coefficients: int = 5, flags: int = 0) -> Calibration:
    """OpenCV's calibration of these views as they are, whatever they are worth.

    Args:
        views: A board in several photographs.
        size: Width and height of the photographs, pixels.
        coefficients: How many distortion coefficients to estimate: 4, 5 or 8.
        flags: OpenCV's, besides those.

    Returns:
        The camera without extrinsics and without a covariance; no outliers.
    """
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
        {view.name: float(error) for view, error in zip(views, errors.ravel(), strict=True)},
        {},
    )


def preview(path: Path, camera: Camera, suffix: str = ".png") -> bytes:
    """Show what a calibration does to a photograph.

    Args:
        path: The photograph.
        camera: What took it.
        suffix: Of an image file, such as `.png`.

    Returns:
        The content of such a file: the photograph as it is and, beside it, without its lens distortion.
    """
    image = cv2.cvtColor(images.read(path), cv2.COLOR_RGB2BGR)
    straight = cv2.undistort(image, *camera.opencv)
    return cv2.imencode(suffix, np.concatenate([image, straight], axis=1))[1].tobytes()


def _of_one_camera(
    views: list[BoardView], size: tuple[int, int], coefficients: int
) -> tuple[list[BoardView], list[BoardView], Calibration]:
    """The views of one camera, those that do not fit them, and the calibration from the former."""
    kept, outliers, division, another = views, list[BoardView](), list[BoardView](), False
    result = fit(views, size, coefficients)
    while len(kept) > MIN_VIEWS:
        linear = (linearize(result.camera, corners, board_pose(result.camera, corners)) for _, corners in kept)
        group, alone = odd_views(evidence(linear))
        odd = [kept[i] for i in (group if alone is None else [alone])]
        if not outliers:  # Leaving out views of the larger group first can make it the smaller one.
            division = [kept[i] for i in group]
        if len(odd) > FEW:
            outliers, another = division if len(division) > FEW else [*outliers, *odd], True
            break
        worst = odd or [max(kept, key=lambda view: result.errors[view.name])]
        others = [view for view in kept if all(view is not other for other in worst)]
        without = fit(others, size, coefficients)
        limit = OUTLIER * float(np.median(list(without.errors.values())))
        if not odd and board_error(without.camera, worst[0].corners) <= limit:
            break
        kept, outliers, result = others, [*outliers, *worst], without
    if another or 4 * len(outliers) > len(views):
        raise UserError(
            f"{len(outliers)} of {len(views)} views do not fit the others ({', '.join(v.name for v in outliers)}): are "
            "they of another camera, zoom or focus? calibrate them by themselves; or is the board not flat?"
        )
    return kept, outliers, result


def _check_different(kept: Sequence[BoardView], views: BoardViews) -> None:
    """Count views that are not repetitions of an earlier one."""
    different: list[Corners] = []
    for view in kept:
        if all(apart(view.corners, other) > SAME_VIEW * np.hypot(*views.size) for other in different):
            different.append(view.corners)
    if len(different) < MIN_VIEWS:
        raise UserError(
            f"only {len(different)} of {len(views.found)} views differ and a calibration takes {MIN_VIEWS}: photograph "
            "the board from different sides and distances, tilted, all over the image"
        )


def _check_agreement(views: Sequence[BoardView], result: Calibration) -> None:
    """Compare the error with that of views calibrated one by one, where they have corners enough for that."""
    matrix, distortion = result.camera.opencv
    flags = COUNT_FLAGS[len(distortion)] | cv2.CALIB_USE_INTRINSIC_GUESS
    together, alone = [], []
    for name, (points, pixels) in views:
        # Fitted are the pose, two focal lengths, the principal point, the lens.
        spare = 1 - (10 + len(distortion)) / pixels.size
        if spare > 0.5:
            size = result.camera.width, result.camera.height
            rms, *_ = cv2.calibrateCamera([points], [pixels], size, matrix.copy(), distortion.copy(), flags=flags)
            together.append(result.errors[name])
            alone.append(rms / np.sqrt(spare))
    if together and (ratio := np.median(together) / np.median(alone)) > DISAGREEMENT:
        raise UserError(
            f"the views do not fit one camera: {np.median(together):.2f} pixels off together, {ratio:.1f} times what "
            "they are one by one; use one camera, one zoom and focus, and a board that is flat"
        )


def _check_deviations(result: Calibration) -> None:
    values, deviations = result.intrinsics, result.deviations
    side = max(result.camera.width, result.camera.height)
    for name, value, deviation, scale in zip(INTRINSICS, values, deviations, [*values[:2], side, side], strict=False):
        limit = MAX_DEVIATION * scale
        if not deviation <= limit:  # NaN is refused too.
            raise UserError(
                f"{name} = {value:.1f} +- {deviation:.1f} pixels (standard deviation) and {limit:.1f} is the limit: "
                "add photographs with the board tilted by 30 to 45 degrees, near, and at the corners"
            )
