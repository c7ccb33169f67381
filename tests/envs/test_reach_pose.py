"""Reaching a pose: against C MuJoCo and SciPy, against itself where two parts must agree, and learnt."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from helpers.errors import said
from helpers.serial import serial_arm
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from arm5dof.arm import Arm, load_arm
from arm5dof.cli import main as cli
from arm5dof.envs.reach_pose import AXES, PoseGoal, ReachPose, ReachPoseConfig
from arm5dof.training import evaluate
from arm5dof.training.config import load_config
from arm5dof.training.run import Run
from arm5dof.training.trainer import Trainer

quick_jit = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 1})

KINDS = ("approach", "rotation")
SEEDS = st.integers(0, 2**32 - 1)


@cache
def loaded(name: str) -> Arm:
    return load_arm(serial_arm(6, int(name), slides=True, finger=True)) if name.isdigit() else load_arm(name)


@cache
def pose_env(name: str, orientation: str, tool_axis: str = "x") -> ReachPose:
    config = ReachPoseConfig(dynamics="kinematic", orientation=orientation, tool_axis=tool_axis)
    return ReachPose(config, loaded(name))


@pytest.fixture(params=KINDS)
def env(request: pytest.FixtureRequest) -> ReachPose:
    return pose_env("arm7.xml", request.param)


def in_c(arm: Arm, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The end effector's position and rotation in C MuJoCo."""
    data = mujoco.MjData(arm.mj_model)
    data.qpos[arm.qpos] = q
    mujoco.mj_kinematics(arm.mj_model, data)
    return data.site_xpos[arm.site].copy(), data.site_xmat[arm.site].reshape(3, 3).copy()


def goal_of(env: ReachPose, position: np.ndarray, turn: Rotation) -> PoseGoal:
    """A goal from a position and the site's whole rotation."""
    matrix = turn.as_matrix()
    axes = [AXES[env.config.tool_axis]] if env.config.orientation == "approach" else list(np.eye(3))
    return PoseGoal(jnp.asarray(position, jnp.float32), jnp.asarray([matrix @ axis for axis in axes], jnp.float32))


def poses(seed: int, n: int) -> tuple[list[np.ndarray], list[Rotation]]:
    rng = np.random.default_rng(seed)
    return list(rng.uniform(-0.3, 0.3, (n, 3))), list(Rotation.random(n, random_state=rng))


@cache
def cylindrical(kind: str) -> tuple[ReachPose, Callable[[PoseGoal], jax.Array]]:
    """An environment in cylindrical coordinates, and what its policy sees of a goal."""
    config = ReachPoseConfig(dynamics="kinematic", orientation=kind, observation="cylindrical")
    env = ReachPose(config, loaded("arm7.xml"))
    return env, quick_jit(lambda goal: env.question(goal)["state"])


@pytest.mark.parametrize("kind", KINDS)
@given(SEEDS, st.floats(-np.pi, np.pi))
def test_what_the_policy_sees_turns_with_the_arm(kind: str, seed: int, angle: float):
    """In cylindrical coordinates, a goal that turns about the vertical axis changes its azimuth alone."""
    env, see = cylindrical(kind)
    (position,), (turn,) = poses(seed, 1)
    about = Rotation.from_rotvec([0, 0, angle])
    before, after = (
        np.asarray(see(goal_of(env, *goal))) for goal in ((position, turn), (about.apply(position), about * turn))
    )
    np.testing.assert_allclose(before[3:], after[3:], atol=5e-4)
    azimuth = np.arctan2(position[1], position[0]) + angle
    np.testing.assert_allclose(after[1:3], [np.cos(azimuth), np.sin(azimuth)], atol=1e-3)
    np.testing.assert_allclose([np.cos(np.pi * after[0]), np.sin(np.pi * after[0])], after[1:3], atol=1e-4)


def test_a_goal_above_the_arm_has_some_azimuth():
    env, see = cylindrical("rotation")
    assert np.isfinite(see(goal_of(env, np.array([0.0, 0.0, 0.4]), Rotation.identity()))).all()


