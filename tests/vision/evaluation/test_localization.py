"""Positions in random scenes, by true boxes and cameras known as calibration makes them known."""

import numpy as np
import pytest
from scipy.stats import chi2

from arm5dof.vision.camera import Camera
from arm5dof.vision.detections import Detections
from arm5dof.vision.evaluation.localization import LEVELS, Tally, locate_by_each, match_truth, render_stereo_sample
from arm5dof.vision.evaluation.simulated_calibration import simulate_calibration
from arm5dof.vision.localization.common import Localization
from arm5dof.vision.objects import CLASS_NAMES
from arm5dof.vision.synthetic.ground_truth import Truth
from arm5dof.vision.synthetic.scene_builder import CAMERA, SECOND
from arm5dof.vision.synthetic.scenes import random_scene


def found(there):
    """What a detector that makes no mistake finds."""
    sure = there.counts
    return Detections(there.xyxy[sure], np.linspace(0.9, 0.5, sure.sum()), there.class_id[sure], CLASS_NAMES)


def test_cameras_are_known_as_well_as_they_say():
    """The errors of what is known, in standard deviations as stated, are as large as normal ones on average."""
    squares = []
    for seed in range(60):
        scene = random_scene((3, seed), "evaluation")
        true = Camera.from_mujoco(scene.model, (CAMERA, SECOND)[seed % 2], 640, 480, scene.data)
        known = simulate_calibration(true, np.random.default_rng(seed))
        turn = known.rotation.T @ true.rotation
        small = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
        lens = np.append((true.matrix - known.matrix)[[0, 1, 0, 1], [0, 1, 2, 2]], -known.distortion)
        error = np.concatenate([lens, small, known.rotation.T @ (true.position - known.position)])
        squares.append(error @ np.linalg.solve(known.covariance, error))
    size = len(known.covariance)
    assert size == 15 and np.mean(squares) == pytest.approx(size, rel=0.2)


def test_the_levels_are_those_of_three_dimensions():
    for name, level in LEVELS.items():
        assert chi2.cdf(level, 3) == pytest.approx(int(name) / 100, abs=5e-3)


@pytest.fixture(scope="module")
def samples():
    return [render_stereo_sample(number, 4, "software") for number in range(6)]


def test_what_is_found_is_placed(samples):
    tallies = {"plane": Tally(), "depth": Tally(), "two_views": Tally()}
    for seen in samples:
        boxes = [found(view.truth) for view in seen.views]
        for method, located in locate_by_each(seen, boxes).items():
            tallies[method].add(located, seen.views[0].truth)
    for tally in tallies.values():
        accuracy = tally.accuracy()
        assert accuracy.median_mm < 3 and accuracy.p95_mm < 10 and accuracy.placed > 0.6
        assert accuracy.covered["95"] > 75


def test_a_sample_is_the_same_each_time(samples):
    again = render_stereo_sample(1, 4, "software")
    for one, other in zip(again.views, samples[1].views, strict=True):
        np.testing.assert_array_equal(one.image, other.image)
        np.testing.assert_array_equal(one.depth, other.depth)
        # OpenCV adds up in another order where it has several threads.
        np.testing.assert_allclose(one.calibrated.matrix, other.calibrated.matrix, rtol=1e-5)
    assert again.solids == samples[1].solids
    assert not np.array_equal(samples[1].views[0].image, samples[1].views[1].image)


def test_boxes_find_objects_of_their_class_that_they_fit_by_half():
    box = np.float32([[10, 10, 30, 30], [50, 10, 70, 30], [10, 50, 30, 70], [50, 50, 70, 70]])
    visible = np.array([1, 1, 1, 0.4])
    there = Truth(box, np.array([0, 1, 2, 3]), visible, np.zeros((4, 3)), np.zeros(4))
    given = [[12, 10, 30, 30], [10, 10, 30, 29.5], [50, 10, 70, 30], [10, 50, 18, 70], [50, 50, 70, 70]]
    objects, boxes = match_truth(Detections(given, [0.9, 0.8, 0.7, 0.6, 0.5], [0, 0, 3, 2, 3], CLASS_NAMES), there)
    assert list(objects) == [0] and list(boxes) == [1]
    assert [len(rows) for rows in match_truth(Detections([], [], [], CLASS_NAMES), there)] == [0, 0]


def test_tallies_count_what_has_a_place():
    there = Truth(
        np.float32([[0, 0, 9, 9], [20, 0, 29, 9]]), np.zeros(2, int), np.ones(2), np.zeros((2, 3)), np.zeros(2)
    )
    boxes = Detections(there.xyxy, [0.9, 0.8], [0, 0], CLASS_NAMES)
    position = np.array([[0.003, 0.004, 0], [np.nan] * 3])
    covariance = np.stack([np.eye(3) * 0.002**2, np.full((3, 3), np.nan)])
    tally = Tally()
    tally.add(Localization(boxes, position, covariance, ("", "outside the workspace")), there)
    accuracy = tally.accuracy()
    assert accuracy.median_mm == pytest.approx(5) and accuracy.placed == 0.5
    assert accuracy.covered == {"68": 0, "95": 100}
    assert Tally().accuracy().placed == 0
