"""`Planner`: motions of the tool to a point and back, whose every pose is an answer of the trained policy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np

from arm5dof.arm import Arm
from arm5dof.envs.reach_pose import ReachPose
from arm5dof.errors import UserError
from arm5dof.grasp.gripper import SITE
from arm5dof.grasp.world import World
from arm5dof.training.policy import Policy

TILTS = tuple(np.deg2rad(angle) for angle in (0, 10, 20, 30, 40, -10, -20))
"""From straight down, radians, in the order in which they are tried; negative ones towards the arm's axis."""
ASIDE = tuple(np.deg2rad(angle) for angle in (0, -8, 8, -16, 16))
"""A tilted tool points away from the arm's axis, or so far to the side of that, radians: the plane in which an arm
moves may pass beside its axis."""
POINTS = 6
"""Poses on the straight line to the point, its ends included."""
CORRECTIONS = 8
MAX_DISTANCE, MAX_ANGLE = 0.002, np.deg2rad(3)
"""What an answer may be off."""
AVOIDED = np.deg2rad(12)
"""What was met in one direction is met in others as near, radians."""
JUMP = 0.5
"""A joint turns less from one pose on the line to the next, radians; more is another branch."""
ALLOWED = (0.0, 0.003, 0.006)
"""How deep a motion may cut into what is known, metres, the first at which there is one: objects count as upright
cylinders, up to 5 mm wider than they are."""
CHAINS = 6
"""How many chains of answers are tried for each direction."""


@dataclass(frozen=True, eq=False)
class Approach:
    """A way of the tool to a point. Joint positions, radians."""

    transit: np.ndarray
    """From where the arm is to before the point, (k, dof)."""
    line: np.ndarray
    """From there straight to the point, (POINTS, dof), `transit`'s last pose first."""
    direction: np.ndarray
    """In which the tool points, a unit vector in the base frame, (3,)."""


