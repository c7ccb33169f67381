"""Photographs in which the board is looked for: OpenCV's, and ones that will not do."""

import cv2
import numpy as np
import pytest
from helpers.photographs import vast_png

from arm5dof.errors import UserError
from arm5dof.vision.calibration.boards import BoardNotFoundError
from arm5dof.vision.calibration.checkerboard import Checkerboard
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
        find_views([*photographs[:5], small], BOARD)


def test_files_that_are_no_photographs_are_named_and_left_out(photographs, tmp_path):
    bad = []
    for name, content in [("empty.png", b""), ("words.jpg", b"hello"), ("half.jpg", photographs[0].read_bytes()[:200])]:
        bad.append(tmp_path / name)
        bad[-1].write_bytes(content)
    speck = tmp_path / "speck.png"
    cv2.imwrite(str(speck), np.zeros((1, 1), np.uint8))
    views = find_views([bad[0], *photographs[:5], *bad[1:], speck], BOARD)
    assert [view.name for view in views.found] == [path.name for path in photographs[:5]]
    assert views.without == ["speck.png"] and views.size == (640, 480), "it shows no board, whatever its size"
    assert list(views.unread) == [path.name for path in bad]
    assert all(f"{path} is empty, damaged, or no image" in views.unread[path.name] for path in bad)
    with pytest.raises(
        UserError, match=r"1 of 4 photographs show .*, 3 cannot be read \(empty.png, words.jpg, half.jpg\)"
    ):
        find_views([photographs[0], *bad], BOARD)
    with pytest.raises(UserError, match=r"empty.png is empty, .*; and none of the 2 others can be used"):
        find_views(bad, BOARD)


def test_images_without_a_board(tmp_path):
    paths = []
    for i in range(6):
        paths.append(tmp_path / f"{i}.png")
        cv2.imwrite(str(paths[-1]), np.random.default_rng(i).integers(0, 255, (240, 320), np.uint8))
    with pytest.raises(UserError, match="0 of 6 photographs show the 9x6 checkerboard; none of them shows any"):
        find_views(paths, BOARD)


def test_an_image_beyond_opencvs_limit_is_refused(tmp_path):
    (tmp_path / "huge.png").write_bytes(vast_png())
    with pytest.raises(UserError, match=r"huge\.png is empty, damaged, or no image that OpenCV reads"):
        read_gray(tmp_path / "huge.png")
