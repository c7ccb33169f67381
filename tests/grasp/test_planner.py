"""Motions are answers of the policy, and MuJoCo says that they lead where they should."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from helpers.errors import said
from helpers.grasping import TOOL

from arm5dof.arm import Arm, load_arm
from arm5dof.arm.kinematics import inverse
from arm5dof.envs.reach import Reach, ReachConfig
from arm5dof.envs.reach_pose import ReachPose
from arm5dof.grasp.gripper import SITE
from arm5dof.grasp.perception import SeenObject
from arm5dof.grasp.planner import ALLOWED, CORRECTIONS, JUMP, POINTS, Approach, Planner
from arm5dof.grasp.shipped import shipped
from arm5dof.grasp.world import World, dense
from arm5dof.training.policy import Policy
from arm5dof.training.policy_file import load_policy
from arm5dof.vision.objects import CATALOGUE

CLEARANCE, OPENING = 0.06, 0.033
DOWN = np.array([0.0, 0.0, -1.0])


@cache
def gripping_arm() -> Arm:
    return load_arm("arm5.xml", SITE)


@cache
def policy() -> Policy:
    return load_policy(shipped("arm5.xml").policy)


@cache
def planner() -> Planner:
    return Planner(policy(), gripping_arm())


def places(seed: int, count: int) -> np.ndarray:
    """Centers (n, 3) of objects of the catalogue, anywhere on the table where objects lie."""
    rng = np.random.default_rng(seed)
    (near, far), azimuth = shipped("arm5.xml").radii, np.deg2rad(rng.uniform(-100, 100, count))
    radius = np.sqrt(rng.uniform(near**2, far**2, count))
    heights = rng.choice([one.half_height for one in CATALOGUE], count)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), heights], -1)


def tool(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the site between the fingers is, and which way it points, (n, 3) each, by MuJoCo."""
    model = gripping_arm().mj_model
    data, site = mujoco.MjData(model), model.site(SITE).id
    position, direction = np.empty((len(q), 3)), np.empty((len(q), 3))
    for i, joints in enumerate(q):
        data.qpos[: len(joints)] = joints
        mujoco.mj_kinematics(model, data)
        position[i], direction[i] = data.site_xpos[site], data.site_xmat[site].reshape(3, 3)[:, 0]
    return position, direction


