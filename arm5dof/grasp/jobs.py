"""Jobs: several picks and places in a TOML file, done one after the other.

[[step]]
pick = "red cube"
place = [0.15, -0.10]      # metres, base frame

[[step]]
pick = "blue cube"
on = "red cube"            # stack it

[[step]]
pick = "any"               # whatever is seen, until nothing is left that can be reached
bin = "class"              # sort it by its class
"""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from arm5dof.errors import UserError, nearest_hint
from arm5dof.grasp.grasper import Grasper, checked_place
from arm5dof.grasp.outcome import Outcome
from arm5dof.vision.objects import CLASS_NAMES

ANY, CLASS = "any", "class"
MOST = 20
"""Objects that one step moves: what is seen again and again is not there."""


@dataclass(frozen=True)
class Step:
    """One pick, and where it goes: just one of `place`, `bin` and `on`."""

    pick: str
    """A class, or "any" for all that is there."""
    place: tuple[float, float] | None = None
    """Metres, base frame."""
    bin: str | None = None
    """Its name, or "class" for that of the object's class."""
    on: str | None = None
    """On top of an object of this class."""

    def __post_init__(self) -> None:
        for name, value, more in (("pick", self.pick, ANY), ("bin", self.bin, CLASS), ("on", self.on, None)):
            known = [*CLASS_NAMES, *([more] if more else [])]
            if value not in (known if name == "pick" else [None, *known]):
                raise UserError(f"{name} = {value!r}: it is one of {', '.join(known)}")
        if sum(value is not None for value in (self.place, self.bin, self.on)) != 1:
            raise UserError(f'the step that picks "{self.pick}" says one of place, bin and on')
        if self.pick == ANY and self.bin is None:
            raise UserError('the step that picks "any" says a bin: there is one place for one object')
        if self.place is not None:
            checked_place(self.place)


@dataclass(frozen=True)
class Done:
    """What came of one object."""

    name: str
    outcome: Outcome


def read_job(path: str | Path) -> list[Step]:
    """The steps of a file. Raises `UserError` for the first thing in it that is not understood."""
    try:
        values = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}: give a TOML file with steps") from None
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} is not valid TOML: {error}") from None
    steps = values.pop("step", None)
    if values:
        name = next(iter(values))
        raise UserError(f"{path}: unknown entry {name!r}: {nearest_hint(name, ['step'])}")
    if not isinstance(steps, list) or not steps or not all(isinstance(step, dict) for step in steps):
        raise UserError(f"{path} has no steps: write [[step]], and below it pick = ... and bin, place or on")
    try:
        return [_step(values) for values in steps]
    except UserError as error:
        raise UserError(f"{path}: {error}") from None


def perform(grasper: Grasper, steps: Iterable[Step]) -> list[Done]:
    """Do the steps in order, whatever becomes of one of them, unless what is held can be put nowhere: then it stays
    held, and that is the end.

    Returns:
        What came of each object that was tried, in order.
    """
    done: list[Done] = []
    for step in steps:
        if step.pick != ANY:
            done.append(Done(step.pick, _move(grasper, step.pick, step)))
            if grasper.holds:
                return done
            continue
        moved, failed = 0, dict[str, int]()
        for _ in range(MOST):
            # What failed is tried again when something else is out of its way, after what did not fail.
            names = [n for n in _seen(grasper) if failed.get(n) != moved]
            if not names:
                break
            name = min(names, key=lambda n: n in failed)
            done.append(Done(name, _move(grasper, name, step)))
            if grasper.holds:
                return done
            if done[-1].outcome.success:
                moved += 1
            else:
                failed[name] = moved
    return done


def _seen(grasper: Grasper) -> list[str]:
    """Classes of what can be located, the surest first, each once."""
    return list(dict.fromkeys(one.name for one in grasper.look(again=True) if one.position is not None))


def _move(grasper: Grasper, name: str, step: Step) -> Outcome:
    picked = grasper.pick(name, doubtful=step.pick == ANY)
    if not picked.success:
        return picked
    placed = grasper.place(step.place, name if step.bin == CLASS else step.bin, step.on)
    if not placed.success and grasper.holds:
        grasper.put_back()
    return placed


def _step(values: dict[str, Any]) -> Step:
    names = list(Step.__dataclass_fields__)
    for name in values:
        if name not in names:
            raise UserError(f"unknown entry {name!r}: {nearest_hint(name, names)}")
    if "pick" not in values:
        raise UserError("a step has no pick: say which class")
    place = values.get("place")
    if place is not None:
        if (
            not isinstance(place, list)
            or len(place) != 2
            or any(type(v) not in (int, float) or not abs(v) <= sys.float_info.max for v in place)
        ):
            raise UserError(f"place = {place!r}: it is two numbers, [x, y], metres")
        values = {**values, "place": (float(place[0]), float(place[1]))}
    return Step(**values)
