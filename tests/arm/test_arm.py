"""`Arm`: what it reads from an MJCF, its forward kinematics, its errors, and the servos that the MJCF describes."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from helpers.serial import serial_arm
from hypothesis import given
from hypothesis import strategies as st

from arm5dof.arm import Arm, load_arm
from arm5dof.arm.kinematics import TABLE_1
from arm5dof.envs.reach import ReachConfig
from arm5dof.errors import UserError
from arm5dof.runtime import files
from arm5dof.runtime.mjx import mjx

SUBSTEPS = ReachConfig().substeps
TENTH_OF_A_MILLIMETRE = 1e-4


def random_poses(arm: Arm, count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(arm.lower, arm.upper, (count, arm.dof))


def place(arm: Arm, data: mujoco.MjData, q: np.ndarray) -> None:
    """At rest in pose `q`, everything derived from positions computed."""
    mujoco.mj_resetData(arm.mj_model, data)
    data.qpos[arm.qpos] = q
    mujoco.mj_kinematics(arm.mj_model, data)
    mujoco.mj_comPos(arm.mj_model, data)


# The paper's arm


def test_arm5_is_the_papers_arm(arm: Arm):
    assert arm.dof == 5
    assert [arm.mj_model.joint(j).name for j in arm.joints] == [f"theta_{k}" for k in range(1, 6)]
    assert [arm.mj_model.actuator(a).name for a in arm.actuators] == [f"theta_{k}" for k in range(1, 6)]
    np.testing.assert_allclose(np.degrees(arm.lower), [-90, -90, 0, -135, -120])
    np.testing.assert_allclose(np.degrees(arm.upper), [90, 90, 180, 135, 120])
    np.testing.assert_allclose(np.degrees(arm.home), [0, 0, 90, 0, 0], atol=1e-12)
    np.testing.assert_allclose(arm.origin, [0, 0, 0.045])
    assert arm.mj_model.site(arm.site).name == "ee"


def test_fingers_are_no_joints_of_the_arm(arm: Arm):
    assert arm.mj_model.nq == 7
    np.testing.assert_array_equal(arm.qpos, range(5))
    np.testing.assert_array_equal(arm.dofs, range(5))


def test_the_scene_beside_the_arm_does_not_matter(arm: Arm):
    alone = load_arm("arm5.xml")
    np.testing.assert_array_equal(alone.joints, arm.joints)
    q = jnp.asarray(random_poses(arm, 100))
    np.testing.assert_array_equal(alone.forward(q), arm.forward(q))


def test_the_grasp_site_makes_an_arm_too(arm: Arm):
    hand = load_arm("reach.xml", site="grasp")
    assert hand.dof == 5
    assert hand.reach == pytest.approx(arm.reach + 0.062)


def test_mjcf_is_table_1(arm: Arm):
    """Each hinge turns about its body's z axis, and Tr(x, a_k) Rot(x, alpha_k) Tr(z, d_k+1) leads to the next."""
    model = arm.mj_model
    bodies = [model.body(f"link_{k}").id for k in range(1, 6)]
    np.testing.assert_array_equal(model.jnt_bodyid[arm.joints], bodies)
    np.testing.assert_array_equal(model.jnt_axis[arm.joints], np.tile([0, 0, 1], (5, 1)))
    np.testing.assert_array_equal(model.jnt_pos[arm.joints], np.zeros((5, 3)))
    np.testing.assert_array_equal(model.qpos0[arm.qpos], np.zeros(5))

    # A body's frame stands before its hinge's turn, so row k's a and alpha share a transform with row k + 1's d, which
    # commutes with the turn.
    lengths, twists = [0.0, *(link.a for link in TABLE_1)], [0.0, *(link.alpha for link in TABLE_1)]
    offsets = [*(link.d for link in TABLE_1), 0.0]
    positions = [*model.body_pos[bodies], model.site_pos[arm.site]]
    quaternions = [*model.body_quat[bodies], model.site_quat[arm.site]]
    for position, quaternion, a, alpha, d in zip(positions, quaternions, lengths, twists, offsets, strict=True):
        np.testing.assert_allclose(position, [a, -d * np.sin(alpha), d * np.cos(alpha)], atol=1e-15)
        np.testing.assert_allclose(quaternion, [np.cos(alpha / 2), np.sin(alpha / 2), 0, 0], atol=1e-15)


