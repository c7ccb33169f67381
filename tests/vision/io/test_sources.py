"""Depth images as depth cameras write them."""

import cv2
import numpy as np
import pytest
from helpers.photographs import vast_png
from helpers.videos import greys, write_video
from hypothesis import given
from hypothesis import strategies as st

from arm5dof.errors import UserError
from arm5dof.vision.io.sources import open_source, read_depth


def test_depth_images_are_millimetres_in_sixteen_bits(tmp_path):
    path = tmp_path / "depth.png"
    millimetres = np.arange(12, dtype=np.uint16).reshape(3, 4) * 500
    cv2.imwrite(str(path), millimetres)
    np.testing.assert_array_equal(read_depth(path), millimetres / 1000)
    for content in (b"", b"hello", cv2.imencode(".png", millimetres.astype(np.uint8))[1].tobytes()):
        path.write_bytes(content)
        with pytest.raises(UserError, match=r"no .*image.*: give a PNG file with one channel of 16 bits"):
            read_depth(path)


@given(st.one_of(st.tuples(st.integers(1, 9), st.integers(1, 9)), st.sampled_from([(1, 30_000), (30_000, 1)])))
def test_depth_images_may_be_specks_and_strips(tmp_path_factory, shape):
    path = tmp_path_factory.mktemp("depth") / "depth.png"
    cv2.imwrite(str(path), np.full(shape, 700, np.uint16))
    np.testing.assert_array_equal(read_depth(path), np.full(shape, 0.7))


def test_depth_images_beyond_opencvs_limit_or_cut_short_are_refused(tmp_path):
    whole = cv2.imencode(".png", np.random.default_rng(0).integers(0, 65535, (48, 64), np.uint16))[1].tobytes()
    for name, content in (("vast.png", vast_png(16)), ("cut.png", whole[: len(whole) // 2])):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(
            UserError, match=rf"{name} is empty, damaged, or no image that OpenCV reads: give a PNG file"
        ):
            read_depth(tmp_path / name)


def test_a_colon_in_a_name_is_no_protocol(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a:b").mkdir()
    write_video(tmp_path / "a:b" / "clip.mp4", greys(3))
    assert len(list(open_source(["a:b/clip.mp4"]).frames)) == 3
