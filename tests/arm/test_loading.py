"""Robots as their makers describe them: which point is the end effector, what holds the base, and what is refused."""

from __future__ import annotations

from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest
from helpers.errors import said
from helpers.serial import serial_arm
from hypothesis import given
from hypothesis import strategies as st

from arm5dof.arm import Arm, load_arm

ROBOT = """<mujoco>{options}<worldbody><body name="car" pos=".1 .2 .3" quat="1 2 3 4">{base}<geom size=".1"/>
    <body name="upper" pos="0 0 .2"><joint name="a" range="-1 1"/><geom size=".1"/>
    <body name="lower" pos=".3 0 0"><joint name="b" axis="0 1 0" range="-1 1"/><geom size=".1"/>
    <body name="{tip}" pos=".2 0 0" quat="1 1 0 0"><geom name="blade" size=".1" pos="0 .1 .2" quat="1 0 1 0"/>{inside}
    <body name="finger" pos="0 0 .1"><joint name="grip" type="slide" range="0 .1"/><geom size=".1"/></body>
    </body></body></body></body></worldbody>{more}</mujoco>"""

FREE = '<freejoint name="root"/>'
POSITION = '<actuator><position joint="a"/><position joint="b"/></actuator>'


def robot(base: str = "", inside: str = "", more: str = "", options: str = "", tip: str = "tip") -> mujoco.MjSpec:
    """An arm of two joints with a finger, on a car."""
    xml = ROBOT.format(base=base, inside=inside, more=more, options=options, tip=tip)
    return mujoco.MjSpec.from_string(xml)


def in_c(arm: Arm, q: np.ndarray) -> mujoco.MjData:
    """C MuJoCo's own kinematics of the arm's model."""
    data = mujoco.MjData(arm.mj_model)
    data.qpos[arm.qpos] = q
    mujoco.mj_kinematics(arm.mj_model, data)
    return data


# The end effector


@pytest.mark.parametrize("kind", ["body", "geom"])
@given(offset=st.tuples(*[st.floats(-0.5, 0.5)] * 3))
def test_a_place_on_a_body_or_a_geom_is_where_mujoco_has_it(kind: str, offset: tuple[float, float, float]):
    name = "tip" if kind == "body" else "blade"
    arm = load_arm(robot(), f"{kind} {name} {' '.join(map(str, offset))}")
    q = np.array([0.4, -0.7])
    data = in_c(arm, q)
    frame = data.body(name) if kind == "body" else data.geom(name)
    rotation = frame.xmat.reshape(3, 3)
    with jax.enable_x64(True):
        pose = arm.pose(jax.numpy.asarray(q))
    np.testing.assert_allclose(pose.position, frame.xpos + rotation @ offset, atol=1e-9)
    np.testing.assert_allclose(pose.rotation, rotation, atol=1e-9)


def test_the_compiled_model_and_the_mjcf_remember_the_place():
    made = load_arm(robot(), "body tip 0 0 0.1")
    for source in (made.mj_model, mujoco.MjSpec.from_string(made.mj_spec.to_xml())):
        again = load_arm(source, "body tip  0 0 0.1")
        q = np.array([0.1, 0.2])
        np.testing.assert_allclose(again.forward(q), made.forward(q), atol=1e-6)
    assert robot().sites == [] and load_arm(robot(), "body tip").dof == 2


def test_no_place_that_is_not_there():
    spec = robot()
    for wanted, lacking in (
        ("body tap 0 0 1", "body 'tap 0 0 1'"),
        ("geom tip", "geom 'tip'"),
        ("body tip 0 0", "body 'tip 0 0'"),
        ("body tip 0 0 nan", "body 'tip 0 0 nan'"),
        ("tip 0 0", "site, body or geom 'tip 0 0'"),
    ):
        told = said(lambda wanted=wanted: load_arm(spec, wanted))
        assert told.startswith(f"the model has no {lacking} to use as end effector: "), wanted
    assert "did you mean 'tip'?" in said(lambda: load_arm(spec, "tap"))
    assert "a compiled model can be given none" in said(lambda: load_arm(spec.compile(), "body tip"))
    assert "no joint moves the site 'body car'" in said(lambda: load_arm(spec, "body car"))
    assert "no joint moves the site 'body upper' away" in said(lambda: load_arm(spec, "body upper"))


