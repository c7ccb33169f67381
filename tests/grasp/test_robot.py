"""Robots: the simulated one grasps by friction alone, and a dry run keeps what it was told."""

import numpy as np
import pytest
from helpers.grasping import joints_above

from arm5dof.arm import load_arm
from arm5dof.errors import UserError
from arm5dof.grasp.robot import DryRun, SimulatedRobot
from arm5dof.grasp.scene import Disturbance, tabletop_scene
from arm5dof.vision.objects import CATALOGUE
from arm5dof.vision.synthetic.scenes import Placement

UP = np.array([0.0, 0.0, np.pi / 2, 0.0, -1.5])


def single(class_id, seed, **options):
    """A scene with one object, anywhere an object may lie, however turned."""
    rng = np.random.default_rng([seed, class_id])
    radius, azimuth, yaw = rng.uniform(0.10, 0.25), rng.uniform(-1.74, 1.74), rng.uniform(-np.pi, np.pi)
    position = np.array([radius * np.cos(azimuth), radius * np.sin(azimuth), CATALOGUE[class_id].half_height])
    placement = Placement(class_id, position, yaw)
    return tabletop_scene((seed, class_id), objects=[placement], distractors=False, bins=(), start=UP, **options)


def grasp(scene, error=(0.0, 0.0)):
    """Grasp the only object where it is said to be, lift it and hold it; whether it came along, and stayed."""
    position, height = scene.objects[0].position[:2] + error, scene.objects[0].position[2]
    heights = height + np.concatenate([np.linspace(0.05, 0, 11), np.linspace(0, 0.06, 13)[1:]])
    joints = joints_above(scene, position, heights)
    robot = SimulatedRobot(scene)
    robot.grip(min(2 * (scene.objects[0].catalogue_object.radius + 0.006), scene.gripper.limits[1]))
    robot.move([1.0], joints[:1])
    robot.move(np.linspace(0.06, 0.6, 10), joints[1:11])
    assert np.linalg.norm(scene.data.site_xpos[scene.arm.site] - [*position, height]) < 1e-3
    robot.grip(-0.02)
    robot.move(np.linspace(0.06, 0.72, 12), joints[11:])
    lifted = bool(scene.lifted()[0])
    robot.move([2.0], joints[-1:])
    return lifted and bool(scene.lifted()[0])


@pytest.mark.parametrize("class_id", range(len(CATALOGUE)), ids=[one.name for one in CATALOGUE])
def test_single_objects_are_lifted_and_held(class_id):
    assert all(grasp(single(class_id, seed)) for seed in range(3))


def test_they_are_held_with_half_the_friction_and_twice_the_mass_and_3_mm_beside():
    for class_id in range(len(CATALOGUE)):
        scene = single(class_id, 7, disturbance=Disturbance(friction=0.5, mass=2.0))
        assert grasp(scene, (0.002, -0.002))


def test_nothing_is_lifted_without_friction_or_beside_an_object():
    assert not grasp(single(3, 0, disturbance=Disturbance(friction=0.001)))
    assert not grasp(single(3, 1), (0.03, 0.03))


def test_it_goes_where_it_is_told_and_says_where_it_is():
    scene = single(0, 0)
    calls = []
    robot = SimulatedRobot(scene, on_step=lambda: calls.append(scene.data.time), every=0.1)
    target = UP + np.array([0.5, -0.3, 0.2, -0.4, 0.3])
    robot.move([0.5, 1.0], [UP, target])
    np.testing.assert_allclose(robot.joints(), target, atol=2e-3)
    assert 1.0 <= scene.data.time < 1.5
    np.testing.assert_allclose(np.diff(calls), 0.1, atol=1e-9)
    for opening in (0.05, 0.01):
        robot.grip(opening)
        assert robot.opening() == pytest.approx(opening, abs=1e-3)
    image = robot.image()
    assert image.shape == (480, 640, 3) and image.dtype == np.uint8
    first = image.copy()
    image[:] = 0
    np.testing.assert_array_equal(robot.image(), first)  # Nothing has moved.
    robot.move([0.5], [UP])
    assert (robot.image() != first).any()


def test_bad_trajectories_are_refused():
    for robot in (SimulatedRobot(single(0, 0)), DryRun(load_arm("arm5.xml"))):
        for times, joints in (([1.0], np.zeros((1, 4))), ([], np.zeros((0, 5))), ([1.0], np.zeros(5))):
            with pytest.raises(UserError, match="a trajectory has times"):
                robot.move(times, joints)
        for times, joints in (
            ([1.0, 1.0], np.zeros((2, 5))),
            ([0.0], np.zeros((1, 5))),
            ([1.0], np.full((1, 5), np.nan)),
        ):
            with pytest.raises(UserError, match="times that rise from above 0"):
                robot.move(times, joints)


def test_a_dry_run_keeps_what_it_was_told():
    arm = load_arm("arm5.xml")
    robot = DryRun(arm, opening=0.01)
    np.testing.assert_array_equal(robot.joints(), arm.home)
    robot.grip(0.03)
    robot.move([0.5, 1.0], [UP, 2 * UP])
    robot.grip(0.0)
    assert [round(c.time, 6) for c in robot.commands] == [0, 0.2, 0.7, 1.2, 1.5]
    assert [c.opening for c in robot.commands] == [0.01, 0.03, 0.03, 0.03, 0.0]
    np.testing.assert_array_equal(robot.joints(), 2 * UP)
    assert robot.opening() == pytest.approx(0.022), "something of the width for which it was opened is held"
    with pytest.raises(UserError, match="no image"):
        robot.image()
    photo = np.zeros((4, 5, 3), np.uint8)
    assert DryRun(arm, image=photo).image() is photo
