"""What the ways to locate objects share: what they take, what they return, and what can be wrong with a detection."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from flax import struct

from arm5dof.errors import UserError
from arm5dof.vision.camera import Array, Camera
from arm5dof.vision.detections import Detections
from arm5dof.vision.localization.solids import FORMS, Solid

Solids = Mapping[str, Solid | float]
"""What is known of objects by the names of their classes; a number is the half height of a block, metres."""

Workspace = Callable[[np.ndarray], np.ndarray]
"""Which of some points (n, 3) of the base frame the arm may be asked for, (n,), bool."""

Problem = tuple[np.ndarray, str]
"""Which of n detections have it, (n,), bool, and what to say of them, in which `{name}` is the class."""

EDGE_MARGIN = 1.0
"""A box that comes so close to the image's edge, pixels, is taken to be cut by it."""

MAX_RMS = 4.0
"""A box that is so many standard deviations from that of the best solid, root mean square over its edges, is of
something else."""

NOTHING_SEEN = "the lens model shows nothing there"


@dataclass(frozen=True, eq=False)
class Localization:
    """Where detected objects are. Arrays have a row for each detection."""

    detections: Detections
    """What was located."""
    position: np.ndarray
    """Centers of the objects in the base frame, (n, 3) float64, metres; NaN where localization failed."""
    covariance: np.ndarray
    """Of the positions, (n, 3, 3) float64, square metres; NaN where localization failed."""
    failure: tuple[str, ...]
    """Why an object has no position, (n,); empty strings for those that have one."""

    @classmethod
    def of(
        cls,
        detections: Detections,
        position: np.ndarray,
        covariance: np.ndarray,
        problems: Sequence[Problem],
        workspace: Workspace | None,
    ) -> Localization:
        """The estimates (n, 3) and (n, 3, 3) for the detections that have no problem and lie in the workspace; and the
        first problem of the others."""
        failure = np.full(len(detections), "", object)
        names = detections.data["class_name"]
        if workspace is not None:
            problems = [*problems, (~workspace(position), "outside the workspace")]
        for wrong, text in reversed(problems):
            for i in np.flatnonzero(wrong):
                failure[i] = text.format(name=names[i])
        failed = failure != ""
        return cls(
            detections,
            np.where(failed[:, None], np.nan, position),
            np.where(failed[:, None, None], np.nan, covariance),
            tuple(failure),
        )

    def rows(self) -> list[dict[str, Any]]:
        """What JSON says of each object.

        Returns:
            For each detection `class_name`, `confidence`, `position` (3,) in metres and `covariance` (3, 3) in square
            metres, base frame, or None for both, and `reason`: why, or None.
        """
        names, confidence = self.detections.data["class_name"], self.detections.confidence
        return [
            {
                "class_name": str(name),
                "confidence": round(float(sure), 4),
                "position": None if failure else position.tolist(),
                "covariance": None if failure else covariance.tolist(),
                "reason": failure or None,
            }
            for name, sure, position, covariance, failure in zip(
                names, confidence, self.position, self.covariance, self.failure, strict=True
            )
        ]


class ObjectBatch(struct.PyTreeNode):
    """Detected objects as arrays: their boxes and what is known of their solids."""

    boxes: Array
    """Left, top, right and bottom edges, pixels, (n, 4); in several views, (n, v, 4)."""
    half_height: Array
    """(n,), metres."""
    std: Array
    """Standard deviations of the half heights, (n,), metres."""
    form: Array
    """Indices into `FORMS`, (n,), int."""
    known: Array | None = None
    """Which edges of the boxes are where the objects end, (n, 4) bool; None for all."""

    @classmethod
    def of(cls, boxes: np.ndarray, names: np.ndarray, solids: Solids) -> ObjectBatch:
        """Boxes (n, 4) or (n, v, 4) of objects of the classes `names` (n,); where nothing is known of one, anything."""
        given = (solids.get(name, 0.01) for name in names)
        known = [solid if isinstance(solid, Solid) else Solid(solid) for solid in given]
        return cls(
            boxes,
            np.array([solid.half_height for solid in known]),
            np.array([solid.std for solid in known]),
            np.array([list(FORMS).index(solid.form) for solid in known], int),
        )


