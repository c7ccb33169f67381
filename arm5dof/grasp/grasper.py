"""`Grasper`: see, decide, grasp, place. It knows of the table what its perception tells and what its robot feels."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from arm5dof.errors import UserError
from arm5dof.grasp.bins import HEIGHT as BIN_HEIGHT
from arm5dof.grasp.bins import Bin
from arm5dof.grasp.gripper import Gripper
from arm5dof.grasp.outcome import Outcome, Stage
from arm5dof.grasp.perception import Perception, SeenObject
from arm5dof.grasp.planner import Approach, Planner
from arm5dof.grasp.robot import Robot
from arm5dof.grasp.world import World
from arm5dof.vision.objects import CATALOGUE, CLASS_NAMES, CatalogueObject

CLEARANCE = 0.06
"""From how far above a point is approached, and how high objects are lifted, metres."""
SLACK = 0.008
"""How much wider than an object the gripper opens, metres."""
SQUEEZE = 0.02
"""How much narrower than an object it is told to close, metres: what makes the grip firm."""
SPEED = 1.5
"""Of the fastest joint on the way, rad/s, and a third of it on the line to an object."""
DOUBT = 0.6
"""Of less confidence, what is seen is taken for an obstacle at the first attempt only."""
ATTEMPTS = 3
"""From as many images."""
PLACED = 0.006
"""What is seen further from where it should lie is picked and put there again, metres: a gripper does not know where
along its fingers it holds an object."""
BESIDE = 0.06
"""What was just put down is seen no further away, metres."""
DROP = 0.003
"""Above where it will rest an object is let go, metres."""
ARRIVED = 0.05
"""Where a joint is further from its target, something is in the way, radians."""
WIDER = 0.004
"""What is held may be so much wider than its class, metres."""
LEAST = 0.002
"""An object between the fingers is at least so wide, metres."""
SAME = 0.01
"""Where the fingers closed on nothing, what is seen no further away is not there, metres."""


class Grasper:
    """A program that picks objects by their class.

    Args:
        robot: The arm, its gripper and its camera.
        perception: What finds objects in its images.
        planner: What finds motions.
        rest: Where the arm waits, out of the camera's way, (dof,), radians.
        bins: By name.
        second_look: What is asked where `perception` does not see what it should; slower and surer.
        on_stage: Called with a few words whenever it begins something, such as for a video.

    >>> import numpy as np
    >>> from arm5dof import Grasper, load_arm
    >>> from arm5dof.grasp.perception import SeenObject
    >>> from arm5dof.grasp.planner import Planner
    >>> from arm5dof.grasp.robot import DryRun
    >>> from arm5dof.grasp.shipped import shipped
    >>> from arm5dof.training.policy_file import load_policy
    >>> arm = load_arm("arm5.xml", site="grasp")
    >>> robot = DryRun(arm, image=np.zeros((480, 640, 3), np.uint8))  # Moves nothing and keeps what it was told.
    >>> planner = Planner(load_policy(shipped("arm5.xml").policy), arm)
    >>> perception = lambda image: [SeenObject("can", 0.9, np.array([0.18, 0.05, 0.02]), 0.001)]
    >>> Grasper(robot, perception, planner, arm.home).pick("can").stage
    'done'
    """

    def __init__(
        self,
        robot: Robot,
        perception: Perception,
        planner: Planner,
        rest: np.ndarray,
        bins: Iterable[Bin] = (),
        second_look: Perception | None = None,
        on_stage: Callable[[str], object] = lambda _: None,
    ) -> None:
        self.robot, self.perception, self.planner, self.rest = robot, perception, planner, rest
        self.bins = {one.name: one for one in bins}
        self._second, self._say = second_look, on_stage
        self._objects: list[SeenObject] = []
        self._held: CatalogueObject | None = None
        self._from: np.ndarray | None = None
        self._filled: dict[str, int] = {}
        self._met: list[np.ndarray] = []
        self._nothing: list[np.ndarray] = []
        self._widest = Gripper.of(planner.arm.mj_model).limits[1]

    @property
    def holds(self) -> str | None:
        """The class of what it holds, as far as it knows."""
        return None if self._held is None else self._held.name

    def look(self, again: bool = False) -> list[SeenObject]:
        """What is seen now, but for what lies in a bin. `again` takes the second look."""
        self._say("look again" if again else "look")
        perception = self._second if again and self._second is not None else self.perception
        seen = perception(self.robot.image())
        return [one for one in seen if one.position is None or not self._in_a_bin(one.position)]

    def _in_a_bin(self, position: np.ndarray) -> bool:
        flat = np.append(position[:2], 0.0)  # What lies on something else in there is in it too.
        return any(one.contains(flat[None])[0] for one in self.bins.values())

    def pick(self, name: str) -> Outcome:
        """Pick up an object of a class and hold it, `CLEARANCE` above where it was.

        Args:
            name: Of the class.

        Returns:
            What came of it. Unless it is `done` the arm is at rest and the gripper empty.

        Raises:
            UserError: There is no such class, or something is held already.
        """
        if name not in CLASS_NAMES:
            raise UserError(f"no class {name!r}: the detector knows {', '.join(CLASS_NAMES)}")
        if self._held is not None:
            raise UserError(f"the gripper holds the {self._held.name}: place it first, or put it back")
        outcome, again = Outcome("see"), False
        self._met, self._nothing = [], []
        for attempt in range(1, ATTEMPTS + 1):
            outcome = self._attempt(name, attempt, again)
            unseen = outcome.stage in ("see", "locate")
            # Another image of the same table shows the same.
            if outcome.success or outcome.stage == "reach" or (unseen and (again or self._second is None)):
                break
            again |= unseen or outcome.stage == "collide"
        return outcome

    def place(
        self, point: Sequence[float] | np.ndarray | None = None, bin: str | None = None, on: str | None = None
    ) -> Outcome:
        """Put down what was picked up, and go to rest.

        Args:
            point: Where on the table, (2,), metres, base frame.
            bin: Or the name of a bin.
            on: Or on an object of this class that was seen when this one was picked.

        Returns:
            What came of it. Unless it is `done` or the object is lost the arm still holds it: see `put_back`.

        Raises:
            UserError: Nothing is held, there is no such bin, the point is none, or not one of the three was given.
        """
        if sum(value is not None for value in (point, bin, on)) != 1:
            raise UserError("place takes a point, the name of a bin, or the class of what it is put on")
        if bin is not None and bin not in self.bins:
            raise UserError(f"no bin {bin!r}: there are {', '.join(self.bins) or 'none'}")
        if self._held is None:
            raise UserError("nothing is held: pick something first")
        if on is not None:
            below = next((one for one in self._objects if one.name == on), None)
            if below is None:
                return Outcome("see", f"no {on} is seen to put it on")
            assert below.position is not None
            where, height = below.position[:2], 2 * below.position[2] + self._held.half_height + DROP
        elif bin is not None:
            where, height = self._free(self.bins[bin])
        else:
            assert point is not None
            return self._put_exactly(checked_place(point), self._held)
        return self._put(where, height)

    def _put_exactly(self, where: np.ndarray, kind: CatalogueObject) -> Outcome:
        """Put down what is held, see where it came to lie, and pick it up again while that is elsewhere."""
        outcome = self._put(where, kind.half_height + DROP)
        for _ in range(ATTEMPTS - 1):
            if not outcome.success:
                break
            found = self._nearest(kind.name, where)
            if found is None or found <= PLACED or not self._attempt(kind.name, 1, False, where).success:
                break
            outcome = self._put(where, kind.half_height + DROP)
        return outcome

    def _nearest(self, name: str, where: np.ndarray) -> float | None:
        """How far from a place an object of a class is seen, metres, if it is no further than `BESIDE`, and not where
        it was picked."""
        seen = [one for one in self.look() if one.name == name and one.position is not None]
        away = [_away(one, where) for one in seen if self._from is None or _away(one, self._from) > SAME]
        return min((d for d in away if d <= BESIDE), default=None)

    def _free(self, bin: Bin) -> tuple[np.ndarray, float]:
        """Where in a bin, and how high, what is held is let go: in one corner after the other, opposite ones first; or,
        where two would not fit in opposite corners, on top of each other."""
        assert self._held is not None
        count = self._filled[bin.name] = self._filled.get(bin.name, -1) + 1
        if self._held.radius > 2**0.5 * (bin.room - self._held.radius):
            pile = 2 * self._held.half_height * count + DROP
            return bin.position, self._held.half_height + max(BIN_HEIGHT, pile)
        along = np.array([np.cos(bin.yaw), np.sin(bin.yaw)])
        corner = np.array([(1, 1), (-1, -1), (1, -1), (-1, 1)][count % 4])
        aside = (bin.room - self._held.radius) * corner
        return bin.position + aside @ np.stack([along, [-along[1], along[0]]]), self._held.half_height + BIN_HEIGHT

    def put_back(self) -> Outcome:
        """Put down what is held where it was picked up, and go to rest."""
        if self._held is None or self._from is None:
            raise UserError("nothing is held: pick something first")
        return self._put(self._from, self._held.half_height + DROP)

    def _put(self, where: np.ndarray, height: float) -> Outcome:
        self._say(f"place at {1e3 * where[0]:.0f} {1e3 * where[1]:.0f} mm")
        opening = self.robot.opening()
        way = self._approach(np.append(where, height), opening)
        if isinstance(way, str):
            return Outcome("place", f"the place is {way}")
        self._go(way)
        if self.robot.opening() < LEAST:
            return self._give_up("lift", "the object was lost on the way", way)
        self.robot.grip(opening + SLACK)
        self._held = None
        self._retreat(way)
        self._go_to_rest()
        return Outcome("done")

    def _attempt(self, name: str, attempt: int, again: bool, near: np.ndarray | None = None) -> Outcome:
        """Try once to pick an object of a class, the one that is nearest to a place or else the surest."""
        seen = self.look(again)
        wanted = [one for one in seen if one.name == name and not self._is_nothing(one)]
        located = [one for one in wanted if one.position is not None]
        if near is not None:
            located = sorted(located, key=lambda one: _away(one, near))[:1]
        # Where everything would collide, the doubtful may not be there.
        doubt = 0.0 if attempt == 1 else DOUBT
        self._objects = [
            one for one in seen if one.position is not None and (one.confidence >= doubt or one.name == name)
        ]
        if not wanted:
            return Outcome("see", f"no {name} is seen", attempt)
        if not located:
            return Outcome("locate", f"a {name} is seen, but {wanted[0].failure}", attempt)
        kind = next(one for one in CATALOGUE if one.name == name)
        outcome = Outcome("reach")
        for target in located:
            assert target.position is not None
            self._say(f"plan: {name} at {1e3 * target.position[0]:.0f} {1e3 * target.position[1]:.0f} mm")
            opening = min(2 * kind.radius + SLACK, self._widest)
            way = self._approach(target.position, opening, target)
            if not isinstance(way, str):
                return self._grasp(way, target, kind, opening, attempt)
            stage: Stage = "reach" if way == "out of reach" else "collide"
            outcome = Outcome(stage, f"the {name} is there, but {way}", attempt, target.position)
        return outcome

    def _is_nothing(self, seen: SeenObject) -> bool:
        """Whether the fingers closed there on nothing, and it is doubtful too."""
        if seen.position is None or seen.confidence >= DOUBT:
            return False
        return any(np.linalg.norm(seen.position - other) < SAME for other in self._nothing)

    def _approach(self, point: np.ndarray, opening: float, target: SeenObject | None = None) -> Approach | str:
        world = World(self.planner.arm, self.bins.values(), self._objects)
        without = None if target is None else self._objects.index(target)
        return self.planner.approach(world, self.robot.joints(), point, CLEARANCE, opening, without, self._met)

    def _grasp(self, way: Approach, target: SeenObject, kind: CatalogueObject, opening: float, attempt: int) -> Outcome:
        assert target.position is not None
        self._say(f"grasp the {target.name}")
        self.robot.grip(opening)
        self._go(way)
        if np.abs(self.robot.joints() - way.line[-1]).max() > ARRIVED:
            self._met.append(way.direction)
            return self._give_up("collide", "the arm met something on the way", way, attempt, target)
        self.robot.grip(-SQUEEZE)
        if self.robot.opening() < LEAST:
            self._nothing.append(target.position)
            return self._give_up("grip", "the fingers closed on nothing", way, attempt, target)
        if self.robot.opening() > 2 * kind.radius + WIDER:
            self._met.append(way.direction)
            return self._give_up("identify", f"what is between the fingers is no {target.name}", way, attempt, target)
        self._say("lift")
        self._retreat(way)
        if self.robot.opening() < LEAST:
            return self._give_up("lift", "the object was lost on the way up", way, attempt, target)
        self._objects = [one for one in self._objects if one is not target]
        self._held, self._from, self._met = kind, target.position[:2], []
        return Outcome("done", attempts=attempt, position=target.position)

    def _give_up(
        self, stage: Stage, reason: str, way: Approach, attempt: int = 1, target: SeenObject | None = None
    ) -> Outcome:
        self._say(f"give up: {reason}")
        self._held = None
        self.robot.grip(min(max(self._widest / 2, self.robot.opening() + SLACK), self._widest))
        if np.abs(self.robot.joints() - way.line[-1]).max() < np.abs(self.robot.joints() - way.line[0]).max():
            self._retreat(way)
        self._go_to_rest()
        return Outcome(stage, reason, attempt, None if target is None else target.position)

    def _go(self, way: Approach) -> None:
        self._follow(way.transit[1:], SPEED)
        self._follow(way.line[1:], SPEED / 3)

    def _retreat(self, way: Approach) -> None:
        self._follow(way.line[-2::-1], SPEED / 3)

    def _go_to_rest(self) -> None:
        self._say("rest")
        world = World(self.planner.arm, self.bins.values(), self._objects)
        path = self.planner.transit(world, self.robot.joints(), self.rest, self.robot.opening())
        self._follow(np.stack([self.rest]) if path is None else path[1:], SPEED)

    def _follow(self, path: np.ndarray, speed: float) -> None:
        before = np.concatenate([[self.robot.joints()], path[:-1]])
        seconds = np.maximum(np.abs(path - before).max(1) / speed, 0.02)
        self.robot.move(np.cumsum(seconds), path)


def _away(seen: SeenObject, where: np.ndarray) -> float:
    """How far from a place on the table something is seen, metres."""
    assert seen.position is not None
    return float(np.hypot(*(seen.position[:2] - where)))


def checked_place(point: np.ndarray | Sequence[float]) -> np.ndarray:
    """A point of the table, (2,), metres. Raises `UserError` if it is none."""
    found = np.asarray(point, float)
    if found.shape != (2,) or not np.isfinite(found).all():
        raise UserError(f"no place {' '.join(map(str, np.ravel(found)))}: give x and y, metres")
    return found
