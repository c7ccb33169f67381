"""How well things are placed in random scenes: by the detector's own boxes, and cameras known only as well as
calibration makes them known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from arm5dof.vision.boxes import iou
from arm5dof.vision.camera import Camera
from arm5dof.vision.detections import Detections
from arm5dof.vision.evaluation.simulated_calibration import rehearse
from arm5dof.vision.localization.depth import by_depth
from arm5dof.vision.localization.locate import Located, by_plane
from arm5dof.vision.localization.multi_view import by_views
from arm5dof.vision.localization.solids import CATALOGUE_SOLIDS, Solid
from arm5dof.vision.rendering.simulated import BackEnd, simulated_camera
from arm5dof.vision.synthetic.ground_truth import Truth, truth
from arm5dof.vision.synthetic.samples import HEIGHT, WIDTH
from arm5dof.vision.synthetic.scene_builder import CAMERA, SECOND
from arm5dof.vision.synthetic.scenes import random_scene

EDGES = 0.9
"""What is said of the edges of the detector's boxes, as a standard deviation, pixels. Most are nearer, as if it were
0.8; with those round half-hidden things it is 1.2."""
SHARED, NOISE = 2e-3, 2e-3
"""Standard deviations of what depth images are off by, as a whole and in each pixel, metres."""
LEVELS = {"68": 3.5267, "95": 7.8147}
"""Squares of how many standard deviations hold so many per cent of positions in space."""


@dataclass(frozen=True, eq=False)
class View:
    """What one camera sees of a scene."""

    picture: np.ndarray
    """RGB uint8 (h, w, 3)."""
    depth: np.ndarray
    """As a depth camera would measure it, (h, w), metres."""
    truth: Truth
    known: Camera
    """The camera as its calibration has it."""


@dataclass(frozen=True)
class Accuracy:
    """Of one method of placing things."""

    median_mm: float
    """Of distances in space from the true middles."""
    p95_mm: float
    placed: float
    """Which share of the things that count has a position."""
    covered: dict[str, float]
    """Per cent of true positions inside the ellipsoids that should hold 68 and 95 of 100."""


@dataclass(frozen=True, eq=False)
class StereoSample:
    """A scene seen by two cameras, and how high its things are taken to be: heights vary, as things do."""

    views: tuple[View, View]
    solids: dict[str, Solid]


def render_stereo_sample(number: int, seed: int, back_end: BackEnd) -> StereoSample:
    """The scene of that number in a series, in the style of evaluation."""
    scene = random_scene((seed, number), "evaluation")
    rng = np.random.default_rng((seed, number))
    views = []
    for name in (CAMERA, SECOND):
        camera = simulated_camera(scene.model, name, WIDTH, HEIGHT, back_end)
        true = Camera.from_mujoco(scene.model, name, WIDTH, HEIGHT, scene.data)
        depth = camera.depth(scene.data) + SHARED * rng.normal() + NOISE * rng.normal(size=(HEIGHT, WIDTH))
        there = truth(scene, camera.segmentation(scene.data), name)
        views.append(View(camera.rgb(scene.data), depth.astype(np.float32), there, rehearse(true, rng)))
    solids = {
        name: replace(solid, half_height=solid.half_height + solid.deviation * rng.normal())
        for name, solid in CATALOGUE_SOLIDS.items()
    }
    return StereoSample((views[0], views[1]), solids)


def place(seen: StereoSample, found: Sequence[Detections]) -> dict[str, Located]:
    """Where the things found in both pictures are, by each method."""
    first, second = seen.views
    given = found[0], first.known, seen.solids
    return {
        "plane": by_plane(*given, pixels=EDGES),
        "depth": by_depth(found[0], first.depth, *given[1:], pixels=EDGES, deviation=SHARED),
        "two_views": by_views(found, (first.known, second.known), seen.solids, pixels=EDGES),
    }


def pairs(found: Detections, there: Truth) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the things that count and were found, and of the boxes that found them, (n,) each. A thing is found by
    the box of its class that fits it best, if by half at least."""
    fit = np.where(there.class_id[:, None] == found.class_id, iou(there.xyxy[:, None], found.xyxy), 0.0)
    things = np.flatnonzero(there.counts & (fit.max(1, initial=0) >= 0.5))
    return things, fit[things].argmax(1) if len(things) else things


def edge_errors(found: Detections, there: Truth) -> np.ndarray:
    """How far the edges of boxes are off, (n, 4), pixels."""
    things, boxes = pairs(found, there)
    return found.xyxy[boxes] - there.xyxy[things]


class Tally:
    """Collects what one method says of the things in many scenes."""

    def __init__(self) -> None:
        self._things = 0
        self._off: list[float] = []
        self._squares: list[float] = []

    def add(self, located: Located, there: Truth) -> None:
        """Of one scene."""
        things, boxes = pairs(located.detections, there)
        self._things += int(there.counts.sum())
        for i, j in zip(things, boxes, strict=True):
            if not located.reasons[j]:
                off = located.position[j] - there.position[i]
                self._off.append(float(np.linalg.norm(off)))
                self._squares.append(float(off @ np.linalg.solve(located.covariance[j], off)))

    def accuracy(self) -> Accuracy:
        """Of all scenes."""
        off, squares = np.array(self._off or [np.nan]), np.array(self._squares or [np.nan])
        median, p95 = np.percentile(off, [50, 95]) * 1e3
        covered = {name: 100 * float(np.mean(squares <= level)) for name, level in LEVELS.items()}
        return Accuracy(float(median), float(p95), len(self._off) / max(self._things, 1), covered)
