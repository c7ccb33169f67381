"""Servos that take their time, and servos that are computed, against plain C MuJoCo and the equations of motion."""

from __future__ import annotations

import pickle
from pathlib import Path

import mujoco
import numpy as np
import pytest
from helpers.soft import soft_arm

from arm5dof.arm import Arm, load_arm
from arm5dof.arm.computed_servos import with_servos
from arm5dof.arm.servos import MOST_S, Servos
from arm5dof.errors import UserError

ROBOT = """<mujoco><compiler angle="radian"/><option gravity="0 0 {gravity}" integrator="{integrator}"/>
  <worldbody><body>
  <joint name="a" axis="0 1 0" range="-2 2" armature="{armature}"/><geom size=".05" pos=".3 0 0" mass="1"/>
  <body pos=".3 0 0"><joint name="b" axis="0 1 0" range="-2 2"/><geom size=".05" pos=".2 0 0" mass=".5"/>
  <site name="ee" pos=".2 0 0"/></body></body></worldbody>{more}</mujoco>"""
MOTORS = '<actuator><motor joint="a" ctrlrange="-20 20" gear="2"/><motor joint="b" forcerange="-9 9"/></actuator>'


def robot(more: str = "", gravity: float = 0, armature: float = 0, integrator: str = "implicitfast") -> mujoco.MjSpec:
    xml = ROBOT.format(more=more, gravity=gravity, armature=armature, integrator=integrator)
    return mujoco.MjSpec.from_string(xml)


def position(kp: float, kv: float) -> str:
    return "<actuator>" + "".join(f'<position joint="{j}" kp="{kp}" kv="{kv}"/>' for j in "ab") + "</actuator>"


def plain(arm: Arm, q: np.ndarray, target: np.ndarray, seconds: float) -> np.ndarray:
    """Where C MuJoCo's own loop of steps brings the arm."""
    data = mujoco.MjData(arm.free_model)
    data.qpos[arm.qpos], data.ctrl[arm.actuators] = q, np.asarray(arm.to_ctrl(target))
    mujoco.mj_step(arm.free_model, data, nstep=int(seconds / arm.mj_model.opt.timestep))
    return data.qpos.copy()