def test_reach_is_the_longest_stretch(arm: Arm):
    position = np.asarray(arm.forward(jnp.asarray(random_poses(arm, 20_000))))
    distance = np.linalg.norm(position - arm.origin, axis=1)
    assert 0.97 * arm.reach < distance.max() <= arm.measured_reach + 1e-6 < arm.reach


# Any arm

dofs, seeds = st.integers(1, 9), st.integers(0, 2**32 - 1)


@given(dofs, seeds, st.booleans(), st.booleans())
def test_forward_is_mujocos_on_random_arms(dof: int, seed: int, slides: bool, finger: bool):
    arm = load_arm(serial_arm(dof, seed, slides, finger))
    data = mujoco.MjData(arm.mj_model)
    assert arm.dof == dof
    poses = random_poses(arm, 16, seed)
    with jax.enable_x64(True):
        position = np.asarray(arm.forward(jnp.asarray(poses)))
        joints = np.asarray(arm.joint_positions(jnp.asarray(poses)))
    assert position.dtype == np.float64
    for i, q in enumerate(poses):
        place(arm, data, q)
        np.testing.assert_allclose(position[i], data.site_xpos[arm.site], atol=1e-12, rtol=0)
        np.testing.assert_allclose(joints[i], data.xanchor[arm.joints], atol=1e-12, rtol=0)


@given(dofs, seeds, st.booleans(), st.booleans())
def test_gradient_is_mujocos_jacobian_on_random_arms(dof: int, seed: int, slides: bool, finger: bool):
    arm = load_arm(serial_arm(dof, seed, slides, finger))
    data, jacobian = mujoco.MjData(arm.mj_model), np.empty((3, arm.mj_model.nv))
    poses = random_poses(arm, 4, seed)
    with jax.enable_x64(True):
        gradient = np.asarray(jax.vmap(jax.jacobian(arm.forward))(jnp.asarray(poses)))
    for q, found in zip(poses, gradient, strict=True):
        place(arm, data, q)
        mujoco.mj_jacSite(arm.mj_model, data, jacobian, None, arm.site)
        np.testing.assert_allclose(found, jacobian[:, arm.dofs], atol=1e-12, rtol=0)


@pytest.mark.parametrize(("dof", "slides"), [(1, True), (5, False), (8, True)])
def test_forward_is_mjxs_kinematics(dof: int, slides: bool):
    arm = load_arm(serial_arm(dof, seed=dof, slides=slides, finger=True))
    poses = jnp.asarray(random_poses(arm, 64), jnp.float32)

    def carried(q: jax.Array) -> mjx.Data:
        data = mjx.make_data(arm.mjx_model)
        return mjx.kinematics(arm.mjx_model, data.replace(qpos=data.qpos.at[arm.qpos].set(q)))

    data = jax.jit(jax.vmap(carried))(poses)
    atol = 2e-6 * np.abs(data.site_xpos).max()
    np.testing.assert_allclose(arm.forward(poses), data.site_xpos[:, arm.site], atol=atol, rtol=0)
    np.testing.assert_allclose(arm.joint_positions(poses), data.xanchor[:, arm.joints], atol=atol, rtol=0)


@given(dofs, seeds, st.booleans())
def test_nothing_is_further_away_than_the_reach(dof: int, seed: int, slides: bool):
    arm = load_arm(serial_arm(dof, seed, slides))
    position = np.asarray(arm.forward(jnp.asarray(random_poses(arm, 500, seed))))
    assert np.linalg.norm(position - arm.origin, axis=1).max() <= arm.reach + 1e-5


@given(dofs, seeds)
def test_to_action_undoes_to_joints(dof: int, seed: int):
    arm = load_arm(serial_arm(dof, seed))
    with jax.enable_x64(True):
        action = jnp.asarray(np.random.default_rng(seed).uniform(-1, 1, (20, dof)))
        q = arm.to_joints(action)
        np.testing.assert_allclose(arm.to_action(q), action, atol=1e-12)
        np.testing.assert_allclose(arm.to_joints(-jnp.ones(dof)), arm.lower, atol=1e-12)
        np.testing.assert_allclose(arm.to_joints(jnp.ones(dof)), arm.upper, atol=1e-12)
        assert ((q >= arm.lower) & (q <= arm.upper)).all()


