"""`Driver`: moves a robot along planned motions, past what is known to be around it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from arm5dof.grasp.bins import Bin
from arm5dof.grasp.perception import SeenObject
from arm5dof.grasp.planner import Approach, Planner
from arm5dof.grasp.robot import Robot
from arm5dof.grasp.world import Held, World

CLEARANCE = 0.06
"""From how far above a point is approached, and how high objects are lifted, metres."""
SPEED = 1.5
"""Of the fastest joint on the way, rad/s, and a third of it on the line to an object."""
ARRIVED = 0.05
"""Where a joint is further from its target, something is in the way, radians."""


class Driver:
    """What moves a robot.

    Args:
        robot: The arm and its gripper.
        planner: What finds motions.
        rest: Where the arm waits, (dof,), radians.
        bins: What stands on the table.

    Attributes:
        objects: What lies there too, as far as is known.
        held: What the gripper holds.
    """

    def __init__(self, robot: Robot, planner: Planner, rest: np.ndarray, bins: Iterable[Bin]) -> None:
        self.objects: list[SeenObject] = []
        self.held: Held | None = None
        self._robot, self._planner, self._rest, self._bins = robot, planner, rest, tuple(bins)

    def approach(
        self,
        point: np.ndarray,
        opening: float,
        target: SeenObject | None = None,
        avoid: Sequence[np.ndarray] = (),
    ) -> Approach | str:
        """A way to a point, or why there is none: see `Planner.approach`. `target` is what may be touched there."""
        without = None if target is None else self.objects.index(target)
        return self._planner.approach(self._world(), self._robot.joints(), point, CLEARANCE, opening, without, avoid)

    def go(self, way: Approach) -> bool:
        """Follow a way to its point. Returns whether it was reached."""
        self._follow(way.transit[1:], SPEED)
        self._follow(way.line[1:], SPEED / 3)
        return bool(np.abs(self._robot.joints() - way.line[-1]).max() <= ARRIVED)

    def retreat(self, way: Approach) -> None:
        """Go back along the line of a way, if that is where the arm is."""
        here = self._robot.joints()
        if np.abs(here - way.line[-1]).max() < np.abs(here - way.line[0]).max():
            self._follow(way.line[-2::-1], SPEED / 3)

    def go_to_rest(self) -> bool:
        """Go where the arm waits. Returns whether there is a clear way; if not the arm stays where it is."""
        path = self._planner.transit(self._world(), self._robot.joints(), self._rest, self._robot.opening())
        if path is not None:
            self._follow(path[1:], SPEED)
        return path is not None

    def _world(self) -> World:
        return World(self._planner.arm, self._bins, self.objects, self.held)

    def _follow(self, path: np.ndarray, speed: float) -> None:
        before = np.concatenate([[self._robot.joints()], path[:-1]])
        seconds = np.maximum(np.abs(path - before).max(1) / speed, 0.02)
        self._robot.move(np.cumsum(seconds), path)
