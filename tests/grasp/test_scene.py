"""Scenes that can be stepped: they look like the detector's, and rest until something touches them."""

import mujoco
import numpy as np
import pytest

from arm5dof.errors import UserError
from arm5dof.grasp import bins
from arm5dof.grasp.scene import ARM_BIT, DENSITY, Disturbance, tabletop_scene
from arm5dof.vision.camera import Camera
from arm5dof.vision.objects import CATALOGUE, CLASS_NAMES
from arm5dof.vision.rendering.simulated import simulated_camera
from arm5dof.vision.synthetic.ground_truth import truth
from arm5dof.vision.synthetic.scene_builder import CAMERA
from arm5dof.vision.synthetic.scenes import MAX_OBJECTS, Placement, random_layout, random_scene

UP = np.array([0.0, 0.0, np.pi / 2, 0.0, 0.0])
"""The paper's arm, out of the way."""


def rendered(scene):
    return simulated_camera(scene.model, CAMERA, 320, 240, "software")


def placed(name, x, y, z=None, yaw=0.0):
    class_id = CLASS_NAMES.index(name)
    return Placement(class_id, np.array([x, y, CATALOGUE[class_id].half_height if z is None else z]), yaw)


def stepped(scene, seconds):
    mujoco.mj_step(scene.model, scene.data, round(seconds / scene.model.opt.timestep))
    return scene.object_poses()[0]


def test_it_looks_like_the_detector_s():
    """All that is drawn at random is the same, and every pixel too, where no bin and no shadow of one comes."""
    same = 0
    for number in range(6):
        flat = random_scene((5, number), "evaluation")
        scene = tabletop_scene((5, number), count=(0, MAX_OBJECTS), bins=())
        assert len(scene.objects) == len(flat.objects)
        for ours, theirs in zip(scene.objects, flat.objects, strict=True):
            assert ours.class_id == theirs.class_id and ours.yaw == theirs.yaw
            np.testing.assert_array_equal(ours.position, theirs.position)
        if np.array_equal(scene.data.qpos[: flat.model.nq], flat.data.qpos):
            np.testing.assert_array_equal(rendered(scene).rgb(scene.data), rendered(flat).rgb(flat.data))
            camera = Camera.from_mujoco(flat.model, CAMERA, 640, 480, flat.data)
            np.testing.assert_allclose(scene.camera.position, camera.position)
            same += 1
    assert same > 3
    assert len(truth(scene, rendered(scene).segmentation(scene.data))) <= len(scene.objects)


def test_the_same_seed_gives_the_same_bits():
    first, again = (tabletop_scene((1, 2)) for _ in range(2))
    np.testing.assert_array_equal(stepped(first, 0.2), stepped(again, 0.2))


@pytest.mark.parametrize(("arm", "radii"), [("arm5.xml", (0.1, 0.25)), ("arm7_gripper.xml", (0.18, 0.32))])
def test_it_rests_until_something_touches_it(arm, radii):
    for number in range(4):
        scene = tabletop_scene((0, number), arm=arm, radii=radii)
        model, data = scene.model, scene.data
        assert 1 <= len(scene.objects) <= MAX_OBJECTS
        assert not (model.geom_contype[data.contact.geom] == ARM_BIT).any()
        joints = data.qpos[scene.arm.qpos].copy()
        assert np.abs(stepped(scene, 1.0) - scene.start).max() < 1e-4
        assert scene.resting().all() and not scene.lifted().any()
        assert np.abs(data.qpos[scene.arm.qpos] - joints).max() < 1e-3


@pytest.mark.parametrize("radii", [(0.1, 0.25), (0.18, 0.32), (0.5, 0.9)])
def test_the_camera_sees_where_objects_lie(radii):
    seen = []
    for number in range(20):
        scene = tabletop_scene((3, number), radii=radii, distractors=False)
        pixels = np.asarray(scene.camera.project(scene.start))
        seen += list(((pixels >= 0) & (pixels < (scene.camera.width, scene.camera.height))).all(1))
    assert np.mean(seen) > 0.95


def test_objects_have_mass_and_friction_and_nothing_else_holds_them():
    objects = [placed(name, 0.2, -0.2 + 0.06 * i) for i, name in enumerate(CLASS_NAMES)]
    light, heavy = (
        tabletop_scene(0, objects=objects, start=UP, disturbance=Disturbance(mass=m, friction=f))
        for m, f in ((1.0, 1.0), (2.0, 0.5))
    )
    masses = [[s.model.body(f"object {i}").mass[0] for i in range(len(objects))] for s in (light, heavy)]
    assert masses[0][0] == pytest.approx(DENSITY * 0.025**3)
    np.testing.assert_allclose(masses[1], 2 * np.array(masses[0]))
    for scene, friction in ((light, 0.8), (heavy, 0.4)):
        solid = scene.model.geom_contype | scene.model.geom_conaffinity
        np.testing.assert_allclose(scene.model.geom_friction[solid > 0, 0], friction)
        assert not scene.model.neq
        assert scene.model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC and scene.model.opt.impratio == 10


def test_friction_is_coulomb_s():
    """A cube on a table tilted by less than the friction's angle stays; on one tilted by more it slides."""
    for slope, slides in ((0.7, False), (0.9, True)):
        scene = tabletop_scene(0, objects=[placed("brick", 0.2, 0.0)], start=UP, distractors=False)
        scene.model.opt.gravity[:] = 9.81 * np.array([0, slope, -1]) / np.hypot(slope, 1)
        assert (abs(stepped(scene, 0.5)[0, 1]) > 0.01) == slides


