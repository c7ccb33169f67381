"""From an image to a lifted object: what was asked for is done, or it is said why not and the arm is at rest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.errors import said

from arm5dof.grasp.evaluation import Eyes, Program, Setting
from arm5dof.grasp.grasper import ATTEMPTS, Grasper
from arm5dof.grasp.perception import Perception, SeenObject
from arm5dof.grasp.robot import DryRun, SimulatedRobot
from arm5dof.grasp.scene import TabletopScene, tabletop_scene
from arm5dof.grasp.shipped import shipped
from arm5dof.vision.objects import CATALOGUE, CLASS_NAMES
from arm5dof.vision.synthetic.scenes import Placement

EYES: tuple[Eyes, ...] = ("truth", "camera")


@cache
def program(eyes: Eyes) -> Program:
    return Program(Setting(shipped("arm5.xml").policy, "arm5.xml", shipped("arm5.xml").radii, 31, eyes))


class Bench:
    """A random scene, and a program that picks in it. Of the scene it gets nothing but what a real arm would give."""

    def __init__(self, number: int, eyes: Eyes) -> None:
        self.scene: TabletopScene = program(eyes).scene(number)
        self.names = [one.catalogue_object.name for one in self.scene.objects]
        self.robot = SimulatedRobot(self.scene)
        self.rest = self.robot.joints()
        self.perception, *second = program(eyes).perceptions(self.scene)
        self.said: list[str] = []
        self.on_stage: Callable[[str], object] = lambda words: None
        five = {name: getattr(self.robot, name) for name in ("joints", "opening", "move", "grip", "image")}
        self.grasper = Grasper(
            SimpleNamespace(**five),
            lambda image: self.perception(image),
            program(eyes).planner,
            self.rest,
            self.scene.bins.values(),
            *second,
            on_stage=self.tell,
        )

    def tell(self, words: str) -> None:
        self.said.append(words)
        self.on_stage(words)

    def absent(self) -> str:
        return next(name for name in CLASS_NAMES if name not in self.names)

    def held(self) -> set[str]:
        """Classes of what is lifted, and still is after 2 s."""
        before = self.scene.lifted()
        self.robot.move(np.array([2.0]), self.robot.joints()[None])
        return {name for name, up in zip(self.names, before & self.scene.lifted(), strict=True) if up}

    def remove(self, name: str) -> None:
        """Take all objects of a class off the table."""
        for i, other in enumerate(self.names):
            if other == name:
                self.position(i)[:] = [5 + i, 5]

    def position(self, i: int) -> np.ndarray:
        """x and y of an object in the simulation, to be changed."""
        first = self.scene.model.jnt_qposadr[self.scene.model.body(f"object {i}").jntadr[0]]
        return self.scene.data.qpos[first : first + 2]

    def free(self, radius: float) -> np.ndarray:
        """A place on the table so far from the arm's axis, as far as can be from all objects, (2,)."""
        angles = np.linspace(-1.4, 1.4, 30)
        points = radius * np.stack([np.cos(angles), np.sin(angles)], 1)
        return max(points, key=lambda point: np.linalg.norm(self.scene.start[:, :2] - point, axis=1).min())

    def at_rest(self) -> bool:
        return np.abs(self.robot.joints() - self.rest).max() < 0.01 and not self.scene.lifted().any()


@pytest.mark.parametrize("eyes", EYES)
@pytest.mark.parametrize("number", [0, 1, 2, 4])
def test_what_is_asked_for_is_lifted_and_held(number: int, eyes: Eyes):
    bench = Bench(number, eyes)
    asked = bench.names[number % len(bench.names)]
    outcome = bench.grasper.pick(asked)
    assert outcome.success and outcome.stage == "done" and not outcome.reason
    assert bench.held() == {asked}
    truth = bench.scene.start[[name == asked for name in bench.names]]
    assert np.linalg.norm(truth - outcome.position, axis=1).min() < 0.006
    assert bench.said[0] == "look" and bench.said[-2:] == [f"grasp the {asked}", "lift"]


