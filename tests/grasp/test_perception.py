"""What is seen is where it is, to a few millimetres; images and cameras that do not fit are refused."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.errors import said

from arm5dof.grasp.ground_truth import TrueBoxes
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
    true = TrueBoxes(scene)(np.zeros(0))
    whole = np.flatnonzero(true.confidence > 0.95)[:2]  # That is how much of them is shown.
    first, second = true.xyxy[whole]
    boxes, ids = [first, first + 1, second], [*true.class_id[whole], 0]
    detector = lambda _: Detections(boxes, [0.9, 0.2, 0.2], [ids[0], (ids[0] + 1) % 8, ids[1]], CLASS_NAMES)
    seen = CameraPerception(detector, scene.camera)(np.zeros((480, 640, 3), np.uint8))
    names = [CLASS_NAMES[i] for i in ids[:2]]
    assert [(one.name, round(one.confidence, 2)) for one in seen] == [(names[0], 0.9), (names[1], 0.2)]


def test_what_looks_too_large_or_small_for_its_class_is_hardly_believed(scene: TabletopScene):
    """A box that fits stays as sure as it is; the same one with other sizes does not."""
    true = TrueBoxes(scene)(np.zeros(0))
    for i in np.flatnonzero(true.confidence > 0.99):
        low, high = true.xyxy[i, :2], true.xyxy[i, 2:]
        middle, half = (low + high) / 2, (high - low) / 2
        for factor, fits in ((1.0, True), (1.05, True), (0.7, False), (1.4, False)):
            box = np.concatenate([middle - factor * half, middle + factor * half])
            detector = lambda _, box=box, i=i: Detections([box], [0.9], true.class_id[[i]], CLASS_NAMES)
            (seen,) = CameraPerception(detector, scene.camera)(np.zeros((480, 640, 3), np.uint8))
            assert (seen.confidence > 0.5) == fits, (seen.name, factor)


def test_cameras_and_images_that_do_not_fit_are_refused(detector: Detector, scene: TabletopScene):
    unposed = scene.camera.replace(has_extrinsics=False)
    assert said(lambda: CameraPerception(detector, unposed)).startswith("the camera has no extrinsics: find its pose")
    small = SimulatedRobot(scene, 320, 240).image()
    told = said(lambda: CameraPerception(detector, scene.camera)(small))
    assert told == "the image is 320 x 240, the camera was calibrated for 640 x 480: give one of its own"