def rest(servos: Servos, q: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """From rest in one pose (n, dof) to another."""
    model, n = servos.model, len(q)
    qpos = np.tile(model.qpos0, (n, 1))
    qpos[:, servos.arm.qpos] = q
    still = np.zeros((n, model.nv)), np.zeros((n, model.na))
    return servos.rest(qpos, *still, servos.hold(q), servos.hold(target))


# How they come to rest


def test_arms_come_to_rest_where_mujoco_brings_them():
    arm = soft_arm()
    servos = Servos(arm)
    q, target = np.random.default_rng(0).uniform(arm.lower, arm.upper, (2, 12, arm.dof))
    qpos, qvel, _ = rest(servos, q, target)
    assert np.abs(qvel).max() < 1e-2
    expected = [plain(arm, *pair, 2 * MOST_S) for pair in zip(q, target, strict=True)]
    np.testing.assert_allclose(qpos, expected, atol=1e-3)
    # They sag, which is what corrections are for.
    assert 0.002 < np.abs(qpos[:, arm.qpos] - target).max() < 0.5
    # Any leading axes do.
    start = np.tile(servos.model.qpos0, (3, 4, 1))
    start[..., arm.qpos] = q.reshape(3, 4, -1)
    held = [x.reshape(3, 4, -1) for x in (np.zeros_like(qvel), np.zeros((12, 0)), servos.hold(q), servos.hold(target))]
    np.testing.assert_array_equal(servos.rest(start, *held)[0].reshape(12, -1), qpos)


def test_an_arm_that_is_told_the_same_stays():
    servos = Servos(soft_arm())
    q, target = np.random.default_rng(1).uniform(servos.arm.lower, servos.arm.upper, (2, 5, servos.arm.dof))
    qpos, qvel, act = rest(servos, q, target)
    ctrl, other = servos.hold(target), servos.hold(target)
    other[0] += 0.01
    again, _, _ = servos.rest(qpos, qvel, act, ctrl, other)
    assert (again[1:] == qpos[1:]).all() and (again[0] != qpos[0]).any()


def test_settling_is_a_matter_of_stiffness_and_damping():
    assert Servos(load_arm("arm7.xml")).settle_steps == 3
    stiff, soft = (
        Servos(load_arm(robot(position(kp, kv), armature=0.1))).settle_steps for kp, kv in ((400, 40), (40, 12))
    )
    assert stiff < soft / 3
    assert Servos(load_arm(robot(position(100, 0)))).settle_steps is None


def test_commands_are_no_jumps():
    """A light joint that is told to be far away at once is at the limit of its force, and trembles there for ever."""
    xml = """<mujoco><compiler angle="radian"/><option integrator="implicitfast"/><worldbody><body>
      <joint name="a" range="-2 2" damping="1"/><geom size=".02" mass=".05"/><site name="ee" pos=".1 0 0"/></body>
      </worldbody><actuator><position joint="a" kp="1000" kv="100" forcerange="-30 30"/></actuator></mujoco>"""
    arm = load_arm(mujoco.MjSpec.from_string(xml))
    servos = Servos(arm)
    q, target = np.random.default_rng(3).uniform(arm.lower, arm.upper, (2, 20, 1))
    assert np.abs(rest(servos, q, target)[0] - target).max() < 1e-2 and servos.rest_seconds < 1
    assert max(np.abs(plain(arm, *pair, 5.0) - pair[1]).max() for pair in zip(q, target, strict=True)) > 2e-2


def test_sagging_servos_settle_all_the_same():
    assert Servos(load_arm(robot(position(40, 12), gravity=-9.81))).settle_steps > 0


def test_physics_that_blows_up_is_not_finite(tmp_path: Path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    arm = load_arm(robot(position(1e7, 1e5), integrator="Euler"))
    servos = Servos(arm)
    qpos, _, _ = rest(servos, np.ones((2, 2)), -np.ones((2, 2)))
    assert not np.isfinite(qpos).any() and servos.settle_steps is None
    assert not list(tmp_path.iterdir()) and capfd.readouterr().err == ""


# Computed ones


def test_a_computed_servo_is_critically_damped():
    """One joint with a load: q(t) = 1 - (1 + w t) exp(-w t)."""
    xml = """<mujoco><compiler angle="radian"/><option gravity="0 0 0" timestep="5e-4"/>
      <worldbody><body><joint name="a" axis="0 1 0" range="-2 2"/><geom size=".05" pos=".3 0 0"/>
      <site name="ee" pos=".2 0 0"/></body></worldbody></mujoco>"""
    arm = with_servos(load_arm(mujoco.MjSpec.from_string(xml)))
    model, data = arm.mj_model, mujoco.MjData(arm.mj_model)
    kp, kv = -model.actuator_biasprm[0, 1:3]
    frequency = 2 * kp / kv
    data.ctrl[arm.actuators] = 1.0
    for _ in range(600):
        mujoco.mj_step(model, data)
        t = frequency * data.time
        assert data.qpos[0] == pytest.approx(1 - (1 + t) * np.exp(-t), abs=1e-2)


def test_motors_give_way_to_servos_of_their_strength():
    arm = load_arm(robot(MOTORS, gravity=-9.81))
    assert (arm.actuators < 0).all()
    served = with_servos(arm)
    assert served.actuation == ("position", "position") and served.joint_names == arm.joint_names
    assert served.mj_model.nu == 2
    np.testing.assert_array_equal(served.mj_model.actuator_forcerange[served.actuators], [[-40, 40], [-9, 9]])
    np.testing.assert_array_equal([served.lower, served.upper], [arm.lower, arm.upper])
    assert Servos(served).settle_steps is not None
    assert arm.mj_model.nu == 2 and (arm.actuators < 0).all()  # The arm that was given is as it was.


def test_joints_that_have_a_servo_keep_it():
    arm = load_arm(robot('<actuator><position joint="b" kp="33" kv="3"/></actuator>'))
    served = with_servos(arm)
    assert served.mj_model.actuator_gainprm[served.actuators[1], 0] == 33 and with_servos(served) is served


def test_unnamed_joints_and_those_with_keyframes_get_servos_too():
    spec = robot('<keyframe><key qpos="0 1"/></keyframe>')
    spec.joint("a").name = ""
    served = with_servos(load_arm(spec))
    assert served.actuation == ("position", "position") and served.joint_names == ("joint_0", "b")


def test_a_compiled_model_cannot_be_given_servos():
    with pytest.raises(UserError, match="joint 'a', 'b' has no position actuator: load the arm from its MJCF"):
        with_servos(load_arm(robot().compile()))


def test_a_copy_rests_where_the_servos_do():
    servos = Servos(load_arm("reach.xml"))
    assert servos.settle_steps == pickle.loads(pickle.dumps(servos)).settle_steps == 3
    told = servos.hold(servos.arm.home[None])
    start = (np.zeros((1, servos.model.nq)), np.zeros((1, servos.model.nv)), np.zeros((1, 0)), 0 * told, told)
    for found, expected in zip(pickle.loads(pickle.dumps(servos)).rest(*start), servos.rest(*start), strict=True):
        np.testing.assert_array_equal(found, expected)