def test_what_is_lifted_was_within_reach(monkeypatch: pytest.MonkeyPatch):
    """An object may be held by its end, whose middle the arm does not reach."""
    program = Program(Setting(shipped("arm5.xml").policy, "arm5.xml", (0.1, 0.25), 31, "truth"))
    monkeypatch.setattr(program, "_reaches", lambda _: False)
    trial = program.trial(1)
    assert trial.success and trial.reachable and not trial.said


@pytest.mark.parametrize("eyes", EYES)
def test_what_is_not_there_is_said_not_to_be(eyes: Eyes):
    bench = Bench(0, eyes)
    outcome = bench.grasper.pick(bench.absent())
    assert outcome.stage == "see" and not outcome.success
    assert bench.said == {"truth": ["look"], "camera": ["look", "look again"]}[eyes]
    assert outcome.reason == f"no {bench.absent()} is seen"
    assert bench.at_rest() and not bench.held()
    with_moon = said(lambda: bench.grasper.pick("moon"))
    assert with_moon == f"no class 'moon': the detector knows {', '.join(CLASS_NAMES)}"


def test_a_second_look_finds_what_the_first_does_not():
    bench = Bench(1, "truth")
    both = bench.perception
    bench.perception = lambda image: [one for one in both(image) if one.name != "can"]
    assert bench.grasper.pick("can").stage == "see"
    five = bench.grasper.robot
    again = Grasper(five, bench.perception, program("truth").planner, bench.rest, second_look=both)
    outcome = again.pick("can")
    assert outcome.success and outcome.attempts == 1 and bench.held() == {"can"}


def test_what_is_out_of_reach_or_not_located_is_said_to_be():
    bench, far = Bench(0, "truth"), np.array([0.5, 0.0, 0.0125])
    for seen, stage, reason in (
        (SeenObject("red cube", 1.0, far, 0.0), "reach", "the red cube is there, but out of reach"),
        (SeenObject("red cube", 1.0, None, np.nan, "it is above the horizon"), "locate", "it is above the horizon"),
    ):
        bench.perception = lambda _, seen=seen: [seen]
        outcome = bench.grasper.pick("red cube")
        assert outcome.stage == stage and reason in outcome.reason and outcome.attempts == 1
        assert bench.at_rest()


@pytest.mark.parametrize("eyes", EYES)
def test_it_is_put_into_a_bin(eyes: Eyes):
    bench = Bench(1, eyes)
    for name in ("dumbbell", "can"):
        assert bench.grasper.pick(name).success
        assert bench.grasper.place(bin=name).success
        assert bench.at_rest()
        assert bench.scene.in_bin(name)[bench.names.index(name)]
    assert "dumbbell" not in {one.name for one in bench.grasper.look()}, "what lies in a bin is done with"


@pytest.mark.parametrize("eyes", EYES)
def test_it_is_put_down_where_it_should_be(eyes: Eyes):
    bench = Bench(2, eyes)
    point = bench.free(0.18)
    for name in ("red cube", "brick"):
        assert bench.grasper.pick(name).success
        assert bench.grasper.place(point).success
        position = bench.scene.object_poses()[0][bench.names.index(name), :2]
        assert np.linalg.norm(position - point) <= 0.010
        assert bench.at_rest() and bench.scene.resting().all()
        point = point * 0.72


def test_what_came_to_lie_elsewhere_is_put_there_again():
    """As what was held at its end, or rolls away, does."""
    bench, point = Bench(1, "truth"), np.array([0.19, 0.02])
    which, moved = bench.names.index("can"), []

    def roll_away(words: str) -> None:
        if words == "look" and "rest" in bench.said and not moved:
            moved.append(which)
            bench.position(which)[:] += [0.012, -0.008]

    assert bench.grasper.pick("can").success
    bench.on_stage = roll_away
    assert bench.grasper.place(point).success
    assert moved and sum(words.startswith("place at") for words in bench.said) == 2
    assert np.linalg.norm(bench.scene.object_poses()[0][which, :2] - point) < 0.006 and bench.at_rest()


