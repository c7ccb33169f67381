"""`SoftwareRenderer`: pictures of a MuJoCo scene with nothing but NumPy and OpenCV's triangle rasteriser.

It draws MuJoCo's own abstract scene (`mjvScene`) as MuJoCo's OpenGL renderer does: lit at the vertices, interpolated
between them, multiplied by the texture, shadow by shadow. What it leaves out: smoothed edges (draw more pixels and
shrink the picture), reflections, haze, planes seen from behind, and a mesh's own texture coordinates; what is half
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
from arm5dof.vision.rendering.meshes import BOX, PLANE, Assembler, Solid, capacity
from arm5dof.vision.rendering.raster import Raster

GEOM = int(mujoco.mjtObj.mjOBJ_GEOM)
COLOUR_TEXTURE = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
SKY = mujoco.mjtTexture.mjTEXTURE_SKYBOX
NO_LIGHT = 0.3
"""The light that is everywhere in a scene without any."""
FURNITURE = 0.3
"""Half width, in metres, of boxes whose shadows fall on planes alone: tables. They would blur those of all else."""


class _View(NamedTuple):
    """What the camera sees where."""

    geoms: list[mujoco.MjvGeom]
    solid: Solid
    raster: Raster
    planes: np.ndarray
    """A depth buffer with the planes alone, (h, w)."""
    owner: np.ndarray
    """Which of the geoms is seen in a pixel, (h, w) int32; -1 for none."""
    buffer: np.ndarray
    """The depth buffer, (h, w)."""


class SoftwareRenderer:
    """A camera of a MuJoCo model, drawn by the CPU. `data` must have been through `mj_forward`."""

    def __init__(self, model: mujoco.MjModel, camera: str, width: int, height: int) -> None:
        self.model, self.camera, self.width, self.height = model, camera, width, height
        self._scene = mujoco.MjvScene(model, maxgeom=capacity(model))
        self._option, self._viewer = mujoco.MjvOption(), mujoco.MjvCamera()
        self._viewer.type, self._viewer.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, model.camera(camera).id
        self._assembler = Assembler(model)
        self._textures: dict[int, shading.Texture] = {}

    def depth(self, data: mujoco.MjData) -> np.ndarray:
        """Metres along the optical axis, (h, w) float32; infinite where there is nothing."""
        view = self._see(data)
        return np.where(view.owner >= 0, view.raster.depth(view.buffer), np.float32(np.inf))

    def segmentation(self, data: mujoco.MjData) -> np.ndarray:
        """The id of the geom that is seen, (h, w) int32; -1 where there is none."""
        view = self._see(data)
        return np.array([*_ids(view.geoms), -1], np.int32)[view.owner]

    def outlines(self, data: mujoco.MjData, groups: Sequence[np.ndarray]) -> list[int]:
        """How many pixels each group of geoms, given by their ids, would cover if nothing hid them and the picture
        had no edges. They must be in front of the camera and no planes."""
        geoms, raster, solid = self._look(data)
        ids = np.array(_ids(geoms))[solid.owner[solid.triangles[:, 0]]]
        return [raster.outline(solid.triangles[np.isin(ids, group)]) for group in groups]

    def rgb(self, data: mujoco.MjData) -> np.ndarray:
        """The picture, (h, w, 3) uint8."""
        view = self._see(data)
        points = view.raster.points(view.raster.depth(view.buffer))
        lights = shading.lights(self._scene)
        surfaces = _surfaces(view, points, 0 if lights else NO_LIGHT)
        picture = _draw(view, surfaces, [light for light in lights if not light.shadow], glowing=True)
        for light in lights:
            if light.shadow:
                lit = _draw(view, surfaces, [light], glowing=False)
                _shade(view, points, light, lit)
                picture += lit
        self._texture(view, points, picture)
        return cv2.convertScaleAbs(picture, alpha=255)

    def _look(self, data: mujoco.MjData) -> tuple[list[mujoco.MjvGeom], Raster, Solid]:
        """What there is to draw, loaded into a raster."""
        every = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self.model, data, self._option, None, self._viewer, every, self._scene)
        geoms = list(self._scene.geoms[: self._scene.ngeom])
        near, far = (z * self.model.stat.extent for z in (self.model.vis.map.znear, self.model.vis.map.zfar))
        raster = Raster(Camera.from_mujoco(self.model, self.camera, self.width, self.height, data), near, far)
        solid = self._assembler.solid(geoms)
        raster.load(solid.vertices, solid.triangles)
        return geoms, raster, solid

    def _see(self, data: mujoco.MjData) -> _View:
        """Everything about the picture but its colours."""
        geoms, raster, solid = self._look(data)
        planes = np.ones(raster.shape, np.float32)
        behind = np.full(raster.shape, -1, np.int32)
        for g, geom in enumerate(geoms):
            if geom.type == PLANE:
                buffer = raster.meet(geom)
                behind[buffer < planes] = g
                planes = np.minimum(planes, buffer)
        buffer = planes.copy()
        front = np.full((*raster.shape, 3), -1, np.float32)
        raster.draw(np.repeat(solid.owner[:, None], 3, 1), front, buffer, flat=True)
        owner = front[..., 0].astype(np.int32)
        return _View(geoms, solid, raster, planes, np.where(owner < 0, behind, owner), buffer)

    def _texture(self, view: _View, points: np.ndarray, picture: np.ndarray) -> None:
        """Multiply a picture by the textures of what is seen, and put the sky behind it."""
        counts = np.bincount(view.owner.ravel() + 1, minlength=len(view.geoms) + 1)
        skies = np.flatnonzero(self.model.tex_type == SKY)
        if counts[0] and len(skies):
            crop, sky = _crop(view.owner == -1)
            upright = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], np.float32)
            towards = cv2.transform(points[crop] - view.raster.eye, upright)
            cv2.copyTo(self._load(skies[0]).around(towards), sky, picture[crop])
        for g in np.flatnonzero(counts[1:]):
            geom = view.geoms[g]
            texture, repeat, uniform = geom.texid, geom.texrepeat, geom.texuniform
            if texture < 0 and geom.matid >= 0:
                texture = self.model.mat_texid[geom.matid, COLOUR_TEXTURE]
                repeat, uniform = self.model.mat_texrepeat[geom.matid], self.model.mat_texuniform[geom.matid]
            if texture < 0 or geom.texcoord:
                continue
            crop, mask = _crop(view.owner == g)
            image = self._load(texture)
            size = np.where(geom.size > 0, geom.size, 1)
            scale = geom.mat.T if image.cube and uniform else geom.mat.T / size[:, None]
            local = cv2.transform(points[crop], np.c_[scale, -scale @ geom.pos])
            if image.cube:
                colours = image.around(local)
            else:
                u, v, z = (local[..., axis] for axis in range(3))
                side = np.abs(z) < 0.999
                if geom.type == BOX and side.any():
                    u, v = np.where(side & (np.abs(u) > np.abs(v)), v, u), np.where(side, z, v)
                times = (repeat * (size[:2] if uniform else 1)).astype(np.float32) / 2
                colours = image.flat(times[0] * (1 + u), times[1] * (1 - v))
            cv2.copyTo(cv2.multiply(picture[crop], colours), mask, picture[crop])

    def _load(self, texture: int) -> shading.Texture:
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
    """What is to be lit: the vertices of the solid, then the pixels (a mask of the picture) that show a plane."""
    rgb = np.array([geom.rgba[:3] for geom in view.geoms], np.float32).reshape(-1, 3)
    gloss = np.array([(geom.specular, geom.shininess) for geom in view.geoms], np.float32).reshape(-1, 2)
    glow = np.array([[geom.emission + everywhere] for geom in view.geoms], np.float32).reshape(-1, 1) * rgb
    solid, owner = view.solid, view.solid.owner
    found: list[tuple[np.ndarray | None, shading.Surface]] = [
        (None, shading.Surface(solid.vertices, solid.normals, rgb[owner], gloss[owner], glow[owner]))
    ]
    for g, geom in enumerate(view.geoms):
        if geom.type == PLANE and (mask := view.owner == g).any():
            inside = points[mask]
            alike = (np.broadcast_to(a, (len(inside), len(a))) for a in (geom.mat[:, 2], rgb[g], gloss[g], glow[g]))
            found.append((mask, shading.Surface(inside, *alike)))
    return found


def _draw(
    view: _View,
    surfaces: list[tuple[np.ndarray | None, shading.Surface]],
    lights: list[shading.Light],
    glowing: bool,
) -> np.ndarray:
    """A picture (h, w, 3) float32, without textures, in some of the lights, and in the surfaces' own if `glowing`."""
    picture = np.zeros((*view.raster.shape, 3), np.float32)
    for mask, surface in surfaces:
        colours = surface.glow if glowing else np.zeros_like(surface.glow)
        for light in lights:
            colours = colours + shading.lit(surface, light, view.raster.eye)
        colours = np.minimum(colours, 1)
        if mask is None:
            view.raster.draw(colours, picture, view.planes.copy())
        else:
            picture[mask] = colours
    return picture


def _shade(view: _View, points: np.ndarray, light: shading.Light, picture: np.ndarray) -> None:
    """Make a picture in one light black where the light does not come."""
    large = np.array([geom.type == BOX and geom.size.max() > FURNITURE for geom in view.geoms], bool)
    large = large[view.solid.owner[view.solid.triangles[:, 0]]]
    plane = np.array([geom.type == PLANE for geom in view.geoms] + [False])[view.owner]
    for which, receiver, size in ((~large, view.owner >= 0, 512), (large, plane, 256)):
        if which.any() and receiver.any():
            crop, _ = _crop(receiver)
            shadow = shading.ShadowMap(light, view.solid.vertices, view.solid.triangles[which], size)
            picture[crop] = cv2.copyTo(picture[crop], shadow.reaches(points[crop]).view(np.uint8))
