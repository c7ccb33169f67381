"""Where objects are by a depth image: what it shows of each, against what it would show of a solid standing there.

A camera sees the near side of an object and its top, so the mean of the points it sees is off from the center, by a
centimetre where it looks down at 45 degrees. The mean of those points of a solid that the camera would see is off in
the same way, and the difference of the two is where the object is. Only its top counts, well above the table;
what is higher than the object, such as the arm, is left out of the one mean, and what it hides out of the other.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.camera import Array, Camera
from arm5dof.vision.detections import Detections
from arm5dof.vision.localization.box_fit import camera_errors, fit_box, independent, propagate
from arm5dof.vision.localization.common import (
    Localization,
    ObjectBatch,
    Solids,
    Workspace,
    batched,
    check_inputs,
    detection_problems,
    size_problems,
)
from arm5dof.vision.localization.solids import FORMS, axes
from arm5dof.vision.localization.table_plane import on_plane

GRID = 40
"""So many pixels across and down are looked up in each box."""

MARGIN = 4.0
"""Points so many standard deviations, and 2 mm, above an object's top, or before it, are something else."""

MAX_RADIUS = 1.5
"""Points this far out, in half widths, are something else: the corner of a square is 1.4."""

MIN_SHARE = 0.3
"""The least share of an object's top that must be seen."""

OUTLINE_STD = 2.5e-4
"""Standard deviation, metres, of what whole pixels do, and outlines that are no ellipses."""

ROUNDS = 5

TOP, MIN_TOP = 0.5, 0.004
"""What is looked at of an object, from its top down: this share of its half height, and so many metres at least."""

BANDS, SECTORS = 12, 24
"""Into how many pieces the sides of a solid are cut, and its flat top: one below the other, and around."""


def by_depth(
    detections: Detections,
    depth: np.ndarray,
    camera: Camera,
    solids: Solids,
    *,
    table_height: float = 0.0,
    box_std: float = 1.0,
    depth_std: float = 2e-3,
    workspace: Workspace | None = None,
) -> Localization:
    """Where objects of known height are, from one image and its depth image.

    Args:
        detections: What was detected in the image.
        depth: (h, w), metres along the optical axis; zero or not finite where it is missing.
        camera: What took both, with extrinsics.
        solids: What is known of the classes, by name.
        table_height: About how high the table is in the base frame, metres: lower points are not looked at.
        box_std: Standard deviation of each edge of a box, pixels.
        depth_std: Standard deviation of the error that an object's depths share, metres; their noise averages out.
        workspace: Says which positions count.

    Returns:
        A position and its covariance for each detection, base frame, or why there is none.

    Raises:
        UserError: The camera has no extrinsics, the depth image is not of its size, or `box_std` is not above zero.
    """
    check_inputs(camera, box_std)
    if np.shape(depth) != (camera.height, camera.width):
        size = "x".join(map(str, np.shape(depth)[::-1]))
        raise UserError(f"the depth image has {size} pixels and the camera {camera.width}x{camera.height}")
    objects = ObjectBatch.of(detections.xyxy, detections.data["class_name"], solids)
    position, covariance, share = batched(
        _by_depth, objects, camera, np.asarray(depth), table_height, box_std, depth_std
    )
    problems = [
        *detection_problems(detections, camera, solids),
        (~(share > MIN_SHARE), "the depth image shows too little of it"),
        *size_problems(detections.xyxy, detections.data["class_name"], camera, solids, position),
    ]
    return Localization.of(detections, position, covariance, problems, workspace)


