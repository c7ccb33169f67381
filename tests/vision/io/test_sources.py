"""Depth images as depth cameras write them."""

import cv2
import numpy as np
import pytest
from helpers.videos import greys, write_video

from arm5dof.errors import UserError
from arm5dof.vision.io.sources import open_source, read_depth


def test_depth_images_are_millimetres_in_sixteen_bits(tmp_path):
    path = tmp_path / "depth.png"
    millimetres = np.arange(12, dtype=np.uint16).reshape(3, 4) * 500
    cv2.imwrite(str(path), millimetres)
    np.testing.assert_array_equal(read_depth(path), millimetres / 1000)
    for content in (b"", b"hello", cv2.imencode(".png", millimetres.astype(np.uint8))[1].tobytes()):
        path.write_bytes(content)
        with pytest.raises(UserError, match="is no depth image: give a PNG file with one channel of 16 bits"):
            read_depth(path)


def test_a_colon_in_a_name_is_no_protocol(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a:b").mkdir()
    write_video(tmp_path / "a:b" / "clip.mp4", greys(3))
    assert len(list(open_source(["a:b/clip.mp4"]).frames)) == 3
