"""Joint positions as commands give them: radians and metres for programs, degrees and millimetres for people."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence


def by_unit(names: Sequence[str], slides: Sequence[bool], q: Iterable[float]) -> dict[str, dict[str, float]]:
    """Joint positions by name: those of hinges in radians, and those of slides, where there are any, in metres."""
    named = list(zip(names, map(float, q), slides, strict=True))
    metres = {name: value for name, value, slides in named if slides}
    return {"joints_rad": {name: value for name, value, slides in named if not slides}} | (
        {"joints_m": metres} if metres else {}
    )


def for_people(slides: bool, value: float) -> tuple[float, str]:
    """A joint position in degrees, or a slide's in millimetres, and the unit."""
    return (1e3 * value, "mm") if slides else (math.degrees(value), "deg")