@pytest.mark.parametrize(
    ("inside", "tip", "chosen", "dof"),
    [
        ('<site name="knee"/><site name="ee"/><site name="tcp"/>', "tip", "", 2),
        ('<site name="wheel"/><site name="attachment_site"/>', "hand", "site 'attachment_site'", 2),
        ('<site name="grasp"/><site name="left_tcp"/>', "tip", "site 'left_tcp'", 2),
        ('<site name="hand_camera"/><site name="finger_tool"/>', "left_hand", "body 'left_hand'", 2),
        ("", "tool0", "body 'tool0'", 2),
        ('<body name="gripper"><geom size=".1"/></body><body name="gripper_frame"/>', "x", "body 'gripper_frame'", 2),
        ('<body name="moving_gripper"><joint range="-1 1"/><geom size=".1"/></body>', "tip", "body 'tip', the last", 2),
        ("", "tip", "body 'tip', the last link", 2),
    ],
)
def test_without_a_name_what_looks_like_a_tool_is_chosen_and_kept(inside: str, tip: str, chosen: str, dof: int):
    arm = load_arm(robot(inside=inside, tip=tip))
    assert arm.dof == dof and arm.mj_model.site(arm.site).name == "ee"
    assert chosen in arm.why_site and bool(arm.why_site) == bool(chosen) and arm.why_site in repr(arm)
    q = np.array([0.3, 0.5])
    np.testing.assert_allclose(in_c(arm, q).site("ee").xpos, in_c(arm, q).body(tip).xpos, atol=1e-12)
    again = load_arm(arm.mj_model)
    assert again.why_site == "" and again.chain[-1].offset.tolist() == arm.chain[-1].offset.tolist()


def test_the_last_link_of_slides_alone_is_behind_all_but_fingers():
    spec = robot(tip="")
    for joint in spec.joints:
        joint.type, joint.range = mujoco.mjtJoint.mjJNT_SLIDE, [-1, 1]
    assert load_arm(spec).joint_names == ("a", "b")


def test_of_two_arms_one_is_chosen_and_the_other_named():
    spec = mujoco.MjSpec()
    for side in ("left", "right"):
        child = robot(inside='<site name="gripper"/>')
        spec.worldbody.add_frame().attach_body(child.body("car"), f"{side}/", "")
    assert load_arm(spec).why_site == "chosen: site 'left/gripper', by its name (so could be 'right/gripper')"
    assert load_arm(spec, "right/gripper").joint_names == ("right/a", "right/b")


# The base


def test_a_base_is_held_where_the_mjcf_has_it():
    acts = '<actuator><position joint="a"/><motor joint="root" gear="1 0 0 0 0 0"/></actuator>'
    more = acts + '<sensor><jointpos joint="a"/></sensor><keyframe><key qpos="0 0 0 1 0 0 0 0 0 0"/></keyframe>'
    spec = robot(FREE, more=more)
    text = said(lambda: load_arm(spec, "body tip"))
    assert text == "joint 'root' is neither a hinge nor a slide: hold what carries the arm still, base = \"car\""
    arm = load_arm(spec, "body tip", "car")
    assert (arm.joint_names, arm.held) == (("a", "b"), ("root",)) and "root held" in repr(arm)
    assert (arm.mj_model.nq, arm.mj_model.nu) == (3, 1) and spec.compile().nq == 10
    original = mujoco.MjData(spec.compile())
    q = np.array([0.3, -0.4])
    original.joint("a").qpos, original.joint("b").qpos = q
    mujoco.mj_kinematics(original.model, original)
    with jax.enable_x64(True):
        np.testing.assert_allclose(arm.forward(jax.numpy.asarray(q)), original.body("tip").xpos, atol=1e-12)
    assert load_arm(arm.mj_model, "body tip", "car").held == ()


def test_slides_and_wheels_of_a_base_are_held_too():
    base = '<joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/><joint name="turn"/>'
    spec = robot(base)
    text = said(lambda: load_arm(spec, "body tip"))
    assert "slides 'x', 'y' have no limits" in text and 'base = "car"' in text
    assert load_arm(spec, "body tip", "car").held == ("x", "y", "turn")
    assert load_arm(spec, "body tip", "upper").joint_names == ("b",)
    assert "did you mean 'car'?" in said(lambda: load_arm(spec, "body tip", "cart"))
    assert "does not carry" in said(lambda: load_arm(spec, "body tip", "finger"))
    assert "load the arm from its MJCF" in said(lambda: load_arm(spec.compile(), "", "car"))


# Joints without limits


