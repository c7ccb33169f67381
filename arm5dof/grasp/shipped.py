"""The arms for which a grasping policy ships."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from arm5dof.errors import UserError


class Shipped(NamedTuple):
    """An arm and its policy."""

    policy: Path
    """Its file."""
    radii: tuple[float, float]
    """How near and far from the arm's axis objects lie in its scenes, metres."""


_FOLDER = Path(__file__).parent / "policies"
ARMS = {
    "arm5.xml": Shipped(_FOLDER / "arm5.zip", (0.10, 0.25)),
    "arm7_gripper.xml": Shipped(_FOLDER / "arm7_gripper.zip", (0.18, 0.32)),
}


def shipped(arm: str) -> Shipped:
    """What ships for an arm. Raises `UserError` if nothing does."""
    if arm not in ARMS:
        raise UserError(f"no policy ships for {arm}: give one, or one of the arms {', '.join(ARMS)}")
    return ARMS[arm]
