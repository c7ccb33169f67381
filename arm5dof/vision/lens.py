"""Lens models: how a lens moves what an ideal pinhole would show, on the image plane at depth 1.

In JAX for `Camera`; by OpenCV's functions, in float64, for calibration. Both models are OpenCV's: its usual one, and
that of its `fisheye` functions, ROS's `equidistant`, which is Kannala and Brandt (2006), "A generic camera model and
calibration method for conventional, wide-angle, and fish-eye lenses", IEEE Trans. PAMI 28(8).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np

Array = jax.Array | np.ndarray

Parameters = tuple[np.ndarray, np.ndarray]
"""Of a lens, as `Camera.opencv`: matrix (3, 3) and coefficients (k,), float64."""

NEWTON_STEPS = 10
"""Enough for float64 wherever the lens model can be inverted: Newton converges from one side, then quadratically."""

HALVINGS = 53
"""Of the interval in which an angle is looked for: enough for float64."""

WIDEST = 1.57
"""The largest angle from the optical axis, radians: a little less than a quarter turn, where depth ends."""

ANGLES = np.linspace(0, WIDEST, 257)

EXACT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
"""OpenCV's criterion for when to stop."""


class Projection(NamedTuple):
    """Where n points are seen, and what that depends on."""

    pixels: np.ndarray
    """(n, 2)."""
    by_lens: np.ndarray
    """Derivative of the pixels, x and y by turns, by fx, fy, cx, cy and the coefficients, (2n, 4 + k)."""
    by_pose: np.ndarray
    """The same by the rotation vector (radians) and the shift (metres) of the points, (2n, 6)."""


class Lens(ABC):
    """A lens model. `plane` and `distorted` are points (..., 2) of the image plane at depth 1."""

    name: ClassVar[str]
    """As in `Camera.lens`."""
    names: ClassVar[tuple[str, ...]]
    """Of the coefficients, in OpenCV's order."""
    counts: ClassVar[tuple[int, ...]]
    """How many of them there may be, the usual number first."""
    wanted: ClassVar[str]
    """The same in words."""

    @abstractmethod
    def distort(self, coefficients: Array, plane: jax.Array) -> jax.Array:
        """Where the lens shows what a pinhole would show at `plane`. NaN where it would fold back, if it can tell."""

    @abstractmethod
    def approach(self, coefficients: Array, distorted: jax.Array) -> jax.Array:
        """The point that `distort` takes to `distorted`, or anything where there is none."""

    def project(self, points: np.ndarray, turn: np.ndarray, shift: np.ndarray, lens: Parameters) -> Projection:
        """Points (n, 3), metres, after a rotation vector (3,) and a shift (3,) into the camera's frame."""
        pixels, by_lens, by_pose = self._project(np.asarray(points, float), turn, shift, lens)
        (_, skew, _), (_, fy, cy), _ = lens[0]  # OpenCV takes no notice of the skew.
        pixels[:, 0] += skew / fy * (pixels[:, 1] - cy)
        by_lens[::2, 4:] += skew / fy * by_lens[1::2, 4:]
        by_pose[::2] += skew / fy * by_pose[1::2]
        return Projection(pixels, by_lens, by_pose)

    def normalize(self, pixels: np.ndarray, lens: Parameters) -> np.ndarray:
        """Where a pinhole would show, on the image plane at depth 1, what is seen at pixels (n, 2); (n, 2) float64."""
        (_, skew, _), (_, fy, cy), _ = lens[0]
        pixels = np.array(pixels, float)
        pixels[:, 0] -= skew / fy * (pixels[:, 1] - cy)
        return self._normalize(pixels, lens)

    @abstractmethod
    def straighten(self, image: np.ndarray, lens: Parameters) -> np.ndarray:
        """An image (h, w, ...) without its distortion, as a pinhole of the same matrix would have taken it."""

    @abstractmethod
    def _project(self, points: np.ndarray, turn: np.ndarray, shift: np.ndarray, lens: Parameters) -> Projection:
        """The same without skew."""

    @abstractmethod
    def _normalize(self, pixels: np.ndarray, lens: Parameters) -> np.ndarray:
        """The same without skew."""


class Pinhole(Lens):
    """OpenCV's usual model: radial terms, rational ones if there are 8 coefficients, and tangential ones."""

    name = "pinhole"
    names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    counts = (5, 4, 8)
    wanted = (
        "4, 5 or 8 in OpenCV's order, k1 k2 p1 p2 [k3 [k4 k5 k6]]; calibrate without its thin prism and tilted models"
    )

    def distort(self, coefficients: Array, plane: jax.Array) -> jax.Array:
        given = [coefficients[i] for i in range(coefficients.shape[0])]
        k1, k2, p1, p2, k3, k4, k5, k6 = given + [0.0] * (8 - len(given))
        x, y = split(plane)
        r2 = x * x + y * y
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        return jnp.stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ],
            -1,
        )

    def approach(self, coefficients: Array, distorted: jax.Array) -> jax.Array:
        return jax.lax.fori_loop(
            0, NEWTON_STEPS, lambda _, p: _newton(self, coefficients, p, distorted), jax.lax.stop_gradient(distorted)
        )

    def _project(self, points: np.ndarray, turn: np.ndarray, shift: np.ndarray, lens: Parameters) -> Projection:
        pixels, jacobian = cv2.projectPoints(points, turn, shift, *lens)
        return Projection(pixels[:, 0], jacobian[:, 6 : 10 + len(lens[1])], jacobian[:, :6])

    def _normalize(self, pixels: np.ndarray, lens: Parameters) -> np.ndarray:
        return cv2.undistortPoints(pixels[:, None], *lens, criteria=EXACT)[:, 0]

    def straighten(self, image: np.ndarray, lens: Parameters) -> np.ndarray:
        return cv2.undistort(image, *lens)


