"""Where things are by their boxes in two or more pictures, and which boxes are of one thing."""

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
from arm5dof.vision.localization.box_fit import Things, explain, propagate
from arm5dof.vision.localization.locate import (
    MISFIT,
    NOTHING_THERE,
    Located,
    Solids,
    Workspace,
    batched,
    check,
    edges,
    errors,
    height,
    known,
    located,
    sight,
    unusable,
)

ALIKE = np.sin(np.deg2rad(3))
"""Lines of sight must cross at 3 degrees: at less, a pixel is worth centimetres."""

STEPS = 5


def by_views(
    detections: Sequence[Detections],
    cameras: Sequence[Camera],
    solids: Solids,
    rows: np.ndarray | None = None,
    *,
    pixels: float = 1.0,
    workspace: Workspace | None = None,
) -> Located:
    """Where things of known height are, seen by two or more cameras. They need not stand on anything.

    detections: one for each camera
    rows:       the rows (n, v) of things in the detections of v cameras; by default what `match` says of two
    solids:     what is known of the classes, by name
    pixels:     standard deviation of each edge of a box
    workspace:  where a position counts

    The result's detections are those of the first camera: all of them, or those that `rows` names, in their order.
    Raises `UserError` if a camera has no pose, if there are fewer than two, or if there are more and no rows.
    """
    if len(cameras) < 2 or len(cameras) != len(detections):
        raise UserError(f"{len(cameras)} cameras and {len(detections)} lists of detections: give two or more of each")
    for camera in cameras:
        check(camera, pixels)
    if rows is None:
        if len(cameras) > 2:
            raise UserError("which boxes are of one thing must be said for three cameras and more: give their rows")
        rows = match((detections[0], detections[1]), (cameras[0], cameras[1]))
        return _among(
            detections[0], rows[:, 0], by_views(detections, cameras, solids, rows, pixels=pixels, workspace=workspace)
        )
    rows = np.asarray(rows, int).reshape(-1, len(cameras))
    rows = rows[np.argsort(rows[:, 0])]  # As detections are ordered, which sort themselves.
    boxes = np.stack([seen.xyxy[row] for seen, row in zip(detections, rows.T, strict=True)], axis=1)
    names = np.stack([seen.data["class_name"][row] for seen, row in zip(detections, rows.T, strict=True)], axis=1)
    alike, things = (names == names[:, :1]).all(1), detections[0][rows[:, 0]]
    position, covariance, misfit, spread, depth = batched(
        _by_views, (boxes, known(things, solids)), tuple(cameras), pixels
    )
    views = zip(detections, cameras, rows.T, strict=True)
    problems = [
        *((wrong[row], why) for seen, camera, row in views for wrong, why in unusable(seen, camera, solids)),
        (np.isnan(spread), NOTHING_THERE),
        (spread < ALIKE, "the cameras see it from one side, and its distance is open"),
        (~(alike & (depth > 0) & (misfit < MISFIT * pixels)), "no one {name} explains its boxes"),
    ]
    return located(things, position, covariance, problems, workspace)


@jax.jit
def _by_views(given: tuple[jax.Array, Things], cameras: tuple[Camera, ...], pixels: float) -> tuple[jax.Array, ...]:
    """Positions (n, 3), covariances (n, 3, 3), misfits (n,) in pixels, sines (n,) of the largest angle between two
    lines of sight, and depths (n,) in front of the camera that is nearest."""

    def one(boxes: jax.Array, thing: Things) -> tuple[jax.Array, ...]:
        rays = [sight(camera, box) for camera, box in zip(cameras, boxes, strict=True)]
        spread = jnp.stack([jnp.linalg.norm(jnp.cross(a, b)) for a, b in combinations(rays, 2)]).max()
        start = _nearest(cameras, rays)

        def estimate(boxes: jax.Array, half_height: jax.Array, *errors: jax.Array) -> tuple[jax.Array, Any]:
            seen = [camera.perturbed(error) for camera, error in zip(cameras, errors, strict=True)]
            found = explain(seen, boxes.reshape(-1, 4), half_height[0], thing.form, start, None, pixels)
            return found.middle, (found.middle, found.misfit)

        inputs = (edges(boxes.ravel(), pixels), height(thing), *map(errors, cameras))
        covariance, (middle, misfit) = propagate(estimate, *zip(*inputs, strict=True))
        depth = jnp.stack([camera.to_camera(middle)[2] for camera in cameras]).min()
        return middle, covariance, misfit, spread, depth

    return jax.vmap(one)(*given)


@jax.jit
def triangulate(cameras: Sequence[Camera], pixels: Array) -> tuple[jax.Array, jax.Array]:
    """Points (n, 3) of the base frame seen at pixels (n, v, 2) by v cameras, and how far (n,) the pixels are from where
    the points are seen, root mean square; NaN for points not in front of all cameras.

    The start is the point nearest to the lines of sight, a linear problem; Gauss-Newton steps on the pixels follow.
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


def match(detections: tuple[Detections, Detections], cameras: tuple[Camera, Camera], limit: float = 5.0) -> np.ndarray:
    """Which detections in two pictures are of one thing: their rows, (k, 2). Those are pairs of a class of which each
    is the other's best, by how far in pixels their middles are from where one point would be seen; at most `limit`."""
    first, second = detections
    rows = np.array([(i, j) for i in range(len(first)) for j in range(len(second))], int).reshape(-1, 2)
    i, j = rows.T
    middles = np.stack([first.centre[i], second.centre[j]], axis=1)
    _, apart = batched(lambda given, cameras: triangulate(cameras, given), middles, cameras)
    alike = first.data["class_name"][i] == second.data["class_name"][j]
    apart = np.where(alike & (apart <= limit), apart, np.inf).reshape(len(first), len(second))
    nearest = (apart == apart.min(0, initial=np.inf)) & (apart == apart.min(1, initial=np.inf)[:, None])
    return np.argwhere(nearest & np.isfinite(apart))


def _among(detections: Detections, rows: np.ndarray, found: Located) -> Located:
    """What was located of some rows (k,) of detections, in ascending order, among them all."""
    names = detections.data["class_name"]
    position, covariance = np.full((len(names), 3), np.nan), np.full((len(names), 3, 3), np.nan)
    reasons = [f"the other picture shows no {name} there" for name in names]
    position[rows], covariance[rows] = found.position, found.covariance
    for row, reason in zip(rows, found.reasons, strict=True):
        reasons[row] = reason
    return Located(detections, position, covariance, tuple(reasons))


def _nearest(cameras: Sequence[Camera], rays: Sequence[jax.Array]) -> jax.Array:
    """The point (3,) nearest to all lines of sight, which start at the cameras in these directions (3,)."""
    across = [jnp.eye(3) - jnp.outer(ray, ray) for ray in rays]
    right = [flat @ camera.position for flat, camera in zip(across, cameras, strict=True)]
    return jnp.linalg.solve(sum(across[1:], across[0]), sum(right[1:], right[0]))