@pytest.mark.parametrize("name", ["reach.xml", "arm7.xml", "0", "1"])
def test_poses_are_c_mujocos(name: str):
    arm = loaded(name)
    q = arm.sample(jax.random.key(4), (50,))
    tools = [pose_env(name, "approach", axis) for axis in AXES]
    pose, turned, *pointed = quick_jit(
        lambda q: (arm.pose(q), *(jax.vmap(env.forward)(q) for env in (pose_env(name, "rotation"), *tools)))
    )(q)
    for i, angles in enumerate(np.asarray(q, float)):
        position, matrix = in_c(arm, angles)
        np.testing.assert_allclose(pose.position[i], position, atol=3e-6)
        np.testing.assert_allclose(pose.rotation[i], matrix, atol=3e-6)
        np.testing.assert_allclose(turned.position[i], position, atol=3e-6)
        np.testing.assert_allclose(turned.directions[i], matrix.T, atol=3e-6)
        for axis, goal in zip(AXES, pointed, strict=True):
            column, sign = matrix[:, "xyz".index(axis[-1])], -1 if axis[0] == "-" else 1
            np.testing.assert_allclose(goal.directions[i, 0], sign * column, atol=3e-6)


def test_goals_survive_what_networks_see(env: ReachPose):
    encode, decode = quick_jit(env.encode), quick_jit(env.decode)
    for position, turn in zip(*poses(0, 30), strict=True):
        goal = goal_of(env, position, turn)
        seen = encode(goal)
        assert seen.shape == (3 + goal.directions.size,) and (np.abs(seen) < 3).all()
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), decode(seen), goal)


@pytest.mark.parametrize("kind", KINDS)
@given(seed=SEEDS, size=st.sampled_from([1.0, 1e-2, 1e-4]))
def test_errors_are_scipys(kind: str, seed: int, size: float):
    env = pose_env("arm7.xml", kind)
    (here, shift), (turn, other) = poses(seed, 2)
    offset = Rotation.from_rotvec(size * other.as_rotvec())
    there, turned = here + size * shift, offset * turn
    found = errors(env)(goal_of(env, there, turned), goal_of(env, here, turn))
    assert found["distance"] == pytest.approx(np.linalg.norm(size * shift), abs=1e-6)
    angle = offset.magnitude()
    if kind == "approach":
        a, b = (t.as_matrix()[:, 0] for t in (turned, turn))
        angle = np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)
    assert found["angle"] == pytest.approx(angle, abs=2e-6 if angle < 3.1 else 2e-3)


@cache
def errors(env: ReachPose):
    return quick_jit(env.errors)


@cache
def correct(env: ReachPose):
    return quick_jit(env.correct)


@pytest.mark.parametrize("kind", KINDS)
@given(seed=SEEDS)
def test_correction_undoes_a_constant_error(kind: str, seed: int):
    """A policy whose answers are always off by the same small motion: asked for the corrected goal, it meets the goal.
    A direction does not say by which rotation it is off, so there an angle is left that is smaller by an order."""
    env = pose_env("arm7.xml", kind)
    (position, shift), (turn, other) = poses(seed, 2)
    offset = Rotation.from_rotvec(0.1 * other.as_rotvec() / max(other.magnitude(), 1e-6))

    def achieved(asked: PoseGoal) -> PoseGoal:
        moved = asked.position + jnp.asarray(0.05 * shift, jnp.float32)
        return PoseGoal(moved, jnp.asarray(offset.apply(np.asarray(asked.directions, float)), jnp.float32))

    goal = asked = goal_of(env, position, turn)
    left = [errors(env)(achieved(asked), goal)]
    for _ in range(2):
        asked = correct(env)(asked, achieved(asked), goal)
        np.testing.assert_allclose(np.linalg.norm(asked.directions, axis=1), 1, atol=1e-5)
        left.append(errors(env)(achieved(asked), goal))
    assert all(error["distance"] < 1e-6 for error in left[1:])
    if kind == "rotation":
        assert left[0]["angle"] == pytest.approx(0.1, abs=1e-5) and left[1]["angle"] < 2e-6
    else:
        assert left[1]["angle"] < 0.15 * left[0]["angle"] + 2e-6 and left[2]["angle"] < 0.02 * left[0]["angle"] + 2e-6


def test_correction_leaves_what_is_met_as_it_is(env: ReachPose):
    goal = goal_of(env, *(p[0] for p in poses(3, 1)))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), correct(env)(goal, goal, goal), goal)


