"""`Camera`: a pinhole camera with OpenCV's lens distortion and a pose in the arm's base frame.

Frames follow OpenCV: x right, y down, z forward along the optical axis; the centre of the top left pixel is (0, 0).
MuJoCo's convention (y up, looking along -z) is converted in `Camera.from_mujoco` and nowhere else.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from arm5dof.errors import UserError
from arm5dof.runtime import files

Array = jax.Array | np.ndarray

COEFFICIENTS = (4, 5, 8)
"""How many distortion coefficients a camera may have: k1 k2 p1 p2 [k3 [k4 k5 k6]], in OpenCV's order."""

NEWTON_STEPS = 10
"""Enough for float64 wherever the lens model can be inverted: Newton converges from one side, then quadratically."""

OPENCV_FROM_MUJOCO = np.diag([1.0, -1.0, -1.0])


class Camera(struct.PyTreeNode):
    """A camera. Immutable, a pytree, and its methods are jitted and can be batched and differentiated.

    They calculate in float32, or in float64 under `jax.enable_x64(True)`. Arrays read from a file stay float64 NumPy
    arrays until then, so nothing is lost on the way from file to file.
    """

    matrix: Array
    """Focal lengths and principal point, (3, 3), pixels."""
    distortion: Array
    """OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6]], (4,), (5,) or (8,)."""
    rotation: Array
    """Camera to base frame, (3, 3)."""
    position: Array
    """The optical centre in the base frame, (3,), metres."""
    width: int = struct.field(pytree_node=False)
    height: int = struct.field(pytree_node=False)
    posed: bool = struct.field(pytree_node=False, default=True)
    """False if nobody has said where the camera stands: `rotation` and `position` are then those of the camera's own
    frame, and what is computed from them is in that frame."""
    covariance: Array | None = None
    """How well all that is known, (m, m), in the order in which `disturbed` takes errors; None if nobody has said."""

    def __post_init__(self) -> None:
        # Transformations build cameras out of whatever they put in place of arrays; only arrays have a shape to check.
        shape = getattr(self.distortion, "shape", ())
        if shape and shape[-1] not in COEFFICIENTS:
            raise UserError(
                f"{shape[-1]} distortion coefficients: give 4, 5 or 8 in OpenCV's order, k1 k2 p1 p2 [k3 [k4 k5 k6]]; "
                "calibrate without OpenCV's thin prism and tilted models"
            )

    def with_pose(self, rotation: Array, position: Array) -> Camera:
        """This camera at another place: `rotation` (3, 3) camera to base, `position` (3,) metres."""
        return self.replace(rotation=rotation, position=position, posed=True)

    @jax.jit
    def disturbed(self, error: Array) -> Camera:
        """This camera with an `error` (m,) in each of its parameters: fx, fy, cx, cy (pixels), the distortion, then a
        small turn about its own axes (3,) (radians, to the second order) and a shift along them (3,) (metres)."""
        lens, turn, shift = jnp.split(jnp.asarray(error), [len(error) - 6, len(error) - 3])
        (fx, fy, cx, cy), (x, y, z), o = lens[:4], turn, 0.0
        turn = jnp.array([[o, -z, y], [z, o, -x], [-y, x, o]])
        change = _matmul(turn, jnp.eye(3) + turn / 2)
        return self.replace(
            matrix=self.matrix + jnp.array([[fx, o, cx], [o, fy, cy], [o, o, o]]),
            distortion=self.distortion + lens[4:],
            rotation=self.rotation + _matmul(jnp.asarray(self.rotation), change),
            position=self.position + _matmul(shift, jnp.asarray(self.rotation).T),
        )

    @jax.jit
    def to_camera(self, points: Array) -> jax.Array:
        """Points (..., 3) of the base frame in the camera's frame, metres. The last column is their depth."""
        return _matmul(jnp.asarray(points) - self.position, self.rotation)

    @jax.jit
    def project(self, points: Array) -> jax.Array:
        """Pixels (..., 2) where points (..., 3) of the base frame are seen; NaN for points that are not in front.

        As with OpenCV's, a pixel says nothing about whether it lies in the picture; far outside the field of view a
        barrel distortion folds back, and a point there may be given a pixel inside.
        """
        x, y, z = _split(self.to_camera(points))
        depth = jnp.where(z > 0, z, 1.0)  # Keeps the gradient of the points in front free of NaN.
        pixels = self._to_pixels(self._distort(jnp.stack([x / depth, y / depth], -1)))
        return jnp.where(z[..., None] > 0, pixels, jnp.nan)

    @jax.jit
    def undistort(self, pixels: Array) -> jax.Array:
        """Where pixels (..., 2) would lie without lens distortion; NaN where the lens model shows nothing at all."""
        return self._to_pixels(self._normalise(pixels))

    @jax.jit
    def rays(self, pixels: Array) -> jax.Array:
        """Unit directions (..., 3) in the base frame from the camera's position to what pixels (..., 2) show."""
        plane = self._normalise(pixels)
        direction = jnp.concatenate([plane, jnp.ones_like(plane[..., :1])], -1)
        direction = direction / jnp.linalg.norm(direction, axis=-1, keepdims=True)
        return _matmul(direction, jnp.asarray(self.rotation).T)

    @jax.jit
    def back_project(self, pixels: Array, depth: Array) -> jax.Array:
        """Points (..., 3) of the base frame seen at pixels (..., 2) at `depth` (...) metres along the optical axis."""
        plane = self._normalise(pixels)
        point = jnp.concatenate([plane, jnp.ones_like(plane[..., :1])], -1) * jnp.asarray(depth)[..., None]
        return _matmul(point, jnp.asarray(self.rotation).T) + self.position

    def _to_pixels(self, plane: jax.Array) -> jax.Array:
        """Pixels (..., 2) of points (..., 2) on the image plane at depth 1."""
        x, y = _split(plane)
        (fx, skew, cx), (_, fy, cy) = self.matrix[0], self.matrix[1]
        return jnp.stack([fx * x + skew * y + cx, fy * y + cy], -1)

    def _normalise(self, pixels: Array) -> jax.Array:
        """Undistorted points (..., 2) on the image plane at depth 1, by Newton's method on `_distort`."""
        u, v = _split(jnp.asarray(pixels))
        (fx, skew, cx), (_, fy, cy) = self.matrix[0], self.matrix[1]
        y = (v - cy) / fy
        target = jnp.stack([(u - cx - skew * y) / fx, y], -1)
        start = jax.lax.fori_loop(0, NEWTON_STEPS, lambda _, p: self._newton(p, target), target)
        # The last step alone carries the gradient: it is that of the implicit function, whatever came before.
        plane = self._newton(jax.lax.stop_gradient(start), target)
        error = jnp.linalg.norm(self._distort(plane) - target, axis=-1, keepdims=True)
        tolerance = 1e-5 * (1 + jnp.linalg.norm(target, axis=-1, keepdims=True))
        # Past where a barrel distortion folds back, the way back leads to the other side of the picture.
        ahead = jnp.sum(plane * target, axis=-1, keepdims=True) >= 0
        return jnp.where((error < tolerance) & ahead, plane, jnp.nan)

    def _newton(self, plane: jax.Array, target: jax.Array) -> jax.Array:
        """One Newton step from `plane` towards the point that `_distort` takes to `target`, (..., 2) each."""
        one, zero = jnp.ones_like(plane[..., 0]), jnp.zeros_like(plane[..., 0])
        found, along_x = jax.jvp(self._distort, (plane,), (jnp.stack([one, zero], -1),))
        _, along_y = jax.jvp(self._distort, (plane,), (jnp.stack([zero, one], -1),))
        (a, c), (b, d), (e, f) = _split(along_x), _split(along_y), _split(target - found)
        return plane + jnp.stack([d * e - b * f, a * f - c * e], -1) / (a * d - b * c)[..., None]

    def _distort(self, plane: jax.Array) -> jax.Array:
        """OpenCV's lens model on points (..., 2) of the image plane at depth 1 (documentation of its calib3d)."""
        given = [self.distortion[i] for i in range(self.distortion.shape[0])]
        k1, k2, p1, p2, k3, k4, k5, k6 = given + [0.0] * (8 - len(given))
        x, y = _split(plane)
        r2 = x * x + y * y
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        return jnp.stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ],
            -1,
        )

    @classmethod
    def from_mujoco(
        cls, model: mujoco.MjModel, name: str, width: int, height: int, data: mujoco.MjData | None = None
    ) -> Camera:
        """The camera `name` of a MuJoCo model as it renders `width` x `height` pixels, where `data` has it (it must
        have been through `mj_forward`), or where it is at the model's `qpos0`. The base frame is the world's."""
        camera = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, name)
        if camera < 0:
            known = ", ".join(model.camera(i).name for i in range(model.ncam))
            raise UserError(f"the model has no camera {name!r}; it has: {known or 'none'}")
        if data is None:
            data = mujoco.MjData(model)
            mujoco.mj_forward(model, data)
        # A camera with a sensor size has its focal lengths from there; every other one has square pixels and fovy.
        if model.cam_sensorsize[camera].any():
            focal, centre = model.cam_intrinsic[camera].reshape(2, 2)
            if centre.any():
                raise UserError(
                    f"camera {name!r} has its principal point off the centre: leave out principal in the MJCF"
                )
            fx, fy = focal / model.cam_sensorsize[camera] * (width, height)
        else:
            fx = fy = height / (2 * np.tan(np.deg2rad(model.cam_fovy[camera]) / 2))
        return cls(
            matrix=np.array([[fx, 0, (width - 1) / 2], [0, fy, (height - 1) / 2], [0, 0, 1]]),
            distortion=np.zeros(5),
            rotation=data.cam_xmat[camera].reshape(3, 3) @ OPENCV_FROM_MUJOCO,
            position=data.cam_xpos[camera].copy(),
            width=width,
            height=height,
        )

    @classmethod
    def load(cls, path: str | Path, hand: np.ndarray | None = None) -> Camera:
        """Read a camera from a YAML file in the format of OpenCV's calibration sample; ours adds the pose and the
        covariance, and a file without a pose gives a camera that is not `posed`. A camera that was calibrated on the
        hand has its pose there; it takes the pose of the `hand` in the base frame, (4, 4), to be `posed`. Raises
        `UserError` for anything else."""
        path = Path(path)
        values = _read(path)
        matrix = _array(path, values, "camera_matrix", (3, 3))
        distortion = _array(path, values, "distortion_coefficients", None)
        if (matrix[2] != (0, 0, 1)).any() or matrix[1, 0] or min(matrix[0, 0], matrix[1, 1]) <= 0:
            raise UserError(f"{path}: camera_matrix is not of the form [fx s cx; 0 fy cy; 0 0 1]")
        if distortion.size not in COEFFICIENTS:
            raise UserError(f"{path} has {distortion.size} distortion_coefficients: 4, 5 or 8 can be used")
        width, height = (_whole(path, values, name) for name in ("image_width", "image_height"))
        place = "camera" if hand is None else "hand"
        posed = f"{place}_rotation" in values
        if hand is not None and not posed:
            raise UserError(f"{path} has no hand_rotation: this camera was not calibrated on a hand")
        rotation = _array(path, values, f"{place}_rotation", (3, 3)) if posed else np.eye(3)
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-6 or np.linalg.det(rotation) < 0:
            raise UserError(f"{path}: {place}_rotation is no rotation matrix")
        position = _array(path, values, f"{place}_position", (3,)) if posed else np.zeros(3)
        if hand is not None:
            rotation, position = hand[:3, :3] @ rotation, hand[:3, :3] @ position + hand[:3, 3]
        covariance = None
        if "camera_covariance" in values:
            covariance = _array(path, values, "camera_covariance", 2 * (10 + distortion.size,))
            scale = np.sqrt(np.abs(np.diag(covariance)))
            scaled = covariance / np.maximum(np.outer(scale, scale), 1e-30)
            if np.abs(scaled - scaled.T).max() > 1e-6 or np.linalg.eigvalsh(scaled)[0] < -1e-6:
                raise UserError(f"{path}: camera_covariance is no covariance matrix")
        return cls(matrix, distortion, rotation, position, width, height, posed, covariance)

    def save(self, path: str | Path, notes: Mapping[str, Any] | None = None) -> None:
        """Write the camera, and any `notes` (numbers, words, arrays), where `load` and OpenCV can read them."""
        storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
        values = {
            "image_width": self.width,
            "image_height": self.height,
            "camera_matrix": np.asarray(self.matrix, float),
            "distortion_coefficients": np.asarray(self.distortion, float).reshape(-1, 1),
        }
        if self.posed:
            values["camera_rotation"] = np.asarray(self.rotation, float)
            values["camera_position"] = np.asarray(self.position, float).reshape(3, 1)
        if self.covariance is not None:
            values["camera_covariance"] = np.asarray(self.covariance, float)
        for name, value in {**values, **(notes or {})}.items():
            storage.write(name, value)
        files.write_text(Path(path), storage.releaseAndGetString())


