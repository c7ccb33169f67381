"""What a scene is made of besides the things to find: the room, what lies about, lamps, and where the camera stands."""

from __future__ import annotations

import mujoco
import numpy as np

from arm5dof.vision import patterns
from arm5dof.vision.catalogue import BOX, CYLINDER, Part

CAMERA = "camera"
TEXTURE = 128
"""Width of a texture, pixels."""


class Builder:
    """Adds geoms, materials and textures to a spec. The pictures are filled in after compiling, which is quicker."""

    def __init__(self, spec: mujoco.MjSpec, rng: np.random.Generator, family: tuple[patterns.Pattern, ...]) -> None:
        self.spec, self.rng, self.family = spec, rng, family
        self.pictures: dict[str, np.ndarray] = {}
        self._count = 0

    def paint_arm(self) -> None:
        """Sometimes the arm has other colours."""
        for material in self.spec.materials:
            if self.rng.random() < 0.3:
                material.rgba = [*patterns.colour(self.rng), 1]
            material.specular, material.shininess = self.rng.uniform(0, 0.6), self.rng.uniform(0.1, 0.9)

    def room(self) -> None:
        """A table and the floor that it stands on."""
        half = (self.rng.uniform(0.35, 0.8), self.rng.uniform(0.35, 0.8), 0.015)
        shift = (self.rng.uniform(-0.05, 0.2), self.rng.uniform(-0.1, 0.1), -half[2])
        table = self.material(self._pattern(), repeat=self.rng.uniform(1, 8))
        self.add(self.spec.worldbody, Part(BOX, half, shift), table)
        floor = self.material(self._pattern(), repeat=self.rng.uniform(0.5, 4))
        self.spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_PLANE, size=[6, 6, 0.1], pos=[0, 0, -self.rng.uniform(0.4, 0.9)], material=floor
        )

    def material(
        self,
        pattern: patterns.Pattern | None,
        colour: np.ndarray | None = None,
        repeat: float = 1.0,
        cube: bool = False,
    ) -> str:
        """A new material with a pattern, a colour, or both."""
        name = self._name("material")
        material = self.spec.add_material(name=name)
        material.rgba = [*(np.ones(3) if colour is None else colour), 1]
        material.specular, material.shininess = self.rng.uniform(0, 0.5), self.rng.uniform(0.1, 0.9)
        if pattern is not None:
            self.pictures[name] = pattern(self.rng, TEXTURE)
            kind = mujoco.mjtTexture.mjTEXTURE_CUBE if cube else mujoco.mjtTexture.mjTEXTURE_2D
            texture = self.spec.add_texture(name=name, type=kind, width=TEXTURE, height=TEXTURE, nchannel=3)
            texture.builtin = mujoco.mjtBuiltin.mjBUILTIN_FLAT
            roles = [""] * int(mujoco.mjtTextureRole.mjNTEXROLE)
            roles[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = name
            material.textures, material.texrepeat = roles, [repeat, repeat]
        return name

    def thing_material(self, hue: float | None) -> str:
        """Mostly of one colour, sometimes with a faint pattern."""
        colour = patterns.colour(self.rng, hue, vivid=0.6 if hue is not None else 0.0)
        if self.rng.random() < 0.75:
            return self.material(None, colour)
        return self.material(lambda rng, size: 255 - (255 - self._pattern()(rng, size)) // 4, colour, cube=True)

    def add(self, body: mujoco.MjsBody, part: Part, material: str) -> str:
        """A geom in a body. Its name."""
        size = [*part.size, *[0.0] * (3 - len(part.size))]
        name = self._name("geom")
        body.add_geom(
            name=name, type=part.kind, size=size, pos=part.position, quat=part.quaternion, material=material,
            contype=0, conaffinity=0,
        )  # fmt: skip
        return name

    def body(self, position: np.ndarray, yaw: float) -> mujoco.MjsBody:
        return self.spec.worldbody.add_body(pos=position, quat=[np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])

    def _pattern(self) -> patterns.Pattern:
        return self.family[self.rng.integers(len(self.family))]

    def _name(self, what: str) -> str:
        self._count += 1
        return f"{what} {self._count}"


def other_shape(rng: np.random.Generator) -> tuple[tuple[Part, ...], float, float]:
    """Parts, half height and radius of something that is not in the catalogue."""
    u = rng.uniform
    shape = rng.integers(7)
    if shape == 0:  # A cube, neither red nor blue.
        return (Part(BOX, (0.0125, 0.0125, 0.0125)),), 0.0125, 0.0177
    if shape == 1:  # A larger box.
        x, y, z = u(0.03, 0.06), u(0.025, 0.05), u(0.01, 0.05)
        return (Part(BOX, (x, y, z)),), z, float(np.hypot(x, y))
    if shape == 2:  # A disc.
        radius, z = u(0.018, 0.04), u(0.002, 0.005)
        return (Part(CYLINDER, (radius, z)),), z, radius
    if shape == 3:  # A beaker.
        radius, z = u(0.028, 0.045), u(0.03, 0.06)
        return (Part(CYLINDER, (radius, z)),), z, radius
    if shape == 4:  # A pen.
        radius, z = u(0.004, 0.007), u(0.05, 0.08)
        return (
            (Part(mujoco.mjtGeom.mjGEOM_CAPSULE, (radius, z), quaternion=(0.5**0.5, 0, 0.5**0.5, 0)),),
            radius,
            z + radius,
        )
    if shape == 5:  # An egg.
        x, y, z = u(0.025, 0.04), u(0.015, 0.022), u(0.01, 0.02)
        return (Part(mujoco.mjtGeom.mjGEOM_ELLIPSOID, (x, y, z)),), z, x
    arm, wide, z = u(0.02, 0.035), u(0.005, 0.008), u(0.006, 0.012)  # An L.
    return (Part(BOX, (arm, wide, z)), Part(BOX, (wide, arm, z), (arm - wide, arm - wide, 0.0))), z, 2 * arm


def lamps(spec: mujoco.MjSpec, rng: np.random.Generator, training: bool) -> None:
    """For training one to three lamps near the table, of nearly white light; for evaluation the tinted light of
    windows far away."""
    spec.visual.headlight.ambient = np.repeat(rng.uniform(0.15, 0.4), 3)
    spec.visual.headlight.diffuse = np.repeat(rng.uniform(0, 0.35), 3)
    spec.visual.headlight.specular = np.repeat(rng.uniform(0, 0.2), 3)
    count = rng.integers(1, 4 if training else 3)
    for lamp in range(count):
        azimuth, elevation = rng.uniform(-np.pi, np.pi), np.deg2rad(rng.uniform(30, 80))
        direction = np.array(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        )
        aim = np.array([*rng.uniform(-0.1, 0.25, 2), 0.0])
        tint = np.clip(1 + rng.normal(0, 0.05 if training else 0.12, 3), 0.5, 1.5)
        light = spec.worldbody.add_light(pos=aim + direction * rng.uniform(0.8, 1.6), dir=-direction)
        light.diffuse = tint * rng.uniform(0.3, 0.9) / np.sqrt(count)
        light.specular = np.repeat(rng.uniform(0, 0.5), 3)
        light.castshadow = bool(rng.random() < (0.9 if lamp == 0 else 0.3))
        if training:
            light.type, light.cutoff, light.exponent = (
                mujoco.mjtLightType.mjLIGHT_SPOT,
                rng.uniform(35, 70),
                rng.uniform(0, 12),
            )
        else:
            light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL


def camera(spec: mujoco.MjSpec, rng: np.random.Generator) -> None:
    """0.6 to 0.9 m away, from overhead to oblique, on the side that the arm works on."""
    aim = np.array([0.12, 0.0, 0.01]) + rng.normal(0, 0.02, 3)
    azimuth, elevation = rng.uniform(-1.9, 1.9), np.arcsin(rng.uniform(np.sin(np.deg2rad(35)), 1))
    back = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    up = np.cross(back, right)
    roll = rng.normal(0, 0.05)
    x, y = np.cos(roll) * right + np.sin(roll) * up, np.cos(roll) * up - np.sin(roll) * right
    placed = spec.worldbody.add_camera(name=CAMERA, pos=aim + rng.uniform(0.6, 0.9) * back, fovy=rng.uniform(32, 42))
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.stack([x, y, back], 1).ravel())
    placed.quat = quaternion
