"""`Score`: what came of many requests, and where they were lost. Judged by what is true of a scene."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from arm5dof.grasp.jobs import ANY, CLASS, Step
from arm5dof.grasp.outcome import Outcome
from arm5dof.grasp.scene import TabletopScene

NEAR = 0.010
"""From where it should be put it may lie so far, metres."""
MISPLACED = 0.010
"""An object that was thought so far from its place was lost by localization, metres."""


@dataclass(frozen=True)
class Trial:
    """What came of one scene."""

    number: int
    asked: str
    reachable: bool
    """Whether an object of the class is there that the arm could reach, were nothing else there."""
    in_sight: bool
    """Whether one of those can be seen as the detector's own evaluation demands it, half of it or more."""
    success: bool
    """Lifted and held, and put where it should be; where none can be reached, whether that was said."""
    wrong: bool
    """Whether an object of another class was lifted."""
    lost: str
    """Where it was lost, empty if it was not."""
    said: str = ""
    """What the program said of why it did not do it."""


LOST_BY = {
    "see": "missed",
    "locate": "missed",
    "reach": "policy",
    "collide": "collision",
    "rest": "collision",
    "place": "place",
}
"""By the stage at which a request ended, where that is all that is known."""
LOST = ("missed", "wrong class", "localization", "policy", "collision", "grip", "place")
"""Where requests are lost."""


@dataclass(frozen=True)
class Score:
    """What came of many scenes."""

    trials: tuple[Trial, ...]

    @property
    def failures(self) -> dict[str, int]:
        """How many requests that can be reached and are in sight were lost, by where."""
        found = Counter(one.lost for one in self.trials if one.reachable and one.in_sight and not one.success)
        return {name: found[name] for name in LOST if found[name]}

    def as_json(self) -> dict[str, Any]:
        """`success_percent` is of the requests that can be reached and are in sight, `reachable_percent` of all that
        can be reached, `wrong_object_percent` of all scenes."""
        reachable = [one for one in self.trials if one.reachable]
        seen = [one for one in reachable if one.in_sight]
        others = [one for one in self.trials if not one.reachable]
        percent = lambda of, n: 100 * sum(of) / max(1, n)
        return {
            "success_percent": percent((one.success for one in seen), len(seen)),
            "wrong_object_percent": percent((one.wrong for one in self.trials), len(self.trials)),
            "scenes": len(self.trials),
            "in_sight": len(seen),
            "reachable": len(reachable),
            "reachable_percent": percent((one.success for one in reachable), len(reachable)),
            "unreachable_told": sum(one.success for one in others),
            "failures": self.failures,
        }


def is_put(scene: TabletopScene, which: int, place: Sequence[float] | None, bin: str | None) -> bool:
    """Whether an object lies where it should be put."""
    if bin is not None:
        return bool(scene.in_bin(bin)[which])
    away = scene.object_poses()[0][which, :2] - np.asarray(place)
    return bool(np.hypot(*away) <= NEAR and scene.resting()[which])


def is_met(step: Step, scene: TabletopScene, there: list[int]) -> bool:
    """Whether a scene is as a step should have left it; `there` are the objects that could be seen and reached."""
    places, rests = scene.object_poses()[0], scene.resting()
    kinds = [one.catalogue_object for one in scene.objects]
    if step.pick == ANY:
        bins = [kinds[i].name if step.bin == CLASS else str(step.bin) for i in there]
        return all(scene.in_bin(bin)[i] for i, bin in zip(there, bins, strict=True))
    mine = [i for i, kind in enumerate(kinds) if kind.name == step.pick and rests[i]]
    if step.bin is not None:
        return any(scene.in_bin(step.pick if step.bin == CLASS else step.bin)[i] for i in mine)
    if step.place is not None:
        return any(np.hypot(*(places[i, :2] - step.place)) <= NEAR for i in mine)
    below = [i for i, kind in enumerate(kinds) if kind.name == step.on]
    return any(
        np.hypot(*(places[i] - places[j])[:2]) <= kinds[j].radius
        and abs((places[i] - places[j])[2] - kinds[i].half_height - kinds[j].half_height) < 0.003
        for i in mine
        for j in below
        if i != j
    )


def lost_by(outcome: Outcome, held: bool, wrong: bool, scene: TabletopScene, names: list[str], asked: str) -> str:
    """Where a request was lost: the first stage that was wrong."""
    if wrong:
        return "wrong class"
    if outcome.stage in LOST_BY:
        return LOST_BY[outcome.stage]
    if held:
        return "place"
    places = scene.start[[name == asked for name in names]]
    if outcome.position is not None and len(places):
        off = np.linalg.norm(places - outcome.position, axis=1).min()
        if off > MISPLACED:
            return "localization"
    return "grip"


def table(score: Score) -> str:
    """For people."""
    found = score.as_json()
    lines = [
        f"{found['success_percent']:.2f} % of {found['in_sight']} requests that can be reached and are in sight, "
        f"{found['reachable_percent']:.2f} % of all {found['reachable']} that can be reached",
        f"another object lifted in {found['wrong_object_percent']:.2f} % of {found['scenes']} scenes",
    ]
    told = found["scenes"] - found["reachable"]
    if told:
        lines.append(f"{found['unreachable_told']} of {told} requests out of reach were told so")
    lines += [f"  {count:4} lost by {name}" for name, count in found["failures"].items()]
    return "\n".join(lines)
