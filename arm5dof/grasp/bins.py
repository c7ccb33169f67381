"""`Bin`: low open boxes on the table, behind the arm, for what was picked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.objects import CatalogueObject

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
DROP = 0.003
"""Above where it will rest an object is let go, metres."""
FINGERTIPS = 0.011
"""How far below what they hold fingers reach, and a little, metres: they open above the walls."""
BESIDE_WALL = 0.85
"""How far from the middle an object comes into a corner, of how far it could: what slipped a little between the fingers
does not come down on a wall."""
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

    def contains_seen(self, point: np.ndarray, eye: np.ndarray | None = None) -> bool:
        """Whether what is seen at a point (3,), metres, base frame, lies in the bin.

        Args:
            point: Where it is if it lies on the table.
            eye: Where it is seen from, (3,), if it may lie on other objects in the bin: it is nearer to that then.
        """
        if eye is None or eye[2] <= PILED:
            return bool(self.contains(np.append(point[:2], 0.0)[None])[0])
        share = np.linspace(0, (PILED - point[2]) / (eye[2] - point[2]), 10, endpoint=False)[:, None]
        return bool(self.contains(point + share * (eye - point)).any())

    def spot(self, kind: CatalogueObject, count: int) -> tuple[np.ndarray, float]:
        """Where an object is let go that comes after `count` others of its class: in one corner after the other,
        opposite ones first; or, where two would not fit in opposite corners, on top of each other.

        Returns:
            Place of its center, (2,), and how high that is, metres, base frame.
        """
        lowest = max(kind.half_height + DROP, HEIGHT + FINGERTIPS)
        aside = BESIDE_WALL * (self.room - kind.radius)
        if kind.radius > 2**0.5 * aside:
            return self.position, max(lowest, kind.half_height * (2 * count + 1) + DROP)
        along = np.array([np.cos(self.yaw), np.sin(self.yaw)])
        corner = np.array([(1, 1), (-1, -1), (1, -1), (-1, 1)][count % 4])
        return self.position + aside * corner @ np.stack([along, [-along[1], along[0]]]), lowest

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
