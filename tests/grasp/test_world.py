"""The planner's model of what stands around says what MuJoCo says of the scene itself."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import mujoco
import numpy as np
import pytest

from arm5dof.arm import Arm, load_arm
from arm5dof.errors import UserError
from arm5dof.grasp.gripper import SITE
from arm5dof.grasp.perception import SeenObject
from arm5dof.grasp.scene import ARM_BIT, TabletopScene, tabletop_scene
from arm5dof.grasp.world import MARGINS, STEP, Held, World, dense
from arm5dof.vision.objects import CATALOGUE, CLASS_NAMES
from arm5dof.vision.rendering.simulated import simulated_camera
from arm5dof.vision.synthetic.scene_builder import CAMERA
from arm5dof.vision.synthetic.scenes import Placement

ARMS = {"arm5.xml": (0.10, 0.25), "arm7_gripper.xml": (0.18, 0.32)}
CAN = CATALOGUE[CLASS_NAMES.index("can")]


@cache
def gripping_arm(name: str) -> Arm:
    return load_arm(name, SITE)


def scene_of_cans(name: str, **options) -> TabletopScene:
    """Cans in a ring around the arm: of the catalogue's objects the one that is an upright cylinder."""
    near, far = ARMS[name]
    angles = np.linspace(-1.7, 1.7, 9)
    spots = [(r * np.cos(a), r * np.sin(a)) for r, a in zip(np.tile([near, far], 5), angles, strict=False)]
    cans = [Placement(CLASS_NAMES.index("can"), np.array([*spot, CAN.half_height]), 0.0) for spot in spots]
    return tabletop_scene(0, arm=name, radii=ARMS[name], objects=cans, distractors=False, **options)


def world_of(scene: TabletopScene, name: str) -> World:
    seen = [SeenObject(one.catalogue_object.name, 1.0, one.position, 0.0) for one in scene.objects]
    return World(gripping_arm(name), scene.bins.values(), seen)


def hit(scene: TabletopScene, q: np.ndarray, opening: float, allowed: float = 0.0) -> set[int]:
    """What the arm is deeper in at a pose than is allowed, metres, by MuJoCo in the scene: numbers of objects, -1 for
    anything else."""
    model, data = scene.model, scene.data
    model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    data.qpos[scene.arm.qpos], data.qpos[scene.gripper.qpos] = q, scene.gripper.fingers(opening)
    for stage in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_collision):
        stage(model, data)
    owner = {g: i for i, one in enumerate(scene.objects) for g in one.geoms}
    found = set()
    for contact in data.contact:
        arms = [g for g in contact.geom if model.geom_contype[g] == ARM_BIT]
        if arms and contact.dist < -allowed:
            (other,) = [g for g in contact.geom if g not in arms]
            found.add(owner.get(int(other), -1))
    return found


@pytest.mark.parametrize("name", ARMS)
def test_it_is_clear_where_mujoco_has_no_contact_in_the_scene(name):
    scene = scene_of_cans(name)
    world, rng = world_of(scene, name), np.random.default_rng(0)
    clear, cans = 0, 0
    for _ in range(1500):
        q, opening = rng.uniform(scene.arm.lower, scene.arm.upper), rng.uniform(*scene.gripper.limits)
        allowed = rng.choice([0.0, 0.003, 0.006])
        truth = hit(scene, q, opening, allowed)
        assert world.clear(q[None], opening, allowed=allowed) == (not truth)
        clear += not truth
        if truth and truth != {-1}:
            cans += 1
            number = max(truth)
            assert world.clear(q[None], opening, number, allowed) == (truth == {number})
    assert clear > 200 and cans > 30


