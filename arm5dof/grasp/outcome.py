"""`Outcome`: what came of a request, and the stage at which it ended."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

Stage = Literal["see", "locate", "reach", "collide", "grip", "lift", "identify", "place", "rest", "done"]
"""Where an attempt ended. see: no object of the class was seen; locate: none could be located; reach: the policy has no
answer; collide: every motion would hit something; grip: the fingers closed on nothing; lift: what they held was lost;
identify: what they hold is wider than the class can be; place: no way to where it should go, or it came to
lie elsewhere; rest: no clear way back, so that the arm stays where it is; done: as asked."""

STAGES: tuple[Stage, ...] = get_args(Stage)


@dataclass(frozen=True)
class Outcome:
    """What came of a request."""

    stage: Stage
    """Where it ended."""
    reason: str = ""
    """In words, for people."""
    attempts: int = 1
    """How often it was tried."""
    position: np.ndarray | None = field(default=None, repr=False)
    """Where the object was thought to be, (3,), metres, base frame."""

    @property
    def success(self) -> bool:
        """Whether it ended as asked."""
        return self.stage == "done"
