"""Detections are sorted and checked; suppression keeps the best of what overlaps, class by class."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arm5dof.errors import UserError
from arm5dof.vision.boxes import nms
from arm5dof.vision.detections import Detections, check_thresholds

NAMES = ("cube", "ball", "ring")


@pytest.fixture
def three():
    return Detections([[0, 0, 2, 2], [10, 20, 30, 60], [5, 5, 9, 9]], [0.3, 0.9, 0.5], [0, 2, 0], NAMES)


def iou(a, b):
    low, high = np.maximum(a[:2], b[:2]), np.minimum(a[2:], b[2:])
    shared = np.prod(np.clip(high - low, 0, None))
    return shared / (np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2]) - shared)


def test_the_most_confident_comes_first(three):
    np.testing.assert_allclose(three.confidence, [0.9, 0.5, 0.3])
    np.testing.assert_array_equal(three.class_id, [2, 0, 0])
    np.testing.assert_array_equal(three.xyxy[0], [10, 20, 30, 60])
    assert three.xyxy.dtype == np.float32 and three.confidence.dtype == np.float32 and three.class_id.dtype == int
    assert list(three.data["class_name"]) == ["ring", "cube", "cube"]


def test_some_of_them(three):
    assert [one.data["class_name"][0] for one in three] == ["ring", "cube", "cube"]
    np.testing.assert_allclose(three.named("cube").confidence, [0.5, 0.3])
    np.testing.assert_allclose(three.named("cube", "ring", "ball").confidence, [0.9, 0.5, 0.3])
    assert len(three.named("ball")) == 0 and three.named("ball").xyxy.shape == (0, 4)
    np.testing.assert_allclose(three[three.confidence > 0.4].confidence, [0.9, 0.5])
    with pytest.raises(UserError, match="cube, ball, ring"):
        three.named("cup")


def test_centers_count_from_the_middle_of_the_first_pixel():
    one_pixel = Detections([[3, 7, 4, 8]], [1], [0], NAMES)
    np.testing.assert_array_equal(one_pixel.center, [[3, 7]])


def test_json(three):
    first = json.loads(three.to_json())[0]
    assert first == {"class_name": "ring", "class_id": 2, "confidence": 0.9, "xyxy": [10, 20, 30, 60]}
    assert json.loads(Detections([], [], [], NAMES).to_json()) == []


@pytest.mark.parametrize(
    "boxes, confidence, class_id",
    [
        ([[0, 0, 1, 1]], [0.5, 0.4], [0, 0]),
        ([[0, 0, 1, np.nan]], [0.5], [0]),
        ([[0, 0, 1, 1]], [np.nan], [0]),
        ([[0, 0, 1, 1]], [0.5], [3]),
        ([[0, 0, 1, 1]], [0.5], [-1]),
    ],
)
def test_what_does_not_fit_together_is_refused(boxes, confidence, class_id):
    with pytest.raises(ValueError):
        Detections(boxes, confidence, class_id, NAMES)


@given(seed=st.integers(0, 10_000), n=st.integers(0, 40), threshold=st.sampled_from([0.2, 0.45, 0.7]))
def test_suppression_keeps_the_best_of_each_class(seed, n, threshold):
    random = np.random.default_rng(seed)
    boxes = np.concatenate([random.uniform(-20, 60, (n, 2)), random.uniform(5, 40, (n, 2))], axis=1)
    scores = random.uniform(0, 1, (n, 3))
    found = Detections.from_scores(boxes, scores, NAMES, 0.5, threshold)

    corners = np.concatenate([boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, :2] + boxes[:, 2:] / 2], axis=1)
    best = scores.argmax(1)
    expected = []
    for i in np.argsort(-scores.max(1)):
        rivals = [j for j in expected if best[j] == best[i]]
        if scores[i].max() >= 0.5 and all(iou(corners[i], corners[j]) <= threshold for j in rivals):
            expected.append(i)
    np.testing.assert_allclose(found.xyxy, corners[expected].reshape(-1, 4), rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(found.class_id, best[expected])

    kept = boxes[expected].reshape(-1, 4), scores[expected].reshape(-1, 3)
    again = Detections.from_scores(*kept, NAMES, 0.5, threshold)
    np.testing.assert_array_equal(again.xyxy, found.xyxy)


def test_suppression_keeps_classes_apart_and_without_them_the_best_of_all():
    boxes, scores = np.array([[5, 5, 4, 4], [5, 5, 4, 5], [50, 5, 4, 4]]), np.array([[0.6, 0], [0, 0.9], [0.7, 0]])
    found = Detections.from_scores(boxes, scores, ("cube", "ball"), 0.25, 0.45)
    assert len(found) == 3
    kept = nms(found.xyxy, found.confidence, 0.45)
    np.testing.assert_array_equal(found.class_id[kept], [1, 0])


def test_suppression_of_nothing_of_flat_boxes_and_of_too_many():
    assert len(Detections.from_scores(np.empty((0, 4)), np.empty((0, 3)), NAMES, 0.25, 0.45)) == 0
    flat = np.array([[5, 5, 0, 3], [5, 5, 3, -1]])
    assert len(Detections.from_scores(flat, np.ones((2, 3)), NAMES, 0.25, 0.45)) == 0
    apart = np.array([[10.0 * i, 5, 4, 4] for i in range(20)])
    few = Detections.from_scores(apart, np.linspace(0.5, 0.9, 20)[:, None], ("cube",), 0.25, 0.45, limit=3)
    np.testing.assert_allclose(few.confidence, np.linspace(0.5, 0.9, 20)[:-4:-1], rtol=1e-6)


def test_what_is_not_finite_is_refused():
    with pytest.raises(UserError, match="not finite"):
        Detections.from_scores(np.array([[5, 5, np.nan, 3]]), np.ones((1, 3)), NAMES, 0.25, 0.45)
    with pytest.raises(UserError, match="iou"):
        check_thresholds(0.5, 1.2)
    with pytest.raises(UserError, match="confidence"):
        check_thresholds(-0.1, 0.5)