@pytest.mark.parametrize(
    "radius, shift, times, reason",
    [
        (0.19, 0.014, 3, "it lies 14 mm from the place"),
        (0.275, 0.055, 1, "it lies 55 mm from the place, and the can is"),
    ],
)
def test_what_stays_elsewhere_is_not_done(radius: float, shift: float, times: int, reason: str):
    """It rolls away every time, or to where the arm cannot pick it again."""
    bench = Bench(1, "truth")
    which, point = bench.names.index("can"), bench.free(radius)

    def roll_away(words: str) -> None:
        if words == "look" and "rest" in bench.said:
            bench.position(which)[:] = point * (1 + shift / radius)

    assert bench.grasper.pick("can").success
    bench.on_stage = roll_away
    outcome = bench.grasper.place(point)
    assert outcome.stage == "place" and outcome.reason.startswith(reason)
    assert sum(words.startswith("place at") for words in bench.said) == times and not bench.grasper.holds


def test_a_place_near_the_last_one_is_corrected_too():
    bench, point = Bench(1, "truth"), np.array([0.19, 0.02])
    which, shifts = bench.names.index("can"), [[0.0, 0.008], [0.008, 0.0]]

    def roll_away(words: str) -> None:
        if words == "look" and bench.said[-2] == "rest" and shifts:
            bench.position(which)[:] = point + shifts.pop()

    assert bench.grasper.pick("can").success
    bench.on_stage = roll_away
    assert bench.grasper.place(point).success and not shifts
    assert sum(words.startswith("place at") for words in bench.said) == 3
    assert np.linalg.norm(bench.scene.object_poses()[0][which, :2] - point) < 0.006


def test_where_one_failed_others_are_tried_first():
    """Two of a class are seen, of which the surer one is not there."""
    bench = Bench(4, "truth")
    name = bench.names[0]
    true = bench.perception
    bench.perception = lambda image: [SeenObject(name, 1.0, np.append(bench.free(0.2), 0.01), 0.001), *true(image)]
    outcome = bench.grasper.pick(name)
    assert outcome.success and outcome.attempts == 2 and bench.held() == {name}


def test_the_unsure_is_looked_at_again():
    """What the second look does not show, or hardly, is not picked, unless that is asked for."""
    bench = Bench(0, "truth")
    name = bench.names[0]
    true = bench.perception
    scored = lambda score: lambda image: [replace(one, confidence=score) for one in true(image) if one.name == name]
    grasp = lambda first, second: Grasper(
        bench.grasper.robot, first, program("truth").planner, bench.rest, second_look=second, on_stage=bench.tell
    )
    for second in (lambda _: [], scored(0.05)):
        assert grasp(scored(0.4), second).pick(name).stage == "see"
        assert bench.said == ["look", "look again"]
        bench.said.clear()
    assert grasp(lambda _: [], scored(0.05)).pick(name, doubtful=True).success and bench.held() == {name}


def test_the_arm_stays_where_no_way_leads_to_rest():
    bench = Bench(1, "truth")
    planner, ways = program("truth").planner, []
    blocked = SimpleNamespace(
        arm=planner.arm,
        approach=planner.approach,
        transit=lambda *args: ways.append(args),
    )
    grasper = Grasper(bench.grasper.robot, bench.perception, blocked, bench.rest, bench.scene.bins.values())
    assert grasper.pick("can").success
    outcome = grasper.place(bin="can")
    assert outcome.stage == "rest" and outcome.reason == "done, and no clear way leads to where the arm rests"
    assert len(ways) == 1 and np.abs(bench.robot.joints() - bench.rest).max() > 0.1
    assert bench.scene.in_bin("can")[bench.names.index("can")]


