"""Light, shadow and texture as MuJoCo's OpenGL renderer has them, for points held in NumPy arrays.

Lighting is OpenGL's fixed-function one (specification of OpenGL 2.1, section 2.14) with a local viewer; vectors are in
the world frame, colors RGB in [0, 1], everything float32.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import mujoco
import numpy as np

SPOT, DIRECTIONAL = int(mujoco.mjtLightType.mjLIGHT_SPOT), int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)

SHININESS = 128.0
"""OpenGL's exponent of a material whose shininess is 1."""
SHADOW_BIAS = 0.0015
"""A surface is in shadow where something is nearer to the light by more than so many metres."""
SHADOW_NEAR = 0.01
"""Nothing nearer to a lamp, in metres, casts a shadow, nor anything behind it."""
SUN_DISTANCE = 30.0
"""Metres from which a directional light casts its shadows."""


class Surface(NamedTuple):
    """Points, and what they are made of."""

    points: np.ndarray
    """(n, 3), metres."""
    normals: np.ndarray
    """Unit vectors (n, 3)."""
    rgb: np.ndarray
    """(n, 3)."""
    gloss: np.ndarray
    """Specular reflection and shininess (n, 2)."""
    glow: np.ndarray
    """The color that it has without any light, (n, 3)."""


class Light(NamedTuple):
    """A light of an `mjvScene`, by the names that MuJoCo gives its properties."""

    position: np.ndarray
    direction: np.ndarray
    directional: bool
    ambient: np.ndarray
    diffuse: np.ndarray
    specular: np.ndarray
    attenuation: np.ndarray
    cutoff: float
    exponent: float
    shadow: bool


def lights(scene: mujoco.MjvScene) -> list[Light]:
    """The scene's spots and directional lights; others MuJoCo's OpenGL renderer does not show either."""
    return [
        Light(
            np.array(light.pos, np.float32),
            np.array(light.dir, np.float32),
            light.type == DIRECTIONAL,
            np.array(light.ambient, np.float32),
            np.array(light.diffuse, np.float32),
            np.array(light.specular, np.float32),
            np.array(light.attenuation, np.float32),
            float(light.cutoff),
            float(light.exponent),
            bool(light.castshadow),
        )
        for light in scene.lights[: scene.nlight]
        if light.type in (SPOT, DIRECTIONAL)
    ]


def illuminate(surface: Surface, light: Light, eye: np.ndarray) -> np.ndarray:
    """The light that a surface reflects to an eye.

    Args:
        surface: n points of it.
        light: Where it comes from.
        eye: (3,), metres.

    Returns:
        RGB (n, 3) float32 in [0, 1].
    """
    if light.directional:
        towards: np.ndarray = -light.direction[None]
        strength: np.ndarray = np.ones((1, 1), np.float32)
    else:
        away = light.position - surface.points
        distance = np.sqrt(np.einsum("ij,ij->i", away, away))[:, None]
        towards = away / np.maximum(distance, 1e-6)
        constant, linear, quadratic = light.attenuation
        strength = 1 / (constant + distance * (linear + distance * quadratic))
        if light.cutoff < 180:
            cosine = -(towards @ light.direction)[:, None]
            inside = cosine >= np.cos(np.deg2rad(light.cutoff))
            strength = strength * np.where(inside, np.maximum(cosine, 0) ** light.exponent, 0)
    incidence = np.maximum(np.einsum("ij,ij->i", surface.normals, np.broadcast_to(towards, surface.normals.shape)), 0)
    color = surface.rgb * (light.ambient + incidence[:, None] * light.diffuse)
    if light.specular.any():
        half = eye - surface.points
        half /= np.maximum(np.sqrt(np.einsum("ij,ij->i", half, half))[:, None], 1e-6)
        half += towards
        cosine = np.einsum("ij,ij->i", surface.normals, half) / np.sqrt(np.einsum("ij,ij->i", half, half) + 1e-12)
        shine = np.where(incidence > 0, np.maximum(cosine, 0) ** (SHININESS * surface.gloss[:, 1]), 0)
        color += (surface.gloss[:, 0] * shine)[:, None] * light.specular
    return np.clip(color * strength, 0, 1).astype(np.float32)


