"""What is seen is where it is, to a few millimetres; images and cameras that do not fit are refused."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.errors import said

from arm5dof.grasp.perception import CameraPerception
from arm5dof.grasp.robot import SimulatedRobot
from arm5dof.grasp.scene import TabletopScene, tabletop_scene
from arm5dof.vision.detections import Detections, Detector
from arm5dof.vision.detectors.loading import load_detector
from arm5dof.vision.objects import CLASS_NAMES

UP = np.array([0.0, 0.0, np.pi / 2, 0.0, 0.0])


@pytest.fixture(scope="module")
def detector() -> Detector:
    return load_detector()


@pytest.fixture(scope="module")
def scene() -> TabletopScene:
    return tabletop_scene((31, 0), start=UP)


def test_objects_are_seen_where_they_are(detector: Detector):
    found, missed = [], 0
    for number in range(6):
        scene = tabletop_scene((31, number), start=UP)
        seen = CameraPerception(detector, scene.camera)(SimulatedRobot(scene).image())
        assert [one.confidence for one in seen] == sorted((one.confidence for one in seen), reverse=True)
        for placed in scene.objects:
            same = [one for one in seen if one.name == placed.catalogue_object.name and one.position is not None]
            off = min(((np.linalg.norm(one.position - placed.position), one.std) for one in same), default=(np.inf, 0))
            if off[0] < 0.03:
                found.append(off)
            else:
                missed += 1
    error, std = np.array(found).T
    assert len(found) > 20 and missed <= 2
    assert np.median(error) < 0.001 and np.quantile(error, 0.95) < 0.004
    assert (error < 4 * std).mean() > 0.95 and np.median(std) < 0.003


def test_what_cannot_be_located_is_seen_with_a_reason(detector: Detector, scene: TabletopScene):
    """For a camera that is said to look away from the table."""
    camera = scene.camera.replace(rotation=np.asarray(scene.camera.rotation) @ np.diag([1.0, -1.0, -1.0]))
    seen = CameraPerception(detector, camera)(SimulatedRobot(scene).image())
    assert seen
    for one in seen:
        assert one.position is None and one.failure and np.isnan(one.std)


def test_what_is_faint_counts_where_nothing_certain_is(scene: TabletopScene):
    def detector(image: np.ndarray) -> Detections:
        boxes = [[300, 200, 340, 240], [302, 201, 341, 242], [100, 300, 140, 340]]
        return Detections(boxes, [0.9, 0.2, 0.2], [0, 1, 1], CLASS_NAMES)

    seen = CameraPerception(detector, scene.camera)(np.zeros((480, 640, 3), np.uint8))
    assert [(one.name, round(one.confidence, 2)) for one in seen] == [("red cube", 0.9), ("blue cube", 0.2)]


def test_cameras_and_images_that_do_not_fit_are_refused(detector: Detector, scene: TabletopScene):
    unposed = scene.camera.replace(has_extrinsics=False)
    assert said(lambda: CameraPerception(detector, unposed)).startswith("the camera has no extrinsics: find its pose")
    small = SimulatedRobot(scene, 320, 240).image()
    told = said(lambda: CameraPerception(detector, scene.camera)(small))
    assert told == "the image is 320 x 240, the camera was calibrated for 640 x 480: give one of its own"
