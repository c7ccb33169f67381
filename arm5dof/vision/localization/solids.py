"""`Solid`: what must be known of an object on the table to tell from its box in an image where it stands.

That is its height, and whether it is a block, a ball or a cone. Its width is not needed: the box tells it. A solid here
is the hull of two ellipsoids over one vertical axis, flat ones for the rims of a block, whose outlines are known: see
Cross and Zisserman (1998), "Quadric reconstruction from dual-space geometry". An ellipse stands in for any outline
that half a turn leaves as it is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.camera import Array, Camera
from arm5dof.vision.lens import split
from arm5dof.vision.objects import CATALOGUE

ACROSS, SIGNS = np.array([True, False, True, False]), np.array([-1, -1, 1, 1], np.float32)
"""Of the edges of a box: whether x or y tells them, and whether they are the smallest or the largest there."""

FORMS = {
    "block": np.array([[-1, 1, 0], [1, 1, 0]]),
    "ball": np.array([[0, 1, 1], [0, 1, 1]]),
    "cone": np.array([[-1, 1, 0], [1, 1e-3, 0]]),
}
"""The two ellipsoids of which a solid of each form is the hull, (2, 3): how high above its center, in half heights; how
wide, as a share of its width; half its thickness, in half heights."""


@dataclass(frozen=True)
class Solid:
    """An object that stands on the table. Raises `UserError` for a form or a height that cannot be."""

    half_height: float
    """From the table to its center, metres."""
    form: str = "block"
    """`block`: of one outline all the way up, such as a box or a standing cylinder. `ball`: rounded above and below,
    such as a ball or an egg. `cone`: pointed, such as a cone or a pyramid."""
    std: float = 5e-4
    """Standard deviation of the half height, metres."""
    sizes: tuple[float, float] = (0.0, math.inf)
    """The least and the most that the longer side of a box around it can measure, where it stands, metres."""

    def __post_init__(self) -> None:
        if self.form not in FORMS:
            raise UserError(f"no form {self.form!r}: choose from {', '.join(FORMS)}")
        if not (0 < self.half_height < math.inf and 0 <= self.std < math.inf):
            raise UserError(f"a half height of {self.half_height:g} +- {self.std:g} m: give metres above zero")


CATALOGUE_SIZES = (0.4 * 0.02, 1.4 * max(2 * math.hypot(each.radius, each.half_height) for each in CATALOGUE))
"""Of boxes around objects of the catalogue: from two fifths of what is as wide as the least of them, the rest being
hidden, to all of the largest, for which a box near the image's edge is too large."""

CATALOGUE_SOLIDS = {each.name: Solid(each.half_height, each.form, sizes=CATALOGUE_SIZES) for each in CATALOGUE}
"""What is known of the objects of the catalogue, by the names of their classes."""


def axes(camera: Camera) -> jax.Array:
    """The horizontal directions along which a camera sees objects wide and deep, and upwards: (3, 3), one in a row,
    base frame."""
    x, y = camera.rotation[:2, 0] / jnp.linalg.norm(camera.rotation[:2, 0])
    return jnp.stack([x, y, 0 * x, -y, x, 0 * x, 0 * x, 0 * x, 0 * x + 1]).reshape(3, 3)


def solid_box(
    camera: Camera, center: Array, radii: Array, half_height: Array, form: Array, skew: Array | float = 0.0
) -> jax.Array:
    """The box around a solid in the image.

    Args:
        camera: What sees it.
        center: Of the solid, (3,), metres, base frame.
        radii: Half its width along the camera's horizontal `axes`, (2,), metres.
        half_height: (), metres.
        form: One of `FORMS`, (2, 3).
        skew: How far behind its center it is widest on the right, and before it on the left, as a share of half its
            depth, (), in (-1, 1): zero only for what stands along or across those axes.

    Returns:
        Left, top, right and bottom edges, (4,), pixels, pixel i covering [i, i + 1); NaN if the solid is not all in
        front of the camera.
    """
    directions = axes(camera)
    centers = camera.to_camera(center + half_height * form[:, :1] * directions[2])
    sizes = jnp.concatenate([radii * form[:, 1:2], half_height * form[:, 2:]], axis=1)
    wide, deep, high = jnp.moveaxis(sizes[:, :, None] * (directions @ camera.rotation), 1, 0)
    semiaxes = jnp.stack([wide + skew * deep, jnp.sqrt(1 - jnp.square(skew)) * deep, high], axis=1)
    shapes = semiaxes.transpose(0, 2, 1) @ semiaxes

    def edges(ascent: jax.Array) -> jax.Array:
        """Where both ellipsoids reach farthest, (4, 2, 3) in the base frame, if the edges' coordinates grow along
        `ascent`, (4, 2, 2)."""
        both = jax.vmap(_touching, (None, 0, 0, 0))
        points = jax.vmap(both, (0, 0, None, None))(SIGNS, ascent, centers, shapes)
        return jnp.asarray(camera.position) + points @ jnp.asarray(camera.rotation).T

    # As a pinhole would show it first. Where a coordinate is extreme, just where matters to the second order only.
    upright = edges(jnp.broadcast_to(np.stack([ACROSS, ~ACROSS], -1)[:, None].astype(np.float32), (4, 2, 2)))
    by_point = camera.magnification(jax.lax.stop_gradient(upright))
    ascent = jnp.where(ACROSS[:, None, None], by_point[..., 0, :], by_point[..., 1, :])
    points = edges(jax.lax.stop_gradient(ascent))
    x, y = split(camera.project(points) + 0.5)
    pixels = jnp.where(ACROSS[:, None], x, y)
    return jnp.where(SIGNS < 0, pixels.min(1), pixels.max(1))


def _touching(sign: Array, ascent: jax.Array, center: jax.Array, shape: jax.Array) -> jax.Array:
    """Where the image of an ellipsoid, on the image plane at depth 1, reaches farthest against (`sign` -1) or along (1)
    a direction `ascent` (2,): (3,) in the camera's frame. `center` (3,) is in the camera's frame, `shape` (3, 3) the
    sum of the outer products of the semi-axes with themselves."""
    # The plane through the camera and the line ascent . (x, y) = t has the normal l = (ascent, -t) and touches the
    # ellipsoid where (l . center)^2 = l . shape l, at the point shape l - (l . center) center.
    along = jnp.append(ascent, 0.0)
    c, z, s, sz, zz = along @ center, center[2], along @ shape @ along, along @ shape[2], shape[2, 2]
    root = jnp.sqrt(z * z * s - 2 * c * z * sz + c * c * zz + sz * sz - s * zz)
    normal = along.at[2].set(-(c * z - sz + sign * root) / (z * z - zz))
    point = normal @ shape - (normal @ center) * center
    return jnp.where((z > 0) & (z * z > zz), point / point[2], jnp.nan)