def test_samples_fill_the_limits(arm: Arm):
    q = np.asarray(arm.sample(jax.random.key(0), (100, 200)))
    assert q.shape == (100, 200, 5)
    assert q.dtype == np.float32
    assert (q >= arm.lower - 1e-6).all()
    assert (q <= arm.upper + 1e-6).all()
    share = (q.reshape(-1, 5) - arm.lower) / (arm.upper - arm.lower)
    for joint in share.T:
        counts, _ = np.histogram(joint, 10, (0, 1))
        # 2,000 expected in each bin, with a standard deviation of 42.
        assert np.abs(counts - 2000).max() < 210
    assert np.abs(np.corrcoef(share.T) - np.eye(5)).max() < 0.05


def test_only_position_servos_count_as_actuators():
    """MuJoCo gives velocity servos and dampers an affine bias too, but no target position."""
    spec = serial_arm(4, seed=1)
    servos = list(spec.actuators)
    servos[1].set_to_velocity(kv=1.0)
    servos[2].set_to_motor()
    spec.delete(servos[3])
    arm = load_arm(spec)
    np.testing.assert_array_equal(arm.actuators, [0, -1, -1, -1])


def test_gears_gains_and_control_ranges_of_the_servos_are_respected():
    """Told `to_ctrl(q)`, C MuJoCo's servos come to rest at q whatever their gear, gain and bias; and the limits are
    those that the controls can ask for."""
    spec = serial_arm(3, seed=4)
    spec.option.gravity = [0, 0, 0]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for joint in spec.joints:
        joint.armature = 1.0
    plain = load_arm(spec.copy())
    servos = list(spec.actuators)
    servos[1].gear[0] = -2.5
    servos[1].ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
    servos[2].gainprm[0], servos[2].biasprm[0] = 50.0, 10.0
    middle = (plain.lower[2] + plain.upper[2]) / 2
    servos[2].inheritrange, servos[2].ctrllimited = 0.0, mujoco.mjtLimited.mjLIMITED_TRUE
    servos[2].ctrlrange = [2 * middle - 0.2 - 0.2, 2 * middle - 0.2 + 0.2]
    arm = load_arm(spec)
    np.testing.assert_allclose(arm.lower, [*plain.lower[:2], middle - 0.1], atol=1e-9)
    np.testing.assert_allclose(arm.upper, [*plain.upper[:2], middle + 0.1], atol=1e-9)

    q = np.asarray(arm.sample(jax.random.key(5)), float)
    data = mujoco.MjData(arm.mj_model)
    place(arm, data, arm.home)
    data.ctrl[arm.actuators] = arm.to_ctrl(q)
    mujoco.mj_step(arm.mj_model, data, nstep=10_000)
    np.testing.assert_allclose(data.qpos[arm.qpos], q, atol=1e-3)


# Errors

ARM = """<mujoco><worldbody><body name="a">{joint}<geom size=".1"/>
    <body name="b"><joint name="tip" range="-1 1"/><geom size=".1"/>{site}</body></body></worldbody></mujoco>"""
GOOD, EE = '<joint name="base" range="-1 1"/>', '<site name="ee" pos="1 0 0"/>'


@pytest.mark.parametrize(
    ("xml", "words"),
    [
        ("<mujoco><worldbody>", "cannot read"),
        ("not XML at all", "cannot read"),
        ("", "cannot read"),
        ('<mujoco><include file="absent.xml"/></mujoco>', "cannot read"),
        ('<mujoco><worldbody><body name="a"><joint range="-1 1"/></body></worldbody></mujoco>', "cannot read"),
        (ARM.format(joint='<joint name="base" type="ball"/>', site=EE), "joint 'base' is neither a hinge nor a slide"),
        (ARM.format(joint='<freejoint name="base"/>', site=EE), "joint 'base' is neither a hinge nor a slide"),
        (ARM.format(joint='<joint name="base" type="slide"/>', site=EE), "slide 'base' has no limits"),
        ('<mujoco><worldbody><site name="ee"/></worldbody></mujoco>', "no joint moves the site 'ee'"),
        ("<mujoco/>", "no joints"),
    ],
)
def test_bad_arms_are_refused_in_one_line(tmp_path: Path, xml: str, words: str):
    path = tmp_path / "bad.xml"
    path.write_text(xml)
    with pytest.raises(UserError) as refused:
        load_arm(path)
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


