"""Checkerboards as they are drawn, and what all boards refuse."""

import numpy as np
import pytest
from helpers.photographs import draw

from arm5dof.errors import UserError
from arm5dof.vision.calibration.charuco import Charuco
from arm5dof.vision.calibration.checkerboard import Checkerboard


@pytest.mark.parametrize("order", [np.s_[:, :], np.s_[::-1], np.s_[:, ::-1], np.s_[::-1, ::-1]], ids=str)
def test_the_first_corner_is_told_by_the_colours(order, monkeypatch):
    """In whatever order a detector gives them: the square before the first corner is black, the columns go down."""
    board = Checkerboard(8, 5, 0.03)
    image, metres_per_pixel, origin = draw(board)
    detect = Checkerboard._detect
    monkeypatch.setattr(Checkerboard, "_detect", lambda self, gray: detect(self, gray)[order])
    corners = board.find(image)
    np.testing.assert_allclose(corners.pixels, corners.points[:, :2] / metres_per_pixel + origin, atol=0.1)


def test_the_unit_of_a_square_is_doubted():
    with pytest.raises(UserError, match=r"squares of 2 m: give .* in metres, 0.02 if 2 is in centimetres"):
        Checkerboard(9, 6, 2)
    with pytest.raises(UserError, match=r"0\.025 if 25 is in millimetres"):
        Charuco(8, 6, 25, 18)


@pytest.mark.parametrize("shape", [(1, 1), (1, 4000), (3000, 2), (40, 6000)], ids=str)
@pytest.mark.parametrize("board", [Checkerboard(9, 6, 0.02), Charuco(8, 6, 0.03, 0.022)], ids=str)
def test_specks_and_strips_show_no_board(board, shape):
    image = np.full(shape, 90, np.uint8)
    assert board.find(image) is None and board.inspect(image, None) == ()
