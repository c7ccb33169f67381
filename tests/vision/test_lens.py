"""Fisheye lenses against OpenCV's own functions, and what of a solid they show."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.fisheye import FISHEYE
from jax.test_util import check_grads

from arm5dof.errors import UserError
from arm5dof.vision.camera import Camera
from arm5dof.vision.localization.solids import FORMS, solid_box


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def seen_points(n=500, widest=88):
    """Points (n, 3) in the camera's frame, up to so many degrees from the optical axis, some of them on it."""
    rng = np.random.default_rng(0)
    away, around = np.deg2rad(rng.uniform(0, widest, n)), rng.uniform(0, 2 * np.pi, n)
    away[:5] = 0, 1e-9, 9e-5, 1e-4, 1.1e-4
    plane = np.tan(away)[:, None] * np.c_[np.cos(around), np.sin(around)]
    return np.c_[plane, np.ones(n)] * rng.uniform(0.1, 3, (n, 1))


def posed(camera=FISHEYE):
    return camera.with_pose(cv2.Rodrigues(np.array([0.7, -1.1, 0.4]))[0], np.array([0.2, -0.3, 0.5]))


@pytest.mark.parametrize("skew", [0.0, 1.5])
def test_projects_and_undistorts_as_opencv_does(skew):
    camera = posed(FISHEYE.replace(matrix=FISHEYE.matrix + skew * np.eye(3, k=1) * [[1], [0], [0]]))
    local, none = seen_points(), np.zeros(3)
    alpha = skew / camera.matrix[0, 0]  # OpenCV's fisheye functions do not look for it in the matrix.
    expected, _ = cv2.fisheye.projectPoints(local[:, None], none, none, *camera.opencv, alpha=alpha)
    points = local @ camera.rotation.T + camera.position
    pixels = camera.project(points)
    np.testing.assert_allclose(pixels, expected[:, 0], atol=1e-9)
    found = camera.model.project(local, none, none, camera.opencv)
    np.testing.assert_allclose(found.pixels, expected[:, 0], atol=1e-9)

    np.testing.assert_allclose(camera.back_project(pixels, local[:, 2]), points, atol=1e-6)
    rays = (points - camera.position) / np.linalg.norm(local, axis=1, keepdims=True)
    np.testing.assert_allclose(camera.rays(pixels), rays, atol=1e-9)
    # OpenCV's way back ends where the distorted angle is a quarter turn.
    near = np.linalg.norm(local[:, :2], axis=1) < 5 * local[:, 2]
    plane = camera.model.normalize(np.asarray(pixels)[near], camera.opencv)
    np.testing.assert_allclose(plane, local[near, :2] / local[near, 2:], atol=1e-8)


@pytest.mark.parametrize("lens", ["pinhole", "fisheye"])
def test_derivatives_by_opencv_are_those_of_perturbed_cameras(lens):
    """With skew, of which OpenCV's functions take no notice."""
    camera = FISHEYE.replace(lens=lens, matrix=FISHEYE.matrix + np.array([[0, 1.5, 0], [0, 0, 0], [0, 0, 0]]))
    local, turn, shift = seen_points(20, 40), np.array([0.01, -0.02, 0.03]), np.array([0.01, 0.02, 0.03])
    found = camera.model.project(local, turn, shift, camera.opencv)
    moved = local @ cv2.Rodrigues(turn)[0].T + shift
    expected = jax.jacfwd(lambda error: camera.perturbed(error).project(moved))(jnp.zeros(14))
    np.testing.assert_allclose(found.pixels, camera.project(moved), atol=1e-9)
    np.testing.assert_allclose(found.by_lens, expected[..., :8].reshape(-1, 8), atol=1e-6)
    # A point that is shifted sees the camera shifted the other way.
    np.testing.assert_allclose(found.by_pose[:, 3:], -expected[..., 11:].reshape(-1, 3), atol=1e-6)


def test_gradients_are_those_of_finite_differences():
    camera, local = posed(), seen_points(40, 60)
    local = local[[0, *range(5, 12)]]
    points = local @ camera.rotation.T + camera.position
    pixels = np.array(camera.project(points))
    check_grads(camera.project, (points,), order=1, modes=("rev",), rtol=1e-4)
    check_grads(lambda p: camera.back_project(p, local[:, 2]), (pixels,), order=1, modes=("rev",), rtol=1e-4)
    lens = lambda d: camera.replace(distortion=d).rays(pixels)
    check_grads(lens, (camera.distortion,), order=1, modes=("rev",), rtol=1e-4)
    every = camera.magnification(points)
    each = jax.vmap(jax.jacfwd(lambda plane: FISHEYE.project(jnp.append(plane, 1.0))))(local[:, :2] / local[:, 2:])
    np.testing.assert_allclose(every, each, atol=1e-9)


def test_what_a_fisheye_lens_cannot_show_is_nan():
    camera = FISHEYE
    assert np.isnan(camera.project(np.array([[0, 0, -1.0], [1, 0, 0], [0, 0, 0]]))).all()
    assert np.isnan(camera.rays(camera.matrix[:2, 2] + np.array([[800.0, 0], [0, 3000]]))).all()
    # k1 = -0.3 alone reaches 60.4 degrees, and then folds back.
    fold = camera.replace(distortion=np.array([-0.3, 0, 0, 0]))
    angles = np.deg2rad([40, 59.9, 61, 80])
    pixels = fold.project(np.c_[np.tan(angles), 0 * angles, 1 + 0 * angles])
    assert np.isfinite(pixels[:2]).all() and np.isnan(pixels[2:]).all()
    np.testing.assert_allclose(fold.rays(pixels[:2])[:, 0], np.sin(angles[:2]), atol=1e-9)
    assert np.isnan(fold.rays(pixels[1] + jnp.array([3.0, 0]))).all()


