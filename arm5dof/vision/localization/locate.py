"""From boxes in pictures to points in the arm's base frame, each with a covariance, or a reason why there is none."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.camera import Array, Camera
from arm5dof.vision.detections import Detections
from arm5dof.vision.localization.box_fit import Things, explain, propagate
from arm5dof.vision.localization.solids import Solid

Solids = Mapping[str, Solid | float]
"""What is known of things by the names of their classes; a number is the half height of a block, metres."""

Workspace = Callable[[np.ndarray], np.ndarray]
"""Which of some points (n, 3) of the base frame the arm may be asked for, (n,), bool."""

EDGE = 1.0
"""A box that comes so close to the picture's edge, pixels, is taken to be cut by it."""

GRAZING = np.sin(np.deg2rad(5))
"""Lines of sight must meet the table at 5 degrees: at less, a pixel is worth centimetres."""

MISFIT = 4.0
"""A box that is so many standard deviations from the best explanation, root mean square over its edges, is of something
else."""

NOTHING_THERE = "the lens model shows nothing there"

Problem = tuple[np.ndarray, str]
"""Which of n detections have it, (n,), bool, and what to say of them, in which `{name}` is the class."""


@dataclass(frozen=True, eq=False)
class Located:
    """Where the things detected are. Arrays have a row for each detection."""

    detections: Detections
    position: np.ndarray
    """Middles of the things in the base frame, (n, 3), metres; NaN where there is a reason."""
    covariance: np.ndarray
    """Of the positions, (n, 3, 3), square metres; NaN where there is a reason."""
    reasons: tuple[str, ...]
    """Why a thing has no position; empty for those that have one."""

    def rows(self) -> list[dict[str, Any]]:
        """For JSON: class, confidence, position and covariance (metres) or null, reason or null."""
        names, confidence = self.detections.data["class_name"], self.detections.confidence
        return [
            {
                "class_name": str(name),
                "confidence": round(float(sure), 4),
                "position": None if reason else position.tolist(),
                "covariance": None if reason else covariance.tolist(),
                "reason": reason or None,
            }
            for name, sure, position, covariance, reason in zip(
                names, confidence, self.position, self.covariance, self.reasons, strict=True
            )
        ]


def by_plane(
    detections: Detections,
    camera: Camera,
    solids: Solids,
    *,
    table: float = 0.0,
    pixels: float = 1.0,
    workspace: Workspace | None = None,
) -> Located:
    """Where things of known height stand on a table, from one picture.

    solids:    what is known of the classes, by name
    table:     its height in the base frame, metres
    pixels:    standard deviation of each edge of a box
    workspace: where a position counts

    Raises `UserError` if the camera has no pose, or `pixels` is not above zero.
    """
    check(camera, pixels)
    position, covariance, misfit, slope = batched(
        _by_plane, (detections.xyxy, known(detections, solids)), camera, table, pixels
    )
    problems = [
        *unusable(detections, camera, solids),
        (np.isnan(slope), NOTHING_THERE),
        (slope < GRAZING, "the line of sight does not meet the table"),
        (~(misfit < MISFIT * pixels), "nothing of the height of {name} on the table explains its box"),
    ]
    return located(detections, position, covariance, problems, workspace)


@jax.jit
def _by_plane(given: tuple[jax.Array, Things], camera: Camera, table: float, pixels: float) -> tuple[jax.Array, ...]:
    """Positions (n, 3), covariances (n, 3, 3), misfits (n,) in pixels, and sines (n,) of the angles at which the lines
    of sight meet the plane of the middles: negative if they lead away from it, NaN if there are none."""

    def one(box: jax.Array, thing: Things) -> tuple[jax.Array, ...]:
        start, slope = on_plane(camera, box, table + thing.half_height)

        def estimate(box: jax.Array, error: jax.Array, half_height: jax.Array) -> tuple[jax.Array, Any]:
            seen = [camera.perturbed(error)]
            found = explain(seen, box[None], half_height[0], thing.form, start, table, pixels)
            return found.middle, (found.middle, found.misfit)

        inputs, covariances = zip(edges(box, pixels), errors(camera), height(thing), strict=True)
        covariance, (middle, misfit) = propagate(estimate, inputs, covariances)
        return middle, covariance, misfit, slope

    return jax.vmap(one)(*given)


