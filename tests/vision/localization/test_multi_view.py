"""Points and objects seen by several cameras, against OpenCV's triangulation, scipy's least squares and MuJoCo."""

import cv2
import jax
import numpy as np
import pytest
from helpers import tabletop
from helpers.tabletop import (
    LENS,
    NAMES,
    SOLIDS,
    camera_at,
    detections,
    ideal_boxes,
    on_the_table,
    over_the_table,
)
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.stats import chi2

from arm5dof.errors import UserError
from arm5dof.vision.camera import Camera
from arm5dof.vision.detections import Detections
from arm5dof.vision.localization.multi_view import by_views, match_views, triangulate

SEEDS = st.integers(0, 2**32 - 1)


def apart(rng, count=2, least=20):
    """Poses of cameras that see the center of the table from directions so many degrees apart."""
    while True:
        poses = [over_the_table(rng) for _ in range(count)]
        looks = np.array([pose[:3, 2] for pose in poses])
        if (looks @ looks.T)[np.triu_indices(count, 1)].max() < np.cos(np.deg2rad(least)):
            return poses


@given(SEEDS)
def test_exact_pixels_give_the_point_and_opencv_agrees(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform([0, -0.15, 0], [0.3, 0.15, 0.1], (8, 3))
    with jax.enable_x64(True):
        cameras = tuple(camera_at(pose) for pose in apart(rng))
        pixels = np.stack([camera.project(points) for camera in cameras], 1)
        found, left = triangulate(cameras, pixels)
    np.testing.assert_allclose(found, points, atol=1e-9)
    assert np.asarray(left).max() < 1e-6
    np.testing.assert_allclose(opencv(cameras, pixels), points, atol=1e-6)


def opencv(cameras, pixels):
    """OpenCV's linear triangulation of pixels (n, 2, 2)."""
    matrices = [np.hstack([c.rotation.T, -c.rotation.T @ c.position[:, None]]) for c in cameras]
    planes = [cv2.undistortPoints(pixels[:, i : i + 1], *LENS)[:, 0].T for i in range(2)]
    homogeneous = cv2.triangulatePoints(*matrices, *planes)
    return (homogeneous[:3] / homogeneous[3]).T


def test_noisy_pixels_are_explained_as_well_as_can_be():
    """The linear solutions are a start: what is left in the pixels is what scipy leaves, and less than OpenCV does."""
    rng = np.random.default_rng(0)
    points = rng.uniform([0, -0.15, 0], [0.3, 0.15, 0.1], (8, 3))
    with jax.enable_x64(True):
        cameras = tuple(camera_at(pose) for pose in apart(rng))
        pixels = np.stack([camera.project(points) for camera in cameras], 1) + rng.normal(size=(8, 2, 2))
        found, left = triangulate(cameras, pixels)

        def residual(point, seen):
            return np.concatenate([np.asarray(camera.project(point)) for camera in cameras]) - seen.ravel()

        best = [least_squares(residual, point, args=(seen,)) for point, seen in zip(points, pixels, strict=True)]
        linear = [residual(point, seen) for point, seen in zip(opencv(cameras, pixels), pixels, strict=True)]
    np.testing.assert_allclose(found, [b.x for b in best], atol=1e-6)
    np.testing.assert_allclose(left, [np.sqrt(b.cost) for b in best], rtol=1e-5)  # Cost is half the sum of squares.
    assert (np.linalg.norm(linear, axis=1) >= np.sqrt(2) * np.asarray(left) - 1e-9).all()


@given(SEEDS)
def test_what_is_projected_is_located_wherever_it_is(seed):
    """Things in the air, their boxes exact."""
    rng = np.random.default_rng(seed)
    names = list(rng.choice(NAMES, 8))
    centers = on_the_table(rng, names) + rng.uniform(0, 0.1, (8, 1)) * [0, 0, 1]
    with jax.enable_x64(True):
        cameras = [camera_at(pose) for pose in apart(rng)]
        views = [detections(ideal_boxes(c, centers, rng.uniform(0.01, 0.03, (8, 2)), names), names) for c in cameras]
        found = by_views(views, cameras, SOLIDS, np.stack([np.arange(8)] * 2, 1))
    assert all(reason in ("", "the picture's edge cuts it off") for reason in found.failure)
    seen = np.array([not reason for reason in found.failure])
    np.testing.assert_allclose(found.position[seen], centers[seen], atol=2e-6)


def test_what_mujoco_renders_is_located():
    rng = np.random.default_rng(1)
    errors, plain, cones = [], [], []
    for _ in range(12):
        names = list(rng.choice(NAMES, 4, replace=False))
        model, data, centers = tabletop.table(rng, names, apart(rng, least=30))
        cameras = [Camera.from_mujoco(model, name, tabletop.WIDTH, tabletop.HEIGHT) for name in "01"]
        views = [detections(tabletop.boxes(model, tabletop.cast(model, data, c)[0], 4), names) for c in cameras]
        rows = np.stack([np.arange(4)] * 2, 1)
        np.testing.assert_array_equal(match_views(tuple(views), tuple(cameras), limit=20), rows)
        found = by_views(views, cameras, SOLIDS)
        assert not any(found.failure)
        points, _ = triangulate(tuple(cameras), np.stack([view.center for view in views], 1))
        cones += [name in ("cone", "pyramid") for name in names]
        errors += [*np.linalg.norm(found.position - centers, axis=1)]
        plain += [*np.linalg.norm(points - centers, axis=1)]
    errors, plain, cones = 1e3 * np.array(errors), 1e3 * np.array(plain), np.array(cones)
    assert np.median(errors) < 1 and np.percentile(errors, 95) < 3
    assert np.median(plain[~cones]) > 1.2 * np.median(errors[~cones]) and np.median(plain[cones]) > 5


def test_the_stated_covariance_is_that_of_the_errors():
    rng = np.random.default_rng(2)
    distance, errors = [], []
    for _ in range(50):
        pairs = [tabletop.calibrated_and_posed(rng) for _ in range(2)]
        names = list(rng.choice(NAMES, 8))
        centers = on_the_table(rng, names)
        centers[:, 2] += 5e-4 * rng.normal(size=8)
        views = []
        for true, _ in pairs:
            boxes = ideal_boxes(true, centers, rng.uniform(0.012, 0.025, (8, 2)), names, centers[:, 2])
            views.append(detections(boxes + rng.normal(size=(8, 4)), names))
        found = by_views(views, [camera for _, camera in pairs], SOLIDS, np.stack([np.arange(8)] * 2, 1))
        for i in np.flatnonzero([not reason for reason in found.failure]):
            error = found.position[i] - centers[i]
            distance.append(error @ np.linalg.solve(found.covariance[i], error))
            errors.append(1e3 * np.linalg.norm(error))
    assert len(distance) > 300
    for nominal in (0.5, 0.68, 0.95):
        assert abs(np.mean(np.array(distance) < chi2.ppf(nominal, 3)) - nominal) < 0.1
    assert np.median(errors) < 3


def test_boxes_are_matched_by_class_and_by_lines_of_sight():
    """Four cubes and two balls, each camera giving its own confidences, one object being seen by one camera only."""
    rng = np.random.default_rng(3)
    names = ["cube", "cube", "ball", "cube", "ball", "cube"]
    centers = np.array([[0.08 + 0.06 * i, 0.08 * j, SOLIDS["cube"].half_height] for i in range(3) for j in (-1, 1)])
    centers[[2, 4], 2] = SOLIDS["ball"].half_height
    cameras = tuple(camera_at(pose) for pose in apart(rng, least=30))
    orders = rng.permutation(6), rng.permutation(6)[:5]
    views = tuple(
        detections(ideal_boxes(c, centers, np.full((6, 2), 0.015), names)[order], [names[i] for i in order])
        for c, order in zip(cameras, orders, strict=True)
    )
    rows = match_views(views, cameras)
    pairs = {(int(orders[0][i]), int(orders[1][j])) for i, j in rows}
    assert pairs == {(int(i), int(i)) for i in orders[1]}
    found = by_views(views, cameras, SOLIDS)
    seen = np.isin(orders[0], orders[1])
    np.testing.assert_allclose(found.position[seen], centers[orders[0]][seen], atol=1e-4)
    assert np.isnan(found.position[~seen]).all() and np.isnan(found.covariance[~seen]).all()
    alone = f"the other picture shows no {names[orders[0][~seen][0]]} there"
    assert found.detections is views[0] and list(found.failure) == ["" if both else alone for both in seen]
    nothing = Detections(np.zeros((0, 4)), [], [], NAMES)
    assert match_views((views[0], nothing), cameras).shape == (0, 2)
    assert by_views((nothing, nothing), cameras, SOLIDS).position.shape == (0, 3)
    assert all(by_views((views[0], nothing), cameras, SOLIDS).failure)


def test_three_views_and_every_reason():
    rng = np.random.default_rng(4)
    cameras = [camera_at(pose) for pose in apart(rng, 3)]
    names = ["cube", "can", "ball", "cube"]
    centers = np.array([[0.1, 0.05, 0.015], [0.2, -0.05, 0.03], [0.15, 0.08, 0.018], [0.2, 0.02, 0.015]])
    views = [detections(ideal_boxes(c, centers, np.full((4, 2), 0.015), names), names) for c in cameras]
    rows = np.stack([np.arange(4)] * 3, 1)
    three = by_views(views, cameras, SOLIDS, rows)
    np.testing.assert_allclose(three.position, centers, atol=1e-4)
    two = by_views(views[:2], cameras[:2], SOLIDS, rows[:, :2])
    assert (np.trace(three.covariance, axis1=1, axis2=2) < np.trace(two.covariance, axis1=1, axis2=2)).all()

    def reasons(views, cameras, rows, **options):
        return list(by_views(views, cameras, SOLIDS, np.array(rows), **options).failure)

    mixed = "no one cube explains its boxes"
    assert reasons(views[:2], cameras[:2], [[0, 3], [1, 1], [3, 2]]) == [mixed, "", mixed]
    side = [cameras[0], cameras[0].replace(position=cameras[0].position + 0.01)]
    assert reasons([views[0]] * 2, side, [[0, 0]]) == ["the cameras see it from one side, and its distance is open"]
    near = lambda points: points[:, 0] < 0.12
    assert reasons(views[:2], cameras[:2], rows[:, :2], workspace=near) == ["", *["outside the workspace"] * 3]
    edge = Detections([[0, 100, 30, 130]], [0.9], [NAMES.index("cube")], NAMES)
    assert reasons([views[0], edge], cameras[:2], [[0, 0]]) == ["the picture's edge cuts it off"]
    part = by_views(views[:2], cameras[:2], {"cube": 0.015}, rows[:, :2])
    assert part.failure == ("", "no height is known of can", "no height is known of ball", "")

    with pytest.raises(UserError, match="give two or more of each"):
        by_views(views[:1], cameras[:1], SOLIDS)
    with pytest.raises(UserError, match="must be said for three cameras and more"):
        by_views(views, cameras, SOLIDS)
    with pytest.raises(UserError, match="the camera has no extrinsics"):
        by_views(views[:2], [cameras[0], cameras[1].replace(has_extrinsics=False)], SOLIDS)