class Fisheye(Lens):
    """OpenCV's fisheye model: the angle from the optical axis, times a polynomial, is the distance from the center."""

    name = "fisheye"
    names = ("k1", "k2", "k3", "k4")
    counts = (4,)
    wanted = "4, those of OpenCV's fisheye model: k1 k2 k3 k4"

    def distort(self, coefficients: Array, plane: jax.Array) -> jax.Array:
        squared = jnp.sum(plane * plane, -1, keepdims=True)
        # Near the axis the square root has no derivative, and a series is exact.
        near = squared < 1e-8
        radius = jnp.sqrt(jnp.where(near, 1.0, squared))
        angle = jnp.where(near, 0.0, jnp.arctan(radius))
        per_radius = jnp.where(near, 1 - squared / 3, angle / radius)
        t2 = jnp.where(near, squared, angle * angle)
        seen = angle <= self._limit(coefficients)
        return jnp.where(seen, plane * per_radius * _polynomial(coefficients, t2), jnp.nan)

    def approach(self, coefficients: Array, distorted: jax.Array) -> jax.Array:
        # By bisection: the polynomial ascends as far as `_limit`, but not always convexly.
        coefficients, distorted = jax.lax.stop_gradient((jnp.asarray(coefficients), distorted))
        radius = jnp.linalg.norm(distorted, axis=-1, keepdims=True)

        def halve(_: int, ends: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            low, high = ends
            middle = (low + high) / 2
            less = middle * _polynomial(coefficients, middle * middle) < radius
            return jnp.where(less, middle, low), jnp.where(less, high, middle)

        ends = jnp.zeros_like(radius), jnp.broadcast_to(self._limit(coefficients), radius.shape)
        low, _ = jax.lax.fori_loop(0, HALVINGS, halve, ends)
        return distorted * jnp.where(radius > 1e-4, jnp.tan(low) / jnp.where(radius > 0, radius, 1.0), 1.0)

    def _project(self, points: np.ndarray, turn: np.ndarray, shift: np.ndarray, lens: Parameters) -> Projection:
        pixels, jacobian = cv2.fisheye.projectPoints(points[:, None], turn, shift, *lens)
        return Projection(pixels[:, 0], jacobian[:, :8], jacobian[:, 8:14])

    def _normalize(self, pixels: np.ndarray, lens: Parameters) -> np.ndarray:
        return cv2.fisheye.undistortPoints(pixels[:, None], *lens, criteria=EXACT)[:, 0]

    def straighten(self, image: np.ndarray, lens: Parameters) -> np.ndarray:
        return cv2.fisheye.undistortImage(image, *lens, Knew=lens[0])

    def _limit(self, coefficients: Array) -> jax.Array:
        """The angle up to which what is farther out is shown farther out, radians."""
        t2 = ANGLES**2
        slope = 1 + sum((2 * i + 3) * coefficients[i] * t2 ** (i + 1) for i in range(4))
        folds = slope <= 0
        return jnp.where(jnp.any(folds), jnp.asarray(ANGLES)[jnp.argmax(folds) - 1], WIDEST)


LENSES: dict[str, Lens] = {lens.name: lens for lens in (Pinhole(), Fisheye())}


def undistort(lens: Lens, coefficients: Array, distorted: jax.Array) -> jax.Array:
    """The inverse of `Lens.distort`, with its gradient; NaN where the lens shows nothing."""
    # The last step alone carries the gradient: it is that of the implicit function, whatever came before.
    start = jax.lax.stop_gradient(lens.approach(coefficients, distorted))
    plane = _newton(lens, coefficients, start, distorted)
    error = jnp.linalg.norm(lens.distort(coefficients, plane) - distorted, axis=-1, keepdims=True)
    tolerance = 1e-5 * (1 + jnp.linalg.norm(distorted, axis=-1, keepdims=True))
    # Past where a barrel distortion folds back, the way back leads to the other side of the image.
    ahead = jnp.sum(plane * distorted, axis=-1, keepdims=True) >= 0
    return jnp.where((error < tolerance) & ahead, plane, jnp.nan)


def slopes(function: Callable[[jax.Array], jax.Array], points: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """What a function makes of points (..., 2), each by itself, and its derivatives along x and along y, (..., 2)
    each."""
    one, zero = jnp.ones_like(points[..., 0]), jnp.zeros_like(points[..., 0])
    value, along_x = jax.jvp(function, (points,), (jnp.stack([one, zero], -1),))
    _, along_y = jax.jvp(function, (points,), (jnp.stack([zero, one], -1),))
    return value, along_x, along_y


def split(array: jax.Array) -> list[jax.Array]:
    """The columns of an array (..., n)."""
    return [array[..., i] for i in range(array.shape[-1])]


def _newton(lens: Lens, coefficients: Array, plane: jax.Array, distorted: jax.Array) -> jax.Array:
    """One Newton step from `plane` towards the point that `Lens.distort` takes to `distorted`."""
    found, along_x, along_y = slopes(lambda p: lens.distort(coefficients, p), plane)
    (a, c), (b, d), (e, f) = split(along_x), split(along_y), split(distorted - found)
    return plane + jnp.stack([d * e - b * f, a * f - c * e], -1) / (a * d - b * c)[..., None]


def _polynomial(coefficients: Array, t2: jax.Array) -> jax.Array:
    """By what the square `t2` of an angle is multiplied."""
    k1, k2, k3, k4 = (coefficients[i] for i in range(4))
    return 1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))
