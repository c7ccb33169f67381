"""How long an arm's position servos take, in C MuJoCo."""

from __future__ import annotations

import mujoco
import numpy as np

from arm5dof.arm.arm import Arm

MOVES, SHARE, TOLERANCE = 10, 0.8, 0.01


def settle_steps(arm: Arm, most: int = 1500) -> int | None:
    """Physics steps after which the position servos have brought the arm from random poses to others, to within 1 % of
    the largest joint's move. Two of ten moves may fail, since an arm may hit itself.

    Args:
        arm: An arm each of whose joints has a position actuator.
        most: Steps after which a move has failed.

    Returns:
        The number of steps, or None if the servos do not get there.
    """
    model, data = arm.mj_model, mujoco.MjData(arm.mj_model)
    ends = np.random.default_rng(0).uniform(arm.lower, arm.upper, (MOVES, 2, arm.dof))
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)  # Physics that blows up is an answer here, and no file in this folder.
    try:
        steps = sorted(_settled(arm, model, data, start, target, most) for start, target in ends)
    finally:
        mujoco.set_mju_user_warning(before)
    worst = steps[int(SHARE * MOVES) - 1]
    return worst if worst <= most else None


def _settled(
    arm: Arm, model: mujoco.MjModel, data: mujoco.MjData, start: np.ndarray, target: np.ndarray, most: int
) -> int:
    """Steps after which one move stays within the tolerance, `most` + 1 if it does not."""
    mujoco.mj_resetData(model, data)
    data.qpos[arm.qpos] = start
    data.ctrl[arm.actuators] = arm.servo[:, 0] * target + arm.servo[:, 1]
    left = np.empty(most)
    for step in range(most):
        mujoco.mj_step(model, data)
        left[step] = np.abs(data.qpos[arm.qpos] - target).max()
        if step % 100 == 99 and left[step - 99 : step + 1].max() < TOLERANCE * np.abs(target - start).max() / 2:
            left[step:] = 0  # At rest.
            break
    late = np.flatnonzero(~(left < TOLERANCE * np.abs(target - start).max()))
    return int(late[-1]) + 2 if len(late) else 1
