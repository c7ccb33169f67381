"""Objects located on a table, against MuJoCo's segmentation and the errors that were put in."""

import cv2
import jax
import numpy as np
import pytest
from helpers import tabletop
from helpers.tabletop import (
    LENS,
    NAMES,
    SOLIDS,
    box_around,
    camera_at,
    detections,
    ideal_boxes,
    on_the_table,
    over_the_table,
    random_lens,
)
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from arm5dof.errors import UserError
from arm5dof.vision.detections import Detections
from arm5dof.vision.localization.box_fit import SKEW_STD
from arm5dof.vision.localization.solids import CATALOGUE_SOLIDS, Solid
from arm5dof.vision.localization.table_plane import by_plane

SEEDS = st.integers(0, 2**32 - 1)


@given(SEEDS, st.sampled_from([5, 8]))
def test_what_is_projected_is_located(seed, coefficients):
    """Any camera, and any solid whose box it sees: the way back leads to where it stood."""
    rng = np.random.default_rng(seed)
    names = list(rng.choice(NAMES, 8))
    centers, radii = on_the_table(rng, names), rng.uniform(0.01, 0.03, (8, 2))
    with jax.enable_x64(True):
        camera = camera_at(over_the_table(rng, 20, 89), random_lens(rng, coefficients))
        found = by_plane(detections(ideal_boxes(camera, centers, radii, names), names), camera, SOLIDS)
    assert all(reason in ("", "the picture's edge cuts it off") for reason in found.failure)
    seen = np.array([not reason for reason in found.failure])
    np.testing.assert_allclose(found.position[seen], centers[seen], atol=1e-6)


def test_what_mujoco_renders_is_located():
    """Boxes around what MuJoCo's rays hit, whole pixels and no noise. The center of the box, cast back onto the plane
    of the centers, is what everybody does; it is further off, and for cones by a centimetre."""
    rng = np.random.default_rng(1)
    errors, plain = {name: [] for name in NAMES}, {name: [] for name in NAMES}
    for _ in range(25):
        names = list(rng.choice(NAMES, 4, replace=False))
        model, data, centers = tabletop.table(rng, names, [over_the_table(rng, 30, 88)])
        camera = tabletop.Camera.from_mujoco(model, "0", tabletop.WIDTH, tabletop.HEIGHT)
        found = detections(tabletop.boxes(model, tabletop.cast(model, data, camera)[0], 4), names)
        located = by_plane(found, camera, SOLIDS)
        assert not any(located.failure)
        rays = np.asarray(camera.rays(found.center))
        cast = camera.position + rays * ((centers[:, 2] - camera.position[2]) / rays[:, 2])[:, None]
        for i, name in enumerate(names):
            errors[name].append(1e3 * np.linalg.norm(located.position[i] - centers[i]))
            plain[name].append(1e3 * np.linalg.norm(cast[i] - centers[i]))
    every, before = np.concatenate(list(errors.values())), np.concatenate(list(plain.values()))
    assert np.median(every) < 0.6 and np.percentile(every, 95) < 1.5
    assert np.median(before) > 1.4 * np.median(every)
    assert np.median(plain["cone"]) > 5 and np.median(errors["cone"]) < 1
    assert np.median(plain["can"]) > 2 * np.median(errors["can"])


def test_the_stated_covariance_is_that_of_the_errors():
    """Cameras calibrated from 13 noisy views and posed from a noisy board, boxes off by a pixel, heights by half a
    millimetre: so many positions lie within so much of their covariance as should, and the bar of the project holds."""
    rng = np.random.default_rng(2)
    distance, errors = [], []
    for _ in range(50):
        true, camera = tabletop.calibrated_and_posed(rng)
        names = list(rng.choice(NAMES, 8))
        centers, radii = on_the_table(rng, names), rng.uniform(0.012, 0.025, (8, 2))
        centers[:, 2] += 5e-4 * rng.normal(size=8)
        boxes = ideal_boxes(true, centers, radii, names, centers[:, 2]) + rng.normal(size=(8, 4))
        found = by_plane(detections(boxes, names), camera, SOLIDS)
        for i in np.flatnonzero([not reason for reason in found.failure]):
            error = found.position[i] - centers[i]
            distance.append(error @ np.linalg.solve(found.covariance[i], error))
            errors.append(1e3 * np.linalg.norm(error))
    assert len(distance) > 350
    for nominal in (0.5, 0.68, 0.95):
        assert abs(np.mean(np.array(distance) < chi2.ppf(nominal, 3)) - nominal) < 0.1
    assert np.median(errors) <= 2 and np.percentile(errors, 95) <= 6


