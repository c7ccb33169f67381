"""`Score`: what came of many requests, and where they were lost."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any


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


LOST_BY = {"see": "missed", "locate": "missed", "reach": "policy", "collide": "collision", "place": "place"}
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
