"""`Solid`: what must be known of a thing on the table to tell from its box in a picture where it stands.

That is its height, and whether it is a block, a ball or a cone. Its width is not needed: the box tells it. A solid here
is the hull of two ellipsoids over one vertical axis, flat ones for the rims of a block, and its box in closed form: see
Cross and Zisserman (1998), "Quadric reconstruction from dual-space geometry". An ellipse stands in for any outline
that half a turn leaves as it is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.camera import Array, Camera
from arm5dof.vision.objects import CATALOGUE

FORMS = {
    "block": np.array([[-1, 1, 0], [1, 1, 0]]),
    "ball": np.array([[0, 1, 1], [0, 1, 1]]),
    "cone": np.array([[-1, 1, 0], [1, 1e-3, 0]]),
}
"""The two ellipsoids of which a solid of each form is the hull, (2, 3): how high above its middle, in half heights; how
wide, as a share of its width; half its thickness, in half heights."""


@dataclass(frozen=True)
class Solid:
    """A thing that stands on the table."""

    half_height: float
    """From the table to its middle, metres."""
    form: str = "block"
    """`block`: of one outline all the way up, such as a box or a standing cylinder. `ball`: rounded above and below,
    such as a ball or an egg. `cone`: pointed, such as a cone or a pyramid."""
    deviation: float = 5e-4
    """Standard deviation of the half height, metres."""

    def __post_init__(self) -> None:
        if self.form not in FORMS:
            raise UserError(f"no form {self.form!r}: choose from {', '.join(FORMS)}")
        if not (0 < self.half_height < math.inf and 0 <= self.deviation < math.inf):
            raise UserError(f"a half height of {self.half_height:g} +- {self.deviation:g} m: give metres above zero")


CATALOGUE_SOLIDS = {thing.name: Solid(thing.half_height, thing.form) for thing in CATALOGUE}
"""What is known of the things of the catalogue, by the names of their classes."""


def axes(camera: Camera) -> jax.Array:
    """The horizontal directions along which a camera sees things wide and deep, and upwards: (3, 3), one in a row."""
    x, y = camera.rotation[:2, 0] / jnp.linalg.norm(camera.rotation[:2, 0])
    return jnp.stack([x, y, 0 * x, -y, x, 0 * x, 0 * x, 0 * x, 0 * x + 1]).reshape(3, 3)


def box(camera: Camera, middle: Array, radii: Array, half_height: Array, form: Array) -> jax.Array:
    """The box around a solid in the picture: left, top, right, bottom (4,), pixels, pixel i covering [i, i + 1); NaN
    if it is not all in front of the camera.

    middle:      (3,) in the base frame, metres
    radii:       (2,) half its width along the camera's horizontal `axes`, metres
    half_height: metres
    form:        (2, 3) of `FORMS`
    """
    directions = axes(camera)
    centres = camera.to_camera(middle + half_height * form[:, :1] * directions[2])
    sizes = jnp.concatenate([radii * form[:, 1:2], half_height * form[:, 2:]], axis=1)
    semiaxes = sizes[:, :, None] * (directions @ camera.rotation)
    shapes = semiaxes.transpose(0, 2, 1) @ semiaxes
    (left, right), (top, bottom) = (jax.vmap(partial(_touching, axis), out_axes=1)(centres, shapes) for axis in (0, 1))
    touching = jnp.stack([left, top, right, bottom])
    pixels = camera.project(camera.position + touching @ jnp.asarray(camera.rotation).T) + 0.5
    left, top, right, bottom = pixels[[0, 1, 2, 3], :, [0, 1, 0, 1]]
    return jnp.stack([left.min(), top.min(), right.max(), bottom.max()])


def _touching(axis: int, centre: jax.Array, shape: jax.Array) -> jax.Array:
    """Where the picture of an ellipsoid, on the image plane at depth 1, touches the vertical lines (`axis` 0) or the
    horizontal lines (1) around it: (2, 3) in the camera's frame, the smaller coordinate first.

    centre: (3,) in the camera's frame
    shape:  (3, 3), sum of the outer products of the semi-axes with themselves
    """
    # The plane through the camera and the line x = t has the normal l = (1, 0, -t) and touches the ellipsoid where
    # (l . centre)^2 = l . shape l, at the point shape l - (l . centre) centre.
    c, z, s, sz, zz = centre[axis], centre[2], shape[axis, axis], shape[axis, 2], shape[2, 2]
    root = jnp.sqrt(z * z * s - 2 * c * z * sz + c * c * zz + sz * sz - s * zz)
    t = (c * z - sz + jnp.stack([-root, root])) / (z * z - zz)
    normals = np.eye(3)[axis] - t[:, None] * np.eye(3)[2]
    points = normals @ shape - (normals @ centre)[:, None] * centre
    return jnp.where((z > 0) & (z * z > zz), points / points[:, 2:], jnp.nan)