def test_the_covariance_is_made_of_derivatives():
    """By the edges, taken by locating again with each a little off; by the height; by the camera, perturbed; and by the
    form, taken from boxes of solids that are skewed."""
    rng = np.random.default_rng(3)
    names = ["can", "ball"]
    with jax.enable_x64(True):
        camera = camera_at(over_the_table(rng))
        centers, radii = on_the_table(rng, names), np.full((2, 2), 0.02)
        boxes, *skewed = (ideal_boxes(camera, centers, radii, names, skew=s) for s in (0, 0.05, -0.05))

        def position(boxes=boxes, camera=camera, raised=0.0):
            solids = {name: Solid(SOLIDS[name].half_height + raised, SOLIDS[name].form, 0) for name in names}
            found = by_plane(detections(boxes, names), camera, solids, box_std=1e-3)
            return found.position

        steps = [0.05 * step.reshape(1, 4) for step in np.eye(4)]
        by_edges = np.stack([(position(boxes + s) - position(boxes - s)) / 0.1 for s in steps], -1)
        exact = {name: Solid(SOLIDS[name].half_height, SOLIDS[name].form, 0) for name in names}
        by_form = (position(skewed[0]) - position(skewed[1])) / 0.1 * SKEW_STD
        form = by_form[:, :, None] * by_form[:, None]
        found = by_plane(detections(boxes, names), camera, exact, box_std=2.0)
        expected = form + 4 * by_edges @ by_edges.transpose(0, 2, 1)
        np.testing.assert_allclose(found.covariance, expected, rtol=1e-2, atol=1e-10)

        by_height = (position(raised=1e-4) - position(raised=-1e-4)) / 2e-4
        spread = {name: Solid(SOLIDS[name].half_height, SOLIDS[name].form, 0.003) for name in names}
        found = by_plane(detections(boxes, names), camera, spread, box_std=1e-3)
        expected = form + 9e-6 * by_height[:, :, None] * by_height[:, None]
        np.testing.assert_allclose(found.covariance, expected, rtol=1e-2, atol=1e-10)

        scale = np.array([1, 1, 1, 1, 0.01, 0.01, 1e-3, 1e-3, 0.01, *[1e-3] * 6])
        by_camera = np.stack(
            [
                (position(camera=camera.perturbed(s)) - position(camera=camera.perturbed(-s))) / 0.1
                for s in 0.05 * np.diag(scale)
            ],
            -1,
        )
        known = camera.replace(covariance=np.diag(scale**2))
        found = by_plane(detections(boxes, names), known, exact, box_std=1e-3)
        expected = form + by_camera @ by_camera.transpose(0, 2, 1)
        np.testing.assert_allclose(found.covariance, expected, rtol=1e-2, atol=1e-9)


@pytest.mark.parametrize("elevation", [25, 50])
@pytest.mark.parametrize("size", [(0.15, 0.075, 0.008), (0.1, 0.06, 0.04)])
def test_the_covariance_holds_for_objects_turned_anyhow(size, elevation):
    """A telephone and a box, by the corners that OpenCV projects. They lie up to a centimetre beside the ellipses that
    stand in for them, of which no box tells how they are turned."""
    rng, names, distance = np.random.default_rng(4), ["thing"] * 32, []
    corners = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (0, 2)]) / 2 * size
    for _ in range(8):
        camera = camera_at(over_the_table(rng, elevation, elevation))
        places = np.c_[rng.uniform(0.05, 0.25, 32), rng.uniform(-0.1, 0.1, 32), np.zeros(32)]
        turned = Rotation.from_euler("z", rng.uniform(0, np.pi, (32, 1))).as_matrix() @ corners.T
        boxes = [box_around(camera, each.T + place) for each, place in zip(turned, places, strict=True)]
        seen = Detections(boxes + rng.normal(size=(32, 4)), np.ones(32), np.zeros(32, int), ("thing",))
        found = by_plane(seen, camera, {"thing": size[2] / 2})
        for i in np.flatnonzero([not reason for reason in found.failure]):
            error = (found.position[i] - places[i])[:2]
            distance.append(error @ np.linalg.solve(found.covariance[i, :2, :2], error))
    assert len(distance) > 0.9 * 8 * len(names)
    assert np.mean(np.array(distance) < chi2.ppf(0.95, 2)) > 0.9
    assert np.mean(np.array(distance) < chi2.ppf(0.5, 2)) < 0.7, "nor is it far too wide"