def batched(function: Callable[..., tuple[jax.Array, ...]], batch: Any, *others: Any) -> tuple[np.ndarray, ...]:
    """Apply a jitted function to any number of rows.

    It is called with 8, 16, 32, ... rows, so that it need not be compiled for every number.

    Args:
        function: Takes a pytree of arrays with a row for each of n items, then `others`; returns arrays (n, ...).
        batch: The pytree.
        others: What else the function takes.

    Returns:
        What the function returns, (n, ...) float64 each.
    """
    n = len(jax.tree.leaves(batch)[0])
    rows = np.minimum(np.arange(max(8, 1 << max(n - 1, 0).bit_length())), n - 1)
    filled = jax.tree.map(lambda a: a[rows] if n else np.ones((len(rows), *a.shape[1:]), a.dtype), batch)
    return tuple(np.asarray(result, float)[:n] for result in function(filled, *others))


def check_inputs(camera: Camera, box_std: float) -> None:
    """Raise `UserError` if the camera has no extrinsics, or if boxes are said to be exact."""
    if not 0 < box_std < math.inf:
        raise UserError(f"the standard deviation of a box's edges is a number of pixels above zero, not {box_std:g}")
    if not camera.has_extrinsics:
        raise UserError(
            "the camera has no extrinsics: calibrate its pose first, by a board at a known place or by moving the hand"
        )


def cut_edges(boxes: np.ndarray, camera: Camera) -> np.ndarray:
    """Which edges of boxes (n, 4) are those of the camera's image, (n, 4) bool."""
    high = boxes[:, 2:] > np.array([camera.width, camera.height]) - EDGE_MARGIN
    return np.concatenate([boxes[:, :2] < EDGE_MARGIN, high], axis=1)


def detection_problems(detections: Detections, camera: Camera, solids: Solids, cuts_allowed: int = 0) -> list[Problem]:
    """What can be wrong with detections, whatever the method."""
    unknown = np.array([name not in solids for name in detections.data["class_name"]], bool)
    low, high = detections.xyxy[:, :2], detections.xyxy[:, 2:]
    cut = cut_edges(detections.xyxy, camera).sum(1) > cuts_allowed
    return [
        (unknown, "no height is known of {name}"),
        ((high - low < 1).any(1), "its box is empty"),
        # How far it goes on beyond, nobody knows: no covariance would be honest.
        (cut, "the picture's edge cuts it off"),
    ]


def size_problems(
    boxes: np.ndarray, names: np.ndarray, camera: Camera, solids: Solids, position: np.ndarray
) -> list[Problem]:
    """Boxes (n, 4) in a camera's image that are larger or smaller than those of solids can be where they are, (n, 3),
    metres, base frame."""
    known = [solids.get(name) for name in names]
    low, high = np.array([each.sizes if isinstance(each, Solid) else (0, np.inf) for each in known]).reshape(-1, 2).T
    depth = (position - camera.position) @ np.asarray(camera.rotation)[:, 2]
    size = (boxes[:, 2:] - boxes[:, :2]).max(1) * depth / camera.matrix[0, 0]
    return [
        (size > high, "its box is larger than that of any {name}"),
        (size < low, "its box is smaller than that of any {name}"),
    ]


def within_distance(nearest: float, farthest: float) -> Workspace:
    """A workspace between two spheres round the origin of the base frame, which is the arm's.

    Args:
        nearest: Radius of the inner sphere, metres.
        farthest: Radius of the outer one, metres.

    Raises:
        UserError: Nothing lies between them.
    """
    if not 0 <= nearest < farthest:
        raise UserError(
            f"a workspace needs its smallest distance and its largest, metres: not {nearest:g} {farthest:g}"
        )

    def within(points: np.ndarray) -> np.ndarray:
        distance = (points**2).sum(1) ** 0.5
        return (distance >= nearest) & (distance <= farthest)

    return within