def test_two_cubes_can_be_stacked():
    scene = tabletop_scene(
        0, objects=[placed("red cube", 0.2, 0), placed("blue cube", 0.203, 0, 0.0377, 0.4)], start=UP, distractors=False
    )
    assert np.abs(stepped(scene, 2.0) - scene.start).max() < 5e-4
    assert scene.resting().all()


def test_what_trembles_rests_and_what_rolls_does_not():
    bricks = [Placement(CLASS_NAMES.index("brick"), np.array([0.2, 0.0, 0.01 + 0.02 * k]), 0.3 * k) for k in range(3)]
    scene = tabletop_scene(0, objects=[*bricks, placed("ball", 0.15, 0.1)], start=UP, distractors=False)
    stepped(scene, 1.0)
    time, before = scene.data.time, scene.data.qpos.copy()
    assert scene.resting().all()
    np.testing.assert_array_equal(scene.data.qpos, before)
    assert scene.data.time == time, "looking moves nothing"
    scene.data.qvel[scene.model.body("object 3").dofadr[0]] = 0.02
    assert scene.resting().tolist() == [True, True, True, False]


def test_bins_hold_what_is_dropped_into_them():
    scene = tabletop_scene(0, objects=[placed(name, 0.2, 0.0) for name in CLASS_NAMES], start=UP, distractors=False)
    assert list(scene.bins) == list(CLASS_NAMES)
    for i, (name, one) in enumerate(scene.bins.items()):
        assert not scene.in_bin(name).any()
        joint = scene.model.body(f"object {i}").jntadr[0]
        first = scene.model.jnt_qposadr[joint]
        scene.data.qpos[first : first + 3] = [*(one.position + 0.004), scene.objects[i].position[2] + 0.02]
    stepped(scene, 2.0)
    for i, name in enumerate(scene.bins):
        np.testing.assert_array_equal(scene.in_bin(name), np.arange(len(CLASS_NAMES)) == i)
    with pytest.raises(UserError, match="no bin 'moon': there are red cube"):
        scene.in_bin("moon")


def test_bins_stand_apart_from_each_other_and_from_objects():
    radius = 0.25
    corners = {}
    for one in bins.arrange(CLASS_NAMES, radius).values():
        along = np.array([np.cos(one.yaw), np.sin(one.yaw)])
        across = np.array([-along[1], along[0]])
        grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 15) * bins.HALF] * 2), -1).reshape(-1, 2)
        corners[one.name] = one.position + grid @ np.stack([along, across])
        angles = np.deg2rad(np.linspace(-100, 100, 101))
        objects = np.concatenate(
            [r * np.stack([np.cos(angles), np.sin(angles)], -1) for r in np.linspace(0.1, 0.25, 16)]
        )
        nearest = np.linalg.norm(corners[one.name][:, None] - objects, axis=-1).min()
        assert nearest > max(c.radius for c in CATALOGUE)
        assert np.linalg.norm(corners[one.name], axis=-1).min() > 0.056  # The arm's foot.
    names = list(corners)
    for i, name in enumerate(names):
        for other in names[:i]:
            assert np.linalg.norm(corners[name][:, None] - corners[other], axis=-1).min() > 0.003


def test_what_is_disturbed():
    calm = tabletop_scene((2, 1), start=UP)
    disturbed = tabletop_scene(
        (2, 1), start=UP, disturbance=Disturbance(light=0.5, camera_shift=(0.003, 0, 0.004), camera_turn=(0, 0, 0.02))
    )
    np.testing.assert_array_equal(calm.camera.position, disturbed.camera.position)
    moved = Camera.from_mujoco(disturbed.model, CAMERA, 640, 480, disturbed.data)
    assert np.linalg.norm(moved.position - calm.camera.position) == pytest.approx(0.005)
    turn = moved.rotation @ np.asarray(calm.camera.rotation).T
    c, s = np.cos(0.02), np.sin(0.02)
    np.testing.assert_allclose(turn, [[c, -s, 0], [s, c, 0], [0, 0, 1]], atol=1e-9)
    dark = tabletop_scene((2, 1), start=UP, disturbance=Disturbance(light=0.5))
    ratio = rendered(dark).rgb(dark.data).mean() / rendered(calm).rgb(calm.data).mean()
    assert 0.4 < ratio < 0.65


def test_distractors_are_objects_too_unless_left_out():
    number = next(n for n in range(20) if len(random_layout((0, n), "evaluation").distractors) >= 3)
    names = lambda scene: [n for b in range(scene.model.nbody) if (n := scene.model.body(b).name).startswith("distr")]
    scene = tabletop_scene((0, number), bins=(), count=(0, MAX_OBJECTS))
    assert len(names(scene)) >= 3
    assert all(scene.model.body(name).dofnum[0] == 6 for name in names(scene))
    assert not names(tabletop_scene((0, number), distractors=False))


def test_what_cannot_be_built_is_refused():
    with pytest.raises(UserError, match="no site, body or geom 'grasp'"):
        tabletop_scene(0, arm="arm7.xml")
    with pytest.raises(UserError, match="9 bins: there is room for 8"):
        tabletop_scene(0, bins=[str(i) for i in range(9)])
    with pytest.raises(UserError, match="two bins of the same name: a, a"):
        tabletop_scene(0, bins=["a", "a"])
    with pytest.raises(UserError, match="seed is 0 or more"):
        tabletop_scene(-1)