@pytest.mark.parametrize(
    ("kind", "inputs", "text"),
    [
        ("approach", {"approach": [[0, 0, 0]]}, "approach 0 0 0 points nowhere: give the direction"),
        ("approach", {"approach": [[0, 0, 1], [0, 0, 0]]}, "points nowhere"),
        ("approach", {"approach": [[0, 0, np.nan]]}, "approach 1 is not finite"),
        ("approach", {"approach": [1, 0]}, "approach takes 3 numbers (ax, ay, az)"),
        ("rotation", {"quaternion": [[1, 0, 0]]}, "quaternion takes 4 numbers (qw, qx, qy, qz)"),
        ("rotation", {"quaternion": [[1, 1, 0, 0]]}, "quaternion [1.0, 1.0, 0.0, 0.0] is no unit quaternion W X Y Z"),
        ("rotation", {"quaternion": [[1, 0, 0, 0], [0, 0, 0, 0]]}, "[0.0, 0.0, 0.0, 0.0] is no unit quaternion"),
        ("rotation", {"quaternion": [[1, 0, 0, np.inf]]}, "quaternion 1 is not finite"),
        ("rotation", {"target": [[1, 0]], "quaternion": [[1, 0, 0, 0]]}, "target takes 3 numbers"),
    ],
)
def test_what_is_no_goal_is_refused(kind: str, inputs: dict, text: str):
    assert text in said(lambda: pose_env("arm7.xml", kind).goals(**{"target": [[0.1, 0.1, 0.1]], **inputs}))


def test_stated_goals_are_what_they_say():
    points, turns = poses(5, 20)
    axes = np.array([3 * turn.as_matrix()[:, 0] for turn in turns])
    pointing = pose_env("arm7.xml", "approach").goals(target=points, approach=axes)
    np.testing.assert_allclose(pointing.position, points, atol=1e-7)
    np.testing.assert_allclose(pointing.directions[:, 0], axes / 3, atol=1e-6)
    quaternions = np.array([np.roll(turn.as_quat(), 1) for turn in turns])
    turned = pose_env("arm7.xml", "rotation").goals(target=points, quaternion=1.005 * quaternions)
    expected = np.array([turn.as_matrix().T for turn in turns])
    np.testing.assert_allclose(turned.directions, expected, atol=1e-6)


def test_a_step_and_hindsight_say_the_same(env: ReachPose):
    """Exchanging the goal of what happened gives what would have happened with that goal."""
    n = 30
    q, actions = env.arm.sample(jax.random.key(0), (n,)), jax.random.uniform(jax.random.key(1), (n, 7), minval=-1.0)
    both = quick_jit(jax.vmap(jax.vmap(env.sample_goal)))(jax.random.split(jax.random.key(2), (2, n)))
    goals, others = (jax.tree.map(lambda x, i=i: x[i], both) for i in range(2))
    run = quick_jit(jax.vmap(lambda q, goal, action: env.step(env.start(q, goal), action)))
    happened, would = run(q, goals, actions), run(q, others, actions)
    hindsight = lambda obs, goal, action: env.goal_reward(env.achieved(obs), goal, action)
    reward, terminal = quick_jit(jax.vmap(hindsight))(happened.obs, others, actions)
    np.testing.assert_allclose(reward, would.reward, atol=2e-6)
    np.testing.assert_array_equal(terminal, would.done)
    exchanged = quick_jit(jax.vmap(env.replace_goal))(happened.obs, others)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), exchanged, would.obs)
    distance, angle = would.metrics["distance"], would.metrics["angle"]
    # The chord of an angle stands in for it.
    np.testing.assert_allclose(would.reward, -np.hypot(distance, 0.2 * np.sin(angle / 2)), atol=1e-6)


def test_pointing_is_learnt_in_seconds():
    """By each of three seeds; one program serves them all."""
    short = {"episodes": 40, "num_envs": 20, "evaluate_every": 20, "checkpoint_every": 20, "updates_per_step": 48}
    config = load_config("reach_pose.toml", episode_length=64, refinements=0, **short)
    trainer = Trainer(ReachPose(config.env), config)
    for seed in range(3):
        trainer.state = trainer._init(config.ddpg, jax.random.key(seed))
        before = evaluate.evaluate(trainer.policy(), 1000)
        while not trainer.finished:
            trainer.advance()
        after = evaluate.evaluate(trainer.policy(), 1000)
        assert before["one_shot_within"]["percent"] < 2 and after["one_shot_within"]["percent"] > 20, seed
        assert before["one_shot"]["median_mm"] > 30 and before["one_shot_angle"]["median_deg"] > 15, seed
        assert after["one_shot"]["median_mm"] < 8 and after["one_shot_angle"]["median_deg"] < 5, seed


