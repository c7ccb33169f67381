"""Where things are by a depth image: what it shows of each, against what it would show of a solid standing there.

A camera sees the near side of a thing and its top, so the mean of the points it sees is off from the middle, by a
centimetre where it looks down at 45 degrees. The mean of those points of a solid that the camera would see is off in
the same way, and the difference of the two is where the thing is. Only its top counts, well above the table;
what is higher than the thing, such as the arm, is left out of the one mean, and what it hides out of the other.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.camera import Array, Camera
from arm5dof.vision.detections import Detections
from arm5dof.vision.localization.box_fit import Things, explain, propagate
from arm5dof.vision.localization.locate import (
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
    on_plane,
    unusable,
)
from arm5dof.vision.localization.solids import FORMS, axes

GRID = 40
"""So many pixels across and down are looked up in each box."""

MARGIN = 4.0
"""Points so many standard deviations, and 2 mm, above a thing's top, or before it, are something else."""

BESIDE = 1.5
"""Points this far out, in half widths, are something else: the corner of a square is 1.4."""

LEAST = 0.3
"""The least share of a thing's top that must be seen."""

OUTLINE = 2.5e-4
"""Standard deviation, metres, of what whole pixels do, and outlines that are no ellipses."""

ROUNDS = 5

TOP, LEAST_TOP = 0.5, 0.004
"""What is looked at of a thing, from its top down: this share of its half height, and so many metres at least."""

BANDS, AROUND = 12, 24
"""Into how many pieces the sides of a solid are cut, and its flat top: one below the other, and around."""


def by_depth(
    detections: Detections,
    depth: np.ndarray,
    camera: Camera,
    solids: Solids,
    *,
    table: float = 0.0,
    pixels: float = 1.0,
    deviation: float = 2e-3,
    workspace: Workspace | None = None,
) -> Located:
    """Where things of known height are, from one picture and its depth image.

    depth:     (h, w), metres along the optical axis; zero or not finite where it is missing
    solids:    what is known of the classes, by name
    table:     about how high it is in the base frame, metres: lower points are not looked at
    pixels:    standard deviation of each edge of a box
    deviation: standard deviation of the error that a thing's depths share, metres; their noise averages out
    workspace: where a position counts

    Raises `UserError` if the camera has no pose or the depth image is not of its size.
    """
    check(camera, pixels)
    if np.shape(depth) != (camera.height, camera.width):
        size = "x".join(map(str, np.shape(depth)[::-1]))
        raise UserError(f"the depth image has {size} pixels and the camera {camera.width}x{camera.height}")
    position, covariance, share = batched(
        _by_depth, (detections.xyxy, known(detections, solids)), camera, np.asarray(depth), table, pixels, deviation
    )
    problems = [
        *unusable(detections, camera, solids),
        (~(share > LEAST), "the depth image shows too little of it"),
    ]
    return located(detections, position, covariance, problems, workspace)


def read_depth(path: Path) -> np.ndarray:
    """A depth image in metres, (h, w), zero where it is missing, from a file of 16 bits a pixel in millimetres, as most
    depth cameras write. Raises `UserError` if it is none."""
    content = np.frombuffer(path.read_bytes(), np.uint8)
    pixels = cv2.imdecode(content, cv2.IMREAD_UNCHANGED) if content.size else None
    if pixels is None or pixels.dtype != np.uint16 or pixels.ndim != 2:
        raise UserError(f"{path} is no depth image: give a PNG file with one channel of 16 bits, in millimetres")
    return pixels / 1000


