"""The catalogue of objects on the table: their names, what they are made of, and how high their centers lie.

Every object is point-symmetric about its center, so that the center of its outline is where its center is seen,
whichever way it is turned and wherever the camera stands: a box around it needs no correction. All are 20 to 40 mm wide
where a gripper would take them.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

BOX, SPHERE, CYLINDER = (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CYLINDER)
UPRIGHT, ALONG_X = (1.0, 0.0, 0.0, 0.0), (0.5**0.5, 0.0, 0.5**0.5, 0.0)


@dataclass(frozen=True)
class Part:
    """One geom. The origin is the object's center."""

    kind: mujoco.mjtGeom
    size: tuple[float, ...]
    """As MJCF has it: half sizes or radii, metres."""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Metres."""
    quaternion: tuple[float, float, float, float] = UPRIGHT
    """w, x, y, z."""


@dataclass(frozen=True)
class CatalogueObject:
    """A class of graspable objects."""

    name: str
    parts: tuple[Part, ...]
    half_height: float
    """Height of its center above the table on which it lies, metres."""
    radius: float
    """Of a circle around it as seen from above, metres."""
    hue: float | None = None
    """Degrees, for a class that is told by its color; None for objects of any color."""
    form: str = "block"
    """How its outline changes with height: see `localization.solids.Solid`."""


def _cube(name: str, hue: float) -> CatalogueObject:
    return CatalogueObject(name, (Part(BOX, (0.0125, 0.0125, 0.0125)),), 0.0125, 0.0177, hue)


def _ring(radius: float, thickness: float, half_height: float, sides: int = 12) -> tuple[Part, ...]:
    """A regular polygon with a hole: `radius` from the center to the middle of a side, metres."""
    middle = radius - thickness / 2
    half_side = radius * np.tan(np.pi / sides)
    angles = 2 * np.pi * np.arange(sides) / sides
    return tuple(
        Part(
            BOX,
            (thickness / 2, float(half_side), half_height),
            (float(middle * np.cos(a)), float(middle * np.sin(a)), 0.0),
            (float(np.cos(a / 2)), 0.0, 0.0, float(np.sin(a / 2))),
        )
        for a in angles
    )


CATALOGUE = (
    _cube("red cube", 0.0),
    _cube("blue cube", 220.0),
    CatalogueObject("ball", (Part(SPHERE, (0.015,)),), 0.015, 0.015, form="ball"),
    CatalogueObject("can", (Part(CYLINDER, (0.0125, 0.02)),), 0.02, 0.0125),
    CatalogueObject("brick", (Part(BOX, (0.02, 0.01, 0.01)),), 0.01, 0.0224),
    CatalogueObject("ring", _ring(0.02, 0.01, 0.008), 0.008, 0.0207),
    CatalogueObject("cross", (Part(BOX, (0.02, 0.007, 0.01)), Part(BOX, (0.007, 0.02, 0.01))), 0.01, 0.0212),
    CatalogueObject(
        "dumbbell",
        (
            Part(CYLINDER, (0.005, 0.016), quaternion=ALONG_X),
            Part(SPHERE, (0.011,), (0.017, 0.0, 0.0)),
            Part(SPHERE, (0.011,), (-0.017, 0.0, 0.0)),
        ),
        0.011,
        0.028,
        form="ball",
    ),
)
"""A detection's class id is an index into it."""

CLASS_NAMES = tuple(one.name for one in CATALOGUE)