@pytest.mark.parametrize(
    ("ctrlrange", "turn", "turns"),
    [
        ("", [-180, 180], True),
        ('ctrllimited="true" ctrlrange="-7 7"', [-180, 180], True),
        ('ctrllimited="true" ctrlrange="0 7"', [0, 360], True),
        ('ctrllimited="true" ctrlrange="-1 2"', [np.degrees(-1), np.degrees(2)], False),
    ],
)
def test_a_joint_without_limits_is_a_turn(ctrlrange: str, turn: list[float], turns: bool):
    more = f'<actuator><position joint="spin" {ctrlrange}/></actuator>'
    arm = load_arm(robot('<joint name="spin"/>', more=more), "body tip")
    np.testing.assert_allclose(np.degrees([arm.lower[0], arm.upper[0]]), turn, atol=1e-9)
    assert arm.turns == (turns, False, False)
    assert ("continuous" in repr(arm)) == (not ctrlrange)


@pytest.mark.parametrize(
    ("limits", "turn", "turns"),
    [
        ("-361 361", [-180, 180], True),
        ("-30 400", [-30, 330], True),
        ("-170 183", [-170, 183], False),
    ],
)
def test_of_more_than_a_turn_one_is_asked_for(limits: str, turn: list[float], turns: bool):
    arm = load_arm(robot(f'<joint name="spin" range="{limits}"/>'), "body tip")
    np.testing.assert_allclose(np.degrees([arm.lower[0], arm.upper[0]]), turn, atol=1e-9)
    assert arm.turns[0] == turns
    np.testing.assert_allclose(np.degrees(arm.stops[0]), [float(x) for x in limits.split()])


# URDF

LINK = (
    '<link name="{}"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
)
URDF = """<robot name="r"><link name="base"/>{}</link>{}</link><link name="tool0"/>
<joint name="j1" type="continuous"><parent link="base"/><child link="l1"/><origin xyz="0 0 .1"/>
<axis xyz="0 0 1"/></joint>
<joint name="j2" type="revolute"><parent link="l1"/><child link="l2"/><origin xyz="0 0 .3"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="2" effort="1" velocity="1"/>{}</joint>
<joint name="t" type="fixed"><parent link="l2"/><child link="tool0"/><origin xyz="0 0 .2"/></joint></robot>"""


def test_urdf(tmp_path: Path):
    path = tmp_path / "robot.urdf"
    links = LINK.format("l1"), LINK.format("l2")
    path.write_text(URDF.format(*links, ""))
    arm = load_arm(path)
    assert (arm.joint_names, arm.turns) == (("j1", "j2"), (True, False))
    assert arm.why_site == "chosen: body 'tool0', by its name" and (arm.lower[1], arm.upper[1]) == (-1, 2)
    np.testing.assert_allclose(
        arm.forward(np.array([np.pi / 2, 1.0])), [0, 0.2 * np.sin(1), 0.4 + 0.2 * np.cos(1)], atol=1e-6
    )
    path.write_text(URDF.format(*links, '<mimic joint="j1" multiplier="2"/>'))
    assert "couples 'j2' by <joint>" in said(lambda: load_arm(path))


def test_a_model_with_nan_is_refused_and_mujoco_writes_no_log(tmp_path: Path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    for name, text in (("r.urdf", URDF.format(LINK.format("l1"), LINK.format("l2"), "")), ("r.xml", robot().to_xml())):
        path = tmp_path / name
        path.write_text(text.replace(" .1", " nan", 1).replace("0.1", "nan", 1))
        assert said(lambda path=path: load_arm(path)) == f"MuJoCo cannot read {path}: a number in it is NaN"
    assert capfd.readouterr().err == "" and {p.name for p in tmp_path.iterdir()} == {"r.urdf", "r.xml"}


# What couples joints

WELD = '<equality><weld body1="tip" body2="car"/></equality>'


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ('<equality><joint name="mimic" joint1="b" joint2="a"/></equality>', "couples 'b' by <joint>"),
        ('<equality><joint joint1="a"/></equality>', "couples 'a' by <joint>"),
        ('<equality><joint joint1="grip" joint2="a"/></equality>', None),
        ('<equality><joint joint1="b" joint2="a" active="false"/></equality>', None),
        ('<equality><connect body1="lower" body2="car" anchor="0 0 0"/></equality>', "couples 'a', 'b' by <connect>"),
        ('<equality><connect body1="finger" body2="tip" anchor="0 0 0"/></equality>', None),
        (WELD, "couples 'a', 'b' by <weld>"),
        (
            '<tendon><fixed name="t"><joint joint="a" coef="1"/><joint joint="grip" coef="1"/></fixed></tendon>'
            '<equality><tendon tendon1="t"/></equality>',
            "couples 'a' by <tendon>",
        ),
    ],
)
def test_couplings_of_the_arms_joints_are_refused(more: str, words: str | None):
    if words is None:
        assert load_arm(robot(more=more), "body tip").dof == 2
    else:
        assert words in said(lambda: load_arm(robot(more=more), "body tip"))


