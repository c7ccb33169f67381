"""How often it works: random scenes in which one object is asked for, and why it went wrong where it did."""

from __future__ import annotations

import multiprocessing
import signal
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import cv2
import mujoco
import numpy as np

from arm5dof.arm import load_arm
from arm5dof.errors import UserError
from arm5dof.grasp.grasper import CLEARANCE, Grasper, Outcome, checked_place
from arm5dof.grasp.gripper import SITE
from arm5dof.grasp.jobs import ANY, CLASS, Step, perform
from arm5dof.grasp.perception import CameraPerception, Perception, SeenObject
from arm5dof.grasp.planner import Planner
from arm5dof.grasp.robot import SimulatedRobot
from arm5dof.grasp.scene import UNDISTURBED, Disturbance, TabletopScene, tabletop_scene
from arm5dof.grasp.world import World
from arm5dof.runtime import xla
from arm5dof.training.policy_file import load_policy
from arm5dof.vision.detectors.loading import load_detector
from arm5dof.vision.objects import CLASS_NAMES
from arm5dof.vision.rendering.simulated import simulated_camera
from arm5dof.vision.synthetic.ground_truth import truth
from arm5dof.vision.synthetic.scene_builder import CAMERA
from arm5dof.vision.synthetic.scenes import MAX_OBJECTS

Eyes = Literal["camera", "truth"]
"""What the program sees: what its detector finds and localization places, or where objects truly are."""

HOLD = 2.0
"""Seconds for which an object must be held."""
LIFT = 0.05
"""Metres by which it must be lifted."""
NEAR = 0.010
"""From where it should be put it may lie so far, metres."""
MISPLACED = 0.010
"""An object that was thought so far from its place was lost by localization, metres."""


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
    """The class that is asked for; None for a random one that is there."""
    place: tuple[float, float] | None = None
    """Where it is put, metres, base frame; None to hold it."""
    bin: str | None = None
    """Or the bin in which it is put; "class" for that of its class."""
    disturbance: Disturbance = UNDISTURBED
    job: tuple[Step, ...] = ()
    """What is to be done instead of one pick."""
    count: tuple[int, int] = (3, MAX_OBJECTS)
    """The least and the greatest number of objects."""


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
        if setting.pick is not None and setting.pick not in CLASS_NAMES:
            raise UserError(f"no class {setting.pick!r}: the detector knows {', '.join(CLASS_NAMES)}")
        if setting.bin not in (None, "class", *CLASS_NAMES):
            raise UserError(f"no bin {setting.bin!r}: there are {', '.join(CLASS_NAMES)}")
        if setting.place is not None:
            checked_place(setting.place)
        self.setting = setting
        self.planner = Planner(load_policy(setting.policy), load_arm(setting.arm, SITE))
        self.detectors = [load_detector(tta=tta) for tta in (False, True)] if setting.eyes == "camera" else []

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
        return build(start=World(self.planner.arm, seen.bins.values()).rest(seen.camera))

    def perceptions(self, scene: TabletopScene) -> list[Perception]:
        """What is seen of a scene, at the first look and at the second."""
        if self.detectors:
            return [CameraPerception(detector, scene.camera) for detector in self.detectors]
        return [partial(_true, scene)]

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
        names = [one.catalogue_object.name for one in scene.objects]
        rng = np.random.default_rng((s.seed, number))
        asked = s.pick or (str(rng.choice(names)) if names else CLASS_NAMES[0])
        within = [i for i, name in enumerate(names) if name == asked and self._reachable(scene, i)]
        reachable, in_sight = bool(within), self.setting.eyes == "truth" or bool(_visible(scene) & set(within))
        outcome = grasper.pick(asked)
        if outcome.success:
            robot.move(np.array([HOLD]), robot.joints()[None])
        lifted = [name for name, up in zip(names, scene.lifted(LIFT), strict=True) if up]
        wrong = any(name != asked for name in lifted)
        held = outcome.success and asked in lifted
        placed = True
        if held and (s.place or s.bin):
            which = int(np.flatnonzero([n == asked and up for n, up in zip(names, scene.lifted(LIFT), strict=True)])[0])
            bin = asked if s.bin == "class" else s.bin
            there = grasper.place(s.place and np.array(s.place), bin)
            placed = there.success and _at_rest(scene, which, s.place, bin)
        success = held and placed if reachable else not outcome.success and not wrong
        lost = "" if success else _lost(outcome, held, wrong, scene, names, asked)
        return Trial(number, asked, reachable, in_sight, success, wrong, lost, outcome.reason)

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
        seen = _visible(scene) if self.detectors else set(range(len(scene.objects)))
        there = [i for i in sorted(seen) if self._reachable(scene, i)]
        done = perform(grasper, self.setting.job)
        success = all(_met(step, scene, there) for step in self.setting.job)
        stages = [one.outcome.stage for one in done if not one.outcome.success]
        lost = "" if success else LOST_BY.get(stages[0], "grip") if stages else "missed"
        said = next((f"{one.name}: {one.outcome.reason}" for one in done if not one.outcome.success), "")
        return Trial(number, "job", True, True, success, False, lost, said)

    def _reachable(self, scene: TabletopScene, i: int) -> bool:
        world = World(self.planner.arm)
        way = self.planner.approach(world, self.planner.arm.home, scene.start[i], CLEARANCE, 0.0, checked=False)
        return not isinstance(way, str)


def _true(scene: TabletopScene, image: np.ndarray) -> list[SeenObject]:
    """Where objects truly are, whatever an image shows."""
    return [
        SeenObject(one.catalogue_object.name, 1.0, position, 0.0)
        for one, position in zip(scene.objects, scene.object_poses()[0], strict=True)
    ]


def _visible(scene: TabletopScene) -> set[int]:
    """The objects of which the camera sees half or more."""
    camera = simulated_camera(scene.model, CAMERA, scene.camera.width, scene.camera.height)
    mujoco.mj_forward(scene.model, scene.data)
    found = truth(scene, camera.segmentation(scene.data))
    return {i for i, at in enumerate(scene.start) if (np.abs(found.position[found.counts] - at).max(1) < 1e-6).any()}


def _at_rest(scene: TabletopScene, which: int, place: Sequence[float] | None, bin: str | None) -> bool:
    if bin is not None:
        return bool(scene.in_bin(bin)[which])
    away = scene.object_poses()[0][which, :2] - np.asarray(place)
    return bool(np.hypot(*away) <= NEAR and scene.resting()[which])


def _met(step: Step, scene: TabletopScene, there: list[int]) -> bool:
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


def _lost(outcome: Outcome, held: bool, wrong: bool, scene: TabletopScene, names: list[str], asked: str) -> str:
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


_program: Program


def _start(setting: Setting) -> None:
    """In a worker process: it has one core, and an interrupt is its parent's affair."""
    cv2.setNumThreads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    global _program
    _program = Program(setting)


def _trial(number: int) -> Trial:
    return _program.trial(number)


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
