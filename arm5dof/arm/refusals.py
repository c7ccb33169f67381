"""What an arm's joints cannot be: what is refused, and how it can be mended."""

from __future__ import annotations

from collections.abc import Iterable

import mujoco
import numpy as np

from arm5dof.arm.chain import HINGE, SLIDE, joint_name, joints_of, path_to

JOINT, TENDON = int(mujoco.mjtEq.mjEQ_JOINT), int(mujoco.mjtEq.mjEQ_TENDON)
LOOPS = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))
WRAPS_JOINT, SITE = int(mujoco.mjtWrap.mjWRAP_JOINT), int(mujoco.mjtObj.mjOBJ_SITE)


def unfit_joints(model: mujoco.MjModel, joints: np.ndarray) -> list[str]:
    """What is said of the chain's joints that no arm can have, all of them."""
    other = [j for j in joints if model.jnt_type[j] not in (HINGE, SLIDE)]
    endless = [j for j in joints if model.jnt_type[j] == SLIDE and not model.jnt_limited[j]]
    found = []
    carrier = lambda some: model.body(model.jnt_bodyid[some[-1]]).name
    hold = lambda some: f'hold what carries the arm still, base = "{carrier(some)}"' if carrier(some) else ""
    if other:
        what = (
            "joint {} is neither a hinge nor a slide" if len(other) == 1 else "joints {} are neither hinges nor slides"
        )
        found.append(f"{what.format(_quoted(model, other))}: {hold(other) or 'name its body, to hold it as base'}")
    if endless:
        what = "slide {} has no limits" if len(endless) == 1 else "slides {} have no limits"
        remedies = filter(None, ('give range="LOWER UPPER" in the MJCF', hold(endless)))
        found.append(f"{what.format(_quoted(model, endless))}: {', or '.join(remedies)}")
    return found


def couplings(model: mujoco.MjModel, joints: np.ndarray) -> list[str]:
    """What is said of the equalities that keep the chain's joints from being independent, all of them."""
    tied: dict[str, set[int]] = {}
    for e in range(model.neq):
        if model.eq_active0[e] and (of_arm := _tied(model, e) & {int(j) for j in joints}):
            kind = str(mujoco.mjtEq(model.eq_type[e]).name).removeprefix("mjEQ_").lower()
            tied.setdefault(kind, set()).update(of_arm)
    return [
        f"<equality> couples {_quoted(model, sorted(some))} by <{kind}>; an arm moves its joints freely: take it out "
        "if the robot is not so, else choose an end effector in front of it"
        for kind, some in tied.items()
    ]


def _tied(model: mujoco.MjModel, e: int) -> set[int]:
    """Ids of the joints that an equality keeps from moving freely."""
    first, second = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
    if model.eq_type[e] == JOINT:
        return {first}  # It follows the second, which moves freely.
    if model.eq_type[e] in LOOPS:
        on_sites = model.eq_objtype[e] == SITE
        ends = [int(model.site_bodyid[i]) if on_sites else i for i in (first, second)]
        one, two = ({int(j) for j in joints_of(model, path_to(model, body))} for body in ends)
        return one ^ two
    if model.eq_type[e] == TENDON:
        tendons = [t for t in (first, second) if t >= 0]
        wraps = [w for t in tendons for w in range(model.tendon_adr[t], model.tendon_adr[t] + model.tendon_num[t])]
        return {int(model.wrap_objid[w]) for w in wraps if model.wrap_type[w] == WRAPS_JOINT}
    return set()


def _quoted(model: mujoco.MjModel, joints: Iterable[int]) -> str:
    return ", ".join(repr(joint_name(model, j)) for j in joints)