def test_paths_are_checked_all_the_way():
    scene = scene_of_cans("arm5.xml")
    world, rng = world_of(scene, "arm5.xml"), np.random.default_rng(1)
    low = lambda q: not hit(scene, q, 0.02) and scene.data.site_xpos[scene.arm.site][2] < 0.05
    poses = [q for q in rng.uniform(scene.arm.lower, scene.arm.upper, (1500, 5)) if low(q)][:15]
    clear, blocked = 0, 0
    for ends in pairwise(poses):
        path = np.stack(ends)
        hits = "".join("x" if hit(scene, q, 0.02) else " " for q in np.linspace(*ends, 500))
        if not hits.strip():
            assert world.clear(path, 0.02)
            clear += 1
        elif "x" * (500 // (len(dense(path)) - 1) + 1) in hits:  # Anything shorter may fall between two checks.
            assert not world.clear(path, 0.02)
            blocked += 1
    assert clear > 2 and blocked > 2


@pytest.mark.parametrize("name", ARMS)
def test_what_is_held_must_not_hit_the_table(name):
    """Against the lowest point of an upright can that was taken with the tool pointing aside, by geometry."""
    arm, rng = gripping_arm(name), np.random.default_rng(2)
    taken = rng.uniform(arm.lower, arm.upper)
    _, at_first = map(np.asarray, arm.pose(taken))
    free, world = World(arm), World(arm, held=Held(CAN, taken))
    clear, blocked = 0, 0
    for q in rng.uniform(arm.lower, arm.upper, (1500, arm.dof)):
        if not free.clear(q[None], 0.03):
            assert not world.clear(q[None], 0.03)
            continue
        position, rotation = map(np.asarray, arm.pose(q))
        upright = np.clip((rotation @ at_first.T)[2, 2], -1, 1)
        lowest = position[2] - CAN.half_height * abs(upright) - CAN.radius * np.sqrt(1 - upright**2)
        if abs(lowest) > 1e-4:
            assert world.clear(q[None], 0.03) == (lowest > 0)
            clear, blocked = clear + (lowest > 0), blocked + (lowest < 0)
    assert clear > 50 and blocked > 3


def test_dense_paths_keep_their_poses_and_take_small_steps():
    path = np.random.default_rng(0).uniform(-2, 2, (4, 5))
    found = dense(path)
    assert np.abs(np.diff(found, axis=0)).max() <= STEP + 1e-12
    at = [int(np.abs(found - q).max(1).argmin()) for q in path]
    np.testing.assert_allclose(found[at], path, atol=1e-12)
    assert at == sorted(at) and at[0] == 0 and at[-1] == len(found) - 1
    np.testing.assert_array_equal(dense(path[:1]), path[:1])


def hidden(scene: TabletopScene, radii: tuple[float, float]) -> float:
    """The share of the table, where objects may lie and a little around, that the arm hides from the camera."""
    near, far = radii[0] - MARGINS[0], radii[1] + MARGINS[1]
    radius, azimuth = np.meshgrid(np.linspace(near, far, 12), np.deg2rad(np.linspace(-100, 100, 60)))
    points = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.full_like(radius, 0.02)], -1)
    pixels = np.round(np.asarray(scene.camera.project(points.reshape(-1, 3)))).astype(int)
    mujoco.mj_forward(scene.model, scene.data)
    shown = simulated_camera(scene.model, CAMERA, scene.camera.width, scene.camera.height).segmentation(scene.data)
    inside = ((pixels >= 0) & (pixels < shown.shape[::-1])).all(1)
    geoms = shown[tuple(pixels[inside, ::-1].T)]
    moving = scene.model.body_weldid[scene.model.geom_bodyid] > 0
    return float((moving & (scene.model.geom_contype == ARM_BIT))[geoms].mean())


@pytest.mark.parametrize("name", ARMS)
def test_at_rest_the_arm_hides_little_and_hits_nothing(name):
    for number in range(3):
        scene = tabletop_scene((31, number), arm=name, radii=ARMS[name])
        rest = World(gripping_arm(name), scene.bins.values()).rest(scene.camera, ARMS[name])
        again = World(gripping_arm(name), scene.bins.values()).rest(scene.camera, ARMS[name])
        np.testing.assert_array_equal(rest, again)
        scene = tabletop_scene((31, number), arm=name, radii=ARMS[name], start=rest)
        assert not (scene.model.geom_contype[scene.data.contact.geom] == ARM_BIT).any()
        assert hidden(scene, ARMS[name]) < 0.02


def test_a_compiled_arm_is_refused():
    with pytest.raises(UserError, match="the arm's MJCF file"):
        World(load_arm(gripping_arm("arm5.xml").mj_model, SITE))