def test_what_an_edge_of_the_picture_cuts_off_is_located_by_the_others():
    """The picture ends within each object. Square objects lie where they lie; of others, which the box cannot tell
    from square ones, the covariance says how far off they may be."""
    rng = np.random.default_rng(5)
    errors = {1.0: [], 2.0: []}
    for _ in range(20):
        camera = camera_at(over_the_table(rng, 40, 85))
        names = list(rng.choice(NAMES, 8))
        for ratio, found in errors.items():
            centers, radii = on_the_table(rng, names), np.full((8, 2), 0.014) * [[ratio**0.5, ratio**-0.5]]
            boxes = ideal_boxes(camera, centers, radii, names)
            whole = (boxes[:, :2] > 1).all(1) & (boxes[:, 2:] < [camera.width - 1, camera.height - 1]).all(1)
            middle, size = (boxes[:, :2] + boxes[:, 2:]) / 2, boxes[:, 2:] - boxes[:, :2]
            for i in np.flatnonzero(whole):
                # The camera's chip moved, so that it ends at a third of the object behind its middle.
                axis = rng.integers(2)
                edge = middle[i, axis] + size[i, axis] / 3
                shift = np.eye(2)[axis] * ((camera.width, camera.height)[axis] - edge)
                moved = camera.replace(matrix=camera.matrix + np.array([[0, 0, shift[0]], [0, 0, shift[1]], [0, 0, 0]]))
                box = boxes[i] + np.tile(shift, 2)
                box[2 + axis] = (camera.width, camera.height)[axis]
                one, refused = (
                    by_plane(detections(box[None], names[i : i + 1]), moved, SOLIDS, cut=cut) for cut in (True, False)
                )
                assert refused.failure == ("the picture's edge cuts it off",) and one.failure == ("",)
                error = one.position[0] - centers[i]
                found.append((np.linalg.norm(error), np.sqrt(error @ np.linalg.solve(one.covariance[0], error))))
    exact, unlike = (np.array(found) for found in errors.values())
    assert len(exact) > 100 and exact[:, 0].max() < 1e-4
    assert len(unlike) > 100 and np.median(unlike[:, 0]) > 1e-3 and np.quantile(unlike[:, 1], 0.95) < 3
    corner = detections(np.array([[0, 0, 40, 40.0]]), ["cube"])
    assert by_plane(corner, camera, SOLIDS, cut=True).failure == ("the picture's edge cuts it off",)
    inside = detections(np.array([[300, 200, 340, 240.0]]), ["cube"])
    np.testing.assert_allclose(
        by_plane(inside, camera, SOLIDS, cut=True).position, by_plane(inside, camera, SOLIDS).position, atol=1e-6
    )