class Texture:
    """A texture of the model as a mipmap: each level is half as wide as the one before.

    Args:
        model: The model.
        texture: The texture's id.
    """

    def __init__(self, model: mujoco.MjModel, texture: int) -> None:
        width, height = model.tex_width[texture], model.tex_height[texture]
        channels, first = model.tex_nchannel[texture], model.tex_adr[texture]
        data = model.tex_data[first : first + width * height * channels].reshape(height, width, channels)[..., :3]
        self.cube = model.tex_type[texture] != mujoco.mjtTexture.mjTEXTURE_2D
        if self.cube and width == height:
            data = np.tile(data, (6, 1, 1))
        self.levels = [data.astype(np.float32) / 255]

    def sample_2d(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Colors (h, w, 3) in [0, 1] of a two-dimensional texture, repeated for ever, at coordinates (h, w)."""
        height, width = self.levels[0].shape[:2]
        image = self._level(_spacing(u * width, v * height))
        height, width = image.shape[:2]
        u, v = (u - np.floor(u.min())) * width - 0.5, (v - np.floor(v.min())) * height - 0.5
        return cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)

    def sample_cube(self, direction: np.ndarray) -> np.ndarray:
        """Colors (h, w, 3) in [0, 1] of a cube texture in directions (h, w, 3), as OpenGL numbers the cube's sides."""
        size = np.abs(direction)
        axis = size.argmax(-1)
        major = np.take_along_axis(direction, axis[..., None], -1)[..., 0]
        x, y, z = np.moveaxis(direction, -1, 0)
        back = major < 0
        s = np.choose(axis, [np.where(back, z, -z), x, np.where(back, -x, x)])
        t = np.choose(axis, [-y, np.where(back, -z, z), -y])
        major = np.maximum(np.abs(major), 1e-9)
        s, t = (s / major + 1) / 2, (t / major + 1) / 2
        image = self._level(_spacing(s, t) * self.levels[0].shape[1])
        width = image.shape[1]
        u, v = (np.clip(a * width - 0.5, 0, width - 1).astype(np.float32) for a in (s, t))
        v += (width * (2 * axis + back)).astype(np.float32)
        return cv2.remap(image, u, v, cv2.INTER_LINEAR)

    def _level(self, texels: float) -> np.ndarray:
        """The level where neighbouring pixels lie nearest to one texel apart, if they do `texels` in the first."""
        level = int(np.clip(np.round(np.log2(max(texels, 1))), 0, 12))
        while level >= len(self.levels) and min(self.levels[-1].shape[:2]) > (6 if self.cube else 1):
            height, width = self.levels[-1].shape[:2]
            half = (max(width // 2, 1), max(height // 2, 1))
            self.levels.append(cv2.resize(self.levels[-1], half, interpolation=cv2.INTER_AREA))
        return self.levels[min(level, len(self.levels) - 1)]


def _spacing(u: np.ndarray, v: np.ndarray) -> float:
    """How far apart neighbouring pixels lie in coordinates (h, w): the median, so that jumps do not count."""
    height, width = u.shape
    some = np.s_[: height - 1 : max(1, height // 32), : width - 1 : max(1, width // 32)]
    steps = [np.hypot(*(a[neighbour][some] - a[some] for a in (u, v))) for neighbour in (np.s_[1:], np.s_[:, 1:])]
    return max((float(np.sort(s, axis=None)[s.size // 2]) for s in steps if s.size), default=0.0)


class ShadowMap:
    """What a light sees of whatever casts shadows, from behind: the sides that it does not light.

    Args:
        light: The light.
        vertices: Of all that casts shadows, (n, 3), metres.
        triangles: Indices of vertices (m, 3), counter-clockwise seen from outside.
        size: Width and height of the map, pixels.
    """

    def __init__(self, light: Light, vertices: np.ndarray, triangles: np.ndarray, size: int) -> None:
        z = light.direction.astype(float)
        x = np.cross(z, [0, 1, 0] if abs(z[1]) < 0.9 else [1, 0, 0])
        x /= np.linalg.norm(x)
        self._axes = np.stack([x, np.cross(z, x), z])
        # A directional light is a very distant one: the rasterizer knows perspective alone.
        self._eye = vertices.mean(0) - SUN_DISTANCE * z if light.directional else light.position.astype(float)
        seen = (vertices - self._eye) @ self._axes.T
        triangles = np.ascontiguousarray(triangles[(seen[:, 2] > SHADOW_NEAR)[triangles].all(1)])
        used = np.zeros(len(vertices), bool)
        used[triangles] = True
        corners = seen[used] if used.any() else np.array([[0.0, 0.0, 1.0]])
        plane = corners[:, :2] / corners[:, 2:]
        self._center = (plane.max(0) + plane.min(0)) / 2
        self._half = max(float(np.ptp(plane, axis=0).max()) / 2, 1e-6) * 1.02
        near, far = float(corners[:, 2].min()) * 0.99, float(corners[:, 2].max()) * 1.01
        self._inverse = np.array([1 / near, 1 / near - 1 / far])
        seen[:, :2] -= self._center * seen[:, 2:]
        self._size = size
        self._map = np.ones((self._size, self._size), np.float32)
        settings = cv2.TriangleRasterizeSettings()
        settings.setCullingMode(cv2.RASTERIZE_CULLING_CCW)
        settings.setGlCompatibleMode(cv2.RASTERIZE_COMPAT_INVDEPTH)
        seen = (seen * [1, -1, -1]).astype(np.float32)
        field = 2 * np.arctan(self._half)
        cv2.triangleRasterizeDepth(seen, triangles, self._map, np.eye(4), field, near, far, settings)

    def reaches(self, points: np.ndarray) -> np.ndarray:
        """Whether the light reaches points (h, w, 3): (h, w) bool."""
        transform = np.c_[self._axes, -self._axes @ self._eye]
        transform[:2] -= self._center[:, None] * transform[2]
        transform[:2] *= self._size / 2 / self._half
        x, y, depth = cv2.split(cv2.transform(points, transform))
        middle = (self._size - 1) / 2
        u, v = (np.asarray(a / depth + middle, np.float32) for a in (x, y))
        # What a depth buffer would hold for something nearer to the light by `SHADOW_BIAS`; it holds 1 for nothing.
        threshold = np.minimum((self._inverse[0] - 1 / np.maximum(depth - SHADOW_BIAS, 1e-6)) / self._inverse[1], 1)
        outside = cv2.BORDER_CONSTANT
        return cv2.remap(self._map, u, v, cv2.INTER_NEAREST, borderMode=outside, borderValue=1.0) >= threshold
