"""Where objects are by their boxes in two or more images, and which boxes are of one object."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.camera import Array, Camera
from arm5dof.vision.detections import Detections
from arm5dof.vision.localization.box_fit import (
    SKEW_STD,
    box_center,
    camera_errors,
    fit_box,
    independent,
    propagate,
)
from arm5dof.vision.localization.common import (
    MAX_RMS,
    NOTHING_SEEN,
    Localization,
    ObjectBatch,
    Solids,
    Workspace,
    batched,
    check_inputs,
    detection_problems,
    size_problems,
)

MIN_SINE = np.sin(np.deg2rad(3))
"""Lines of sight must cross at 3 degrees: at less, a pixel is worth centimetres."""

STEPS = 5


def by_views(
    detections: Sequence[Detections],
    cameras: Sequence[Camera],
    solids: Solids,
    matches: np.ndarray | None = None,
    *,
    box_std: float = 1.0,
    workspace: Workspace | None = None,
) -> Localization:
    """Where objects of known height are, seen by two or more cameras. They need not stand on anything.

    Args:
        detections: What was detected in each camera's image.
        cameras: v cameras with extrinsics.
        solids: What is known of the classes, by name.
        matches: Which detections are of one object: rows (n, v) of the v cameras' detections. By default what
            `match_views` says of two cameras.
        box_std: Standard deviation of each edge of a box, pixels.
        workspace: Says which positions count.

    Returns:
        A position and its covariance, base frame, or why there is none, for each match in the order of the first
        camera's detections; without `matches`, for every detection of the first camera.

    Raises:
        UserError: A camera has no extrinsics, there are fewer than two, there are more and no `matches`, or `box_std`
            is not above zero.
    """
    if len(cameras) < 2 or len(cameras) != len(detections):
        raise UserError(f"{len(cameras)} cameras and {len(detections)} lists of detections: give two or more of each")
    for camera in cameras:
        check_inputs(camera, box_std)
    if matches is None:
        if len(cameras) > 2:
            raise UserError("which boxes are of one object must be said for three cameras and more: give their matches")
        matches = match_views((detections[0], detections[1]), (cameras[0], cameras[1]))
        found = by_views(detections, cameras, solids, matches, box_std=box_std, workspace=workspace)
        return _among(detections[0], matches[:, 0], found)
    matches = np.asarray(matches, int).reshape(-1, len(cameras))
    matches = matches[np.argsort(matches[:, 0])]  # As detections are ordered, which sort themselves.
    boxes = np.stack([seen.xyxy[row] for seen, row in zip(detections, matches.T, strict=True)], axis=1)
    names = np.stack([seen.data["class_name"][row] for seen, row in zip(detections, matches.T, strict=True)], axis=1)
    same_class, first = (names == names[:, :1]).all(1), detections[0][matches[:, 0]]
    objects = ObjectBatch.of(boxes, first.data["class_name"], solids)
    position, covariance, rms, sine, depth = batched(_by_views, objects, tuple(cameras), box_std)
    views = zip(detections, cameras, matches.T, strict=True)
    problems = [
        *((wrong[row], why) for seen, camera, row in views for wrong, why in detection_problems(seen, camera, solids)),
        (np.isnan(sine), NOTHING_SEEN),
        (sine < MIN_SINE, "the cameras see it from one side, and its distance is open"),
        (~(same_class & (depth > 0) & (rms < MAX_RMS * box_std)), "no one {name} explains its boxes"),
        *(
            problem
            for i, camera in enumerate(cameras)
            for problem in size_problems(boxes[:, i], names[:, i], camera, solids, position)
        ),
    ]
    return Localization.of(first, position, covariance, problems, workspace)


@jax.jit
def _by_views(objects: ObjectBatch, cameras: tuple[Camera, ...], box_std: float) -> tuple[jax.Array, ...]:
    """Positions (n, 3), covariances (n, 3, 3), reprojection errors (n,) in pixels, sines (n,) of the largest angle
    between two lines of sight, and depths (n,) in front of the camera that is nearest."""

    def one(seen: ObjectBatch) -> tuple[jax.Array, ...]:
        rays = [camera.rays(box_center(box)) for camera, box in zip(cameras, seen.boxes, strict=True)]
        sine = jnp.stack([jnp.linalg.norm(jnp.cross(a, b)) for a, b in combinations(rays, 2)]).max()
        start = _nearest(cameras, rays)

        def estimate(
            boxes: jax.Array, half_height: jax.Array, skew: jax.Array, *errors: jax.Array
        ) -> tuple[jax.Array, Any]:
            true = [camera.perturbed(error) for camera, error in zip(cameras, errors, strict=True)]
            fit = fit_box(true, boxes.reshape(-1, 4), half_height[0], seen.form, start, None, box_std, skew=skew)
            return fit.center, (fit.center, fit.reprojection_rms)

        inputs = [
            independent(seen.boxes.ravel(), box_std),
            independent(seen.half_height[None], seen.std),
            independent(jnp.zeros(len(cameras)), SKEW_STD),
            *map(camera_errors, cameras),
        ]
        covariance, (center, rms) = propagate(estimate, inputs)
        depth = jnp.stack([camera.to_camera(center)[2] for camera in cameras]).min()
        return center, covariance, rms, sine, depth

    return jax.vmap(one)(objects)


@jax.jit
def triangulate(cameras: Sequence[Camera], pixels: Array) -> tuple[jax.Array, jax.Array]:
    """Points seen by several cameras. The start is the point nearest to the lines of sight, a linear problem;
    Gauss-Newton steps on the pixels follow.

    Args:
        cameras: v cameras.
        pixels: Where each of them sees each point, (n, v, 2).

    Returns:
        The points, (n, 3), metres, base frame; and how far the pixels are from where the points are seen, root mean
        square, (n,), pixels: NaN for points not in front of all cameras.
    """

    def one(seen: jax.Array) -> tuple[jax.Array, jax.Array]:
        def residual(point: jax.Array) -> jax.Array:
            return jnp.concatenate([camera.project(point) for camera in cameras]) - seen.ravel()

        def step(_: int, point: jax.Array) -> jax.Array:
            jacobian = jax.jacfwd(residual)(point)
            return point - jnp.linalg.solve(jacobian.T @ jacobian, jacobian.T @ residual(point))

        start = _nearest(cameras, [camera.rays(pixel) for camera, pixel in zip(cameras, seen, strict=True)])
        point = jax.lax.fori_loop(0, STEPS, step, start)
        return point, jnp.sqrt(2 * jnp.mean(residual(point) ** 2))

    return jax.vmap(one)(jnp.asarray(pixels))


def match_views(
    detections: tuple[Detections, Detections], cameras: tuple[Camera, Camera], limit: float = 5.0
) -> np.ndarray:
    """Which detections in two images are of one object: pairs of a class of which each is the other's best, by how far
    the centers of their boxes are from where one point would be seen.

    Args:
        detections: In each camera's image.
        cameras: Two cameras with extrinsics.
        limit: The largest distance, root mean square, pixels.

    Returns:
        Rows of the two cameras' detections, (k, 2) int.
    """
    first, second = detections
    rows = np.array([(i, j) for i in range(len(first)) for j in range(len(second))], int).reshape(-1, 2)
    i, j = rows.T
    centers = np.stack([first.center[i], second.center[j]], axis=1)
    _, apart = batched(lambda given, cameras: triangulate(cameras, given), centers, cameras)
    same_class = first.data["class_name"][i] == second.data["class_name"][j]
    apart = np.where(same_class & (apart <= limit), apart, np.inf).reshape(len(first), len(second))
    nearest = (apart == apart.min(0, initial=np.inf)) & (apart == apart.min(1, initial=np.inf)[:, None])
    return np.argwhere(nearest & np.isfinite(apart))


def _among(detections: Detections, rows: np.ndarray, found: Localization) -> Localization:
    """What was located of some rows (k,) of detections, in ascending order, among them all."""
    names = detections.data["class_name"]
    position, covariance = np.full((len(names), 3), np.nan), np.full((len(names), 3, 3), np.nan)
    failure = [f"the other picture shows no {name} there" for name in names]
    position[rows], covariance[rows] = found.position, found.covariance
    for row, reason in zip(rows, found.failure, strict=True):
        failure[row] = reason
    return Localization(detections, position, covariance, tuple(failure))


def _nearest(cameras: Sequence[Camera], rays: Sequence[jax.Array]) -> jax.Array:
    """The point (3,) nearest to all lines of sight, which start at the cameras in these directions (3,)."""
    across = [jnp.eye(3) - jnp.outer(ray, ray) for ray in rays]
    right = [flat @ camera.position for flat, camera in zip(across, cameras, strict=True)]
    return jnp.linalg.solve(sum(across[1:], across[0]), sum(right[1:], right[0]))
