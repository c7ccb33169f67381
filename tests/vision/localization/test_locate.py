"""`locate` takes the way that what it is given allows."""

import doctest
import subprocess
import sys

import numpy as np
import pytest
from helpers import tabletop
from helpers.tabletop import SOLIDS, detections, over_the_table

from arm5dof.errors import UserError
from arm5dof.vision import localization
from arm5dof.vision.camera import Camera
from arm5dof.vision.localization import locate
from arm5dof.vision.localization.common import within_distance
from arm5dof.vision.localization.depth import by_depth
from arm5dof.vision.localization.multi_view import by_views
from arm5dof.vision.localization.table_plane import by_plane

OBJECTS = ["cube", "ball", "can"]


@pytest.fixture(scope="module")
def scene():
    """Detections in the images of three cameras, the cameras, and the first one's depth image."""
    rng = np.random.default_rng(0)
    model, data, _ = tabletop.table(rng, OBJECTS, [over_the_table(rng) for _ in range(3)])
    cameras = [Camera.from_mujoco(model, name, tabletop.WIDTH, tabletop.HEIGHT) for name in "012"]
    seen = [tabletop.cast(model, data, camera) for camera in cameras]
    return [detections(tabletop.boxes(model, ids, 3), OBJECTS) for ids, _ in seen], cameras, seen[0][1]


def assert_same(one, other):
    np.testing.assert_array_equal(one.position, other.position)
    np.testing.assert_array_equal(one.covariance, other.covariance)
    assert one.failure == other.failure
    np.testing.assert_array_equal(one.detections.xyxy, other.detections.xyxy)


def test_one_camera_takes_the_table(scene):
    (first, *_), (camera, *_), _ = scene
    options = {"table_height": 0.001, "box_std": 2.0, "workspace": within_distance(0.1, 0.25)}
    expected = by_plane(first, camera, SOLIDS, **options)
    assert_same(locate(first, camera, SOLIDS, **options), expected)
    assert_same(locate([first], [camera], SOLIDS, **options), expected)
    assert not np.array_equal(expected.position, by_plane(first, camera, SOLIDS).position)


def test_a_depth_image_is_used(scene):
    (first, *_), (camera, *_), depth = scene
    options = {"table_height": 0.001, "box_std": 2.0, "depth_std": 1e-3, "workspace": within_distance(0.1, 0.25)}
    expected = by_depth(first, depth, camera, SOLIDS, **options)
    assert_same(locate(first, camera, SOLIDS, depth=depth, **options), expected)
    assert not np.array_equal(expected.position, by_plane(first, camera, SOLIDS).position)


def test_several_cameras_triangulate(scene):
    found, cameras, _ = scene
    options = {"box_std": 2.0, "workspace": within_distance(0.1, 0.25)}
    expected = by_views(found[:2], cameras[:2], SOLIDS, **options)
    assert_same(locate(found[:2], cameras[:2], SOLIDS, table_height=0.5, **options), expected)
    matches = np.array([[0, 0], [2, 2]])
    some = locate(found[:2], cameras[:2], SOLIDS, matches=matches, **options)
    assert_same(some, by_views(found[:2], cameras[:2], SOLIDS, matches, **options))
    assert some.position.shape == (2, 3)


def test_what_does_not_go_together_is_refused(scene):
    found, cameras, depth = scene
    with pytest.raises(UserError, match="a depth image goes with one camera"):
        locate(found[:2], cameras[:2], SOLIDS, depth=depth)
    with pytest.raises(UserError, match="2 cameras and 1 lists of detections: give two or more of each"):
        locate(found[0], cameras[:2], SOLIDS)
    with pytest.raises(UserError, match="1 cameras and 2 lists of detections"):
        locate(found[:2], cameras[0], SOLIDS)
    with pytest.raises(UserError, match="1 cameras and 1 lists of detections"):
        locate(found[0], cameras[0], SOLIDS, matches=np.zeros((1, 1)))
    with pytest.raises(UserError, match="must be said for three cameras and more"):
        locate(found, cameras, SOLIDS)
    with pytest.raises(UserError, match="the camera has no extrinsics: calibrate its pose first"):
        locate(found[0], cameras[0].replace(has_extrinsics=False), SOLIDS)


def test_a_workspace_between_two_distances():
    points = np.array([[0, 0, 0.1], [0.2, 0, 0], [0, -0.3, 0], [np.nan] * 3])
    np.testing.assert_array_equal(within_distance(0.15, 0.25)(points), [False, True, False, False])
    for distances in ((0.3, 0.1), (-1, 1), (0, 0), (np.nan, 1)):
        with pytest.raises(UserError, match="needs its smallest distance and its largest"):
            within_distance(*distances)


def test_the_example_holds():
    result = doctest.testmod(localization)
    assert result.attempted > 5 and not result.failed


def test_importing_it_costs_nothing():
    code = "import sys, arm5dof.vision.localization; print([m for m in ('jax', 'cv2', 'mujoco') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