def degrees(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles between unit vectors (..., 3)."""
    return np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1)))


def can(x: float, y: float) -> SeenObject:
    return SeenObject("can", 1.0, np.array([x, y, 0.02]), 0.0)


def test_approaches_are_straight_and_on_one_branch():
    arm, world, found = gripping_arm(), World(gripping_arm()), 0
    start = np.array([0.3, -0.4, np.pi / 2, 0.2, -0.5])
    for point in places(0, 40):
        way = planner().approach(world, start, point, CLEARANCE, OPENING)
        if isinstance(way, str):
            assert way in ("out of reach", "would collide")
            continue
        found += 1
        np.testing.assert_array_equal(way.transit[0], start)
        np.testing.assert_array_equal(way.transit[-1], way.line[0])
        position, direction = tool(way.line)
        along = np.linspace(CLEARANCE, 0, POINTS)[:, None] / -way.direction[2]
        assert np.linalg.norm(position - (point - along * way.direction), axis=1).max() <= 0.002
        assert degrees(direction, way.direction).max() <= 3
        assert degrees(way.direction, DOWN) <= 40.001
        assert np.abs(np.diff(way.line, axis=0)).max() <= JUMP
        position, direction = tool(dense(way.line))  # And on the way from one pose to the next.
        assert np.linalg.norm(np.cross(position - point, way.direction), axis=1).max() <= 0.001
        assert degrees(direction, way.direction).max() <= 3
        for path in (way.line, way.transit):
            assert (path >= arm.lower - 1e-5).all() and (path <= arm.upper + 1e-5).all()
            assert world.clear(path, OPENING, allowed=ALLOWED[-1])
    assert found >= 38


def test_the_policy_solves_what_the_closed_form_solves():
    """The tool straight down, where an object is grasped and above."""
    arm, points = gripping_arm(), places(1, 500)
    points = np.stack([points, points + np.array([0, 0, CLEARANCE])], 1)
    with jax.enable_x64(True):
        limits = jnp.asarray(np.stack([arm.lower, arm.upper], 1))
        pitch = jnp.full(points.shape[:2], -np.pi / 2)
        closed = np.asarray(jax.jit(inverse)(jnp.asarray(points + TOOL * -DOWN), pitch, limits).valid).any(-1).all(-1)
    assert closed.sum() > 450

    targets = points.reshape(-1, 3)
    answer = policy().solve(targets, np.tile(DOWN, (len(targets), 1)), corrections=CORRECTIONS, candidates=True)
    q = np.asarray(answer.q, float)
    position, direction = (x.reshape(*q.shape[:2], 3) for x in tool(q.reshape(-1, arm.dof)))
    good = (np.linalg.norm(position - targets[:, None], axis=-1) <= 0.002) & (degrees(direction, DOWN) <= 2)
    good &= ((q >= arm.lower - 1e-5) & (q <= arm.upper + 1e-5)).all(-1)
    solved = good.any(1).reshape(-1, 2).all(1)
    assert solved[closed].mean() >= 0.995


def test_what_is_out_of_reach_is_said_to_be():
    for point in ([0.5, 0.0, 0.02], [0.0, -0.4, 0.01], [0.02, 0.0, 0.01]):
        way = planner().approach(World(gripping_arm()), gripping_arm().home, np.array(point), CLEARANCE, OPENING)
        assert way == "out of reach"


def test_what_is_walled_in_is_not_approached():
    arm, point = gripping_arm(), np.array([0.18, 0.05, 0.02])
    around = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    wall = [can(*(point[:2] + 0.027 * np.array([np.cos(a), np.sin(a)]))) for a in around]
    ask = lambda objects, **options: planner().approach(
        World(arm, (), objects), arm.home, point, CLEARANCE, OPENING, **options
    )
    assert ask(wall) == "would collide"
    assert isinstance(ask(wall, checked=False), Approach)
    assert isinstance(ask([]), Approach)
    assert isinstance(ask([can(*point[:2])], without=0), Approach)


def test_directions_that_met_something_are_avoided():
    arm, point = gripping_arm(), np.array([0.15, 0.1, 0.02])
    ask = lambda avoid: planner().approach(World(arm), arm.home, point, CLEARANCE, OPENING, avoid=avoid)
    met: list[np.ndarray] = []
    while not isinstance(way := ask(met), str):
        assert all(degrees(way.direction, other) >= 11.99 for other in met)
        met.append(way.direction)
    assert way == "would collide" and 2 < len(met) < 20


def test_transits_go_around():
    """A tower of cans stands where the straight path between two poses leads; there is another."""
    arm = gripping_arm()
    start, end = np.array([[-0.5, -0.5, 0.3, 0.3, -1.2], [0.5, 0.5, 0.3, 0.3, -1.2]])
    position, _ = tool(np.stack([(start + end) / 2]))
    tower = [SeenObject("can", 1.0, np.array([*position[0, :2], z]), 0.0) for z in (0.02, 0.06, 0.10, 0.14)]
    world = World(arm, (), tower)
    assert World(arm).clear(np.stack([start, end]), OPENING) and not world.clear(np.stack([start, end]), OPENING)
    path = planner().transit(world, start, end, OPENING)
    assert path is not None and len(path) == 3 and world.clear(path, OPENING, allowed=ALLOWED[-1])
    np.testing.assert_array_equal(path[[0, -1]], [start, end])
    position, direction = tool(end[None])
    hand = position - 0.042 * direction
    blocked = World(arm, (), [SeenObject("can", 1.0, hand[0], 0.0)])
    assert planner().transit(blocked, start, end, OPENING) is None


def test_policies_of_another_task_site_or_arm_are_refused():
    arm, env = gripping_arm(), policy().env
    reach = Reach(ReachConfig(arm="arm5.xml", site=SITE, dynamics="kinematic"))
    for other, task in (
        (reach, "Reach"),
        (ReachPose(replace(env.config, site="ee")), "ReachPose"),
        (ReachPose(replace(env.config, orientation="rotation", arm="arm7_gripper.xml")), "ReachPose"),
    ):
        told = said(lambda other=other: Planner(policy().replace(env=other), arm))
        assert told.startswith(f"the policy is of {task} and not for grasping: train one with reach_pose.toml")
    seven = load_arm("arm7_gripper.xml", SITE)
    assert said(lambda: Planner(policy(), seven)).startswith("the policy is of another arm (theta_1, theta_2, ")
    longer = arm.mj_spec.copy()
    longer.body("link_5").pos[0] += 0.002
    narrower = arm.mj_spec.copy()
    narrower.joint("theta_4").range[0] += 0.01
    for spec in (longer, narrower):
        assert "the policy is of another arm" in said(lambda spec=spec: Planner(policy(), load_arm(spec, SITE)))
    Planner(policy(), load_arm(arm.mj_spec.copy(), SITE))


def test_the_planner_wants_a_file():
    compiled = load_arm(gripping_arm().mj_model, SITE)
    assert "the arm's MJCF file" in said(lambda: World(compiled))
