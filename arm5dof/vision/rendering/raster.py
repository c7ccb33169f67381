"""`Raster`: OpenCV's triangle rasterizer as a camera, and the planes that it cannot draw."""

from __future__ import annotations

import cv2
import mujoco
import numpy as np

from arm5dof.vision.camera import Camera


class Raster:
    """Draws triangles and planes of the base frame as a `Camera` without distortion sees them.

    A depth buffer (h, w) float32 holds 0 at the near plane and 1 at the far plane, as OpenGL's: between them it is
    linear in the inverse of the depth.

    Args:
        camera: The camera, with a pose.
        near: Depth of the near plane, metres.
        far: Depth of the far plane, metres.
    """

    def __init__(self, camera: Camera, near: float, far: float) -> None:
        self.shape = (camera.height, camera.width)
        self.eye = np.asarray(camera.position, np.float32)
        self._near, self._far = near, far
        self._rotation = np.asarray(camera.rotation, np.float32)
        (fx, _, cx), (_, fy, cy) = camera.matrix[:2]
        self._x = np.asarray((np.arange(camera.width) - cx) / fx, np.float32)
        self._y = np.asarray((np.arange(camera.height) - cy) / fy, np.float32)[:, None]
        # The rasterizer's camera is OpenGL's, with square pixels and the principal point in the middle.
        self._axes = self._rotation * np.array([fx / fy, -1, -1], np.float32)
        self._field = 2 * np.arctan(camera.height / 2 / fy)

    def depth(self, buffer: np.ndarray) -> np.ndarray:
        """Metres along the optical axis, from a depth buffer."""
        return 1 / ((1 - buffer) * np.float32(1 / self._near) + buffer * np.float32(1 / self._far))

    def points(self, depth: np.ndarray) -> np.ndarray:
        """The points at which pixels look, (h, w, 3) in the base frame, from their depths (h, w), metres."""
        local = cv2.merge([self._x * depth, self._y * depth, depth])
        return np.asarray(cv2.transform(local, np.c_[self._rotation, self.eye]))

    def plane_buffer(self, plane: mujoco.MjvGeom) -> np.ndarray:
        """A depth buffer with nothing but a plane in it, if that is seen from its front."""
        offset = (self.eye - plane.pos) @ plane.mat
        # How fast a ray goes along the plane's axes: affine in the pixel.
        along = [self._x * x + (self._y * y + z) for x, y, z in (self._rotation.T @ plane.mat).T]
        inverse = -along[2] / max(offset[2], 1e-9)
        buffer = (1 / self._near - inverse) / (1 / self._near - 1 / self._far)
        hit = (inverse > 0) & (buffer > 0) & (buffer < 1) & (offset[2] > 0)
        for axis in (0, 1):
            if plane.size[axis] > 0:
                hit &= np.abs(along[axis] + offset[axis] * inverse) <= plane.size[axis] * inverse
        return np.where(hit, buffer, 1).astype(np.float32)

    def load(self, vertices: np.ndarray, triangles: np.ndarray) -> None:
        """What to draw from now on: vertices (n, 3) and triangles (m, 3), counter-clockwise seen from outside."""
        local = (vertices - self.eye) @ self._axes
        self._triangles, self._ends, self._share = _clip(-local[:, 2], triangles, self._near)
        self._local = self._with_cuts(local)

    def draw(self, colors: np.ndarray, image: np.ndarray, buffer: np.ndarray, flat: bool = False) -> None:
        """Draw what is loaded.

        Args:
            colors: Of the vertices, (n, 3).
            image: (h, w, 3) float32, changed.
            buffer: A depth buffer, changed.
            flat: Whether all vertices of a triangle have the same color.
        """
        if not len(self._triangles):
            return
        settings = cv2.TriangleRasterizeSettings()
        settings.setShadingType(cv2.RASTERIZE_SHADING_FLAT if flat else cv2.RASTERIZE_SHADING_SHADED)
        settings.setCullingMode(cv2.RASTERIZE_CULLING_CW)
        settings.setGlCompatibleMode(cv2.RASTERIZE_COMPAT_INVDEPTH)
        cv2.triangleRasterize(
            self._local, self._triangles, self._with_cuts(colors), image, buffer,
            np.eye(4), self._field, self._near, self._far, settings,
        )  # fmt: skip

    def outline_area(self, triangles: np.ndarray) -> int:
        """How many pixels some of the triangles (k, 3) would cover, were nothing before them and no edge to the image.
        They must be of vertices in front of the near plane."""
        corners = self._local[triangles]
        plane = corners[..., :2] / -corners[..., 2:]
        pixel = 2 * np.tan(self._field / 2) / self.shape[0]
        low, high = (np.asarray(f / pixel) for f in (plane.min((0, 1)), plane.max((0, 1))))
        # A window of its own: whole pixels away from the image, so that it is cut into the same pixels.
        first = np.floor(low + np.array(self.shape[::-1]) / 2) - np.array(self.shape[::-1]) / 2
        size = int(np.ceil((high - first).max())) + 1
        middle = (first + size / 2) * pixel
        vertices = corners.reshape(-1, 3).copy()
        vertices[:, :2] += middle.astype(np.float32) * vertices[:, 2:]
        buffer = np.ones((size, size), np.float32)
        settings = cv2.TriangleRasterizeSettings()
        settings.setGlCompatibleMode(cv2.RASTERIZE_COMPAT_INVDEPTH)
        settings.setCullingMode(cv2.RASTERIZE_CULLING_CW)
        cv2.triangleRasterizeDepth(
            vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3), buffer,
            np.eye(4), 2 * np.arctan(size / 2 * pixel), self._near, self._far, settings,
        )  # fmt: skip
        return int(np.count_nonzero(buffer < 1))

    def _with_cuts(self, values: np.ndarray) -> np.ndarray:
        """Values at the vertices (n, k) and at those that clipping added."""
        if len(self._share):
            start, end = values[self._ends]
            values = np.concatenate([values, start + self._share * (end - start)])
        return np.ascontiguousarray(values, np.float32)


def _clip(depth: np.ndarray, triangles: np.ndarray, near: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut off what lies nearer than `near`, which the rasterizer cannot draw.

    Returns triangles (m, 3), and of the vertices to append: between which two they lie (2, k), and where (k, 1).
    """
    front = depth[triangles] > near
    count = front.sum(1)
    kept = [triangles[count == 3]]
    ends: list[np.ndarray] = []
    new = len(depth)
    for inside in (1, 2):
        # Turn the triangle until the vertex that is alone on its side comes first.
        cut, alone = triangles[count == inside], front[count == inside] == (inside == 1)
        if len(cut):
            turn = (alone.argmax(1)[:, None] + np.arange(3)) % 3
            a, b, c = np.take_along_axis(cut, turn, 1).T
            ab, ac = new + np.arange(2 * len(cut)).reshape(2, -1)
            new += 2 * len(cut)
            ends += [np.stack([a, b]), np.stack([a, c])]
            pieces = [[a, ab, ac]] if inside == 1 else [[ab, b, c], [ab, c, ac]]
            kept += [np.stack(piece, -1) for piece in pieces]
    if not ends:
        return np.ascontiguousarray(kept[0]), np.zeros((2, 0), int), np.zeros((0, 1), np.float32)
    both = np.concatenate(ends, 1)
    start, end = depth[both]
    share = ((near * 1.0001 - start) / (end - start)).astype(np.float32)
    return np.concatenate(kept).astype(np.int32), both, share[:, None]
