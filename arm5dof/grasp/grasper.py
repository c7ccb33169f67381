"""`Grasper`: see, decide, grasp, place. It knows of the table what its perception tells and what its robot feels."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from arm5dof.errors import UserError
from arm5dof.grasp.bins import DROP, Bin
from arm5dof.grasp.driver import Driver
from arm5dof.grasp.gripper import Gripper, least_width
from arm5dof.grasp.outcome import Outcome, Stage
from arm5dof.grasp.perception import Perception, SeenObject
from arm5dof.grasp.planner import Approach, Planner
from arm5dof.grasp.robot import Robot
from arm5dof.grasp.world import Held
from arm5dof.vision.objects import CATALOGUE, CLASS_NAMES, CatalogueObject

SLACK = 0.008
"""How much wider than an object the gripper opens, metres."""
SQUEEZE = 0.02
"""How much narrower than an object it is told to close, metres: what makes the grip firm."""
SURE, LIKELY = 0.5, 0.1
"""What was asked for and is seen with less confidence than the first is looked at again; and then less than the second
does not count."""
DOUBT = 0.6
"""Of less confidence, what is seen is taken for an obstacle at the first attempt only."""
ATTEMPTS = 3
"""At most, each from a new image."""
PLACED, MISPLACED = 0.006, 0.010
"""What is seen further from where it should lie, metres, is picked and put there again, since a gripper does not know
where along its fingers it holds an object; and what is seen further is not done."""
BESIDE = 0.06
"""What was just put down is seen no further away, metres."""
NARROWER, WIDER = 0.002, 0.004
"""What is held may be so much narrower or wider than its class, metres."""
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
        self._driver = Driver(robot, planner, rest, self.bins.values())
        self._second, self._say = second_look, on_stage
        self._from: np.ndarray | None = None
        self._seen_before: list[SeenObject] = []
        self._filled: dict[str, int] = {}
        self._met: list[np.ndarray] = []
        self._nothing: list[np.ndarray] = []
        self._failed: list[np.ndarray] = []
        self._widest = Gripper.of(planner.arm.mj_model).limits[1]

    @property
    def holds(self) -> str | None:
        """The class of what it holds, as far as it knows."""
        return None if self._driver.held is None else self._driver.held.kind.name

    def look(self, again: bool = False) -> list[SeenObject]:
        """What is seen now, but for what lies in a bin. `again` takes the second look."""
        self._say("look again" if again else "look")
        perception = self._second if again and self._second is not None else self.perception
        seen = perception(self.robot.image())
        return [one for one in seen if one.position is None or not self._in_a_bin(one.position, one.eye)]

    def _in_a_bin(self, position: np.ndarray, eye: np.ndarray | None) -> bool:
        return any(
            bin.contains_seen(position, eye if name in self._filled else None) for name, bin in self.bins.items()
        )

    def pick(self, name: str, doubtful: bool = False) -> Outcome:
        """Pick up an object of a class and hold it, `CLEARANCE` above where it was.

        Args:
            name: Of the class.
            doubtful: Whether to try what may well not be there too, as in clearing a table.

        Returns:
            What came of it. Unless it is `done` or `rest` the arm is at rest and the gripper empty.

        Raises:
            UserError: There is no such class, or something is held already.
        """
        if name not in CLASS_NAMES:
            raise UserError(f"no class {name!r}: the detector knows {', '.join(CLASS_NAMES)}")
        if self.holds:
            raise UserError(f"the gripper holds the {self.holds}: place it first, or put it back")
        outcome, again = Outcome("see"), doubtful
        self._met, self._nothing, self._failed = [], [], []
        for attempt in range(1, ATTEMPTS + 1):
            seen = self.look(again)
            sure = any(one.name == name and one.position is not None and one.confidence >= SURE for one in seen)
            if not (again or sure) and self._second is not None:
                again, seen = True, self.look(again=True)
            seen = [one for one in seen if doubtful or one.name != name or one.confidence >= LIKELY]
            outcome = self._attempt(name, attempt, seen)
            # Another image of the same table shows the same.
            if outcome.success or outcome.stage in ("see", "locate", "reach", "rest"):
                break
            again = True
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
        kind = self._kind_held()
        if on is not None:
            below = next((one for one in self._driver.objects if one.name == on), None)
            if below is None:
                return Outcome("see", f"no {on} is seen to put it on")
            where, height = _spot(below)[:2], 2 * _spot(below)[2] + kind.half_height + DROP
        elif bin is not None:
            count = self._filled[bin] = self._filled.get(bin, -1) + 1
            where, height = self.bins[bin].spot(kind, count)
        else:
            assert point is not None
            return self._put_exactly(checked_place(point), kind)
        return self._put(where, height)

    def _put_exactly(self, where: np.ndarray, kind: CatalogueObject) -> Outcome:
        """Put down what is held, see where it came to lie, and pick it up again while that is elsewhere."""
        before = self._seen_before
        for attempt in range(1, ATTEMPTS + 1):
            outcome = self._put(where, kind.half_height + DROP)
            found = self._beside(where, kind.name, before) if outcome.success else None
            off = 0.0 if found is None else _away(found, where)
            if found is None or off <= PLACED:
                return outcome
            again = self._attempt(kind.name, 1, self.look(), found) if attempt < ATTEMPTS else outcome
            if not again.success:
                break
        if off <= MISPLACED:
            return outcome
        also = "" if again.success else f", and {again.reason}"
        return Outcome("place", f"it lies {1e3 * off:.0f} mm from the place{also}")

    def _beside(self, where: np.ndarray, name: str, before: Sequence[SeenObject]) -> SeenObject | None:
        """What of a class is seen nearest to a place, unless it is too far from it to be what was put there, or was
        seen there before."""
        seen = [one for one in self.look() if one.name == name and one.position is not None]
        new = [
            one for one in seen if _away(one, where) <= SAME or all(_away(one, _spot(old)[:2]) > SAME for old in before)
        ]
        nearest = min(new, key=lambda one: _away(one, where), default=None)
        return nearest if nearest is not None and _away(nearest, where) <= BESIDE else None

    def put_back(self) -> Outcome:
        """Put down what is held where it was picked up, and go to rest."""
        kind = self._kind_held()
        assert self._from is not None
        return self._put(self._from, kind.half_height + DROP)

    def _kind_held(self) -> CatalogueObject:
        if self._driver.held is None:
            raise UserError("nothing is held: pick something first")
        return self._driver.held.kind

    def _put(self, where: np.ndarray, height: float) -> Outcome:
        self._say(f"place at {1e3 * where[0]:.0f} {1e3 * where[1]:.0f} mm")
        opening = self.robot.opening()
        way = self._driver.approach(np.append(where, height), opening)
        if isinstance(way, str):
            return Outcome("place", f"the place is {way}")
        arrived = self._driver.go(way)
        if self.robot.opening() < LEAST:
            return self._give_up("lift", "the object was lost on the way", way)
        if not arrived:
            self._driver.retreat(way)
            return Outcome("collide", "the arm met something on the way to the place")
        self.robot.grip(opening + SLACK)
        self._driver.held = None
        self._driver.retreat(way)
        return self._rest(Outcome("done"))

    def _attempt(self, name: str, attempt: int, seen: list[SeenObject], near: SeenObject | None = None) -> Outcome:
        """Try once to pick an object of a class, the one that is nearest to where one was seen or else the surest."""
        wanted = [one for one in seen if one.name == name and not self._is_nothing(one)]
        located = [one for one in wanted if one.position is not None]
        if near is not None:
            located = sorted(located, key=lambda one: _away(one, _spot(near)[:2]))[:1]
        located.sort(key=self._failed_at)  # Where one failed is tried after the others.
        if not wanted:
            return Outcome("see", f"no {name} is seen", attempt)
        if not located:
            return Outcome("locate", f"a {name} is seen, but {wanted[0].failure}", attempt)
        kind = next(one for one in CATALOGUE if one.name == name)
        outcome = Outcome("reach")
        for target in located:
            spot = _spot(target)
            # Where everything would collide, the doubtful may not be there.
            doubt = 0.0 if attempt == 1 else DOUBT
            self._driver.objects = [
                one for one in seen if one.position is not None and (one.confidence >= doubt or one is target)
            ]
            self._say(f"plan: {name} at {1e3 * spot[0]:.0f} {1e3 * spot[1]:.0f} mm")
            opening = min(2 * kind.radius + SLACK, self._widest)
            way = self._driver.approach(spot, opening, target, self._met)
            if not isinstance(way, str):
                return self._grasp(way, target, kind, opening, attempt)
            stage: Stage = "reach" if way == "out of reach" else "collide"
            outcome = Outcome(stage, f"the {name} is there, but {way}", attempt, spot)
        return outcome

    def _failed_at(self, seen: SeenObject) -> bool:
        return any(np.linalg.norm(_spot(seen) - other) < SAME for other in self._failed)

    def _is_nothing(self, seen: SeenObject) -> bool:
        """Whether the fingers closed there on nothing, and it is doubtful too."""
        if seen.position is None or seen.confidence >= DOUBT:
            return False
        return any(np.linalg.norm(seen.position - other) < SAME for other in self._nothing)

    def _grasp(self, way: Approach, target: SeenObject, kind: CatalogueObject, opening: float, attempt: int) -> Outcome:
        spot = _spot(target)
        self._say(f"grasp the {target.name}")
        self.robot.grip(opening)
        if not self._driver.go(way):
            self._met.append(way.direction)
            return self._give_up("collide", "the arm met something on the way", way, attempt, target)
        self.robot.grip(-SQUEEZE)
        if self.robot.opening() < LEAST:
            self._nothing.append(spot)
            return self._give_up("grip", "the fingers closed on nothing", way, attempt, target)
        if not least_width(kind) - NARROWER <= self.robot.opening() <= 2 * kind.radius + WIDER:
            self._met.append(way.direction)
            return self._give_up("identify", f"what is between the fingers is no {target.name}", way, attempt, target)
        self._say("lift")
        self._driver.retreat(way)
        if self.robot.opening() < LEAST:
            return self._give_up("lift", "the object was lost on the way up", way, attempt, target)
        self._seen_before = [one for one in self._driver.objects if one.name == target.name]
        self._driver.objects.remove(target)
        self._driver.held = Held(kind, way.line[-1])
        self._from, self._met = spot[:2], []
        return Outcome("done", attempts=attempt, position=spot)

    def _give_up(
        self, stage: Stage, reason: str, way: Approach, attempt: int = 1, target: SeenObject | None = None
    ) -> Outcome:
        self._say(f"give up: {reason}")
        if target is not None:
            self._failed.append(_spot(target))
        self._driver.held = None
        self.robot.grip(min(max(self._widest / 2, self.robot.opening() + SLACK), self._widest))
        self._driver.retreat(way)
        return self._rest(Outcome(stage, reason, attempt, None if target is None else target.position))

    def _rest(self, outcome: Outcome) -> Outcome:
        """Go to rest; an outcome that says so if there is no way."""
        self._say("rest")
        if self._driver.go_to_rest():
            return outcome
        reason = f"{outcome.reason or outcome.stage}, and no clear way leads to where the arm rests"
        return replace(outcome, stage="rest", reason=reason)


def _spot(seen: SeenObject) -> np.ndarray:
    """Where something that could be located is, (3,), metres."""
    assert seen.position is not None
    return seen.position


def _away(seen: SeenObject, where: np.ndarray) -> float:
    """How far from a place on the table something is seen, metres."""
    return float(np.hypot(*(_spot(seen)[:2] - where)))


def checked_place(point: np.ndarray | Sequence[float]) -> np.ndarray:
    """A point of the table, (2,), metres. Raises `UserError` if it is none."""
    found = np.asarray(point, float)
    if found.shape != (2,) or not np.isfinite(found).all():
        raise UserError(f"no place {' '.join(map(str, np.ravel(found)))}: give x and y, metres")
    return found
