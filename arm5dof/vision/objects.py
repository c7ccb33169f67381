"""The things on the table: what they are called, what they are made of, and how high their middles lie.

Every thing is symmetric about its middle, so that the middle of its outline is where its middle is seen, whichever way
it is turned and wherever the camera stands: a box round it needs no correction. All are 20 to 40 mm wide where a
gripper would take them.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

BOX, SPHERE, CYLINDER = (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CYLINDER)
UPRIGHT, ALONG_X = (1.0, 0.0, 0.0, 0.0), (0.5**0.5, 0.0, 0.5**0.5, 0.0)


@dataclass(frozen=True)
class Part:
    """One geom, in metres, where the thing's middle is the origin."""

    kind: mujoco.mjtGeom
    size: tuple[float, ...]
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] = UPRIGHT


@dataclass(frozen=True)
class Thing:
    """A class of graspable things."""

    name: str
    parts: tuple[Part, ...]
    half_height: float
    """Of its middle above the table when it lies there, metres."""
    radius: float
    """Of a circle round it as seen from above, metres."""
    hue: float | None = None
    """In degrees, for things told by their colour; None for those of any colour."""
    form: str = "block"
    """How its outline changes with height: see `solid.Solid`."""


def _cube(name: str, hue: float) -> Thing:
    return Thing(name, (Part(BOX, (0.0125, 0.0125, 0.0125)),), 0.0125, 0.0177, hue)


def _ring(radius: float, thickness: float, half_height: float, sides: int = 12) -> tuple[Part, ...]:
    """A regular polygon with a hole: `radius` from the middle to the middle of a side."""
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
    Thing("ball", (Part(SPHERE, (0.015,)),), 0.015, 0.015, form="ball"),
    Thing("can", (Part(CYLINDER, (0.0125, 0.02)),), 0.02, 0.0125),
    Thing("brick", (Part(BOX, (0.02, 0.01, 0.01)),), 0.01, 0.0224),
    Thing("ring", _ring(0.02, 0.01, 0.008), 0.008, 0.0207),
    Thing("cross", (Part(BOX, (0.02, 0.007, 0.01)), Part(BOX, (0.007, 0.02, 0.01))), 0.01, 0.0212),
    Thing(
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
"""A detection's class id is a place in here."""

CLASS_NAMES = tuple(thing.name for thing in CATALOGUE)
HALF_HEIGHTS = {thing.name: thing.half_height for thing in CATALOGUE}
"""Metres from the table to the middle of a thing, by the name of its class."""
