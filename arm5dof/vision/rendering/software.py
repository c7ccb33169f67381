"""`SoftwareRenderer`: images of a MuJoCo scene with nothing but NumPy and OpenCV's triangle rasterizer.

It draws MuJoCo's own abstract scene (`mjvScene`) as MuJoCo's OpenGL renderer does: lit at the vertices, interpolated
between them, multiplied by the texture, shadow by shadow. What it leaves out: antialiasing (render more pixels and
shrink the image), reflections, haze, planes seen from behind, and a mesh's own texture coordinates; what is half
transparent it draws as if it were not.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import mujoco
import numpy as np

from arm5dof.vision.camera import Camera
from arm5dof.vision.rendering import shading
from arm5dof.vision.rendering.meshes import BOX, PLANE, Assembler, Mesh, capacity
from arm5dof.vision.rendering.raster import Raster

GEOM = int(mujoco.mjtObj.mjOBJ_GEOM)
COLOR_TEXTURE = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
SKY = mujoco.mjtTexture.mjTEXTURE_SKYBOX
AMBIENT_ONLY = 0.3
"""The light that is everywhere in a scene without any."""
TABLE_SIZE = 0.3
"""Half width, metres, from which the shadows of a box fall on planes alone: a table's would blur those of all else."""


class _View(NamedTuple):
    """What the camera sees in which pixel."""

    geoms: list[mujoco.MjvGeom]
    mesh: Mesh
    raster: Raster
    planes: np.ndarray
    """A depth buffer with the planes alone, (h, w)."""
    owner: np.ndarray
    """Index of the geom that is seen in a pixel, (h, w) int32; -1 for none."""
    buffer: np.ndarray
    """The depth buffer, (h, w)."""


class SoftwareRenderer:
    """A camera of a MuJoCo model, rendered by the CPU. `data` must have been through `mj_forward`.

    Args:
        model: The model.
        camera: The camera's name.
        width: Of the image, pixels.
        height: Of the image, pixels.
    """

    def __init__(self, model: mujoco.MjModel, camera: str, width: int, height: int) -> None:
        self.model, self.camera, self.width, self.height = model, camera, width, height
        self._scene = mujoco.MjvScene(model, maxgeom=capacity(model))
        self._option, self._viewer = mujoco.MjvOption(), mujoco.MjvCamera()
        self._viewer.type, self._viewer.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, model.camera(camera).id
        self._assembler = Assembler(model)
        self._textures: dict[int, shading.Texture] = {}

    def depth(self, data: mujoco.MjData) -> np.ndarray:
        """Metres along the optical axis, (h, w) float32; infinite where there is nothing."""
        view = self._view(data)
        return np.where(view.owner >= 0, view.raster.depth(view.buffer), np.float32(np.inf))

    def segmentation(self, data: mujoco.MjData) -> np.ndarray:
        """The id of the geom that is seen, (h, w) int32; -1 where there is none."""
        view = self._view(data)
        return np.array([*_ids(view.geoms), -1], np.int32)[view.owner]

    def outlines(self, data: mujoco.MjData, groups: Sequence[np.ndarray]) -> list[int]:
        """How many pixels groups of geoms would cover if nothing hid them and the image had no edges.

        Args:
            data: The scene.
            groups: Ids of each group's geoms. They must be in front of the camera and no planes.
        """
        geoms, raster, mesh = self._load_scene(data)
        ids = np.array(_ids(geoms))[mesh.owner[mesh.triangles[:, 0]]]
        return [raster.outline_area(mesh.triangles[np.isin(ids, group)]) for group in groups]

    def rgb(self, data: mujoco.MjData) -> np.ndarray:
        """The image, RGB uint8 (h, w, 3)."""
        view = self._view(data)
        points = view.raster.points(view.raster.depth(view.buffer))
        lights = shading.lights(self._scene)
        surfaces = _surfaces(view, points, 0 if lights else AMBIENT_ONLY)
        image = _draw(view, surfaces, [light for light in lights if not light.shadow], glowing=True)
        for light in lights:
            if light.shadow:
                lit = _draw(view, surfaces, [light], glowing=False)
                _cast_shadows(view, points, light, lit)
                image += lit
        self._apply_textures(view, points, image)
        return cv2.convertScaleAbs(image, alpha=255)

    def _load_scene(self, data: mujoco.MjData) -> tuple[list[mujoco.MjvGeom], Raster, Mesh]:
        """What there is to draw, loaded into a raster."""
        categories = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self.model, data, self._option, None, self._viewer, categories, self._scene)
        geoms = list(self._scene.geoms[: self._scene.ngeom])
        near, far = (z * self.model.stat.extent for z in (self.model.vis.map.znear, self.model.vis.map.zfar))
        raster = Raster(Camera.from_mujoco(self.model, self.camera, self.width, self.height, data), near, far)
        mesh = self._assembler.mesh(geoms)
        raster.load(mesh.vertices, mesh.triangles)
        return geoms, raster, mesh

    def _view(self, data: mujoco.MjData) -> _View:
        """Everything about the image but its colors."""
        geoms, raster, mesh = self._load_scene(data)
        planes = np.ones(raster.shape, np.float32)
        behind = np.full(raster.shape, -1, np.int32)
        for g, geom in enumerate(geoms):
            if geom.type == PLANE:
                buffer = raster.plane_buffer(geom)
                behind[buffer < planes] = g
                planes = np.minimum(planes, buffer)
        buffer = planes.copy()
        front = np.full((*raster.shape, 3), -1, np.float32)
        raster.draw(np.repeat(mesh.owner[:, None], 3, 1), front, buffer, flat=True)
        owner = front[..., 0].astype(np.int32)
        return _View(geoms, mesh, raster, planes, np.where(owner < 0, behind, owner), buffer)

    def _apply_textures(self, view: _View, points: np.ndarray, image: np.ndarray) -> None:
        """Multiply an image by the textures of what is seen, and put the sky behind it."""
        counts = np.bincount(view.owner.ravel() + 1, minlength=len(view.geoms) + 1)
        skies = np.flatnonzero(self.model.tex_type == SKY)
        if counts[0] and len(skies):
            crop, sky = _crop(view.owner == -1)
            upright = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], np.float32)
            towards = cv2.transform(points[crop] - view.raster.eye, upright)
            cv2.copyTo(self._load_texture(skies[0]).sample_cube(towards), sky, image[crop])
        for g in np.flatnonzero(counts[1:]):
            geom = view.geoms[g]
            texture_id, repeat, uniform = geom.texid, geom.texrepeat, geom.texuniform
            if texture_id < 0 and geom.matid >= 0:
                texture_id = self.model.mat_texid[geom.matid, COLOR_TEXTURE]
                repeat, uniform = self.model.mat_texrepeat[geom.matid], self.model.mat_texuniform[geom.matid]
            if texture_id < 0 or geom.texcoord:
                continue
            crop, mask = _crop(view.owner == g)
            texture = self._load_texture(texture_id)
            size = np.where(geom.size > 0, geom.size, 1)
            scale = geom.mat.T if texture.cube and uniform else geom.mat.T / size[:, None]
            local = cv2.transform(points[crop], np.c_[scale, -scale @ geom.pos])
            if texture.cube:
                colors = texture.sample_cube(local)
            else:
                u, v, z = (local[..., axis] for axis in range(3))
                side = np.abs(z) < 0.999
                if geom.type == BOX and side.any():
                    u, v = np.where(side & (np.abs(u) > np.abs(v)), v, u), np.where(side, z, v)
                times = (repeat * (size[:2] if uniform else 1)).astype(np.float32) / 2
                colors = texture.sample_2d(times[0] * (1 + u), times[1] * (1 - v))
            cv2.copyTo(cv2.multiply(image[crop], colors), mask, image[crop])

    def _load_texture(self, texture: int) -> shading.Texture:
        if texture not in self._textures:
            self._textures[texture] = shading.Texture(self.model, texture)
        return self._textures[texture]


