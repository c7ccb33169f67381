"""Crops of images, and boxes relative to them."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from arm5dof.vision.detectors.tabletop.crops import CONTEXT, boxes_to_crop, boxes_to_image, crop, crop_squares
from arm5dof.vision.detectors.tabletop.networks import CROP

SEEDS = st.integers(0, 2**32 - 1)


@given(SEEDS)
def test_crops_show_what_opencv_resizes(seed):
    """A crop whose square lies on whole pixels, at a whole scale, is that part of the image; and boxes go there and
    back."""
    random = np.random.default_rng(seed)
    image = random.integers(0, 256, (480, 640, 3), np.uint8)
    left, top = random.integers(0, (640 - CROP, 480 - CROP))
    seen = crop(image, np.array([left, top, CROP]))
    np.testing.assert_array_equal(seen, image[top : top + CROP, left : left + CROP])

    low = random.uniform(0, 400, (5, 2))
    boxes = np.concatenate([low, low + random.uniform(13, 80, (5, 2))], axis=1)
    where = crop_squares(boxes)
    np.testing.assert_allclose(where[:, 2], CONTEXT * (boxes[:, 2:] - boxes[:, :2]).max(1))
    shares = boxes_to_crop(boxes, where)
    assert (shares > 0.2).all() and (shares < 0.8).all()
    np.testing.assert_allclose((shares[:, :2] + shares[:, 2:]) / 2, 0.5)
    np.testing.assert_allclose(boxes_to_image(shares, where), boxes)


def test_crops_go_on_beyond_the_image_as_it_ends():
    image = np.full((20, 30, 3), 7, np.uint8)
    assert (crop(image, np.array([-15.0, -10.0, 60.0])) == 7).all()