def test_what_lies_on_others_in_a_bin_is_not_on_the_table():
    """It is taken to lie on the table, beyond the bin."""
    eye, bin = np.array([0.8, 0.0, 0.6]), next(iter(program("truth").scene(0).bins.values()))
    top = np.append(bin.position, 0.05)
    beyond = eye + (top - eye) * (eye[2] - 0.01) / (eye[2] - top[2])
    assert not bin.contains(beyond[None])[0]
    bench = Bench(1, "truth")
    true = bench.perception
    ghost = SeenObject("brick", 0.9, beyond, 0.001, eye=eye)
    bench.perception = lambda image: [*true(image), ghost]
    assert ghost in bench.grasper.look(), "nothing was put there yet"
    bench.grasper.bins = {"can": bin}
    assert bench.grasper.pick("can").success and bench.grasper.place(bin="can").success
    assert ghost not in bench.grasper.look()


def test_what_is_faint_and_not_there_is_tried_once():
    bench = Bench(0, "truth")
    name = bench.absent()
    nothing = SeenObject(name, 0.15, np.append(bench.free(0.2), 0.01), 0.001)
    true = bench.perception
    bench.perception = lambda image: [*true(image), nothing]
    outcome = bench.grasper.pick(name)
    assert outcome.stage == "see" and bench.said.count("give up: the fingers closed on nothing") == 1
    assert bench.at_rest() and not bench.held()


def test_what_cannot_be_placed_is_still_held():
    bench = Bench(2, "truth")
    nothing = "nothing is held: pick something first"
    assert said(lambda: bench.grasper.place(np.array([0.2, 0.0]))) == nothing
    assert bench.grasper.pick("red cube").success
    assert said(lambda: bench.grasper.place(bin="moon")).startswith("no bin 'moon': there are red cube, ")
    for both in ({}, {"point": np.zeros(2), "bin": "can"}):
        assert said(lambda both=both: bench.grasper.place(**both)) == (
            "place takes a point, the name of a bin, or the class of what it is put on"
        )
    outcome = bench.grasper.place(np.array([0.6, 0.0]))
    assert outcome.stage == "place" and outcome.reason == "the place is out of reach"
    assert bench.held() == {"red cube"}
    assert bench.grasper.place(bin="red cube").success
    assert said(lambda: bench.grasper.place(bin="red cube")) == nothing


def test_where_the_arm_is_stopped_on_the_way_to_a_place_nothing_is_dropped():
    """It stops halfway, as before a wall that nobody knows of."""
    bench = Bench(1, "truth")
    assert bench.grasper.pick("can").success
    five, halves = bench.grasper.robot, iter([True, True])

    def move(times: np.ndarray, joints: np.ndarray) -> None:
        share = 0.5 if next(halves, False) else 1.0
        bench.robot.move(times, five.joints() + share * (joints - five.joints()))

    five.move = move
    outcome = bench.grasper.place(bench.free(0.19))
    assert outcome.stage == "collide" and outcome.reason == "the arm met something on the way to the place"
    assert bench.grasper.holds == "can" and bench.robot.opening() > 0.02
    assert bench.grasper.put_back().success and bench.at_rest()


@pytest.mark.parametrize("eyes", EYES)
def test_fingers_that_close_on_nothing_feel_it(eyes: Eyes):
    """The object is gone when the arm comes, and the next image shows it."""
    bench = Bench(4, eyes)
    name = bench.names[0]
    bench.on_stage = lambda words: words == f"grasp the {name}" and bench.remove(name)
    outcome = bench.grasper.pick(name)
    assert "give up: the fingers closed on nothing" in bench.said
    assert outcome.stage == {"truth": "reach", "camera": "see"}[eyes] and outcome.attempts > 1
    assert bench.at_rest() and not bench.held()


