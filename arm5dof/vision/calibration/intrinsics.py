"""Calibration of a camera from photographs of a board.

A small reprojection error alone proves nothing: a single photograph fits better than thirteen do, with a focal length
that is wrong by half. So a calibration is judged by the standard deviations of what it estimated, and by how many
different views it rests on.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
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
from arm5dof.vision.lens import EXACT, LENSES

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

BETTER_LENS = 1.2
"""Where another lens model leaves so many times smaller errors, the one that was asked for does not describe the lens.
For OpenCV's photographs it is 1.01 times."""

COUNT_FLAGS = {4: cv2.CALIB_FIX_K3, 5: 0, 8: cv2.CALIB_RATIONAL_MODEL}
"""OpenCV's flags for so many distortion coefficients."""


class LensError(UserError):
    """Views do not fit the lens model that they were to be calibrated with, and fit another."""

    def __init__(self, message: str, lens: str, coefficients: int) -> None:
        super().__init__(message)
        self.lens, self.coefficients = lens, coefficients
        """The other one."""


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


def calibrate(views: BoardViews, coefficients: int | None = None, lens: str = "pinhole") -> Calibration:
    """Calibrate a camera, leaving out views that do not fit the others.

    Args:
        views: What `find_views` found.
        coefficients: How many distortion coefficients to estimate: 4, 5 (the default), or 8 for wide lenses; 4 of a
            fisheye lens.
        lens: The lens model, `pinhole` or `fisheye`.

    Returns:
        The camera without extrinsics, and how well it is known.

    Raises:
        LensError: Another lens model fits the views much better.
        UserError: There is no such lens model; or the views are too few, too much alike or too contradictory to tell
            the camera's intrinsics.
    """
    if lens not in LENSES:
        raise UserError(f"no lens model {lens!r}: choose from {', '.join(LENSES)}")
    coefficients = coefficients or LENSES[lens].counts[0]
    if coefficients not in LENSES[lens].counts:
        raise UserError(f"{coefficients} distortion coefficients: give {LENSES[lens].wanted}")
    kept, copies = distinct(views.found)
    _check_different(kept, views)
    first = fit(kept, views.size, coefficients, lens=lens)
    _check_lens(kept, first)
    kept, outliers, result = _of_one_camera(kept, first)
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


def preview(path: Path, camera: Camera, suffix: str = ".png") -> bytes:
    """Show what a calibration does to a photograph.

    Args:
        path: The photograph.
        camera: What took it.
        suffix: Of an image file, such as `.png`.

    Returns:
        The content of such a file: the photograph as it is and, beside it, without its lens distortion.
    """
    image = cv2.cvtColor(images.read(path, upright=False), cv2.COLOR_RGB2BGR)
    straight = camera.model.straighten(image, camera.opencv)
    return cv2.imencode(suffix, np.concatenate([image, straight], axis=1))[1].tobytes()


def _of_one_camera(views: list[BoardView], result: Calibration) -> tuple[list[BoardView], list[BoardView], Calibration]:
    """The views of one camera, those that do not fit them, and the calibration from the former; `result` is of all."""
    camera = result.camera
    kept, outliers, division, another = views, list[BoardView](), list[BoardView](), False
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
        without = fit(others, (camera.width, camera.height), len(camera.distortion), lens=camera.lens)
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


def _check_lens(views: Sequence[BoardView], result: Calibration) -> None:
    """Raise `LensError` if another lens model fits most views much better. Views of a wide lens that show its edges
    would be taken for outliers one after another."""
    measured = sum(view.corners.pixels.size for view in views) - 6 * len(views)

    def left(calibration: Calibration) -> float:
        """The error of a view, had the lens no parameters to make it smaller; infinite if it has too many."""
        spare = measured - len(calibration.deviations)
        return float(np.median(list(calibration.errors.values())) * np.sqrt(measured / spare)) if spare > 0 else np.inf

    own, size = (result.camera.lens, len(result.camera.distortion)), (result.camera.width, result.camera.height)
    others = dict[tuple[str, int], float]()
    for lens, coefficients in (("pinhole", 5), ("fisheye", 4), ("pinhole", 8)):
        if (lens, coefficients) != own:
            with suppress(UserError):
                others[lens, coefficients] = left(fit(views, size, coefficients, lens=lens))
    best = min(others.values())
    if left(result) > BETTER_LENS * best:
        # The one with the fewest parameters of those that are as good.
        (lens, coefficients), error = next(item for item in others.items() if item[1] < 1.1 * best)
        model = "a fisheye lens" if lens == "fisheye" else f"a pinhole with {coefficients} distortion coefficients"
        raise LensError(
            f"the lens is another: the photographs fit {model} to {error:.2f} pixels, and the model that was asked for "
            f"to {left(result):.2f}",
            lens,
            coefficients,
        )


def _check_agreement(views: Sequence[BoardView], result: Calibration) -> None:
    """Compare the error with that of views calibrated one by one, where they have corners enough for that."""
    together, alone = [], []
    for name, corners in views:
        residual, jacobian = linearize(result.camera, corners, board_pose(result.camera, corners))
        # Fitted are the pose, two focal lengths, the principal point, the lens.
        spare = 1 - jacobian.shape[1] / len(residual)
        if spare > 0.5:
            left = residual - jacobian @ np.linalg.lstsq(jacobian, residual, rcond=None)[0]
            together.append(result.errors[name])
            alone.append(np.sqrt(2 * np.mean(left**2) / spare))
    if together and (ratio := np.median(together) / np.median(alone)) > DISAGREEMENT:
        raise UserError(
            f"the views do not fit one camera: {np.median(together):.2f} pixels off together, {ratio:.1f} times what "
            "they are one by one; use one camera, one zoom and focus, and a board that is flat"
        )


def _check_deviations(result: Calibration) -> None:
    values, deviations = result.intrinsics, result.deviations
    side = max(result.camera.width, result.camera.height)
    for name, value, deviation, scale in zip(result.names, values, deviations, [*values[:2], side, side], strict=False):
        limit = MAX_DEVIATION * scale
        if not deviation <= limit:  # NaN is refused too.
            raise UserError(
                f"{name} = {value:.1f} +- {deviation:.1f} pixels (standard deviation) and {limit:.1f} is the limit: "
                "add photographs with the board tilted by 30 to 45 degrees, near, and at the corners"
            )
