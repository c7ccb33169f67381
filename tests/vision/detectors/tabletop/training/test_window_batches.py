"""What the proposer learns from."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arm5dof.vision.detectors.tabletop.training.training_set import TrainingSet
from arm5dof.vision.detectors.tabletop.training.window_batches import ROWS, WINDOW, window_batch
from arm5dof.vision.synthetic.samples import HEIGHT, WIDTH


@pytest.fixture(scope="module")
def squares():
    """Two bright objects on black, one of them half hidden by nothing but its own number of pixels."""
    images, owners = np.zeros((2, HEIGHT, WIDTH, 3), np.uint8), np.zeros((2, HEIGHT, WIDTH), np.uint8)
    boxes = np.array([[300, 200, 330, 224], [100, 400, 120, 440]])
    for image, owner, (left, top, right, bottom) in zip(images, owners, boxes, strict=True):
        image[top:bottom, left:right], owner[top:bottom, left:right] = 200, 1
    area = np.prod(boxes[:, 2:] - boxes[:, :2], axis=1)
    return TrainingSet(images, owners, np.array([0, 1]), boxes, np.array([3, 5]), np.array([1.0, 1.0]), area)


@given(seed=st.integers(0, 10_000))
def test_boxes_surround_what_windows_show(squares, seed):
    (images,), (labels,) = window_batch(squares, (seed,), 4)
    assert images.shape == (4, WINDOW, WINDOW, 3) and images.dtype == np.uint8
    for i, image in enumerate(images):
        there = labels.found[i] | labels.ignored[i]
        assert labels.boxes[i].shape == (ROWS, 4) and not (labels.found[i] & labels.ignored[i]).any()
        boxes = labels.boxes[i][there]
        assert (boxes[:, :2] >= 0).all() and (boxes <= WINDOW).all() and (boxes[:, 2:] > boxes[:, :2]).all()
        bright = np.zeros(image.shape[:2], bool)
        for left, top, right, bottom in np.round(boxes).astype(int):
            bright[top:bottom, left:right] = True
        # Noise, blur and rounding blur the edges, never the middles.
        shown = image.min(-1) > 45
        assert (shown != bright).sum() <= 2 * (boxes[:, 2:] - boxes[:, :2]).sum() + 2


def test_what_is_mostly_outside_is_ignored(squares):
    ignored = found = 0
    for seed in range(60):
        _, (labels,) = window_batch(squares, (seed,), 8)
        ignored, found = ignored + labels.ignored.sum(), found + labels.found.sum()
    assert 0 < ignored < found


def test_the_same_seed_gives_the_same_bits(squares):
    seeds = (1, 2), (1, 2), (1, 3)
    (one, (labels,)), (same, (others,)), (other, _) = (window_batch(squares, seed, 3) for seed in seeds)
    np.testing.assert_array_equal(one, same)
    for a, b in zip(labels, others, strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(one, other)
