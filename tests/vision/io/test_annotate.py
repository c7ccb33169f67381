"""Boxes are drawn where they are, in colours that people tell apart, and text can be read on them."""

import itertools

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arm5dof.vision.detections import Detections
from arm5dof.vision.io.annotate import BLACK, PALETTE, WHITE, annotate, ink

NAMES = ("cube", "ball", "ring")

# How colours look to people without one kind of cone: Machado, Oliveira and Fernandes 2009, severity 1, linear RGB.
VISION = {
    "usual": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.3039]],
}


def linear(colour):
    share = np.array(colour) / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def test_boxes_are_drawn_on_a_copy():
    image = np.full((200, 300, 3), 128, np.uint8)
    found = Detections([[100, 60, 160, 150], [200, 100, 240, 140]], [0.9, 0.5], [2, 0], NAMES)
    drawn = annotate(image, found)
    assert (image == 128).all() and drawn.shape == image.shape
    for x, y in ((100, 100), (159, 100), (130, 149), (130, 60)):  # In the middle of each edge, its outermost pixel.
        np.testing.assert_array_equal(drawn[y, x], PALETTE[2])
    np.testing.assert_array_equal(drawn[120, 239], PALETTE[0])
    changed = (drawn != 128).any(-1)
    assert not changed[63:147, 103:157].any(), "what is inside the box stays to be seen"
    assert changed[30:58, 100:160].any(), "its name is above it"
    changed[:, 90:] = False
    assert not changed.any()
    np.testing.assert_array_equal(annotate(image, found[:0]), image)


def test_the_most_confident_is_on_top():
    same = [[10, 30, 90, 90]] * 2
    drawn = annotate(np.zeros((100, 100, 3), np.uint8), Detections(same, [0.4, 0.8], [0, 1], NAMES))
    np.testing.assert_array_equal(drawn[60, 10], PALETTE[1])


def test_lines_and_names_grow_with_the_image():
    def width(side):
        found = Detections([[side / 4, side / 4, side / 2, side / 2]], [0.9], [0], NAMES)
        drawn = annotate(np.zeros((side, side, 3), np.uint8), found)
        return (drawn[3 * side // 8] == PALETTE[0]).all(-1)[: 3 * side // 8].sum()

    assert [width(side) for side in (100, 400, 1600)] == [1, 1, 5]  # OpenCV's thick lines are an odd number wide.


@pytest.mark.parametrize("vision", VISION)
def test_colours_that_everybody_tells_apart(vision):
    """As far apart as CIE76 calls plainly different colours."""
    seen = np.clip([np.array(VISION[vision]) @ linear(colour) for colour in PALETTE], 0, 1)
    encoded = np.where(seen <= 0.0031308, 12.92 * seen, 1.055 * seen ** (1 / 2.4) - 0.055)
    lab = cv2.cvtColor(encoded.astype(np.float32)[None], cv2.COLOR_RGB2Lab)[0]
    assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(lab, 2)) > 10


def test_text_stands_out_from_its_ground():
    """By WCAG 2's measure, whose bar for text is 4.5."""

    def contrast(a, b):
        low, high = sorted(float(linear(c) @ [0.2126, 0.7152, 0.0722]) for c in (a, b))
        return (high + 0.05) / (low + 0.05)

    for colour in PALETTE:
        other = WHITE if ink(colour) == BLACK else BLACK
        assert contrast(colour, ink(colour)) > max(4.5, contrast(colour, other))


numbers = st.floats(-(2.0**100), 2.0**100, width=32) | st.floats(-50, 350, width=32)


@given(
    width=st.integers(1, 300),
    height=st.integers(1, 300),
    boxes=st.lists(st.tuples(numbers, numbers, numbers, numbers), max_size=5),
    name=st.text(max_size=40),
)
def test_boxes_may_be_anywhere(width, height, boxes, name):
    image = np.zeros((height, width, 3), np.uint8)
    found = Detections(np.array(boxes), np.full(len(boxes), 0.5), np.zeros(len(boxes), int), (name,))
    drawn = annotate(image, found)
    assert drawn.shape == image.shape and drawn.dtype == np.uint8
    outside = [b for b in boxes if b[0] >= width or b[1] >= height or b[2] <= 0 or b[3] <= 0]
    if len(outside) == len(boxes):
        assert not drawn.any()


@given(left=st.integers(-200, 250), top=st.integers(-200, 150), side=st.integers(1, 200))
def test_names_stay_inside_the_image(left, top, side):
    found = Detections([[left, top, left + side, top + side]], [0.5], [0], ("cube",))
    ground = (annotate(np.zeros((200, 300, 3), np.uint8), found) == PALETTE[0]).all(-1)
    if left + side > 0 and top + side > 0:
        assert ground[:, :-1].sum(1).max() >= 40, "the ground of the text is in sight"