def _split(array: jax.Array) -> list[jax.Array]:
    return [array[..., i] for i in range(array.shape[-1])]


def _matmul(points: jax.Array, matrix: Array) -> jax.Array:
    """Exact on every device: accelerators round the factors of a plain float32 product to 10 bits."""
    return jnp.matmul(points, jnp.asarray(matrix), precision=jax.lax.Precision.HIGHEST)


def _read(path: Path) -> dict[str, Any]:
    """Everything at the top level of one of OpenCV's YAML files: numbers, words and arrays by name."""
    try:
        text = path.read_text(encoding="utf-8")
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = storage.root()
        nodes = {name: root.getNode(name) for name in root.keys()}  # noqa: SIM118
        return {n: node.mat() if node.isMap() else node.real() for n, node in nodes.items() if not node.isString()}
    except (cv2.error, UnicodeDecodeError, SystemError):
        raise UserError(f"{path} is no camera file: give a YAML file of OpenCV's or of vision calibrate's") from None


def _array(path: Path, values: dict[str, Any], name: str, shape: tuple[int, ...] | None) -> np.ndarray:
    value = values.get(name)
    if not isinstance(value, np.ndarray) or (shape is not None and value.size != np.prod(shape)):
        raise UserError(f"{path} has no {name} of the right size: is it a camera file of OpenCV's?")
    if not np.isfinite(value).all():
        raise UserError(f"{path}: {name} is not finite")
    return value.astype(float).reshape(shape or -1)


def _whole(path: Path, values: dict[str, Any], name: str) -> int:
    value = values.get(name)
    if not isinstance(value, float) or value < 1 or value != int(value):
        raise UserError(f"{path} has no {name}, a positive number of pixels: is it a camera file of OpenCV's?")
    return int(value)
