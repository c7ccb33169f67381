"""Grippers are found in models, not written down; what is none is refused."""

import mujoco
import numpy as np
import pytest

from arm5dof.arm import load_arm
from arm5dof.errors import UserError
from arm5dof.grasp.gripper import Gripper, least_width
from arm5dof.runtime import files
from arm5dof.vision.objects import CATALOGUE

HAND = """<mujoco><worldbody><body name="hand"><joint name="swivel"/><geom size="0.01"/><site name="grasp"/>{}</body>
</worldbody><actuator>{}</actuator></mujoco>"""
FINGER = """<body pos="0 {y} 0"><joint name="{name}" {joint} axis="0 {axis} 0"/>
<geom type="box" size="0.01 0.002 0.01"/></body>"""
SLIDE = 'type="slide" range="0 0.02"'


def hand(*axes, joint=SLIDE, servoed=2, ys=(0.01, -0.01)):
    """A hand whose fingers' inner faces are 16 mm apart at first."""
    fingers = [FINGER.format(y=y, name=f"finger {i}", joint=joint, axis=a) for i, (y, a) in enumerate(zip(ys, axes))]  # noqa: B905
    servos = [f'<position joint="finger {i}" kp="100"/>' for i in range(min(servoed, len(axes)))]
    return mujoco.MjModel.from_xml_string(
        HAND.format("".join(fingers), "".join(servos)).replace("<mujoco>", '<mujoco><compiler autolimits="true"/>')
    )


def test_the_least_widths_of_objects():
    """By their shapes: a cube's side, a ball's diameter, a brick's short side, a dumbbell's bar."""
    found = {one.name: 1e3 * least_width(one) for one in CATALOGUE}
    known = {"red cube": 25, "blue cube": 25, "ball": 30, "can": 25, "brick": 20, "ring": 40, "dumbbell": 10}
    assert {name: found[name] for name in known} == pytest.approx(known, abs=0.1)
    assert found["cross"] == pytest.approx(2 * 7 * 2**0.5, abs=0.1)  # Across, between its arms.


@pytest.mark.parametrize("name", ["arm5.xml", "arm7_gripper.xml"])
def test_openings_are_distances_between_the_fingers(name):
    model = load_arm(name).mj_model
    gripper, data, points = Gripper.of(model), mujoco.MjData(model), np.zeros(6)
    tips = [model.geom(f"tip_{side}").id for side in ("left", "right")]
    assert sorted(gripper.geoms) == [model.geom(f"{g}_{s}").id for s in ("left", "right") for g in ("finger", "tip")]
    np.testing.assert_allclose(gripper.axis, [0, 1, 0], atol=1e-9)
    for opening in (0.002, 0.03, gripper.limits[1]):
        data.qpos[:] = 0.3
        data.qpos[gripper.qpos] = gripper.fingers(opening)
        mujoco.mj_kinematics(model, data)
        assert mujoco.mj_geomDistance(model, data, *tips, 1.0, points) == pytest.approx(opening, abs=1e-6)
        assert gripper.opening(data.qpos[gripper.qpos]) == pytest.approx(opening)
        np.testing.assert_allclose(gripper.to_ctrl(data.qpos[gripper.qpos]), data.qpos[gripper.qpos])


def test_fingers_may_close_as_their_positions_grow():
    for axes, sign in (((1, -1), 1), ((-1, 1), -1)):
        gripper = Gripper.of(hand(*axes))
        assert gripper.sign == sign
        assert gripper.opening(np.zeros(2)) == pytest.approx(0.016)
        assert gripper.limits == pytest.approx((0.016, 0.056) if sign > 0 else (-0.024, 0.016))
        assert gripper.opening(gripper.fingers(0.02)) == pytest.approx(0.02)


@pytest.mark.parametrize(
    ("model", "words"),
    [
        (lambda: hand(), "carries 0 joints: a gripper has two fingers"),
        (lambda: hand(1), "carries 1 joints"),
        (lambda: hand(1, -1, 1, ys=(0.01, -0.01, 0.03)), "carries 3 joints"),
        (lambda: hand(1, -1, joint='type="slide"'), "each on a slide with a range"),
        (lambda: hand(1, -1, joint='range="0 1"'), "each on a slide with a range"),
        (lambda: hand(1, 1), "do not slide in opposite directions"),
        (lambda: hand(1, -1, servoed=1), "finger 'finger 1' has no position actuator"),
        (lambda: load_arm("arm7.xml").mj_model, "no site 'grasp'"),
    ],
)
def test_what_is_no_gripper_is_refused(model, words):
    with pytest.raises(UserError, match=words):
        Gripper.of(model())


def test_the_arm_with_a_gripper_is_arm7():
    plain, gripping = (load_arm(name) for name in ("arm7.xml", "arm7_gripper.xml"))
    assert plain.joint_names == gripping.joint_names
    for name in ("lower", "upper", "servo"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(gripping, name))
    for link, other in zip(plain.chain, gripping.chain, strict=True):
        np.testing.assert_array_equal(link.rotation, other.rotation)
        np.testing.assert_array_equal(link.offset, other.offset)
    assert "finger" not in files.shipped_file("mjcf", "arm7.xml").read_text()
