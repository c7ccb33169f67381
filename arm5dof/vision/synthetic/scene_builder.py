"""What a scene is made of besides the arm: a table in a room, what lies on it, lamps, and where the cameras stand."""

from __future__ import annotations

import mujoco
import numpy as np

from arm5dof.vision.objects import ALONG_X, BOX, CYLINDER, Part
from arm5dof.vision.synthetic import textures

CAMERA, SECOND = "camera", "second camera"
TEXTURE_SIZE = 128
"""Width and height of a texture, pixels."""


class SceneBuilder:
    """Adds to a spec, at random. What is on a texture is filled in after compiling, which is quicker.

    Args:
        spec: What it adds to; also its attribute.
        rng: The generator that everything comes from.
        family: The textures to choose from.
    """

    def __init__(self, spec: mujoco.MjSpec, rng: np.random.Generator, family: textures.Family) -> None:
        self.rng = rng
        self.spec, self._family = spec, family
        self._images: dict[str, np.ndarray] = {}
        self._count = 0

    def compile(self) -> mujoco.MjModel:
        """The model, with everything that was added."""
        model = self.spec.compile()
        for name, image in self._images.items():
            first = model.tex_adr[model.texture(name).id]
            model.tex_data[first : first + image.size] = image.ravel()
        return model

    def paint_arm(self) -> None:
        """Sometimes give the arm other colors."""
        for material in self.spec.materials:
            if self.rng.random() < 0.3:
                material.rgba = [*textures.random_color(self.rng), 1]
            material.specular, material.shininess = self.rng.uniform(0, 0.6), self.rng.uniform(0.1, 0.9)

    def room(self) -> None:
        """Add a table and the floor that it stands on."""
        u = self.rng.uniform
        half = (u(0.35, 0.8), u(0.35, 0.8), 0.015)
        table = self._material(self._surface(), repeat=u(1, 8))
        self._add(self.spec.worldbody, Part(BOX, half, (u(-0.05, 0.2), u(-0.1, 0.1), -half[2])), table)
        floor, below = self._material(self._surface(), repeat=u(0.5, 4)), u(0.4, 0.9)
        plane = mujoco.mjtGeom.mjGEOM_PLANE
        place = {"size": [6, 6, 0.1], "pos": [0, 0, -below]}
        self.spec.worldbody.add_geom(type=plane, material=floor, contype=0, conaffinity=0, **place)

    def paper(self) -> None:
        """Add up to four pieces of paper lying flat, printed or of one color."""
        u = self.rng.uniform
        for layer in range(self.rng.integers(0, 5)):
            thickness = 0.0002 * (layer + 1)
            square, printed, round_ = u(size=3) < (0.3, 0.6, 0.2)
            half = np.repeat(u(0.01, 0.03), 2) if square else u(0.008, 0.08, 2)
            if printed:
                material = self._material(self._family.papers[self.rng.integers(len(self._family.papers))])
            else:
                material = self._material(None, textures.random_color(self.rng))
            part = Part(CYLINDER, (half[0], thickness)) if round_ and not printed else Part(BOX, (*half, thickness))
            self.body(np.array([*u([-0.2, -0.35], [0.35, 0.35]), 0.0]), u(-np.pi, np.pi), (part,), material)

    def paint(self, hue: float | None) -> str:
        """Add a material of a hue in degrees, or of any color: mostly plain, sometimes with a faint texture.

        Returns:
            Its name.
        """
        color = textures.random_color(self.rng, hue, vivid=0.0 if hue is None else 0.6)
        if self.rng.random() < 0.75:
            return self._material(None, color)
        return self._material(lambda rng, size: 255 - (255 - self._surface()(rng, size)) // 4, color, cube=True)

    def body(self, position: np.ndarray, yaw: float, parts: tuple[Part, ...], material: str, name: str = "") -> None:
        """Add parts of one material, at a position (3,), metres, and a yaw, radians, in the base frame."""
        body = self.spec.worldbody.add_body(name=name, pos=position, quat=[np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
        for part in parts:
            self._add(body, part, material)

    def lamps(self, distant: bool) -> None:
        """Add one to three lamps of nearly white light above the table, or the tinted light of one or two distant
        windows."""
        u = self.rng.uniform
        head = self.spec.visual.headlight
        head.ambient, head.diffuse, head.specular = (
            np.repeat(u(*range_), 3) for range_ in ((0.2, 0.4), (0, 0.35), (0, 0.2))
        )
        count = self.rng.integers(1, 3 if distant else 4)
        for lamp in range(count):
            up = _direction(u(-np.pi, np.pi), np.deg2rad(u(30, 80)))
            aim = np.array([*u(-0.1, 0.25, 2), 0.0])
            light = self.spec.worldbody.add_light(pos=aim + u(0.8, 1.6) * up, dir=-up)
            tint = np.clip(1 + self.rng.normal(0, 0.12 if distant else 0.05, 3), 0.5, 1.5)
            light.diffuse, light.specular = tint * u(0.4, 0.9) / np.sqrt(count), np.repeat(u(0, 0.5), 3)
            light.castshadow = bool(u() < (0.9 if lamp == 0 else 0.3))
            light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL if distant else mujoco.mjtLightType.mjLIGHT_SPOT
            light.cutoff, light.exponent = u(40, 70), u(0, 10)

    def camera(self, name: str, scale: float = 1.0) -> None:
        """Add a camera 0.6 to 0.9 m away, from overhead to 35 degrees above the table, where the arm works.

        Args:
            name: Its name.
            scale: By how much the arm's work is larger: so much further away it stands.
        """
        u = self.rng.uniform
        azimuth, elevation = u(-1.9, 1.9), np.arcsin(u(np.sin(np.deg2rad(35)), 1))
        back, right = _direction(azimuth, elevation), np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        up, roll = np.cross(back, right), self.rng.normal(0, 0.05)
        x, y = np.cos(roll) * right + np.sin(roll) * up, np.cos(roll) * up - np.sin(roll) * right
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, np.stack([x, y, back], 1).ravel())
        position = scale * (np.array([0.12, 0.0, 0.01]) + self.rng.normal(0, 0.02, 3) + u(0.6, 0.9) * back)
        self.spec.worldbody.add_camera(name=name, pos=position, quat=quaternion, fovy=u(32, 42))

    def _add(self, body: mujoco.MjsBody, part: Part, material: str) -> None:
        size, place = [*part.size, *[0.0] * (3 - len(part.size))], {"pos": part.position, "quat": part.quaternion}
        body.add_geom(type=part.kind, size=size, material=material, contype=0, conaffinity=0, **place)

    def _material(
        self, texture: textures.Texture | None, color: np.ndarray | None = None, repeat: float = 1, cube: bool = False
    ) -> str:
        """The name of a new material with a texture, a color, or both."""
        self._count += 1
        name = f"material {self._count}"
        material = self.spec.add_material(name=name)
        material.rgba = [*(np.ones(3) if color is None else color), 1]
        material.specular, material.shininess = self.rng.uniform(0, 0.5), self.rng.uniform(0.1, 0.9)
        if texture is not None:
            self._images[name] = np.tile(texture(self.rng, TEXTURE_SIZE), (6 if cube else 1, 1, 1))
            kind = mujoco.mjtTexture.mjTEXTURE_CUBE if cube else mujoco.mjtTexture.mjTEXTURE_2D
            added = self.spec.add_texture(name=name, type=kind, width=TEXTURE_SIZE, height=TEXTURE_SIZE, nchannel=3)
            added.builtin = mujoco.mjtBuiltin.mjBUILTIN_FLAT
            roles = [""] * int(mujoco.mjtTextureRole.mjNTEXROLE)
            roles[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = name
            material.textures, material.texrepeat = roles, [repeat, repeat]
        return name

    def _surface(self) -> textures.Texture:
        return self._family.surfaces[self.rng.integers(len(self._family.surfaces))]


def distractor(rng: np.random.Generator) -> tuple[tuple[Part, ...], float, float, float | None]:
    """Something that is not in the catalogue and that no object in it looks like from further away.

    Returns:
        Its parts, half height and radius in metres, and hue in degrees, None for any.
    """
    u = rng.uniform
    match rng.integers(8):
        case 0:  # A cube, neither red nor blue.
            return (Part(BOX, (0.0125, 0.0125, 0.0125)),), 0.0125, 0.0177, u(60, 150)
        case 1:  # A book.
            x, y, z = u(0.04, 0.06), u(0.03, 0.05), u(0.006, 0.012)
            return (Part(BOX, (x, y, z)),), z, np.hypot(x, y), None
        case 2:  # A carton.
            x, z = u(0.025, 0.035), u(0.045, 0.06)
            return (Part(BOX, (x, x, z)),), z, x * np.sqrt(2), None
        case 3:  # A disc.
            radius, z = u(0.018, 0.04), u(0.002, 0.005)
            return (Part(CYLINDER, (radius, z)),), z, radius, None
        case 4:  # A beaker.
            radius, z = u(0.03, 0.045), u(0.03, 0.06)
            return (Part(CYLINDER, (radius, z)),), z, radius, None
        case 5:  # A pen.
            radius, half = u(0.004, 0.007), u(0.05, 0.08)
            pen = Part(mujoco.mjtGeom.mjGEOM_CAPSULE, (radius, half), quaternion=ALONG_X)
            return (pen,), radius, half + radius, None
        case 6:  # An egg.
            x, y = u(0.026, 0.04), u(0.012, 0.017)
            return (Part(mujoco.mjtGeom.mjGEOM_ELLIPSOID, (x, y, y)),), y, x, None
        case _:  # An L.
            arm, width, z = u(0.02, 0.035), u(0.005, 0.008), u(0.006, 0.012)
            foot = Part(BOX, (width, arm, z), (arm - width, arm - width, 0.0))
            return (Part(BOX, (arm, width, z)), foot), z, 2 * arm, None


def _direction(azimuth: float, elevation: float) -> np.ndarray:
    """A unit vector (3,)."""
    return np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