@jax.jit
def _by_depth(
    given: tuple[jax.Array, Things], camera: Camera, depth: jax.Array, table: float, pixels: float, deviation: float
) -> tuple[jax.Array, ...]:
    """Positions (n, 3), covariances (n, 3, 3), and what share (n,) of each thing's top was seen."""
    depth = jnp.where(jnp.isfinite(depth) & (depth > 0), depth, jnp.nan)
    margin = MARGIN * deviation + 2e-3

    def one(box: jax.Array, thing: Things) -> tuple[jax.Array, ...]:
        start, _ = on_plane(camera, box, table + thing.half_height)
        lowest = jnp.clip(1 - jnp.maximum(TOP, LEAST_TOP / thing.half_height), 0, 1)
        surface = _surface(thing.form, lowest)
        grid, density = _grid(box)

        def compare(
            middle: jax.Array, camera: Camera, radii: jax.Array, offset: jax.Array
        ) -> tuple[jax.Array, jax.Array]:
            """The mean of what is seen near `middle` less that of what a solid there would show; and the share."""
            cloud = camera.back_project(grid, _look_up(depth, grid) + offset)
            directions = axes(camera)
            from_middle = cloud - middle
            beside, up = from_middle @ directions[:2].T / radii[:2], from_middle[:, 2]
            taken = (up > lowest * radii[2]) & (up < radii[2] + margin) & (jnp.sum(beside**2, 1) < BESIDE**2)

            away = (surface[:, :3] * radii) @ directions
            # A surface that is stretched has its normals squeezed.
            areas = (surface[:, 3:] / radii * jnp.prod(radii)) @ directions
            distance = camera.to_camera(middle + away)[:, 2]
            facing = jnp.sum(areas * (camera.position - middle - away), 1)
            pieces = density * camera.matrix[0, 0] * camera.matrix[1, 1] * jnp.maximum(facing, 0) / distance**3
            shown = _look_up(depth, camera.project(middle + away)) > distance - margin
            return _mean(cloud, taken) - _mean(away, jnp.where(shown, pieces, 0)), taken.sum() / pieces.sum()

        def estimate(
            box: jax.Array, error: jax.Array, half_height: jax.Array, offset: jax.Array
        ) -> tuple[jax.Array, Any]:
            seen = camera.perturbed(error)
            found = explain([seen], box[None], half_height[0], thing.form, start, table, pixels)
            given = seen, jnp.append(found.radii[0], half_height), offset
            frozen = jax.lax.stop_gradient(given)
            near = jax.lax.stop_gradient(found.middle)
            near = jax.lax.fori_loop(0, ROUNDS, lambda _, middle: compare(middle, *frozen)[0], near)
            middle, share = compare(near, *given)
            return middle, (middle, share)

        inputs = (edges(box, pixels), errors(camera), height(thing), (jnp.zeros(1), deviation**2 * jnp.eye(1)))
        covariance, (middle, share) = propagate(estimate, *zip(*inputs, strict=True))
        return middle, covariance + OUTLINE**2 * jnp.eye(3), share

    return jax.vmap(one)(*given)


def _grid(box: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Pixels (GRID**2, 2) in a box and a little around it, and how many of them there are to a pixel."""
    pad = 0.05 * (box[2:] - box[:2]) + 2
    (left, top), (right, bottom) = box[:2] - pad, box[2:] + pad
    u, v = jnp.meshgrid(jnp.linspace(left, right, GRID), jnp.linspace(top, bottom, GRID))
    density = (GRID - 1) ** 2 / ((right - left) * (bottom - top))
    return jnp.round(jnp.stack([u, v], -1).reshape(-1, 2) - 0.5), density


def _surface(form: Array, lowest: jax.Array) -> jax.Array:
    """The surface of a solid of radius and half height 1, from its top down to `lowest`, in pieces: their middles, and
    their outward normals as long as the pieces are large, (2 * BANDS * AROUND, 6)."""
    down = jnp.linspace(0, 1, BANDS + 1)
    z = 1 - down * (1 - lowest)
    sides = {"block": jnp.ones_like(z), "ball": jnp.sqrt(1 - z**2), "cone": (1 - z) / 2}
    r = jnp.stack([sides[name] for name in FORMS])[form]
    # From the middle of the top outwards, then down.
    r, z = jnp.concatenate([down[:-1] * r[0], r]), jnp.concatenate([jnp.ones(BANDS), z])
    angles = 2 * np.pi * (np.arange(AROUND) + 0.5) / AROUND
    x, y, flat = jnp.cos(angles), jnp.sin(angles), jnp.ones(AROUND)
    radius, area = (r[1:] + r[:-1]) / 2, (r[1:] + r[:-1]) * np.pi / AROUND
    outwards, upwards = area * (z[:-1] - z[1:]), area * (r[1:] - r[:-1])
    columns = [(radius, x), (radius, y), ((z[1:] + z[:-1]) / 2, flat), (outwards, x), (outwards, y), (upwards, flat)]
    return jnp.stack([jnp.outer(*column).ravel() for column in columns], axis=1)


def _look_up(depth: jax.Array, pixels: jax.Array) -> jax.Array:
    """Depths (n,) at the pixels nearest to (n, 2); NaN outside the picture."""
    column, row = jnp.round(jax.lax.stop_gradient(pixels)).astype(int).T
    inside = (column >= 0) & (column < depth.shape[1]) & (row >= 0) & (row < depth.shape[0])
    return jnp.where(inside, depth[row, column], jnp.nan)


def _mean(points: jax.Array, weight: jax.Array) -> jax.Array:
    """The weighted mean (3,) of points (n, 3), of which those with weight zero may be NaN."""
    weight = weight[:, None]
    return jnp.sum(jnp.where(weight > 0, points * weight, 0), 0) / jnp.sum(weight)