def test_everything_that_is_wrong_with_the_joints_is_said_at_once():
    base = (
        FREE.replace("freejoint", 'joint type="ball"')
        + '<joint name="x" type="slide"/><joint name="y" type="slide" axis="0 1 0"/>'
    )
    text = said(lambda: load_arm(robot(base, more=WELD), "body finger"))
    assert all(words in text for words in ("'root' is neither", "slides 'x', 'y' have", "by <weld>"))


# Actuators


def test_actuators_with_a_state_are_no_position_servos():
    acts = '<intvelocity joint="a" kp="9" actrange="-1 1"/><position joint="b" timeconst=".1"/><velocity joint="grip"/>'
    arm = load_arm(robot(more=f"<actuator>{acts}</actuator>"), "body finger")
    assert arm.actuators.tolist() == [-1, -1, -1]
    assert arm.actuation == ("intvelocity", "position with a filter", "velocity")
    assert load_arm(robot(more='<actuator><motor joint="a"/></actuator>'), "body tip").actuation == ("motor", "none")


def test_two_servos_on_a_joint_are_refused():
    acts = '<actuator><position name="one" joint="a"/><position joint="a"/></actuator>'
    text = said(lambda: load_arm(robot(more=acts), "body tip"))
    assert text == "joint 'a' has 2 actuators that hold positions, 'one' and 'actuator_1': keep one"
    damped = '<actuator><position joint="a"/><velocity joint="a"/></actuator>'
    assert load_arm(robot(more=damped), "body tip").actuation == ("position + velocity", "none")


# Names and units


def test_joints_without_a_name_get_one_that_no_other_has():
    spec = robot('<joint name="joint_1" range="-1 1"/>', more="")
    spec.joint("a").name = ""
    assert load_arm(spec, "body tip").joint_names == ("joint_1", "joint_1_", "b")


def test_a_model_in_millimetres_is_warned_of():
    spec = robot()
    for body in spec.bodies[1:]:
        body.pos = 1e3 * body.pos
    with pytest.warns(UserWarning, match=r"units\? the arm reaches 500 m: MJCF and URDF are in metres"):
        load_arm(spec, "body tip")


# The reach


@given(st.integers(1, 9), st.integers(0, 2**32 - 1), st.booleans())
def test_no_random_pose_is_further_than_the_measured_reach(dof: int, seed: int, slides: bool):
    arm = load_arm(serial_arm(dof, seed, slides))
    q = np.random.default_rng(seed).uniform(arm.lower, arm.upper, (2000, dof))
    # Nor is one at the limits, where the furthest often is.
    q[1000:] = np.where(q[1000:] > arm.home, arm.upper, arm.lower)
    distance = np.linalg.norm(np.asarray(arm.forward(q)) - arm.origin, axis=1).max()
    assert distance <= arm.measured_reach + 1e-5 <= arm.reach + 2e-5


def test_the_measured_reach_is_attained():
    arm = load_arm("arm7.xml")
    assert arm.measured_reach == pytest.approx(0.6)
    folded = robot().copy()
    for joint in ("a", "b"):
        folded.joint(joint).range = [1, 1.5] if joint == "b" else [-1, 1]
    bent = np.hypot(0.3 + 0.2 * np.cos(np.radians(1)), 0.2 * np.sin(np.radians(1)))
    assert load_arm(folded, "body tip").measured_reach == pytest.approx(bent, abs=1e-6)


def test_where_the_base_stands_in_the_world_frame_of_all_goals_is_said():
    xml = ROBOT.format(base="", inside="", more="", options="", tip="tip").replace(
        'pos=".1 .2 .3" quat="1 2 3 4"', "{}"
    )
    for pose, words in (
        (
            'pos="1 .5 .8" euler="0 0 90"',
            "base 'car' stands at (1, 0.5, 0.8) m, turned by 90 degrees, in the world frame, that of",
        ),
        ('pos="0 0 0"', ""),
    ):
        arm = load_arm(mujoco.MjSpec.from_string(xml.format(pose)), "body tip")
        assert words in repr(arm) and bool(words) == ("world frame" in repr(arm))
