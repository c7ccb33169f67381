"""Calibration of a camera from photographs of a board.

A small reprojection error alone proves nothing: a single photograph fits better than thirteen do, with a focal length
that is wrong by half. So a calibration is judged by the standard deviations of what it estimated, and by how many
different views it rests on.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision import images
from arm5dof.vision.calibration.boards import Corners
from arm5dof.vision.calibration.covariance import add_intrinsics_covariance, linearize
from arm5dof.vision.calibration.evidence import evidence, odd_views
from arm5dof.vision.calibration.fit import Calibration, fit
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
from arm5dof.vision.lens import LENSES

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


class LensError(UserError):
    """Views do not fit the lens model that they were to be calibrated with, and fit another."""

    def __init__(self, message: str, lens: str, coefficients: int) -> None:
        super().__init__(message)
        self.lens, self.coefficients = lens, coefficients
        """The other one."""


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