def test_every_object_without_a_position_has_a_reason():
    """A camera that looks to the horizon, and boxes all over its image."""
    level = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
    tilted = level @ cv2.Rodrigues(np.array([np.deg2rad(-15), 0, 0]))[0]
    camera = camera_at(tabletop.pose(tilted, [0, 0, 0.4]))
    cases = [
        ("cube", [300, 400, 330, 430], ""),
        ("cup", [300, 400, 330, 430], "no height is known of cup"),
        ("cube", [300, 400, 300, 430], "its box is empty"),
        ("cube", [0, 400, 30, 430], "the picture's edge cuts it off"),
        ("cube", [300, 460, 330, 480], "the picture's edge cuts it off"),
        ("cube", [300, 90, 330, 120], "the line of sight does not meet the table"),  # The horizon, and above it.
        ("cube", [300, 20, 330, 50], "the line of sight does not meet the table"),
        ("tower", [300, 400, 330, 405], "nothing of the height of tower on the table explains its box"),
        ("cube", [300, 200, 330, 230], "outside the workspace"),
    ]
    names = (*NAMES, "cup")
    ids = [names.index(name) for name, _, _ in cases]
    found = Detections([edges for _, edges, _ in cases], np.linspace(0.9, 0.5, len(cases)), ids, names)
    located = by_plane(found, camera, SOLIDS, workspace=lambda points: points[:, 0] < 1)
    assert list(located.failure) == [reason for _, _, reason in cases]
    lost = np.array([bool(reason) for reason in located.failure])
    assert np.isnan(located.position[lost]).all() and np.isnan(located.covariance[lost]).all()
    assert np.isfinite(located.position[~lost]).all() and np.isfinite(located.covariance[~lost]).all()
    first, second, *_ = located.rows()
    assert first["reason"] is None and first["position"] == located.position[0].tolist() and first["confidence"] == 0.9
    assert second["position"] is None and second["covariance"] is None and second["class_name"] == "cup"
    # k1 = -0.3 alone reaches no further than 0.70 from the center of the image plane at depth 1.
    barrel = camera.replace(distortion=np.array([-0.3, 0, 0, 0]), matrix=camera.matrix * [[0.5], [0.5], [1]])
    edge = by_plane(Detections([[600, 400, 630, 430]], [0.9], [0], ("cube",)), barrel, SOLIDS)
    assert edge.failure == ("the lens model shows nothing there",)
    upwards = camera_at(tabletop.pose(np.diag([1.0, -1, -1]) @ np.diag([1, -1, -1]), [0, 0, 0.4]))
    away = by_plane(Detections([[300, 200, 330, 230]], [0.9], [0], ("cube",)), upwards, SOLIDS)
    assert away.failure == ("the line of sight does not meet the table",)


def test_any_number_of_objects_and_heights_as_plain_numbers():
    rng = np.random.default_rng(4)
    camera, names = camera_at(over_the_table(rng)), ["cube"] * 9
    centers = on_the_table(rng, names)
    boxes = ideal_boxes(camera, centers, np.full((9, 2), 0.015), names)
    nine = by_plane(detections(boxes, names), camera, {"cube": 0.015}, table_height=0.0)
    np.testing.assert_allclose(nine.position, centers, atol=1e-4)
    one = by_plane(detections(boxes[:1], names[:1]), camera, {"cube": 0.015})
    np.testing.assert_allclose(one.position, centers[:1], atol=1e-4)
    none = by_plane(detections(np.zeros((0, 4)), []), camera, {"cube": 0.015})
    assert none.position.shape == (0, 3) and none.covariance.shape == (0, 3, 3) and none.failure == ()
    # On a table that is higher, seen by a camera that is as much higher.
    raised = camera.replace(position=camera.position + np.array([0, 0, 0.1]))
    nine = by_plane(detections(boxes, names), raised, {"cube": 0.015}, table_height=0.1)
    np.testing.assert_allclose(nine.position, centers + np.array([0, 0, 0.1]), atol=1e-4)


def test_what_cannot_be_asked():
    camera = camera_at(np.eye(4))
    with pytest.raises(UserError, match="the camera has no extrinsics: calibrate its pose first"):
        by_plane(detections(np.ones((1, 4)), ["cube"]), camera.replace(has_extrinsics=False), SOLIDS)
    for box_std in (0, -1, np.nan, np.inf):
        with pytest.raises(UserError, match="a number of pixels above zero"):
            by_plane(detections(np.ones((1, 4)), ["cube"]), camera, SOLIDS, box_std=box_std)


def test_boxes_of_no_object_of_the_catalogue():
    """Seen from 0.6 m straight above: 12 cm and 4 mm across, beside a cube; of a width that is not known, anything."""
    down = camera_at(tabletop.pose(np.diag([1.0, -1, -1]), [0.2, 0, 0.6]), (LENS[0], np.zeros(5)))
    half = np.array([0.0125, 0.06, 0.002]) * LENS[0][0, 0] / 0.59
    boxes = np.stack([320 - half, 240 - half, 320 + half, 240 + half], axis=1)
    found = Detections(boxes, [0.9, 0.8, 0.7], [0, 0, 0], ("red cube",))
    assert by_plane(found, down, CATALOGUE_SOLIDS).failure == (
        "",
        "its box is larger than that of any red cube",
        "its box is smaller than that of any red cube",
    )
    assert by_plane(found, down, {"red cube": Solid(0.0125)}).failure == ("", "", "")
