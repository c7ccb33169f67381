"""How often it works: random scenes in which one object is asked for, and why it went wrong where it did."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import cv2
import mujoco
import numpy as np

from arm5dof.arm import load_arm
from arm5dof.errors import UserError
from arm5dof.grasp.driver import CLEARANCE
from arm5dof.grasp.grasper import Grasper, checked_place
from arm5dof.grasp.gripper import SITE
from arm5dof.grasp.ground_truth import TrueBoxes, TruePositions, in_sight
from arm5dof.grasp.jobs import CLASS, Step, perform
from arm5dof.grasp.perception import CameraPerception, Perception, detectors
from arm5dof.grasp.planner import Planner
from arm5dof.grasp.robot import SimulatedRobot
from arm5dof.grasp.scene import UNDISTURBED, Disturbance, TabletopScene, tabletop_scene
from arm5dof.grasp.score import LOST_BY, Score, Trial, is_met, is_put, lost_by
from arm5dof.grasp.world import World
from arm5dof.runtime import xla
from arm5dof.training.policy_file import load_policy
from arm5dof.vision.objects import CLASS_NAMES
from arm5dof.vision.synthetic.scenes import MAX_AZIMUTH, MAX_OBJECTS

Eyes = Literal["camera", "boxes", "truth"]
"""What the program sees: what its detector finds and localization places; the true boxes in the image, which
localization places; or where objects truly are."""

ABSENT = "absent"
"""In place of a class: a random one that is not there."""
FREE = "free"
"""In place of where to put it: a random point on the table at which nothing lies."""

HOLD = 2.0
"""Seconds for which an object must be held."""
LIFT = 0.05
"""Metres by which it must be lifted."""
ROOM, HEIGHT = 0.06, 0.02
"""To put something down is for a place from which all else is so far, and which the arm reaches at such a height,
metres."""
PLACES = 1000
"""So many random ones are looked at."""
AT_REST = 0.05
"""No joint is further from where the arm rests, radians."""


@dataclass(frozen=True)
class Setting:
    """What all scenes have in common."""

    policy: Path
    """A run's folder or a policy's file."""
    arm: str
    """MJCF file of the arm with its gripper."""
    radii: tuple[float, float]
    """How near and far from the arm's axis objects lie, metres."""
    seed: int
    eyes: Eyes = "camera"
    pick: str | None = None
    """The class that is asked for; None for a random one that is there, `ABSENT` for one that is not."""
    place: tuple[float, float] | Literal["free"] | None = None
    """Where it is put, metres, base frame, or `FREE`; None to hold it."""
    bin: str | None = None
    """Or the bin in which it is put; "class" for that of its class."""
    disturbance: Disturbance = UNDISTURBED
    job: tuple[Step, ...] = ()
    """What is to be done instead of one pick."""
    count: tuple[int, int] = (3, MAX_OBJECTS)
    """The least and the greatest number of objects."""


def evaluate(setting: Setting, scenes: int, progress: Callable[[int], object] | None = None) -> Score:
    """Try a request in each of many random scenes, in as many processes as there are cores.

    Args:
        setting: What they have in common.
        scenes: How many.
        progress: Told how many are done.

    Raises:
        UserError: A class, bin, arm or policy is none.
    """
    program = Program(setting)  # Faults of the setting are told here, once.
    workers = min(xla.cores(), scenes)
    if workers == 1:
        return Score(tuple(_counted(map(program.trial, range(scenes)), progress)))
    with multiprocessing.get_context("spawn").Pool(workers, _start, (setting,)) as pool:
        return Score(tuple(_counted(pool.imap(_trial, range(scenes)), progress)))


def _counted(trials: Iterator[Trial], progress: Callable[[int], object] | None) -> Iterator[Trial]:
    for i, trial in enumerate(trials, 1):
        yield trial
        if progress is not None:
            progress(i)


class Observer:
    """What is told how a trial goes; this one does not care."""

    perception: Perception | None = None
    """Instead of the program's own, such as one that remembers what it saw."""

    def stage(self, words: str) -> None:
        """Something begins."""

    def step(self) -> None:
        """A short time has passed in the scene."""


