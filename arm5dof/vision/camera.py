"""`Camera`: a camera with one of OpenCV's lens models and a pose in the arm's base frame.

Frames follow OpenCV: x right, y down, z forward along the optical axis; the center of the top left pixel is (0, 0).
MuJoCo's convention (y up, looking along -z) is converted in `Camera.from_mujoco` and nowhere else.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from arm5dof.errors import UserError
from arm5dof.vision import camera_file
from arm5dof.vision.lens import LENSES, Array, Lens, slopes, split, undistort

OPENCV_FROM_MUJOCO = np.diag([1.0, -1.0, -1.0])


class Camera(struct.PyTreeNode):
    """A camera. Immutable, a pytree, and its methods are jitted and can be batched and differentiated.

    They compute in float32, or in float64 under `jax.enable_x64(True)`. Arrays read from a file stay float64 NumPy
    arrays until then, so nothing is lost on the way from file to file.

    >>> import numpy as np
    >>> from arm5dof import Camera
    >>> matrix = np.array([[600.0, 0, 319.5], [0, 600, 239.5], [0, 0, 1]])
    >>> looks_down = np.diag([1.0, -1.0, -1.0])
    >>> camera = Camera(matrix, np.zeros(5), looks_down, np.array([0.2, 0, 0.6]), width=640, height=480)
    >>> camera.project(np.array([0.2, 0.1, 0.0])).round(3).tolist()  # pixels
    [319.5, 139.5]
    """

    matrix: Array
    """Focal lengths and principal point, (3, 3), pixels."""
    distortion: Array
    """OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6]], (4,), (5,) or (8,); of a fisheye lens k1 k2 k3 k4, (4,)."""
    rotation: Array
    """Camera to base frame, (3, 3)."""
    position: Array
    """The optical center in the base frame, (3,), metres."""
    width: int = struct.field(pytree_node=False)
    """Of the image, pixels."""
    height: int = struct.field(pytree_node=False)
    """Of the image, pixels."""
    has_extrinsics: bool = struct.field(pytree_node=False, default=True)
    """False if the camera's pose is unknown: `rotation` and `position` are then those of the camera's own frame, and
    what is computed from them is in that frame."""
    covariance: Array | None = None
    """Of the parameters, (m, m), in the order in which `perturbed` takes errors; None if unknown."""
    lens: str = struct.field(pytree_node=False, default="pinhole")
    """The lens model: `pinhole`, OpenCV's usual one, or `fisheye`."""

    def __post_init__(self) -> None:
        if self.lens not in LENSES:
            raise UserError(f"no lens model {self.lens!r}: choose from {', '.join(LENSES)}")
        # Transformations build cameras out of whatever they put in place of arrays; only arrays have a shape to check.
        shape = getattr(self.distortion, "shape", ())
        if shape and shape[-1] not in self.model.counts:
            raise UserError(f"{shape[-1]} distortion coefficients: give {self.model.wanted}")

    @property
    def model(self) -> Lens:
        """The lens model itself."""
        return LENSES[self.lens]

    @property
    def opencv(self) -> tuple[np.ndarray, np.ndarray]:
        """`matrix` (3, 3) and `distortion` (4, 5 or 8,), float64, as OpenCV's functions take them; for a fisheye lens
        those of `cv2.fisheye`."""
        return np.asarray(self.matrix, float), np.asarray(self.distortion, float)

    def with_pose(self, rotation: Array, position: Array) -> Camera:
        """This camera at another place.

        Args:
            rotation: Camera to base frame, (3, 3).
            position: The optical center in the base frame, (3,), metres.

        Returns:
            A camera that has extrinsics.
        """
        return self.replace(rotation=rotation, position=position, has_extrinsics=True)

    @jax.jit
    def perturbed(self, error: Array) -> Camera:
        """This camera with errors in its parameters.

        Args:
            error: (m,) added to fx, fy, cx, cy (pixels) and the distortion coefficients; then a small rotation about
                the camera's own axes (3,) (radians, applied to the second order) and a shift along them (3,) (metres).

        Returns:
            The camera whose true parameters these are if ours are off by so much.
        """
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
        """Points of the base frame in the camera's frame.

        Args:
            points: (..., 3), metres, base frame.

        Returns:
            (..., 3), metres, camera frame: the last column is their depth.
        """
        return _matmul(jnp.asarray(points) - self.position, self.rotation)

    @jax.jit
    def project(self, points: Array) -> jax.Array:
        """Where points are seen. As with OpenCV's, a pixel says nothing about whether it lies in the image; far outside
        the field of view a pinhole's barrel distortion folds back, and a point there may be given a pixel inside.

        Args:
            points: (..., 3), metres, base frame.

        Returns:
            Pixels (..., 2), x and y; NaN for points that are not in front of the camera, or that a fisheye lens cannot
            show.
        """
        x, y, z = split(self.to_camera(points))
        depth = jnp.where(z > 0, z, 1.0)  # Keeps the gradient of the points in front free of NaN.
        pixels = self._show(jnp.stack([x / depth, y / depth], -1))
        return jnp.where(z[..., None] > 0, pixels, jnp.nan)

    @jax.jit
    def undistort(self, pixels: Array) -> jax.Array:
        """Where pixels would lie without lens distortion.

        Args:
            pixels: (..., 2), x and y.

        Returns:
            Pixels (..., 2); NaN where the lens model shows nothing at all.
        """
        return self._to_pixels(self._normalize(pixels))

    @jax.jit
    def rays(self, pixels: Array) -> jax.Array:
        """The directions in which pixels look.

        Args:
            pixels: (..., 2), x and y.

        Returns:
            Unit vectors (..., 3) of the base frame, from the camera's position; NaN where the lens model shows nothing.
        """
        plane = self._normalize(pixels)
        direction = jnp.concatenate([plane, jnp.ones_like(plane[..., :1])], -1)
        direction = direction / jnp.linalg.norm(direction, axis=-1, keepdims=True)
        return _matmul(direction, jnp.asarray(self.rotation).T)

    @jax.jit
    def back_project(self, pixels: Array, depth: Array) -> jax.Array:
        """The points that are seen at pixels at a given depth.

        Args:
            pixels: (..., 2), x and y.
            depth: (...), metres along the optical axis.

        Returns:
            (..., 3), metres, base frame; NaN where the lens model shows nothing.
        """
        plane = self._normalize(pixels)
        point = jnp.concatenate([plane, jnp.ones_like(plane[..., :1])], -1) * jnp.asarray(depth)[..., None]
        return _matmul(point, jnp.asarray(self.rotation).T) + self.position

    @jax.jit
    def magnification(self, points: Array) -> jax.Array:
        """How pixels follow a point that moves across the line of sight.

        Args:
            points: (..., 3), metres, base frame.

        Returns:
            (..., 2, 2): derivative of the pixel's x and y (rows) by the point's x and y on the image plane at depth 1
            (columns). NaN for points not in front of the camera.
        """
        x, y, z = split(self.to_camera(points))
        depth = jnp.where(z > 0, z, jnp.nan)
        return jnp.stack(slopes(self._show, jnp.stack([x / depth, y / depth], -1))[1:], -1)

    def _show(self, plane: jax.Array) -> jax.Array:
        """Pixels (..., 2) at which the lens shows points (..., 2) of the image plane at depth 1."""
        return self._to_pixels(self.model.distort(self.distortion, plane))

    def _to_pixels(self, plane: jax.Array) -> jax.Array:
        """Pixels (..., 2) of points (..., 2) on the image plane at depth 1."""
        x, y = split(plane)
        (fx, skew, cx), (_, fy, cy) = self.matrix[0], self.matrix[1]
        return jnp.stack([fx * x + skew * y + cx, fy * y + cy], -1)

    def _normalize(self, pixels: Array) -> jax.Array:
        """Undistorted points (..., 2) on the image plane at depth 1."""
        u, v = split(jnp.asarray(pixels))
        (fx, skew, cx), (_, fy, cy) = self.matrix[0], self.matrix[1]
        y = (v - cy) / fy
        return undistort(self.model, self.distortion, jnp.stack([(u - cx - skew * y) / fx, y], -1))

    @classmethod
    def from_mujoco(
        cls, model: mujoco.MjModel, name: str, width: int, height: int, data: mujoco.MjData | None = None
    ) -> Camera:
        """A camera of a MuJoCo model, as it renders. The base frame is MuJoCo's world frame.

        Args:
            model: The model.
            name: Of the camera.
            width: Of the image, pixels.
            height: Of the image, pixels.
            data: Says where the camera is; it must have been through `mj_forward`. Without it the camera is where the
                model's `qpos0` has it.

        Returns:
            The camera, without distortion and without a covariance.

        Raises:
            UserError: There is no such camera, or it has its principal point off the center.
        """
        camera = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, name)
        if camera < 0:
            names = ", ".join(model.camera(i).name for i in range(model.ncam))
            raise UserError(f"the model has no camera {name!r}; it has: {names or 'none'}")
        if data is None:
            data = mujoco.MjData(model)
            mujoco.mj_forward(model, data)
        # A camera with a sensor size has its focal lengths from there; every other one has square pixels and fovy.
        if model.cam_sensorsize[camera].any():
            focal, center = model.cam_intrinsic[camera].reshape(2, 2)
            if center.any():
                raise UserError(
                    f"camera {name!r} has its principal point off the center: leave out principal in the MJCF"
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
        """Read a camera from a YAML file of OpenCV's calibration sample or of `save`.

        Args:
            path: The file. Without a pose in it, the camera has no extrinsics.
            hand: The hand's pose in the base frame, (4, 4), for a camera that was calibrated on the hand: its pose in
                the file is in the hand's frame.

        Returns:
            The camera. Its arrays are float64 NumPy arrays.

        Raises:
            UserError: The file is none such, or has no pose on a hand although `hand` is given.
            OSError: It cannot be read.
        """
        return cls(**camera_file.read(Path(path), hand))

    def save(self, path: str | Path, notes: Mapping[str, Any] | None = None) -> None:
        """Write the camera into a YAML file that `load` and OpenCV read.

        Args:
            path: The file; it is replaced as a whole, or not at all.
            notes: What else to write: numbers, strings and arrays by name.
        """
        values = {
            "image_width": self.width,
            "image_height": self.height,
            **camera_file.model_notes(self.model, len(self.distortion)),
            "camera_matrix": np.asarray(self.matrix, float),
            "distortion_coefficients": np.asarray(self.distortion, float).reshape(-1, 1),
        }
        if self.has_extrinsics:
            values["camera_rotation"] = np.asarray(self.rotation, float)
            values["camera_position"] = np.asarray(self.position, float).reshape(3, 1)
        if self.covariance is not None:
            values["camera_covariance"] = np.asarray(self.covariance, float)
        camera_file.write(Path(path), {**values, **(notes or {})})


def _matmul(points: jax.Array, matrix: Array) -> jax.Array:
    """Exact on every device: accelerators round the factors of a plain float32 product to 10 bits."""
    return jnp.matmul(points, jnp.asarray(matrix), precision=jax.lax.Precision.HIGHEST)
