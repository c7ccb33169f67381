"""Photographs in which the board is looked for: OpenCV's, and ones that will not do."""

import struct
import zlib

import cv2
import numpy as np
import pytest

from arm5dof.errors import UserError
from arm5dof.vision.calibration.boards import BoardNotFoundError, Checkerboard
from arm5dof.vision.calibration.views import MIN_VIEWS, find_views, read_gray

BOARD = Checkerboard(9, 6, 0.025)


def test_too_few_views_are_refused(photographs):
    with pytest.raises(UserError, match=f"1 of 1 photographs show the 9x6 checkerboard and .* takes {MIN_VIEWS}"):
        find_views(photographs[:1], BOARD)


@pytest.mark.parametrize("size", [(8, 6), (9, 7), (7, 5), (3, 3), (12, 9)])
def test_another_size_of_board_is_refused_with_the_right_one(size, photographs):
    """OpenCV finds 8x6 corners in twelve of the photographs of the 9x6 board, and would calibrate with them."""
    with pytest.raises(BoardNotFoundError, match="show one of 9x6 inner corners") as caught:
        find_views(photographs[::2], Checkerboard(*size, 0.025))
    assert caught.value.size == "9x6"


def test_photographs_of_different_sizes_are_named(photographs, tmp_path):
    small = tmp_path / "small.png"
    cv2.imwrite(str(small), cv2.resize(cv2.imread(str(photographs[0])), (320, 240)))
    with pytest.raises(UserError, match=r"most have 640x480 pixels, but not small.png \(320x240\)"):
        find_views([*photographs[:3], small], BOARD)


def test_files_that_are_no_photographs_are_named(photographs, tmp_path):
    for name, content, said in [
        ("empty.png", b"", "is empty"),
        ("words.jpg", b"hello", "no image"),
        ("half.jpg", photographs[0].read_bytes()[:200], "no image"),
    ]:
        (tmp_path / name).write_bytes(content)
        with pytest.raises(UserError, match=f"{name} .*{said}"):
            find_views([photographs[0], tmp_path / name], BOARD)


def test_images_without_a_board(tmp_path):
    paths = []
    for i in range(6):
        paths.append(tmp_path / f"{i}.png")
        cv2.imwrite(str(paths[-1]), np.random.default_rng(i).integers(0, 255, (240, 320), np.uint8))
    with pytest.raises(UserError, match="0 of 6 photographs show the 9x6 checkerboard; none of them shows any"):
        find_views(paths, BOARD)


def test_an_image_beyond_opencvs_limit_is_refused(tmp_path):
    """A PNG file whose header tells of 40000 x 40000 pixels."""

    def chunk(kind, content):
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", 40000, 40000, 8, 0, 0, 0, 0)
    parts = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(100))) + chunk(b"IEND", b"")
    (tmp_path / "huge.png").write_bytes(b"\x89PNG\r\n\x1a\n" + parts)
    with pytest.raises(UserError, match=r"huge\.png is no image that can be read: leave it out"):
        read_gray(tmp_path / "huge.png")