def sight(camera: Camera, box: jax.Array) -> jax.Array:
    """The direction (3,) in which the middle of a box (4,) is seen; NaN if the lens model shows nothing there."""
    return camera.rays((box[:2] + box[2:]) / 2 - 0.5)


def on_plane(camera: Camera, box: jax.Array, height: Array) -> tuple[jax.Array, jax.Array]:
    """Where the middle of a box (4,) is seen on a horizontal plane, (3,), and the sine of the angle at which the line
    of sight meets it: negative if it leads away."""
    ray, away = sight(camera, box), height - camera.position[2]
    return jnp.asarray(camera.position) + ray * away / ray[2], ray[2] * jnp.sign(away)


def edges(box: jax.Array, pixels: float) -> tuple[jax.Array, jax.Array]:
    """The edges of boxes, (k,), and their covariance, as `propagate` takes them."""
    return box, jnp.eye(len(box)) * pixels**2


def height(thing: Things) -> tuple[jax.Array, jax.Array]:
    """The half height (1,) of one thing and its covariance."""
    return jnp.asarray(thing.half_height)[None], jnp.asarray(thing.deviation)[None, None] ** 2


def errors(camera: Camera) -> tuple[jax.Array, jax.Array]:
    """The errors (m,) of a camera, zero as far as one knows, and their covariance; zero too if nobody has said."""
    size = 10 + camera.distortion.shape[0]
    return jnp.zeros(size), jnp.zeros((size, size)) if camera.covariance is None else jnp.asarray(camera.covariance)


def batched(function: Callable[..., tuple[jax.Array, ...]], given: Any, *others: Any) -> tuple[np.ndarray, ...]:
    """What `function(given, *others)` makes of arrays with n rows each. It is called with 8, 16, 32, ... rows, so that
    it need not be compiled for every n."""
    n = len(jax.tree.leaves(given)[0])
    rows = np.minimum(np.arange(max(8, 1 << max(n - 1, 0).bit_length())), n - 1)
    filled = jax.tree.map(lambda a: a[rows] if n else np.ones((len(rows), *a.shape[1:]), a.dtype), given)
    return tuple(np.asarray(result, float)[:n] for result in function(filled, *others))


def check(camera: Camera, pixels: float) -> None:
    """Raise `UserError` if nobody has said where the camera stands, or if boxes are said to be exact."""
    if not 0 < pixels < math.inf:
        raise UserError(f"the standard deviation of a box's edges is a number of pixels above zero, not {pixels:g}")
    if not camera.has_extrinsics:
        raise UserError("nobody has said where the camera stands: find its pose with arm5dof vision pose or hand-eye")


def known(detections: Detections, solids: Solids) -> Things:
    """What is known of each detection; where nothing is, anything."""
    given = (solids.get(name, 0.01) for name in detections.data["class_name"])
    return Things.of([solid if isinstance(solid, Solid) else Solid(solid) for solid in given])


def unusable(detections: Detections, camera: Camera, solids: Solids) -> list[Problem]:
    """What can be wrong with detections, whatever the method."""
    unknown = np.array([name not in solids for name in detections.data["class_name"]], bool)
    low, high = detections.xyxy[:, :2], detections.xyxy[:, 2:]
    cut = (low < EDGE).any(1) | (high > np.array([camera.width, camera.height]) - EDGE).any(1)
    return [
        (unknown, "no height is known of {name}"),
        ((high - low < 1).any(1), "its box is empty"),
        # How far it goes on beyond, nobody knows: no covariance would be honest.
        (cut, "the picture's edge cuts it off"),
    ]


def located(
    detections: Detections,
    position: np.ndarray,
    covariance: np.ndarray,
    problems: Sequence[Problem],
    workspace: Workspace | None,
) -> Located:
    """The positions of the detections that have no problem, and the first problem of the others."""
    reasons = np.full(len(detections), "", object)
    names = detections.data["class_name"]
    if workspace is not None:
        problems = [*problems, (~workspace(position), "outside the workspace")]
    for wrong, text in reversed(problems):
        for i in np.flatnonzero(wrong):
            reasons[i] = text.format(name=names[i])
    lost = reasons != ""
    return Located(
        detections,
        np.where(lost[:, None], np.nan, position),
        np.where(lost[:, None, None], np.nan, covariance),
        tuple(reasons),
    )