def test_it_gives_up_after_several_images():
    """Here the camera shows for ever what is no longer there."""
    bench = Bench(4, "truth")
    name, seen = bench.names[0], bench.perception(bench.robot.image())
    bench.remove(name)
    bench.perception = lambda _: seen
    outcome = bench.grasper.pick(name)
    assert outcome.stage == "grip" and outcome.attempts == ATTEMPTS and not outcome.success
    assert outcome.reason == "the fingers closed on nothing"
    assert sum(words.startswith("look") for words in bench.said) == ATTEMPTS and bench.said[-1] == "rest"
    assert bench.at_rest() and not bench.held()


def test_an_object_lost_on_the_way_up_is_noticed():
    bench = Bench(0, "truth")
    name = bench.names[0]
    bench.on_stage = lambda words: words == "lift" and bench.remove(name)
    outcome = bench.grasper.pick(name)
    assert "give up: the object was lost on the way up" in bench.said
    assert outcome.stage == "reach" and bench.at_rest()


def test_an_object_lost_on_the_way_to_its_place_is_noticed():
    bench = Bench(0, "truth")
    assert bench.grasper.pick(bench.names[0]).success
    bench.remove(bench.names[0])
    outcome = bench.grasper.place(bin=bench.names[0])
    assert outcome.stage == "lift" and outcome.reason == "the object was lost on the way" and bench.at_rest()
    assert "nothing is held" in said(lambda: bench.grasper.place(bin="can"))


@pytest.mark.parametrize("true, taken, met", [("ring", "can", True), ("brick", "ball", False)])
def test_what_is_as_wide_as_its_class_cannot_be_is_put_back(true: str, taken: str, met: bool):
    """A ring that is taken for a can: the fingers come down on it, elsewhere close on it, feel how wide it is and let
    go of it where it was. A brick is narrower than a ball."""
    kind, up = CLASS_NAMES.index(true), np.array([0.0, 0.0, np.pi / 2, 0.0, 0.0])
    placement = Placement(kind, np.array([0.18, 0.05, CATALOGUE[kind].half_height]), 0.0)
    scene = tabletop_scene(0, objects=[placement], distractors=False, bins=(), start=up)
    told: list[str] = []
    grasper = Grasper(
        SimulatedRobot(scene),
        lambda _: [SeenObject(taken, 1.0, scene.object_poses()[0][0], 0.0)],
        program("truth").planner,
        up,
        on_stage=told.append,
    )
    outcome = grasper.pick(taken)
    assert outcome.stage == "identify" and outcome.reason == f"what is between the fingers is no {taken}"
    assert ("give up: the arm met something on the way" in told) == met
    assert not scene.lifted(0.005).any() and np.linalg.norm(scene.object_poses()[0] - scene.start) < 0.02
    np.testing.assert_allclose(grasper.robot.joints(), up, atol=0.01)


def test_a_dry_run_is_told_what_an_arm_would_be():
    """It needs no simulator, only what is seen."""
    planner = program("truth").planner
    arm, seen = planner.arm, SeenObject("ball", 0.9, np.array([0.17, -0.08, 0.015]), 0.001)
    perception: Perception = lambda _: [seen]
    robot = DryRun(arm, arm.home, image=np.zeros((4, 4, 3), np.uint8))
    grasper = Grasper(robot, perception, planner, arm.home)
    assert grasper.pick("ball").success
    assert grasper.place(np.array([0.12, 0.12])).success
    times = np.array([one.time for one in robot.commands])
    joints = np.array([one.joints for one in robot.commands])
    assert (np.diff(times) >= 0).all() and times[-1] < 60
    assert (joints >= arm.lower - 1e-5).all() and (joints <= arm.upper + 1e-5).all()
    speeds = np.abs(np.diff(joints, axis=0)).max(1)[np.diff(times) > 0] / np.diff(times)[np.diff(times) > 0]
    assert speeds.max() < 1.51
    np.testing.assert_array_equal(joints[-1], arm.home)
