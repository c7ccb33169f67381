"""Objects located by a depth image, as MuJoCo's rays measure it."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import tabletop
from helpers.tabletop import NAMES, SOLIDS, detections, over_the_table
from scipy.stats import chi2

from arm5dof.errors import UserError
from arm5dof.vision.camera import Camera
from arm5dof.vision.localization.depth import by_depth
from arm5dof.vision.localization.table_plane import by_plane


def scene(rng, names, low=30, high=88):
    """A camera, the boxes and centers of what it sees, depths (h, w), and which object each pixel shows, counted from 1
    (h, w)."""
    model, data, centers = tabletop.table(rng, names, [over_the_table(rng, low, high)])
    camera = Camera.from_mujoco(model, "0", tabletop.WIDTH, tabletop.HEIGHT)
    ids, depth = tabletop.cast(model, data, camera)
    return camera, tabletop.boxes(model, ids, len(names)), centers, depth, ids


def above_the_table(camera, box, depth):
    """What everybody does: the mean of the points in the box that are above the table."""
    left, top, right, bottom = box.astype(int)
    u, v = np.meshgrid(np.arange(left, right), np.arange(top, bottom))
    plane = np.stack([u, v, np.ones_like(u)], -1).reshape(-1, 3) @ np.linalg.inv(camera.matrix).T
    points = (plane * depth[top:bottom, left:right].reshape(-1, 1)) @ camera.rotation.T + camera.position
    return points[points[:, 2] > 0.004].mean(0)


def test_what_mujoco_measures_is_located():
    """Depths off by 2 mm in each pixel and boxes by a pixel in each edge."""
    rng = np.random.default_rng(0)
    errors, plain, by_box = [], [], []
    for _ in range(20):
        names = list(rng.choice(NAMES, 4, replace=False))
        camera, boxes, centers, depth, _ = scene(rng, names)
        depth = depth + 2e-3 * rng.normal(size=depth.shape)
        boxes = boxes + rng.normal(size=boxes.shape)
        found = by_depth(detections(boxes, names), depth, camera, SOLIDS)
        assert not any(found.failure)
        errors += [*np.linalg.norm(found.position - centers, axis=1)]
        on_plane = by_plane(detections(boxes, names), camera, SOLIDS).position
        by_box += [*np.linalg.norm(on_plane - centers, axis=1)]
        plain += [np.linalg.norm(above_the_table(camera, b, depth) - m) for b, m in zip(boxes, centers, strict=True)]
    assert np.median(errors) < 8e-4 and np.percentile(errors, 95) < 2.5e-3
    assert np.median(plain) > 5 * np.median(errors) and np.median(by_box) > 1.4 * np.median(errors)


def test_the_stated_covariance_is_that_of_the_errors():
    """The camera off as calibrations are, heights by half a millimetre, boxes by a pixel, depths by 2 mm that the
    pixels of an object share and 1 mm that they do not."""
    rng = np.random.default_rng(5)
    distance = []
    calibrations = [tabletop.calibrated_and_posed(rng)[1].covariance for _ in range(10)]
    for number in range(100):
        names = list(rng.choice(NAMES, 4, replace=False))
        camera, boxes, centers, depth, shows = scene(rng, names)
        covariance = calibrations[number % 10]
        error = rng.multivariate_normal(np.zeros(15), covariance, method="svd")
        taken = camera.perturbed(error).replace(covariance=covariance)
        solids = {n: replace(s, half_height=s.half_height + s.std * rng.normal()) for n, s in SOLIDS.items()}
        depth = depth + np.append(0, 2e-3 * rng.normal(size=4))[shows] + 1e-3 * rng.normal(size=depth.shape)
        found = by_depth(detections(boxes + rng.normal(size=(4, 4)), names), depth, taken, solids, depth_std=2e-3)
        for i in np.flatnonzero([not reason for reason in found.failure]):
            error = found.position[i] - centers[i]
            distance.append(error @ np.linalg.solve(found.covariance[i], error))
    assert len(distance) > 390
    for nominal in (0.5, 0.68, 0.95):
        assert abs(np.mean(np.array(distance) < chi2.ppf(nominal, 3)) - nominal) < 0.1


@pytest.mark.parametrize("hidden", ["near", "left"])
def test_an_arm_before_an_object_moves_it_little(hidden):
    """A third of each box shows something 15 cm nearer. The mean of what is left of an object is off by a third of its
    half width, 5 mm and more; of a brick that is turned, which third is gone cannot be told from an ellipse."""
    rng = np.random.default_rng(2)
    errors = []
    for _ in range(10):
        names = ["cube", "can", "brick"]
        camera, boxes, centers, depth, _ = scene(rng, names, 40, 80)
        for left, top, right, bottom in boxes.astype(int):
            if hidden == "near":
                depth[bottom - (bottom - top) // 3 : bottom + 5, left:right] -= 0.15
            else:
                depth[top:bottom, left - 5 : left + (right - left) // 3] -= 0.15
        found = by_depth(detections(boxes, names), depth, camera, SOLIDS)
        assert not any(found.failure)
        errors.append(np.linalg.norm(found.position - centers, axis=1))
    assert np.median(errors, axis=0)[:2].max() < 2e-3 and np.max(errors) < 6e-3


def test_without_depth_there_is_a_reason():
    rng = np.random.default_rng(3)
    camera, boxes, centers, depth, _ = scene(rng, ["cube", "ball"])
    found = detections(boxes, ["cube", "ball"])
    left, top, right, bottom = boxes[0].astype(int)
    for missing in (0, np.nan, np.inf, -1):
        holes = depth.copy()
        holes[top - 3 : bottom + 3, left - 3 : right + 3] = missing
        located = by_depth(found, holes, camera, SOLIDS)
        assert located.failure == ("the depth image shows too little of it", "")
        assert np.isnan(located.position[0]).all()
        np.testing.assert_allclose(located.position[1], centers[1], atol=2e-3)
    unknown = by_depth(found, depth, camera, {"cube": 0.015}, workspace=lambda points: points[:, 0] > 1)
    assert unknown.failure == ("outside the workspace", "no height is known of ball")
    with pytest.raises(UserError, match="has 320x480 pixels and the camera 640x480"):
        by_depth(found, depth[:, :320], camera, SOLIDS)
    with pytest.raises(UserError, match="the camera has no extrinsics"):
        by_depth(found, depth, camera.replace(has_extrinsics=False), SOLIDS)
