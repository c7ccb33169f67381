"""What drives a joint, and what a position servo must be told."""

from __future__ import annotations

import mujoco

from arm5dof.arm.chain import joint_name
from arm5dof.errors import UserError

ON_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
AFFINE, FIXED = int(mujoco.mjtBias.mjBIAS_AFFINE), int(mujoco.mjtGain.mjGAIN_FIXED)
STATELESS, INTEGRATOR = int(mujoco.mjtDyn.mjDYN_NONE), int(mujoco.mjtDyn.mjDYN_INTEGRATOR)


def position_actuator(model: mujoco.MjModel, joint: int) -> int:
    """Id of the actuator that servoes a joint's position, or -1.

    Raises `UserError` if two pull it towards positions of their own: no control says where it comes to rest.
    """
    pulling = [a for a in _on(model, joint) if _pulls(model, a)]
    if len(pulling) > 1:
        names = " and ".join(repr(model.actuator(a).name or f"actuator_{a}") for a in pulling)
        raise UserError(
            f"joint {joint_name(model, joint)!r} has {len(pulling)} actuators that hold positions, {names}: keep one"
        )
    # One with an internal state (intvelocity, a filter) does not go where its control says, but where its state is.
    return pulling[0] if pulling and model.actuator_dyntype[pulling[0]] == STATELESS else -1


def servo_line(model: mujoco.MjModel, actuator: int) -> tuple[float, float]:
    """Slope and offset of the control that holds a position actuator's joint at q: there gain * control + bias_0 +
    bias_1 * gear * q vanishes."""
    if actuator < 0:
        return 1.0, 0.0
    gain, bias = model.actuator_gainprm[actuator, 0], model.actuator_biasprm[actuator]
    return -bias[1] * model.actuator_gear[actuator, 0] / gain, -bias[0] / gain


def actuation(model: mujoco.MjModel, joint: int) -> str:
    """What drives a joint, in MJCF's words: `position`, `velocity`, `motor`, ..., `none`."""
    return " + ".join(_kind(model, a) for a in _on(model, joint)) or "none"


def _on(model: mujoco.MjModel, joint: int) -> list[int]:
    return [a for a in range(model.nu) if model.actuator_trntype[a] in ON_JOINT and model.actuator_trnid[a, 0] == joint]


def _pulls(model: mujoco.MjModel, a: int) -> bool:
    """Whether its force grows with the joint's distance from a position. A velocity servo has an affine bias too, but
    none that grows with position."""
    affine = model.actuator_biastype[a] == AFFINE and model.actuator_gaintype[a] == FIXED
    return bool(affine and model.actuator_biasprm[a, 1] and model.actuator_gainprm[a, 0])


def _kind(model: mujoco.MjModel, a: int) -> str:
    state = model.actuator_dyntype[a]
    if _pulls(model, a):
        return "position" if state == STATELESS else "intvelocity" if state == INTEGRATOR else "position with a filter"
    if state == STATELESS and model.actuator_gaintype[a] == FIXED:
        if model.actuator_biastype[a] == AFFINE and model.actuator_biasprm[a, 2]:
            return "velocity"
        return "motor"
    return "general"