@jax.jit
def _by_depth(
    objects: ObjectBatch, camera: Camera, depth: jax.Array, table_height: float, box_std: float, depth_std: float
) -> tuple[jax.Array, ...]:
    """Positions (n, 3), covariances (n, 3, 3), and what share (n,) of each object's top was seen."""
    depth = jnp.where(jnp.isfinite(depth) & (depth > 0), depth, jnp.nan)
    margin = MARGIN * depth_std + 2e-3

    def one(seen: ObjectBatch) -> tuple[jax.Array, ...]:
        start, _ = on_plane(camera, seen.boxes, table_height + seen.half_height)
        lowest = jnp.clip(1 - jnp.maximum(TOP, MIN_TOP / seen.half_height), 0, 1)
        surface = _surface(seen.form, lowest)
        grid, density = _grid(seen.boxes)

        def compare(
            center: jax.Array, camera: Camera, radii: jax.Array, offset: jax.Array
        ) -> tuple[jax.Array, jax.Array]:
            """The mean of what is seen near `center` less that of what a solid there would show; and the share."""
            cloud = camera.back_project(grid, _look_up(depth, grid) + offset)
            directions = axes(camera)
            from_center = cloud - center
            beside, up = from_center @ directions[:2].T / radii[:2], from_center[:, 2]
            taken = (up > lowest * radii[2]) & (up < radii[2] + margin) & (jnp.sum(beside**2, 1) < MAX_RADIUS**2)

            away = (surface[:, :3] * radii) @ directions
            # A surface that is stretched has its normals squeezed.
            areas = (surface[:, 3:] / radii * jnp.prod(radii)) @ directions
            distance = camera.to_camera(center + away)[:, 2]
            facing = jnp.sum(areas * (camera.position - center - away), 1)
            pixels = jnp.linalg.det(camera.magnification(center + away))
            pieces = density * pixels * jnp.maximum(facing, 0) / distance**3
            shown = _look_up(depth, camera.project(center + away)) > distance - margin
            return _mean(cloud, taken) - _mean(away, jnp.where(shown, pieces, 0)), taken.sum() / pieces.sum()

        def estimate(
            box: jax.Array, error: jax.Array, half_height: jax.Array, offset: jax.Array
        ) -> tuple[jax.Array, Any]:
            true = camera.perturbed(error)
            fit = fit_box([true], box[None], half_height[0], seen.form, start, table_height, box_std)
            given = true, jnp.append(fit.radii[0], half_height), offset
            frozen = jax.lax.stop_gradient(given)
            near = jax.lax.stop_gradient(fit.center)
            near = jax.lax.fori_loop(0, ROUNDS, lambda _, center: compare(center, *frozen)[0], near)
            center, share = compare(near, *given)
            return center, (center, share)

        inputs = [
            independent(seen.boxes, box_std),
            camera_errors(camera),
            independent(seen.half_height[None], seen.std),
            independent(jnp.zeros(1), depth_std),
        ]
        covariance, (center, share) = propagate(estimate, inputs)
        return center, covariance + OUTLINE_STD**2 * jnp.eye(3), share

    return jax.vmap(one)(objects)


def _grid(box: Array) -> tuple[jax.Array, jax.Array]:
    """Pixels (GRID**2, 2) in a box and a little around it, and how many of them there are to a pixel."""
    pad = 0.05 * (box[2:] - box[:2]) + 2
    (left, top), (right, bottom) = box[:2] - pad, box[2:] + pad
    u, v = jnp.meshgrid(jnp.linspace(left, right, GRID), jnp.linspace(top, bottom, GRID))
    density = (GRID - 1) ** 2 / ((right - left) * (bottom - top))
    return jnp.round(jnp.stack([u, v], -1).reshape(-1, 2) - 0.5), density


def _surface(form: Array, lowest: jax.Array) -> jax.Array:
    """The surface of a solid of radius and half height 1, from its top down to `lowest`, in pieces: their centers, and
    their outward normals as long as the pieces are large, (2 * BANDS * SECTORS, 6)."""
    down = jnp.linspace(0, 1, BANDS + 1)
    z = 1 - down * (1 - lowest)
    sides = {"block": jnp.ones_like(z), "ball": jnp.sqrt(1 - z**2), "cone": (1 - z) / 2}
    r = jnp.stack([sides[name] for name in FORMS])[form]
    # From the center of the top outwards, then down.
    r, z = jnp.concatenate([down[:-1] * r[0], r]), jnp.concatenate([jnp.ones(BANDS), z])
    angles = 2 * np.pi * (np.arange(SECTORS) + 0.5) / SECTORS
    x, y, flat = jnp.cos(angles), jnp.sin(angles), jnp.ones(SECTORS)
    radius, area = (r[1:] + r[:-1]) / 2, (r[1:] + r[:-1]) * np.pi / SECTORS
    outwards, upwards = area * (z[:-1] - z[1:]), area * (r[1:] - r[:-1])
    columns = [(radius, x), (radius, y), ((z[1:] + z[:-1]) / 2, flat), (outwards, x), (outwards, y), (upwards, flat)]
    return jnp.stack([jnp.outer(*column).ravel() for column in columns], axis=1)


def _look_up(depth: jax.Array, pixels: jax.Array) -> jax.Array:
    """Depths (n,) at the pixels nearest to (n, 2); NaN outside the image."""
    column, row = jnp.round(jax.lax.stop_gradient(pixels)).astype(int).T
    inside = (column >= 0) & (column < depth.shape[1]) & (row >= 0) & (row < depth.shape[0])
    return jnp.where(inside, depth[row, column], jnp.nan)


def _mean(points: jax.Array, weight: jax.Array) -> jax.Array:
    """The weighted mean (3,) of points (n, 3), of which those with weight zero may be NaN."""
    weight = weight[:, None]
    return jnp.sum(jnp.where(weight > 0, points * weight, 0), 0) / jnp.sum(weight)