@pytest.fixture(scope="module", params=KINDS)
def asked(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A run that has learnt nothing, and how it is asked."""
    arm = {"approach": "reach.xml", "rotation": "arm7.xml"}[request.param]
    small = {"actor_width": 16, "actor_depth": 1, "critic_width": 8, "critic_depth": 1, "replay_capacity": 64}
    config = load_config("reach_pose.toml", arm=arm, orientation=request.param, **small)
    run = Run.create(config, tmp_path_factory.mktemp("runs") / request.param)
    trainer = run.trainer()
    trainer.state = trainer._init(config.ddpg, jax.random.key(0))
    run.checkpoints().save(trainer.state)
    return run.folder, {"approach": "approach", "rotation": "quaternion"}[request.param]


TURNS = {"approach": [[0, 0, -2.0], [1, 1, 0]], "quaternion": [[1, 0, 0, 0], [0.5, 0.5, -0.5, 0.5]]}
POINTS = [[0.15, 0.05, 0.12], [-0.1, 0.1, 0.2]]
LOOSE = ("--refine", "1", "--tolerance-mm", "1000", "--tolerance-deg", "180")


def check_in_c(run: Run, joints: dict[str, float], point: list, turn: list, told_mm: float, told_deg: float) -> None:
    """What an answer says of its errors is what C MuJoCo finds."""
    arm = run.env.arm
    position, matrix = in_c(arm, np.array([float(joints[name]) for name in arm.joint_names]))
    assert 1e3 * np.linalg.norm(position - point) == pytest.approx(told_mm, abs=2e-3)
    if len(turn) == 3:
        wanted = np.array(turn) / np.linalg.norm(turn)
        angle = np.arctan2(np.linalg.norm(np.cross(matrix[:, 0], wanted)), matrix[:, 0] @ wanted)
    else:
        angle = (Rotation.from_quat(np.roll(turn, -1)).inv() * Rotation.from_matrix(matrix)).magnitude()
    assert np.degrees(angle) == pytest.approx(told_deg, abs=2e-3 if angle < 3.1 else 0.2)


def test_the_command_line_asks_for_poses(asked: tuple[Path, str], capsys: pytest.CaptureFixture):
    folder, name = asked
    words = [
        word
        for point, turn in zip(POINTS, TURNS[name], strict=True)
        for word in ("--target", *map(str, point), f"--{name}", *map(str, turn))
    ]
    capsys.readouterr()
    assert cli.main(["solve", str(folder), *words, *LOOSE, "--json"]) == 0
    run = Run.open(folder)
    answers = json.loads(capsys.readouterr().out)
    for answer, point, turn in zip(answers, POINTS, TURNS[name], strict=True):
        assert answer["target_m"] == point and answer[name] == turn
        check_in_c(run, answer["joints_rad"], point, turn, answer["error_mm"], answer["error_deg"])
    assert cli.main(["solve", str(folder), *words, *LOOSE]) == 0
    assert capsys.readouterr().out.count(f", {name} ") == 2
    assert cli.main(["solve", str(folder), *words, "--refine", "0", "--tolerance-deg", "0.001"]) == 2
    assert "2 of 2 targets not reached within 20 mm and 0.001 deg" in capsys.readouterr().err
    assert cli.main(["solve", str(folder), *words[:4], *LOOSE]) == 2
    assert f"give --target X Y Z --{name}" in capsys.readouterr().err


def test_poses_in_and_out_of_a_csv(asked: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture):
    folder, name = asked
    columns = ["x", "y", "z", *Run.open(folder).policy().forward_model.goal_inputs[name]]
    rows = [[*point, *turn] for point, turn in zip(POINTS, TURNS[name], strict=True)]
    with open(tmp_path / "in.csv", "w", newline="") as handle:
        csv.writer(handle).writerows([columns, *rows])
    arguments = ["solve", str(folder), "--csv", str(tmp_path / "in.csv"), "--out", str(tmp_path / "out.csv")]
    assert cli.main([*arguments, *LOOSE]) == 0
    answers = list(csv.DictReader(open(tmp_path / "out.csv")))
    assert len(answers) == 2
    for answer, row in zip(answers, rows, strict=True):
        assert [float(answer[column]) for column in columns] == row and answer["reached"] == "1"
        told = float(answer["error_mm"]), float(answer["error_deg"])
        check_in_c(Run.open(folder), answer, row[:3], row[3:], *told)
    (tmp_path / "points.csv").write_text("x,y,z\n0.1,0.1,0.1\n")
    capsys.readouterr()
    assert cli.main(["solve", str(folder), "--csv", str(tmp_path / "points.csv")]) == 2
    assert f"needs a header with {', '.join(columns[:-1])} and {columns[-1]}" in capsys.readouterr().err
