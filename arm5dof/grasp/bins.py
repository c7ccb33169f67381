"""`Bin`: low open boxes on the table, behind the arm, for what was picked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from arm5dof.errors import UserError

FAR, NEAR = 0.03, 0.12
"""How much nearer to the arm's axis than the furthest objects the bins stand, metres: in both rows the tool can point
straight down, even from above a bin's wall."""
PLACES = tuple(
    (row, side * azimuth)
    for row, azimuth in ((FAR, 121.0), (FAR, 143.5), (NEAR, 139.0), (FAR, 166.0))
    for side in (1, -1)
)
"""Row and azimuth from the x axis, degrees, best first: behind the arm, since objects lie within 100 degrees, and far
enough from those for a finger to pass between."""
HALF, WALL, HEIGHT = 0.035, 0.002, 0.02
"""Half the outer width, thickness and height of the walls, metres: the longest object fits in whichever way it is
turned, and a gripper that holds its center 20 mm above where it will lie opens above the walls."""
COLOR = (0.1, 0.1, 0.11, 1.0)
"""Nearly black: the walls of a lighter bin are easily taken for bricks."""
PILED = 0.06
"""The center of an object that lies on others in a bin is no higher, metres."""


@dataclass(frozen=True, eq=False)
class Bin:
    """A low open box on the table."""

    name: str
    position: np.ndarray
    """Of its middle on the table, (2,), metres, base frame."""
    yaw: float
    """About z, radians."""

    @property
    def room(self) -> float:
        """From its middle to a wall, metres."""
        return HALF - WALL

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Whether points (n, 3), metres, base frame, lie between its walls, on its floor or on what lies there,
        (n,) bool."""
        along = np.array([np.cos(self.yaw), np.sin(self.yaw)])
        local = (points[:, :2] - self.position) @ np.stack([along, [-along[1], along[0]]], -1)
        return (np.abs(local).max(-1) < HALF - WALL) & (points[:, 2] < PILED)

    def add_to(self, spec: mujoco.MjSpec) -> list[mujoco.MjsGeom]:
        """Add the body `bin NAME` to a spec: four walls, which are returned, and a floor that is only seen."""
        quaternion = [np.cos(self.yaw / 2), 0, 0, np.sin(self.yaw / 2)]
        body = spec.worldbody.add_body(name=f"bin {self.name}", pos=[*self.position, 0], quat=quaternion)
        box, middle, inner = mujoco.mjtGeom.mjGEOM_BOX, HALF - WALL / 2, HALF - WALL
        body.add_geom(type=box, size=[inner, inner, 0.0015], rgba=COLOR, contype=0, conaffinity=0)
        return [
            body.add_geom(
                type=box,
                size=[WALL / 2 if x else HALF, WALL / 2 if y else HALF, HEIGHT / 2],
                pos=[x * middle, y * middle, HEIGHT / 2],
                rgba=COLOR,
            )
            for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1))
        ]


def arrange(names: Sequence[str], radius: float) -> dict[str, Bin]:
    """Bins by name.

    Args:
        names: At most eight.
        radius: How far from the arm's axis the furthest objects lie, metres.

    Raises:
        UserError: They are too many, or two have the same name.
    """
    if len(names) > len(PLACES):
        raise UserError(f"{len(names)} bins: there is room for {len(PLACES)}")
    if len(set(names)) < len(names):
        raise UserError(f"two bins of the same name: {', '.join(names)}")
    bins = {}
    for name, (row, azimuth) in zip(names, PLACES, strict=False):
        yaw = float(np.deg2rad(azimuth))
        bins[name] = Bin(name, (radius - row) * np.array([np.cos(yaw), np.sin(yaw)]), yaw)
    return bins