def _ids(geoms: list[mujoco.MjvGeom]) -> list[int]:
    return [geom.objid if geom.objtype == GEOM else -1 for geom in geoms]


def _crop(mask: np.ndarray) -> tuple[tuple[slice, slice], np.ndarray]:
    """The rectangle that a mask (h, w) takes, and the mask in it, (h', w') uint8."""
    left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
    crop = np.s_[top : top + height, left : left + width]
    return crop, mask.view(np.uint8)[crop]


def _surfaces(view: _View, points: np.ndarray, everywhere: float) -> list[tuple[np.ndarray | None, shading.Surface]]:
    """What is to be lit: the vertices of the mesh, then the pixels (a mask of the image) that show a plane."""
    rgb = np.array([geom.rgba[:3] for geom in view.geoms], np.float32).reshape(-1, 3)
    gloss = np.array([(geom.specular, geom.shininess) for geom in view.geoms], np.float32).reshape(-1, 2)
    glow = np.array([[geom.emission + everywhere] for geom in view.geoms], np.float32).reshape(-1, 1) * rgb
    mesh, owner = view.mesh, view.mesh.owner
    surfaces: list[tuple[np.ndarray | None, shading.Surface]] = [
        (None, shading.Surface(mesh.vertices, mesh.normals, rgb[owner], gloss[owner], glow[owner]))
    ]
    for g, geom in enumerate(view.geoms):
        if geom.type == PLANE and (mask := view.owner == g).any():
            inside = points[mask]
            alike = (np.broadcast_to(a, (len(inside), len(a))) for a in (geom.mat[:, 2], rgb[g], gloss[g], glow[g]))
            surfaces.append((mask, shading.Surface(inside, *alike)))
    return surfaces


def _draw(
    view: _View,
    surfaces: list[tuple[np.ndarray | None, shading.Surface]],
    lights: list[shading.Light],
    glowing: bool,
) -> np.ndarray:
    """An image (h, w, 3) float32, without textures, in some of the lights, and in the surfaces' own if `glowing`."""
    image = np.zeros((*view.raster.shape, 3), np.float32)
    for mask, surface in surfaces:
        colors = surface.glow if glowing else np.zeros_like(surface.glow)
        for light in lights:
            colors = colors + shading.illuminate(surface, light, view.raster.eye)
        colors = np.minimum(colors, 1)
        if mask is None:
            view.raster.draw(colors, image, view.planes.copy())
        else:
            image[mask] = colors
    return image


def _cast_shadows(view: _View, points: np.ndarray, light: shading.Light, image: np.ndarray) -> None:
    """Make an image in one light black where the light does not come."""
    large = np.array([geom.type == BOX and geom.size.max() > TABLE_SIZE for geom in view.geoms], bool)
    large = large[view.mesh.owner[view.mesh.triangles[:, 0]]]
    plane = np.array([geom.type == PLANE for geom in view.geoms] + [False])[view.owner]
    for which, receiver, size in ((~large, view.owner >= 0, 512), (large, plane, 256)):
        if which.any() and receiver.any():
            crop, _ = _crop(receiver)
            shadow = shading.ShadowMap(light, view.mesh.vertices, view.mesh.triangles[which], size)
            image[crop] = cv2.copyTo(image[crop], shadow.reaches(points[crop]).view(np.uint8))
