"""Random tabletop scenes: what lies in them, and what is said to be seen of it."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from arm5dof.errors import UserError
from arm5dof.vision.camera import Camera
from arm5dof.vision.objects import CATALOGUE, CLASS_NAMES
from arm5dof.vision.rendering.simulated import simulated_camera
from arm5dof.vision.synthetic import textures
from arm5dof.vision.synthetic.ground_truth import VISIBLE, truth
from arm5dof.vision.synthetic.scene_builder import CAMERA
from arm5dof.vision.synthetic.scenes import MAX_OBJECTS, MAX_RADIUS, MIN_RADIUS, random_scene

SEEDS = st.integers(0, 2**32 - 1)
STYLES = st.sampled_from(["training", "evaluation"])


def rendered(scene, width=320, height=240):
    return simulated_camera(scene.model, CAMERA, width, height, "software")


@pytest.mark.parametrize("one", CATALOGUE, ids=lambda one: one.name)
def test_the_catalogue_is_what_compiles(one):
    """Half heights, radii and symmetry against what rays from all sides meet of the compiled parts."""
    spec = mujoco.MjSpec()
    for part in one.parts:
        size = [*part.size, *[0] * (3 - len(part.size))]
        spec.worldbody.add_geom(type=part.kind, size=size, pos=part.position, quat=part.quaternion)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)

    def surface(axis, sign):
        """Points (n, 3) that parallel rays along an axis meet first."""
        grid = np.stack(np.meshgrid(*[np.linspace(-0.0301, 0.0301, 120)] * 2), -1).reshape(-1, 2)
        hit, points = np.zeros(1, np.int32), []
        for where in grid:
            start, ray = np.insert(where, axis, sign), -sign * np.eye(3)[axis]
            distance = mujoco.mj_ray(model, data, start, ray, None, 1, -1, hit)
            if distance >= 0:
                points.append(start + distance * ray)
        return np.array(points)

    above, below = surface(2, 1), surface(2, -1)
    assert above[:, 2].max() == pytest.approx(one.half_height, abs=1e-5)
    assert below[:, 2].min() == pytest.approx(-one.half_height, abs=1e-5)
    assert np.hypot(above[:, 0], above[:, 1]).max() == pytest.approx(one.radius, abs=7e-4)
    mirrored = {tuple(p) for p in np.round(-below, 6) + 0.0}
    assert mirrored == {tuple(p) for p in np.round(above, 6) + 0.0}
    assert 0.019 <= 2 * np.abs(above[:, :2]).max(0).min() <= 0.041


def test_names_and_half_heights_are_those_of_the_catalogue():
    assert len(CATALOGUE) >= 6 and len(set(CLASS_NAMES)) == len(CATALOGUE)


@settings(max_examples=8)
@given(SEEDS, STYLES)
def test_the_same_seed_gives_the_same_bits(seed, style):
    first, again = (random_scene(seed, style) for _ in range(2))
    np.testing.assert_array_equal(rendered(first).rgb(first.data), rendered(again).rgb(again.data))
    np.testing.assert_array_equal(first.data.qpos, again.data.qpos)
    other = random_scene((seed, 1), style)
    assert not np.array_equal(other.data.qpos, first.data.qpos)


def test_styles_have_nothing_in_common():
    first, second = ({*family.surfaces, *family.papers} for family in (textures.TRAINING, textures.EVALUATION))
    assert not first & second
    for style, kind in (
        ("training", mujoco.mjtLightType.mjLIGHT_SPOT),
        ("evaluation", mujoco.mjtLightType.mjLIGHT_DIRECTIONAL),
    ):
        for seed in range(5):
            assert (random_scene(seed, style).model.light_type == kind).all()
    with pytest.raises(UserError, match="seed is 0 or more, not -1"):
        random_scene(-1)
    with pytest.raises(UserError, match="no style 'holiday': there are training and evaluation"):
        random_scene(0, "holiday")


@settings(max_examples=30)
@given(SEEDS, STYLES)
def test_objects_lie_apart_on_the_table_within_reach(seed, style):
    scene = random_scene(seed, style)
    model, data = scene.model, scene.data
    assert len(scene.objects) <= MAX_OBJECTS
    arm = [g for g in range(model.ngeom) if model.body_weldid[model.geom_bodyid[g]] > 0]
    assert all(data.geom_xpos[g, 2] > 0 for g in arm)
    points = np.zeros(6)
    for i, placed in enumerate(scene.objects):
        assert placed.position[2] == CATALOGUE[placed.class_id].half_height
        assert MIN_RADIUS <= np.hypot(*placed.position[:2]) <= MAX_RADIUS
        body = model.geom_bodyid[placed.geoms[0]]
        np.testing.assert_allclose(data.xpos[body], placed.position)
        others = [g for other in scene.objects[:i] for g in other.geoms] + arm
        for g in placed.geoms:
            assert all(mujoco.mj_geomDistance(model, data, g, o, 0.001, points) >= 0.001 for o in others)


@settings(max_examples=15)
@given(SEEDS, STYLES)
def test_truth_is_what_the_segmentation_shows(seed, style):
    scene = random_scene(seed, style)
    ids = rendered(scene).segmentation(scene.data)
    found = truth(scene, ids)
    camera = Camera.from_mujoco(scene.model, CAMERA, 320, 240, scene.data)
    by_place = {tuple(placed.position): placed for placed in scene.objects}
    assert found.counts.dtype == bool and (found.counts == (found.visible >= VISIBLE)).all()
    for i in range(len(found)):
        placed = by_place[tuple(found.position[i])]
        assert placed.class_id == found.class_id[i]
        mask = np.isin(ids, placed.geoms)
        left, top, right, bottom = found.xyxy[i].astype(int)
        assert mask[top:bottom, left:right].sum() == mask.sum()
        edges = mask[top], mask[bottom - 1], mask[:, left], mask[:, right - 1]
        assert all(edge.any() for edge in edges)
        # The center of the box of an object that nothing hides is where its center is seen.
        if found.visible[i] > 0.99:
            center = (found.xyxy[i, :2] + found.xyxy[i, 2:]) / 2 - 0.5
            np.testing.assert_allclose(center, camera.project(found.position[i]), atol=1.0)
    seen = {tuple(p) for p in found.position}
    for placed in scene.objects:
        assert np.isin(ids, placed.geoms).any() == (tuple(placed.position) in seen)


def test_visibility_is_the_share_of_the_outline_that_is_seen():
    """Against images with nothing but the object itself, by a camera that sees further to all sides."""
    for seed in range(6):
        scene = random_scene(seed)
        found = truth(scene, rendered(scene).segmentation(scene.data))
        for i, position in enumerate(found.position):
            placed = next(p for p in scene.objects if (p.position == position).all())
            ids = rendered(scene).segmentation(scene.data)
            seen = np.isin(ids, placed.geoms).sum()
            model = scene.model
            field = np.tan(np.deg2rad(model.cam_fovy[0]) / 2)
            group, fovy = model.geom_group.copy(), model.cam_fovy.copy()
            model.geom_group[:] = 4
            model.geom_group[placed.geoms] = 0
            model.cam_fovy[0] = np.rad2deg(2 * np.arctan(3 * field))
            alone = (rendered(scene, 960, 720).segmentation(scene.data) >= 0).sum()
            model.geom_group[:], model.cam_fovy[:] = group, fovy
            assert found.visible[i] == pytest.approx(min(seen / alone, 1), abs=0.02)
