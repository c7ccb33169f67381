"""Boards and their first corners, as they are drawn."""

import numpy as np
import pytest
from helpers.photographs import draw

from arm5dof.errors import UserError
from arm5dof.vision.calibration.boards import BoardNotFoundError, Charuco, Checkerboard


@pytest.mark.parametrize("order", [np.s_[:, :], np.s_[::-1], np.s_[:, ::-1], np.s_[::-1, ::-1]], ids=str)
def test_the_first_corner_is_told_by_the_colours(order, monkeypatch):
    """In whatever order a detector gives them: the square before the first corner is black, the columns go down."""
    board = Checkerboard(8, 5, 0.03)
    image, metres_per_pixel, origin = draw(board)
    detect = Checkerboard._detect
    monkeypatch.setattr(Checkerboard, "_detect", lambda self, gray: detect(self, gray)[order])
    corners = board.find(image)
    np.testing.assert_allclose(corners.pixels, corners.points[:, :2] / metres_per_pixel + origin, atol=0.1)


def test_charuco_boards_that_do_not_exist_or_are_another_size():
    for arguments, said in [
        ((8, 6, 0.03, 0.03), "do not fit into squares"),
        ((8, 6, 0.03, 0.02, "DICT_9X9"), "no marker dictionary 'DICT_9X9'"),
        ((20, 20, 0.03, 0.02, "DICT_4X4_50"), "needs 200 markers"),
        ((2, 6, 0.03, 0.02), "at least 3x3"),
    ]:
        with pytest.raises(UserError, match=said):
            Charuco(*arguments)
    with pytest.raises(UserError, match="give the side of a square in metres"):
        Checkerboard(9, 6, 25)
    image, *_ = draw(Charuco(8, 6, 0.03, 0.022))
    small = Charuco(5, 4, 0.03, 0.022)
    with pytest.raises(BoardNotFoundError, match="markers 0 to 9 and the photographs show some up to 23"):
        small.check_inspected([small.inspect(image, None)], "")
