"""Overlap, suppression and conversions of boxes, beside pycocotools' and OpenCV's own results."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arm5dof.vision import boxes
from arm5dof.vision.boxes import giou, iou

SEEDS = st.integers(0, 2**32 - 1)


def some(random, n, low=-20.0):
    """Boxes (n, 4) of which many overlap."""
    corner = random.uniform(low, 50, (n, 2))
    return np.concatenate([corner, corner + random.uniform(1, 50, (n, 2))], axis=1)


def xywh(xyxy):
    return np.concatenate([xyxy[:, :2], xyxy[:, 2:] - xyxy[:, :2]], axis=1)


@given(SEEDS)
def test_overlaps(seed):
    """As pycocotools counts them; and the generalized IoU is less by the share of the hull that neither covers."""
    mask = pytest.importorskip("pycocotools.mask")
    random = np.random.default_rng(seed)
    a, b = (
        np.concatenate([low := random.uniform(0, 50, (6, 2)), low + random.uniform(1, 50, (6, 2))], 1) for _ in "ab"
    )
    theirs = mask.iou(*(np.concatenate([x[:, :2], x[:, 2:] - x[:, :2]], 1) for x in (a, b)), [0] * 6)
    np.testing.assert_allclose(iou(a[:, None], b), theirs, atol=1e-5)
    for one, other, fit in zip(a, b, np.diag(theirs), strict=True):
        area = [np.prod(x[2:] - x[:2]) for x in (one, other)]
        hull = np.prod(np.maximum(one[2:], other[2:]) - np.minimum(one[:2], other[:2]))
        union = sum(area) / (1 + fit)
        assert giou(one, other) == pytest.approx(fit - (hull - union) / hull, abs=1e-5)


@given(SEEDS)
def test_overlaps_are_symmetric_and_one_for_the_same_box(seed):
    random = np.random.default_rng(seed)
    a, b = some(random, 7), some(random, 5)
    for measure in (iou, giou):
        np.testing.assert_array_equal(measure(a[:, None], b), measure(b[:, None], a).T)
        np.testing.assert_allclose(measure(a, a), 1)
    shift, scale = random.uniform(-9, 9, 2), random.uniform(0.5, 2)
    moved = [scale * (x + np.tile(shift, 2)) for x in (a, b)]
    np.testing.assert_allclose(iou(moved[0][:, None], moved[1]), iou(a[:, None], b), atol=1e-6)
    assert (giou(a[:, None], b) <= iou(a[:, None], b) + 1e-9).all() and (giou(a[:, None], b) > -1).all()


@given(SEEDS)
def test_jax_and_numpy_agree(seed):
    random = np.random.default_rng(seed)
    a, b = some(random, 4), some(random, 3)
    for measure in (iou, giou):
        traced = jax.jit(lambda a, b, measure=measure: measure(a[:, None], b))(a, b)
        assert isinstance(traced, jax.Array) and measure(np.float32(a), np.float32(a)).dtype == np.float64
        np.testing.assert_allclose(traced, measure(a[:, None], b), atol=1e-5)
        assert isinstance(measure(jnp.asarray(a[0]), b[0]), jax.Array)


def test_boxes_that_do_not_meet_or_are_empty():
    here, there, empty = np.array([[0, 0, 2, 2], [2, 0, 4, 2], [1, 1, 1, 1.0]])
    assert iou(here, there) == iou(here, empty) == iou(empty, empty) == 0
    assert giou(here, there) == 0
    assert giou(here, there + 100) < giou(here, there + 1) < 0
    pull = jax.grad(lambda box: giou(box, there + 1))(jnp.asarray(here))
    assert (pull[2:] > 0).all(), "it says where to go"


@given(SEEDS, st.integers(0, 30), st.sampled_from([0.2, 0.45, 0.7]))
def test_suppression_is_opencv_s(seed, n, threshold):
    random = np.random.default_rng(seed)
    xyxy, scores = some(random, n, 0.0), random.uniform(0.01, 1, n)
    kept = boxes.nms(xyxy, scores, threshold)
    theirs = cv2.dnn.NMSBoxes(xywh(xyxy).tolist(), scores.tolist(), 0.0, threshold) if n else []
    np.testing.assert_array_equal(kept, np.asarray(theirs, int))
    assert (np.diff(scores[kept]) <= 0).all()

    group = random.integers(0, 3, n)
    kept = boxes.nms(xyxy - 1000, scores, threshold, group)
    rows = [np.flatnonzero(group == g) for g in range(3)]
    expected = np.concatenate([r[boxes.nms(xyxy[r], scores[r], threshold)] for r in rows])
    assert set(kept) == set(expected)


@given(SEEDS)
def test_what_suppression_keeps_overlaps_less_than_the_threshold(seed):
    random = np.random.default_rng(seed)
    xyxy, scores = some(random, 40), random.uniform(0.01, 1, 40)
    kept = xyxy[boxes.nms(xyxy, scores, 0.3)]
    assert (iou(kept[:, None], kept) - np.eye(len(kept))).max() < 0.3 + 1e-4


@given(SEEDS, st.floats(1, 1000))
def test_conversions(seed, width):
    xyxy = some(np.random.default_rng(seed), 6)
    center_size = np.concatenate([(xyxy[:, :2] + xyxy[:, 2:]) / 2, xyxy[:, 2:] - xyxy[:, :2]], axis=1)
    np.testing.assert_allclose(boxes.from_center_size(center_size), xyxy, atol=1e-9)
    before, mirrored = xyxy.copy(), boxes.mirror(xyxy, width)
    np.testing.assert_array_equal(xyxy, before)
    np.testing.assert_allclose(boxes.mirror(mirrored, width), xyxy, atol=1e-9)
    np.testing.assert_allclose(mirrored[:, 2:] - mirrored[:, :2], xyxy[:, 2:] - xyxy[:, :2], atol=1e-9)
    np.testing.assert_allclose(mirrored[0], boxes.mirror(xyxy[0], width))


def test_boxes_around_masks():
    mask = np.zeros((20, 30), bool)
    assert boxes.around_mask(mask) == (0, 0, 0, 0)
    mask[3:7, 10:12] = mask[5, 20] = True
    assert boxes.around_mask(mask) == (10, 3, 21, 7)
