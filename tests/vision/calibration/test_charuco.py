"""ChArUco boards, as they are drawn and as OpenCV once drew them."""

import cv2
import numpy as np
import pytest
from helpers.photographs import draw, photograph, poses

from arm5dof.errors import UserError
from arm5dof.vision.calibration.boards import BoardNotFoundError
from arm5dof.vision.calibration.charuco import Charuco
from arm5dof.vision.calibration.checkerboard import Checkerboard


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


def test_charuco_boards_of_before_opencv_4_6_are_found(test_data):
    """With an even number of rows these began with the other colour."""
    board = Charuco(7, 6, 0.03, 0.022)
    for path in sorted((test_data / "faults/12-charuco-legacy").glob("*.jpg")):
        corners = board.find(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
        assert len(corners.points) == 30
        homography, _ = cv2.findHomography(corners.points[:, :2], corners.pixels)
        flat = cv2.perspectiveTransform(corners.points[:, None, :2].astype(float), homography)[:, 0]
        assert np.abs(flat - corners.pixels).max() < 3, "corners in the wrong order"


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize(
    ("told", "said", "size"),
    [
        (Charuco(6, 8, 0.03, 0.022), "2 of the 2 show one of 8x6 squares", "8x6"),
        (Charuco(8, 6, 0.03, 0.022, "DICT_4X4_50"), "show markers of DICT_5X5_50: is that the dictionary", None),
        (Charuco(8, 6, 0.03, 0.012), r"show markers 0.7. times as large as its squares, not 0\.40", None),
        (Charuco(8, 6, 0.03, 0.029), r"show markers 0.7. times as large as its squares, not 0\.97", None),
        (None, "show the mirror image", None),
    ],
    ids=["rows", "dictionary", "small", "large", "mirrored"],
)
def test_what_is_wrong_with_a_charuco_board_is_named(legacy, told, said, size):
    right = Charuco(8, 6, 0.03, 0.022)
    printed = right.opencv
    printed.setLegacyPattern(legacy)
    drawing = printed.generateImage((8 * 24, 6 * 24), marginSize=0)
    notes = []
    for pose in poses(np.random.default_rng(0), 2, (0.1, 0.06)):
        image = photograph(drawing, 0.03 / 24, np.array([23.5, 23.5]), pose)
        corners = right.find(image)
        assert len(corners.points) >= 6 and right.inspect(image, corners)[-1] in range(24)
        image = image if told else np.ascontiguousarray(image[:, ::-1])
        board = told or right
        notes.append(board.inspect(image, board.find(image)))
    with pytest.raises(BoardNotFoundError, match=said) as caught:
        board.check_inspected(notes, "none")
    assert caught.value.size == size
