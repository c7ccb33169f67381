"""Images become RGB uint8 or are refused in one line; letterboxing can be undone."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from arm5dof.errors import UserError
from arm5dof.vision import images


def test_colours_keep_their_order(tmp_path):
    red = np.zeros((4, 6, 3), np.uint8)
    red[..., 0] = 200
    cv2.imwrite(str(tmp_path / "red.png"), red[..., ::-1])
    np.testing.assert_array_equal(images.read(tmp_path / "red.png"), red)


def test_grey_alpha_and_sixteen_bits_from_files(tmp_path):
    grey = np.arange(24, dtype=np.uint8).reshape(4, 6)
    alpha = np.dstack([grey, grey + 1, grey + 2, np.full_like(grey, 7)])
    cv2.imwrite(str(tmp_path / "grey.png"), grey)
    cv2.imwrite(str(tmp_path / "alpha.png"), alpha)
    cv2.imwrite(str(tmp_path / "deep.png"), grey.astype(np.uint16) * 257)
    np.testing.assert_array_equal(images.read(tmp_path / "grey.png"), np.dstack([grey] * 3))
    np.testing.assert_array_equal(images.read(tmp_path / "alpha.png"), alpha[..., 2::-1])
    np.testing.assert_array_equal(images.read(tmp_path / "deep.png"), np.dstack([grey] * 3))


def test_photographs_are_turned_upright(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6  # Orientation: a quarter turn clockwise is due.
    pixels = np.zeros((16, 32, 3), np.uint8)
    pixels[:, :16] = 255
    Image.fromarray(pixels).save(tmp_path / "turned.jpg", exif=exif)
    image = images.read(tmp_path / "turned.jpg")
    assert image.shape == (32, 16, 3) and image[:12].min() > 200 and image[20:].max() < 50
    assert images.read(tmp_path / "turned.jpg", upright=False).shape == (16, 32, 3)
    Image.fromarray(pixels).save(tmp_path / "plain.jpg")
    assert images.has_orientation(tmp_path / "turned.jpg") and not images.has_orientation(tmp_path / "plain.jpg")
    (tmp_path / "words.jpg").write_text("hello")
    assert not images.has_orientation(tmp_path / "words.jpg")


def test_damage_is_told_in_a_line_of_our_own(tmp_path, capfd):
    pixels = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    for suffix in (".jpg", ".png"):
        content = bytearray(cv2.imencode(suffix, pixels)[1].tobytes())
        (tmp_path / f"short{suffix}").write_bytes(content[: len(content) // 2])
        content[len(content) // 2 : len(content) // 2 + 8] = bytes(8)
        (tmp_path / f"flipped{suffix}").write_bytes(content)
    with pytest.warns(UserWarning, match=r"flipped.jpg may be damaged, look at it: Corrupt JPEG data"):
        assert images.read(tmp_path / "flipped.jpg").shape == pixels.shape
    for name in ("short.jpg", "short.png", "flipped.png"):
        with pytest.raises(UserError, match=f"{name} is empty, damaged, or no image"):
            images.read(tmp_path / name)
    assert capfd.readouterr().err == ""  # Where libjpeg and libpng would say it in their own words.


def test_ranges_meet_at_both_ends_and_round():
    np.testing.assert_array_equal(images.rgb(np.array([[0, 128, 129, 65535]], np.uint16))[..., 0], [[0, 0, 1, 255]])
    np.testing.assert_array_equal(images.rgb(np.array([[0, 0.5, 1.0]]))[..., 0], [[0, 128, 255]])


def test_a_photograph(test_data):
    image = images.read(test_data / "vision" / "photos" / "bus.jpg")
    assert image.shape == (1080, 810, 3) and image.dtype == np.uint8 and image.flags.c_contiguous


@pytest.mark.parametrize(
    "array, says",
    [
        (np.zeros((0, 5, 3), np.uint8), "not empty"),
        (np.zeros((5, 5, 2), np.uint8), "shape"),
        (np.zeros(5, np.uint8), "shape"),
        (np.zeros((1, 5, 5, 3), np.uint8), "shape"),
        (np.full((5, 5), np.nan), "not finite"),
        (np.full((5, 5), -np.inf), "not finite"),
        (np.full((5, 5), 1.01), r"\[0, 1\]"),
        (np.full((5, 5), -0.01), r"\[0, 1\]"),
        (np.zeros((5, 5), np.int64), "int64"),
        (np.zeros((5, 5), bool), "bool"),
    ],
)
def test_other_arrays_are_refused(array, says):
    with pytest.raises(UserError, match=says):
        images.rgb(array)


def test_files_that_are_no_images_are_refused(tmp_path):
    whole = cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8))[1].tobytes()
    for name, content in {"empty.jpg": b"", "text.jpg": b"hello", "cut.jpg": whole[: len(whole) // 2]}.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(UserError, match=name):
            images.read(tmp_path / name)
    with pytest.raises(UserError, match="no image"):
        images.read(tmp_path / "nowhere.jpg")
    with pytest.raises(UserError, match="no image"):
        images.read(tmp_path)


sides = st.integers(1, 300)


@given(width=sides, height=sides, stride=st.sampled_from([None, 32, 64]), seed=st.integers(0, 99))
def test_boxes_go_there_and_back(width, height, stride, seed):
    image = np.zeros((height, width, 3), np.uint8)
    boxed = images.letterbox(image, (128, 128), stride)
    x, y = np.sort(np.random.default_rng(seed).uniform(0, 1, (2, 5, 2)), axis=-1)
    boxes = np.stack([x[:, 0] * width, y[:, 0] * height, x[:, 1] * width, y[:, 1] * height], axis=-1)
    inside = boxes * np.tile(np.array(boxed.inner) / boxed.source, 2) + np.tile(boxed.offset, 2)
    np.testing.assert_allclose(boxed.to_source(inside), boxes, atol=1e-9)
    assert (inside >= 0).all() and (inside <= np.tile(boxed.image.shape[1::-1], 2)).all()


@given(width=sides, height=sides)
def test_the_image_fills_one_side_and_borders_are_grey(width, height):
    image = np.full((height, width, 3), 255, np.uint8)
    square = images.letterbox(image, (128, 128))
    tight = images.letterbox(image, (128, 128), 32)
    for boxed in (square, tight):
        white = (boxed.image == 255).all(-1)
        (left, top), (w, h) = boxed.offset, boxed.inner
        assert max(w, h) == 128 and white.sum() == w * h and white[top : top + h, left : left + w].all()
        assert (boxed.image[~white] == images.GREY).all()
        # The aspect is kept to within the rounding of one pixel.
        assert abs(w * height - h * width) <= max(width, height)
    assert square.image.shape == (128, 128, 3)
    assert all(n % 32 == 0 and n - inner < 32 for n, inner in zip(tight.image.shape[1::-1], tight.inner, strict=True))


def test_boxes_are_cut_off_at_the_edges():
    boxed = images.letterbox(np.zeros((50, 100, 3), np.uint8), (64, 64))
    np.testing.assert_allclose(boxed.to_source([[-5, 0, 80, 64]]), [[0, 0, 100, 50]])
    np.testing.assert_allclose(boxed.to_source([[32, 32, 48, 48]]), [[50, 25, 75, 50]])


@pytest.mark.parametrize("size", [0, -32, 31, 100])
def test_input_sizes_are_multiples_of_the_stride(size):
    with pytest.raises(UserError, match="multiple of 32"):
        images.check_size(size)
