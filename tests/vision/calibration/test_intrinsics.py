"""Calibration: OpenCV's photographs against OpenCV's published calibration, and boards drawn through known cameras."""

import cv2
import numpy as np
import pytest
from helpers.photographs import TRUE, draw, photograph, poses

from arm5dof.errors import UserError
from arm5dof.vision.calibration import boards
from arm5dof.vision.calibration.boards import Corners
from arm5dof.vision.calibration.charuco import Charuco
from arm5dof.vision.calibration.checkerboard import Checkerboard
from arm5dof.vision.calibration.fit import fit
from arm5dof.vision.calibration.intrinsics import calibrate, preview
from arm5dof.vision.calibration.views import BoardView, find_views
from arm5dof.vision.camera import Camera

BOARD = Checkerboard(9, 6, 0.025)


@pytest.fixture(scope="module")
def views(photographs):
    return find_views(photographs, BOARD)


def test_thirteen_photographs_give_a_camera(views):
    result = calibrate(views)
    assert len(views.found) == 13 and not views.without and not result.outliers
    assert result.rms <= 0.24
    fx, fy, cx, cy, *_ = result.intrinsics
    assert abs(fx - 532.3) <= 1 and abs(fy - 532.3) <= 1
    assert abs(cx - 342.4) <= 2 and abs(cy - 233.2) <= 2
    assert (result.deviations[:4] > 0.4).all() and (result.deviations[:4] < 1.7).all()
    assert list(result.errors) == [view.name for view in views.found]
    assert (result.camera.width, result.camera.height, result.camera.has_extrinsics) == (640, 480, False)


def test_opencvs_published_calibration_is_reproduced_with_its_settings(photographs, views, test_data):
    """Its sample refines in windows of 11 pixels until corners move by less than 0.1, and fixes the aspect ratio."""
    path = test_data / "vision/checkerboard/left_intrinsics.yml"
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.1)
    rough = []
    for path_, view in zip(photographs, views.found, strict=True):
        gray = cv2.imread(str(path_), cv2.IMREAD_GRAYSCALE)
        _, pixels = cv2.findChessboardCorners(gray, (9, 6), flags=3)
        rough.append(
            BoardView(
                view.name, Corners(BOARD.points, boards.refine(gray, pixels.reshape(-1, 2), window=11, until=until))
            )
        )
    result = fit(rough, views.size, flags=cv2.CALIB_FIX_ASPECT_RATIO)
    node = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert result.rms == pytest.approx(node.getNode("avg_reprojection_error").real(), abs=0.01)
    published = Camera.load(path)
    np.testing.assert_allclose(result.camera.matrix, published.matrix, atol=0.05)
    np.testing.assert_allclose(result.camera.distortion, published.distortion, atol=2e-3)
    errors = node.getNode("per_view_reprojection_errors").mat().ravel()
    np.testing.assert_allclose(list(result.errors.values()), errors, atol=0.05)


@pytest.mark.parametrize("coefficients", [4, 5, 8])
def test_as_many_coefficients_as_asked_for(views, coefficients):
    result = fit(views.found, views.size, coefficients)
    assert result.camera.distortion.shape == (coefficients,) and result.deviations.shape == (4 + coefficients,)
    assert result.rms < 0.19


def test_photographs_that_are_there_twice_count_once(photographs, views):
    """Exact copies and ones encoded anew; eight of each would make the deviations 2.9 times smaller."""
    content = cv2.imencode(".jpg", cv2.imread(str(photographs[1])), [cv2.IMWRITE_JPEG_QUALITY, 60])[1]
    again = BoardView("again.jpg", BOARD.find(cv2.imdecode(content, cv2.IMREAD_GRAYSCALE)))
    assert (again.corners.pixels != views.found[1].corners.pixels).any()
    exact = [BoardView(f"{i} {view.name}", view.corners) for view in views.found for i in range(7)]
    once, more = calibrate(views), calibrate(views._replace(found=[*views.found, again, *exact]))
    assert more.copies == {"again.jpg": views.found[1].name, **{view.name: view.name.split()[1] for view in exact}}
    np.testing.assert_allclose(more.deviations, once.deviations, rtol=1e-3)
    np.testing.assert_allclose(np.diag(more.camera.covariance), np.diag(once.camera.covariance), rtol=1e-3)
    assert not once.copies and list(more.errors) == list(once.errors)


def test_repeated_views_are_refused(views):
    copies = [BoardView(f"copy {i}", views.found[0].corners) for i in range(13)]
    with pytest.raises(UserError, match="only 1 of 13 views differ"):
        calibrate(views._replace(found=copies))


