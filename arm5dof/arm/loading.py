"""An MJCF read as an arm: which joints it has, what stands between them, and what servos them.

The arm's joints are those on the way from the world, or from a base that is held, to the end effector. Whatever else
the model holds (a gripper, other arms, a table, free objects) is left alone.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import mujoco
import numpy as np

from arm5dof.arm.actuators import position_actuator, servo_line
from arm5dof.arm.arm import Arm
from arm5dof.arm.base import hold_base
from arm5dof.arm.chain import HINGE, SLIDE, fold, joint_name, joints_of, path_to
from arm5dof.arm.end_effector import find_end_effector
from arm5dof.arm.refusals import couplings, unfit_joints
from arm5dof.arm.workspace import moves
from arm5dof.errors import UserError
from arm5dof.runtime import files, models

FAR = 20.0
"""Metres from which an arm's reach speaks for a model in millimetres."""


def load_arm(source: str | Path | mujoco.MjSpec | mujoco.MjModel, site: str = "", base: str = "") -> Arm:
    """Load an arm.

    Args:
        source: An MJCF or URDF file (the user's, or one that ships in `mjcf/`), an `MjSpec`, or a compiled `MjModel`.
        site: The end effector: a site's name; a body's or a geom's, with or without an offset `X Y Z` in its frame,
            metres (`hand 0 0 0.1`, `body hand`); or nothing: the site `ee`, else what is named most like a tool, else
            the last link. The model gets a site for what is none, unless it comes compiled.
        base: A body that is held still, with all that carries it, where the MJCF has it: of an arm on a mobile or
            free base. Nothing: the arm begins at the world.

    Warns:
        UserWarning: It reaches so far that its model is probably in millimetres.

    Raises:
        UserError: The file is missing or broken, there is no such end effector or base, or the joints between base
            and end effector are not independent hinges and limited slides that move it.

    >>> from arm5dof import load_arm
    >>> load_arm("arm7.xml").dof
    7
    >>> round(load_arm("arm7.xml", site="body wrist 0 0 0.1").measured_reach, 6)
    0.59
    >>> load_arm("arm7.xml", site="eef")
    Traceback (most recent call last):
    arm5dof.errors.UserError: the model has no site, body or geom 'eef' to use as end effector: did you mean 'ee'?
    """
    spec, model = _compile(source)
    spec, model, held = hold_base(spec, model, base) if base else (spec, model, ())
    spec, model, site_id, why = find_end_effector(spec, model, site)
    name = model.site(site_id).name
    path = path_to(model, int(model.site_bodyid[site_id]))
    if base and model.body(base).id not in path:
        raise UserError(
            f"the base {base!r} does not carry the end effector {name!r}: name a body between it and the world"
        )
    ids = joints_of(model, path)
    if not len(ids):
        raise UserError(f"no joint moves the site {name!r}: it hangs on {'the base' if held else 'the world'}")
    if found := [*unfit_joints(model, ids), *couplings(model, ids)]:
        raise UserError("; ".join(found))

    actuators = np.array([position_actuator(model, j) for j in ids])
    servo = np.array([servo_line(model, a) for a in actuators])
    lower, upper, stops, turns = _limits(model, ids, actuators, servo)
    chain = fold(model, path, site_id)
    if not moves(chain, lower, upper):
        raise UserError(
            f"no joint moves the site {name!r} away from where it is: choose an end effector beyond the joints"
        )
    slides = ids[model.jnt_type[ids] == SLIDE]
    zero = model.qpos0[model.jnt_qposadr[slides]]
    travel = np.abs(model.jnt_range[slides] - zero[:, None]).max(-1, initial=0) + np.abs(zero)
    arm = Arm(
        mj_model=model,
        mj_spec=spec,
        joints=ids,
        qpos=model.jnt_qposadr[ids],
        dofs=model.jnt_dofadr[ids],
        actuators=actuators,
        servo=servo,
        site=site_id,
        lower=lower,
        upper=upper,
        stops=stops,
        turns=turns,
        chain=chain,
        reach=float(sum(np.linalg.norm(link.offset) for link in chain[1:]) + travel.sum()),
        why_site=why,
        held=held,
    )
    if arm.reach > FAR and arm.measured_reach > FAR:
        warnings.warn(f"units? the arm reaches {arm.measured_reach:.0f} m: MJCF and URDF are in metres", stacklevel=2)
    return arm


def _limits(
    model: mujoco.MjModel, ids: np.ndarray, actuators: np.ndarray, servo: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[bool, ...]]:
    """Of each joint the least and the most that is asked for, its stops, and whether it can make more than a turn:
    then the turn is asked for that is next to -pi to pi. Raises `UserError` if an actuator can be told nothing."""
    stops = np.where(model.jnt_limited[ids, None].astype(bool), model.jnt_range[ids], [-np.inf, np.inf])
    for k, a in enumerate(actuators):
        if a >= 0 and model.actuator_ctrllimited[a]:
            told = np.sort((model.actuator_ctrlrange[a] - servo[k, 1]) / servo[k, 0])
            stops[k] = max(stops[k, 0], told[0]), min(stops[k, 1], told[1])
        if not stops[k, 0] < stops[k, 1]:
            name = joint_name(model, ids[k])
            raise UserError(f"joint {name!r} cannot move: its range and its actuator's ctrlrange leave nothing")
    lower, upper = stops.T.copy()
    turns = (model.jnt_type[ids] == HINGE) & (upper - lower > 2 * np.pi + 1e-6)
    shift = np.where(upper < np.pi, upper - np.pi, np.where(lower > -np.pi, lower + np.pi, 0.0))
    lower, upper = np.where(turns, shift - np.pi, lower), np.where(turns, shift + np.pi, upper)
    return lower, upper, stops, tuple(turns.tolist())


def _compile(source: str | Path | mujoco.MjSpec | mujoco.MjModel) -> tuple[mujoco.MjSpec | None, mujoco.MjModel]:
    if isinstance(source, mujoco.MjModel):
        return None, source
    if isinstance(source, mujoco.MjSpec):
        try:
            return source, source.compile()
        except ValueError as error:
            raise UserError(f"MuJoCo cannot compile the model: {' '.join(str(error).split())}") from None
    path = files.find("mjcf", source)
    if path is None:
        names = ", ".join(files.shipped("mjcf", ".xml"))
        raise UserError(f"no MJCF file {str(source)!r}: give a path, or one of those shipped: {names}")
    try:
        with models.reading():
            spec = mujoco.MjSpec.from_file(str(path))
            if path.suffix.lower() == ".urdf":  # Links without a joint of their own are the frames that people name.
                spec.compiler.fusestatic = False
            return spec, spec.compile()
    except ValueError as error:
        raise UserError(f"MuJoCo cannot read {path}: {' '.join(str(error).split())}") from None