def test_an_arm_that_cannot_be_compiled_or_moved_is_refused_in_one_line():
    spec = serial_arm(2, seed=0)
    spec.joint("joint_0").range = [1, -1]
    with pytest.raises(UserError, match="cannot compile") as refused:
        load_arm(spec)
    assert "\n" not in str(refused.value)

    spec = serial_arm(2, seed=0)
    servo = next(iter(spec.actuators))
    servo.inheritrange, servo.ctrllimited, servo.ctrlrange = 0.0, mujoco.mjtLimited.mjLIMITED_TRUE, [50, 51]
    with pytest.raises(UserError, match="'joint_0' cannot move"):
        load_arm(spec)


def test_the_same_arm_without_the_fault_is_accepted(tmp_path: Path):
    path = tmp_path / "good.xml"
    path.write_text(ARM.format(joint=GOOD, site=EE))
    assert load_arm(path).dof == 2


def test_a_missing_file_names_those_there_are(tmp_path: Path):
    with pytest.raises(
        UserError, match=r"no MJCF file 'absent\.xml'.*arm5\.xml, arm7\.xml, arm7_gripper\.xml, reach\.xml"
    ):
        load_arm("absent.xml")
    with pytest.raises(UserError, match="no MJCF file"):
        load_arm(tmp_path)


# The servos, in C MuJoCo


def steady(arm: Arm, data: mujoco.MjData, q: np.ndarray) -> float:
    """How far the end effector has sunk from pose `q` when the servos have held it for four seconds, metres."""
    place(arm, data, q)
    start = data.site_xpos[arm.site].copy()
    data.ctrl[arm.actuators] = q
    mujoco.mj_step(arm.mj_model, data, nstep=200)
    assert np.abs(data.qvel[arm.dofs]).max() < 1e-6
    mujoco.mj_kinematics(arm.mj_model, data)
    return float(np.linalg.norm(data.site_xpos[arm.site] - start))


def test_the_arm_does_not_sink_under_its_own_weight(arm: Arm):
    assert np.linalg.norm(arm.mj_model.opt.gravity) > 9
    data = mujoco.MjData(arm.mj_model)
    assert max(steady(arm, data, q) for q in random_poses(arm, 200)) < TENTH_OF_A_MILLIMETRE


def test_fifty_grams_in_the_gripper_bend_it_by_less_than_a_tenth_of_a_millimetre():
    spec = mujoco.MjSpec.from_file(str(files.find("mjcf", "reach.xml")))
    grasp = spec.site("grasp")
    grasp.parent.add_body(name="load", pos=grasp.pos).add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.005, 0, 0], mass=0.05, contype=0, conaffinity=0
    )
    arm = load_arm(spec)
    data = mujoco.MjData(arm.mj_model)
    sunk = [steady(arm, data, q) for q in random_poses(arm, 200)]
    assert max(sunk) < TENTH_OF_A_MILLIMETRE
    # The load is really there.
    assert max(sunk) > 1e-5


@pytest.mark.parametrize("which", ["arm5", "arm7"])
def test_a_control_step_settles_to_one_percent(arm: Arm, which: str):
    """From 400 random poses to 400 others: the error left is below 1 % of the largest joint's move."""
    arm = arm if which == "arm5" else load_arm("arm7.xml")
    data = mujoco.MjData(arm.mj_model)
    for start, target in zip(random_poses(arm, 400, 1), random_poses(arm, 400, 2), strict=True):
        place(arm, data, start)
        data.ctrl[arm.actuators] = target
        mujoco.mj_step(arm.mj_model, data, nstep=SUBSTEPS)
        assert np.abs(data.qpos[arm.qpos] - target).max() < 0.01 * np.abs(target - start).max()