def test_uncertain_intrinsics_are_refused(views):
    """A hand that moves sideways, never tilting the board: it all fits, and says little of the focal length."""
    start = views.found[0].corners
    shifts = [(x, y) for x in (0, 60) for y in (0, 30, 60)]
    shifted = [BoardView(str(s), Corners(start.points, start.pixels + np.float32(s))) for s in shifts]
    assert fit(shifted, views.size).rms < 1
    with pytest.raises(UserError, match=r"f[xy] = .* \+- .* is the limit: add photographs"):
        calibrate(views._replace(found=shifted))


@pytest.mark.parametrize("zoom", [0.8, 1.2])
def test_a_view_from_another_camera_is_named(zoom, photographs, views):
    """The last photograph as a lens of another focal length would have taken it."""
    gray = cv2.imread(str(photographs[-2]), cv2.IMREAD_GRAYSCALE)
    center = np.array([319.5, 239.5])
    warp = np.c_[zoom * np.eye(2), (1 - zoom) * center]
    other = BOARD.find(cv2.warpAffine(gray, warp, (640, 480), borderValue=200))
    mixed = [*views.found[:-2], BoardView("other.jpg", other), views.found[-1]]
    result = calibrate(views._replace(found=mixed))
    assert list(result.outliers) == ["other.jpg"] and result.outliers["other.jpg"] > 1
    assert "other.jpg" not in result.errors and len(result.errors) == 12
    assert result.rms < 0.2 and abs(result.intrinsics[0] - 532.3) < 1.5


def test_two_cameras_half_and_half_are_refused(photographs, views):
    """No view stands out, and together they fit to 0.7 pixels, with a focal length that is neither's."""
    mixed, warp = list(views.found), np.array([[1.2, 0, -0.2 * 319.5], [0, 1.2, -0.2 * 239.5]])
    for i in (1, 3, 6, 8, 10, 11):
        gray = cv2.imread(str(photographs[i]), cv2.IMREAD_GRAYSCALE)
        mixed[i] = BoardView(f"other {i}", BOARD.find(cv2.warpAffine(gray, warp, (640, 480), borderValue=200)))
    assert fit(mixed, views.size).rms < 0.8
    with pytest.raises(
        UserError, match=r"6 of 13 views do not fit the others \(other 1, other 3, .*: are they of another camera"
    ):
        calibrate(views._replace(found=mixed))


def test_views_that_contradict_each_other_are_refused(views):
    stretched = [
        BoardView(v.name, Corners(v.corners.points, v.corners.pixels * np.float32([1, 1 + 0.05 * (i % 5)])))
        for i, v in enumerate(views.found)
    ]
    with pytest.raises(UserError, match="do not fit the others"):
        calibrate(views._replace(found=stretched))


@pytest.mark.parametrize("board", [Charuco(8, 6, 0.03, 0.022), Checkerboard(8, 5, 0.03)], ids=str)
def test_drawn_boards_give_the_camera_they_were_drawn_through(board, tmp_path):
    drawing, rng = draw(board), np.random.default_rng(0)
    paths = []
    for i, pose in enumerate(poses(rng, 10, (0.1, 0.06))):
        paths.append(tmp_path / f"{i}.png")
        cv2.imwrite(str(paths[-1]), photograph(*drawing, pose))
    views = find_views(paths, board)
    assert len(views.found) >= 8
    result = calibrate(views, 4)
    assert result.rms < 0.15
    true = [700, 705, 321.5, 236, *TRUE.distortion[:4]]
    assert np.abs(result.intrinsics[:4] - true[:4]).max() < 1.5
    assert (np.abs(result.intrinsics - true) < 5 * result.deviations + 1e-3).all()


def test_the_preview_straightens_lines(photographs, views):
    """Corners of a row, straight on the board, lie on a line in the right half as they do not in the left."""
    camera = calibrate(views).camera
    image = cv2.imdecode(np.frombuffer(preview(photographs[0], camera), np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (480, 1280, 3)

    def bend(half):
        grid = BOARD.find(cv2.cvtColor(half, cv2.COLOR_BGR2GRAY)).pixels.reshape(6, 9, 2)
        away = grid - (grid[:, :1] + (grid[:, -1:] - grid[:, :1]) * np.linspace(0, 1, 9)[:, None])
        normal = (grid[:, -1] - grid[:, 0])[:, ::-1] * [1, -1]
        return np.abs((away * (normal / np.linalg.norm(normal, axis=-1, keepdims=True))[:, None]).sum(-1)).max()

    left, right = (bend(np.ascontiguousarray(half)) for half in np.split(image, 2, axis=1))
    assert right < 0.5 and 3 * right < left
