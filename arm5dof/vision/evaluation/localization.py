"""How well objects are located in random scenes: by the detector's own boxes, and cameras known only as well as
calibration makes them known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from arm5dof.vision.boxes import iou
from arm5dof.vision.camera import Camera
from arm5dof.vision.detections import Detections
from arm5dof.vision.evaluation.simulated_calibration import simulate_calibration
from arm5dof.vision.localization import locate
from arm5dof.vision.localization.common import Localization
from arm5dof.vision.localization.solids import CATALOGUE_SOLIDS, Solid
from arm5dof.vision.rendering.simulated import BackEnd, simulated_camera
from arm5dof.vision.synthetic.ground_truth import Truth, truth
from arm5dof.vision.synthetic.samples import HEIGHT, WIDTH
from arm5dof.vision.synthetic.scene_builder import CAMERA, SECOND
from arm5dof.vision.synthetic.scenes import random_scene

BOX_STD = 0.9
"""What is said of the edges of the detector's boxes, as a standard deviation, pixels. Most are nearer, as if it were
0.8; with those round half-hidden objects it is 1.2."""
DEPTH_STD, PIXEL_STD = 2e-3, 2e-3
"""Standard deviations of the errors of depth images, as a whole and in each pixel, metres."""
LEVELS = {"68": 3.5267, "95": 7.8147}
"""Squares of how many standard deviations hold so many per cent of positions in space."""


@dataclass(frozen=True, eq=False)
class CameraSample:
    """What one camera sees of a scene."""

    image: np.ndarray
    """RGB uint8 (h, w, 3)."""
    depth: np.ndarray
    """As a depth camera would measure it, (h, w) float32, metres."""
    truth: Truth
    calibrated: Camera
    """The camera as its calibration has it."""


@dataclass(frozen=True)
class Accuracy:
    """Of one way to locate objects."""

    median_mm: float
    """Of distances in space from the true centers."""
    p95_mm: float
    """Their 95th percentile."""
    placed: float
    """Which share of the objects that count has a position."""
    covered: dict[str, float]
    """Per cent of true positions inside the ellipsoids that should hold 68 % and 95 % of them."""


@dataclass(frozen=True, eq=False)
class StereoSample:
    """A scene seen by two cameras, and how high its objects are taken to be: heights vary, as objects do."""

    views: tuple[CameraSample, CameraSample]
    solids: dict[str, Solid]


def render_stereo_sample(number: int, seed: int, back_end: BackEnd) -> StereoSample:
    """Draw a random scene in the style of evaluation.

    Args:
        number: Of the scene in a series.
        seed: Of the series.
        back_end: What draws.

    Returns:
        What two cameras see of it.
    """
    scene = random_scene((seed, number), "evaluation")
    rng = np.random.default_rng((seed, number))
    views = []
    for name in (CAMERA, SECOND):
        camera = simulated_camera(scene.model, name, WIDTH, HEIGHT, back_end)
        true = Camera.from_mujoco(scene.model, name, WIDTH, HEIGHT, scene.data)
        depth = camera.depth(scene.data) + DEPTH_STD * rng.normal() + PIXEL_STD * rng.normal(size=(HEIGHT, WIDTH))
        there = truth(scene, camera.segmentation(scene.data), name)
        calibrated = simulate_calibration(true, rng)
        views.append(CameraSample(camera.rgb(scene.data), depth.astype(np.float32), there, calibrated))
    solids = {
        name: replace(solid, half_height=solid.half_height + solid.std * rng.normal())
        for name, solid in CATALOGUE_SOLIDS.items()
    }
    return StereoSample((views[0], views[1]), solids)


def locate_by_each(sample: StereoSample, found: Sequence[Detections]) -> dict[str, Localization]:
    """Locate what was found in both images, in each of the three ways.

    Args:
        sample: The scene.
        found: The detections in each of its images.

    Returns:
        Where the objects are by `plane` and `depth`, from the first image, and by `two_views`.
    """
    first, second = sample.views
    cameras = (first.calibrated, second.calibrated)
    return {
        "plane": locate(found[0], first.calibrated, sample.solids, box_std=BOX_STD),
        "depth": locate(
            found[0], first.calibrated, sample.solids, depth=first.depth, box_std=BOX_STD, depth_std=DEPTH_STD
        ),
        "two_views": locate(found, cameras, sample.solids, box_std=BOX_STD),
    }


def match_truth(found: Detections, there: Truth) -> tuple[np.ndarray, np.ndarray]:
    """Which objects were found. An object is found by the box of its class that fits it best, if by half at least.

    Args:
        found: Detections in an image.
        there: What there is to find in it.

    Returns:
        Rows of the objects that count and were found, and of the boxes that found them, (n,) int each.
    """
    fit = np.where(there.class_id[:, None] == found.class_id, iou(there.xyxy[:, None], found.xyxy), 0.0)
    objects = np.flatnonzero(there.counts & (fit.max(1, initial=0) >= 0.5))
    return objects, fit[objects].argmax(1) if len(objects) else objects


def edge_errors(found: Detections, there: Truth) -> np.ndarray:
    """Errors of the edges of the boxes that found an object, (n, 4), pixels."""
    objects, boxes = match_truth(found, there)
    return found.xyxy[boxes] - there.xyxy[objects]


class Tally:
    """Collects what one way to locate says of the objects in many scenes."""

    def __init__(self) -> None:
        self._count = 0
        self._errors: list[float] = []
        self._squares: list[float] = []

    def add(self, located: Localization, there: Truth) -> None:
        """Add one scene."""
        objects, boxes = match_truth(located.detections, there)
        self._count += int(there.counts.sum())
        for i, j in zip(objects, boxes, strict=True):
            if not located.failure[j]:
                error = located.position[j] - there.position[i]
                self._errors.append(float(np.linalg.norm(error)))
                self._squares.append(float(error @ np.linalg.solve(located.covariance[j], error)))

    def accuracy(self) -> Accuracy:
        """Of all scenes."""
        errors, squares = np.array(self._errors or [np.nan]), np.array(self._squares or [np.nan])
        median, p95 = np.percentile(errors, [50, 95]) * 1e3
        covered = {name: 100 * float(np.mean(squares <= level)) for name, level in LEVELS.items()}
        return Accuracy(float(median), float(p95), len(self._errors) / max(self._count, 1), covered)
