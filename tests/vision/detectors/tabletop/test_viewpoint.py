"""What is said of cameras that the tabletop detector was not trained for."""

import numpy as np
import pytest
from helpers.tabletop import camera_at, pose
from scipy.spatial.transform import Rotation

from arm5dof.vision.camera import Camera
from arm5dof.vision.detectors.tabletop.viewpoint import unlike_training
from arm5dof.vision.synthetic.scene_builder import CAMERA, SECOND
from arm5dof.vision.synthetic.scenes import random_scene


def camera(distance, elevation, roll=0.0, around=1.0, height=0.0):
    """A camera that looks at a point of the table from so far, so many degrees above it, rolled by as many."""
    up = np.deg2rad(elevation)
    away = np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
    right = np.array([-np.sin(around), np.cos(around), 0])
    level = np.stack([right, np.cross(-away, right), -away], axis=1)
    turned = level @ Rotation.from_euler("z", roll, degrees=True).as_matrix()
    return camera_at(pose(turned, [0.2, 0.1, height] + distance * away))


@pytest.mark.parametrize("around", [-2.0, 0.0, 1.0])
def test_cameras_as_in_training_are_not_remarked_on(around):
    for distance, elevation, roll in [(0.52, 32, 0), (0.98, 89.9, 170), (0.7, 60, 10), (0.7, 60, -10)]:
        assert unlike_training(camera(distance, elevation, roll, around)) == ""
    assert unlike_training(camera(0.7, 60, 0, around, height=0.5), 0.5) == ""


def test_the_cameras_of_training_and_evaluation_are_not_remarked_on():
    for number in range(3):
        scene = random_scene((0, number), "evaluation")
        for name in (CAMERA, SECOND):
            assert unlike_training(Camera.from_mujoco(scene.model, name, 640, 480, scene.data)) == ""


@pytest.mark.parametrize(
    ("seen_from", "said"),
    [
        ((0.31, 60), "0.31 m from the table"),
        ((1.4, 60), "1.40 m from the table"),
        ((0.7, 20), "20 degrees above it"),
        ((0.7, 60, 90), "rolled by 90 degrees"),
        ((0.7, 60, -40), "rolled by 40 degrees"),
        ((0.7, 60, 180), "rolled by 180 degrees"),
        ((0.3, 25, 180), "0.30 m from the table, 25 degrees above it, rolled by 180 degrees"),
        ((0.7, -30), "-30 degrees above it"),
    ],
)
def test_what_is_unusual_is_named(seen_from, said):
    assert unlike_training(camera(*seen_from)) == said


def test_a_table_of_another_height_is_another_distance():
    assert unlike_training(camera(0.7, 90), 0.3) == "0.40 m from the table"