def test_float32_is_good_to_a_tenth_of_a_millimetre():
    local = seen_points(widest=80)
    with jax.enable_x64(False):
        again = FISHEYE.back_project(FISHEYE.project(local), local[:, 2])
    assert again.dtype == jnp.float32
    np.testing.assert_allclose(again, local, atol=1e-4)


@pytest.mark.parametrize("form", FORMS)
def test_boxes_surround_the_points_of_a_solid_as_opencv_projects_them(form):
    """20 to 70 degrees from the optical axis. What reaches farthest to the left is not what would in a pinhole."""
    angles = np.linspace(0, 2 * np.pi, 721)
    rounded = [(np.sin(a), np.cos(a)) for a in np.linspace(-np.pi / 2, np.pi / 2, 361)]
    levels = {"block": [(-1, 1), (1, 1)], "cone": [(-1, 1), (1, 0)]}.get(form, rounded)
    turn = np.diag([1.0, -1, -1]) @ cv2.Rodrigues(np.array([0.1, 0.05, 0.7]))[0]
    camera, radii, half_height = FISHEYE.with_pose(turn, np.array([0, 0, 0.4])), np.array([0.015, 0.03]), 0.02
    x = np.append(turn[:2, 0], 0) / np.linalg.norm(turn[:2, 0])
    ring = radii * np.c_[np.cos(angles), np.sin(angles)] @ np.array([x, [-x[1], x[0], 0]])
    shape = np.concatenate([width * ring + [0, 0, half_height * level] for level, width in levels])
    for away in np.deg2rad([20, 40, 60, 70]):
        center = np.array([0.32 * np.tan(away), 0.24 * np.tan(away), half_height])
        place = -turn.T @ camera.position
        pixels, _ = cv2.fisheye.projectPoints(
            (center + shape)[:, None], cv2.Rodrigues(turn.T)[0], place, *camera.opencv
        )
        expected = np.concatenate([pixels[:, 0].min(0), pixels[:, 0].max(0)]) + 0.5
        np.testing.assert_allclose(solid_box(camera, center, radii, half_height, FORMS[form]), expected, atol=0.03)


def test_lenses_that_are_not_known_are_refused():
    with pytest.raises(UserError, match="no lens model 'omni': choose from pinhole, fisheye"):
        FISHEYE.replace(lens="omni")
    with pytest.raises(UserError, match="5 distortion coefficients: give 4, those of OpenCV's fisheye model"):
        FISHEYE.replace(distortion=np.zeros(5))


def test_files_of_opencv_and_ros(tmp_path):
    """What each writes of the same camera, with the fields that ours reads."""
    path = tmp_path / "camera.yml"
    FISHEYE.replace(has_extrinsics=False).save(path)
    ours = Camera.load(path)
    jax.tree.map(np.testing.assert_array_equal, ours, FISHEYE)
    assert ours.lens == "fisheye"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert storage.getNode("fisheye_model").real() == 1
    assert storage.getNode("distortion_model").string() == "equidistant"
    FISHEYE.replace(lens="pinhole").save(path)
    assert Camera.load(path).lens == "pinhole" and "distortion_model: plumb_bob" in path.read_text()

    opencv = path.read_text().replace("distortion_model: plumb_bob\n", "")
    ros = """image_width: 800
image_height: 600
camera_name: front
camera_matrix:
  rows: 3
  cols: 3
  data: [420, 0, 401.5,
    0, 421, 297.5, 0, 0, 1]
distortion_model: equidistant
distortion_coefficients:
  rows: 1
  cols: 4
  data: [0.02, -0.01, 0.004, -0.001]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
"""
    for text, lens in [
        (opencv, "pinhole"),
        (opencv.replace("fisheye_model: 0", "fisheye_model: 1"), "fisheye"),
        (opencv.replace("fisheye_model: 0\n", ""), "pinhole"),
        (ros, "fisheye"),
        (ros.replace("equidistant", "plumb_bob"), "pinhole"),
        (ros.replace("equidistant", '""'), "pinhole"),
    ]:
        path.write_text(text)
        camera = Camera.load(path)
        assert camera.lens == lens
        np.testing.assert_allclose(camera.matrix, FISHEYE.matrix)
        np.testing.assert_allclose(camera.distortion, FISHEYE.distortion)

    for text, said in [
        (opencv.replace("fisheye_model: 0", "fisheye_model: 2"), "says fisheye_model 2, which is no lens model"),
        (opencv + "xi: 1.2\n", "says fisheye_model 0 and xi 1.2, which"),
        (opencv + "model_type: KANNALA_BRANDT\n", "model_type KANNALA_BRANDT"),
        (ros.replace("equidistant", "fov"), "says distortion_model fov, which is no lens model that is known"),
        (ros + "fisheye_model: 0\n", "says fisheye_model 0 and distortion_model equidistant"),
        (ros.replace("4\n  data: [", "5\n  data: [0, "), "has 5 distortion_coefficients: give 4, those of"),
        (ros.replace("data: [0.02", "data: [0, 0.02"), "has no distortion_coefficients of the right size"),
        (ros.replace("data: [0.02", "dota: [0.02"), "has no distortion_coefficients of the right size"),
    ]:
        path.write_text(text)
        with pytest.raises(UserError, match=said) as caught:
            Camera.load(path)
        assert "\n" not in str(caught.value)