class Planner:
    """Motions by the answers of a policy.

    Args:
        policy: Of the task `reach_pose`, with an approach axis, at the site between the gripper's fingers.
        arm: The arm to be moved, from its MJCF file, with that site as its end effector.

    Raises:
        UserError: The policy is of another task, another site or another arm.
    """

    def __init__(self, policy: Policy, arm: Arm) -> None:
        env = policy.env
        if not isinstance(env, ReachPose) or env.config.orientation != "approach" or env.config.site != SITE:
            raise UserError(
                f"the policy is of {type(env).__name__} and not for grasping: train one with reach_pose.toml, "
                f'orientation = "approach" and site = "{SITE}"'
            )
        if not _same(env.arm, arm):
            raise UserError(
                f"the policy is of another arm ({', '.join(env.arm.joint_names)}) than the one to be moved "
                f"({', '.join(arm.joint_names)}): train one for it"
            )
        self.policy, self.arm = policy, arm

    def approach(
        self,
        world: World,
        start: np.ndarray,
        point: np.ndarray,
        clearance: float,
        opening: float,
        without: int | None = None,
        avoid: Sequence[np.ndarray] = (),
        checked: bool = True,
    ) -> Approach | str:
        """A way to bring the site between the fingers to a point.

        Args:
            world: What is known to be around.
            start: Where the arm is, (dof,), radians.
            point: Where it is to be, (3,), metres, base frame.
            clearance: How far above the point the straight line begins on which it is approached, metres.
            opening: Of the gripper on the way, metres.
            without: Number of an object of the world that may be touched on the line.
            avoid: Directions in which the tool met something that is not known.
            checked: Whether motions that hit something are ruled out.

        Returns:
            The way, or why there is none.
        """
        directions = _directions(point)
        ways: list[tuple[np.ndarray, np.ndarray]] = []
        # Straight down will do nearly always, and takes a twentieth of the time.
        for some, depths in ((directions[:1], ALLOWED[:1]), (directions, ALLOWED)):
            ways = self._ways(some, point, clearance, start)
            if ways and not checked:
                return Approach(ways[0][1][:1], ways[0][1], ways[0][0])
            free = [way for way in ways if all(way[0] @ other <= np.cos(AVOIDED) for other in avoid)]
            for allowed in depths:
                for direction, line in free:
                    if world.clear(line, opening, without, allowed):
                        transit = self.transit(world, start, line[0], opening, allowed)
                        if transit is not None:
                            return Approach(transit, line, direction)
        return "would collide" if ways else "out of reach"

    def _ways(
        self, directions: np.ndarray, point: np.ndarray, clearance: float, start: np.ndarray
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Directions and lines of poses that lead to a point in them, the best first, whatever they hit."""
        along = np.linspace(clearance, 0, POINTS) / -directions[:, 2:]
        targets = point - directions[:, None] * along[..., None]
        answer = self.policy.solve(
            targets.reshape(-1, 3), np.repeat(directions, POINTS, 0), corrections=CORRECTIONS, candidates=True
        )
        shape = (len(directions), POINTS, -1)
        q = np.asarray(answer.q, float).reshape(*shape, self.arm.dof)
        distance, angle = (np.asarray(answer.errors[name]) for name in ("distance", "angle"))
        good = (distance <= MAX_DISTANCE) & (angle <= MAX_ANGLE)
        return [
            (direction, line)
            for direction, candidates, valid in zip(directions, q, good.reshape(shape), strict=True)
            for line in _chains(candidates, valid, start)[:CHAINS]
        ]

    def transit(
        self, world: World, start: np.ndarray, end: np.ndarray, opening: float, allowed: float = ALLOWED[-1]
    ) -> np.ndarray | None:
        """A path from one pose to another, (k, dof), straight or by way of one other pose; None if none is clear."""
        if world.clear(path := np.stack([start, end]), opening, allowed=allowed):
            return path
        rng = np.random.default_rng(0)
        middle = (start + end) / 2
        for k in range(60):
            spread = 0.15 + 0.01 * k
            via = middle + spread * (self.arm.upper - self.arm.lower) * rng.uniform(-0.5, 0.5, len(start))
            path = np.stack([start, np.clip(via, self.arm.lower, self.arm.upper), end])
            if world.clear(path, opening, allowed=allowed):
                return path
        return None


def _same(arm: Arm, other: Arm) -> bool:
    """Whether two arms have the same joints and lead to the same places."""
    if arm.joint_names != other.joint_names:
        return False
    q = arm.sample(jax.random.key(0), (100,))
    ours, theirs = ([np.asarray(x) for x in (one.lower, one.upper, *jax.vmap(one.pose)(q))] for one in (arm, other))
    return all(np.allclose(a, b, atol=1e-4) for a, b in zip(ours, theirs, strict=True))


def _directions(point: np.ndarray) -> np.ndarray:
    """In which the tool may point at a point, the best first, (n, 3)."""
    away = np.arctan2(point[1], point[0])
    found = []
    for tilt in TILTS:
        for aside in ASIDE if tilt else ASIDE[:1]:
            azimuth = away + aside
            found.append([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)])
    return np.array(found)


def _chains(candidates: np.ndarray, valid: np.ndarray, start: np.ndarray) -> list[np.ndarray]:
    """Chains (k, dof) of answers, one from each of k sets (k, n, dof) of which some are valid (k, n), in which no joint
    jumps; those that begin nearest to `start` first."""
    begin = np.flatnonzero(valid[0])
    begin = begin[np.argsort(np.abs(candidates[0, begin] - start).max(-1))]
    chains: list[np.ndarray] = []
    for b in begin:
        chain = [candidates[0, b]]
        for here, ok in zip(candidates[1:], valid[1:], strict=True):
            far = np.where(ok, np.abs(here - chain[-1]).max(-1), np.inf)
            if far.min() > JUMP:
                break
            chain.append(here[far.argmin()])
        line = np.array(chain)
        # Many candidates are the same answer.
        if len(line) == len(candidates) and all(np.abs(line - other).max() > 0.05 for other in chains):
            chains.append(line)
    return chains