class Program:
    """What tries a request: policy, planner and detector, loaded once."""

    def __init__(self, setting: Setting) -> None:
        if setting.pick not in (None, ABSENT, *CLASS_NAMES):
            raise UserError(f"no class {setting.pick!r}: the detector knows {', '.join(CLASS_NAMES)}")
        if setting.bin not in (None, "class", *CLASS_NAMES):
            raise UserError(f"no bin {setting.bin!r}: there are {', '.join(CLASS_NAMES)}")
        if isinstance(setting.place, tuple):
            checked_place(setting.place)
        self.setting = setting
        self.planner = Planner(load_policy(setting.policy), load_arm(setting.arm, SITE))
        self._empty = World(self.planner.arm)
        self.detectors = detectors() if setting.eyes == "camera" else ()

    def scene(self, number: int) -> TabletopScene:
        """A random scene, the arm at rest out of the camera's way."""
        s = self.setting
        build = partial(
            tabletop_scene,
            (s.seed, number),
            arm=s.arm,
            radii=s.radii,
            count=s.count,
            disturbance=s.disturbance,
        )
        seen = build()
        return build(start=World(self.planner.arm, seen.bins.values()).rest(seen.camera, s.radii))

    def perceptions(self, scene: TabletopScene) -> list[Perception]:
        """What is seen of a scene, at the first look and at the second."""
        if self.setting.eyes == "boxes":
            return [CameraPerception(TrueBoxes(scene), scene.camera)]
        if self.setting.eyes == "truth":
            return [TruePositions(scene)]
        return [CameraPerception(detector, scene.camera) for detector in self.detectors]

    def trial(self, number: int, watch: Callable[[TabletopScene, Perception], Observer] | None = None) -> Trial:
        """Ask for one object in one scene.

        Args:
            number: Of the scene.
            watch: Makes what is told how it goes.
        """
        s, scene = self.setting, self.scene(number)
        if s.job:
            return self._job(number, scene, watch)
        robot, grasper = self._grasper(scene, watch)
        rng = np.random.default_rng((s.seed, number))
        names = [one.catalogue_object.name for one in scene.objects]
        asked = self._asked(names, rng)
        within = [i for i, name in enumerate(names) if name == asked and self._reaches(scene.start[i])]
        reachable, in_sight = bool(within), bool(self._in_sight(scene) & set(within))
        place = self._place(scene, rng)
        outcome = grasper.pick(asked)
        if outcome.success:
            robot.move(np.array([HOLD]), robot.joints()[None])
        up = scene.lifted(LIFT)
        lifted = {name for name, is_up in zip(names, up, strict=True) if is_up}
        held, wrong = outcome.success and asked in lifted, bool(lifted - {asked})
        reachable = reachable or held  # By its end, where its middle is just out of reach.
        placed = True
        if held and (place or s.bin):
            bin = asked if s.bin == CLASS else s.bin
            there = grasper.place(place, bin)
            which = next(i for i, name in enumerate(names) if name == asked and up[i])
            placed = there.success and is_put(scene, which, place, bin)
        told = not (outcome.success or up.any()) and bool(np.abs(robot.joints() - grasper.rest).max() < AT_REST)
        success = held and placed if reachable else told
        lost = "" if success else lost_by(outcome, held, wrong, scene, names, asked)
        return Trial(number, asked, reachable, in_sight, success, wrong, lost, outcome.reason)

    def _asked(self, names: list[str], rng: np.random.Generator) -> str:
        if self.setting.pick == ABSENT:
            return str(rng.choice([name for name in CLASS_NAMES if name not in names]))
        return self.setting.pick or (str(rng.choice(names)) if names else CLASS_NAMES[0])

    def _place(self, scene: TabletopScene, rng: np.random.Generator) -> tuple[float, float] | None:
        place = self.setting.place
        return place if isinstance(place, tuple) else self._free(scene, rng) if place == FREE else None

    def _free(self, scene: TabletopScene, rng: np.random.Generator) -> tuple[float, float]:
        """A point that the arm can reach and beside which there is room for an object and for fingers."""
        for _ in range(PLACES):
            radius, azimuth = rng.uniform(*self.setting.radii), rng.uniform(-MAX_AZIMUTH, MAX_AZIMUTH)
            point = np.array([radius * np.cos(azimuth), radius * np.sin(azimuth), HEIGHT])
            free = scene.model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
            away = scene.data.xpos[scene.model.jnt_bodyid[free]] - point
            if (np.hypot(*away[:, :2].T) > ROOM).all() and self._reaches(point):
                return float(point[0]), float(point[1])
        raise UserError(f"none of {PLACES} random places on the table is free and within reach: give a place")

    def _in_sight(self, scene: TabletopScene) -> set[int]:
        """The objects that the camera shows as the detector's own evaluation demands it."""
        return set(range(len(scene.objects))) if self.setting.eyes == "truth" else in_sight(scene)

    def _grasper(
        self, scene: TabletopScene, watch: Callable[[TabletopScene, Perception], Observer] | None
    ) -> tuple[SimulatedRobot, Grasper]:
        """The robot of a scene, and what moves it."""
        first, *second = self.perceptions(scene)
        observer = watch(scene, first) if watch is not None else Observer()
        robot = SimulatedRobot(scene, on_step=observer.step)
        eyes, look_again = observer.perception or first, second[0] if second else None
        bins = scene.bins.values()
        return robot, Grasper(robot, eyes, self.planner, robot.joints(), bins, look_again, observer.stage)

    def _job(
        self, number: int, scene: TabletopScene, watch: Callable[[TabletopScene, Perception], Observer] | None
    ) -> Trial:
        """Do the job, and see what it left behind."""
        _, grasper = self._grasper(scene, watch)
        there = [i for i in sorted(self._in_sight(scene)) if self._reaches(scene.start[i])]
        done = perform(grasper, self.setting.job)
        success = all(is_met(step, scene, there) for step in self.setting.job)
        stages = [one.outcome.stage for one in done if not one.outcome.success]
        lost = "" if success else LOST_BY.get(stages[0], "grip") if stages else "missed"
        said = next((f"{one.name}: {one.outcome.reason}" for one in done if not one.outcome.success), "")
        return Trial(number, "job", True, True, success, False, lost, said)

    def _reaches(self, point: np.ndarray) -> bool:
        """Whether the arm could bring its fingers to a point, were nothing else there."""
        way = self.planner.approach(self._empty, self.planner.arm.home, point, CLEARANCE, 0.0, checked=False)
        return not isinstance(way, str)


_program: Program


def _start(setting: Setting) -> None:
    """In a worker process: it has one core, and an interrupt is its parent's affair."""
    cv2.setNumThreads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    global _program
    _program = Program(setting)


def _trial(number: int) -> Trial:
    return _program.trial(number)
