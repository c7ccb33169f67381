"""An MJCF read as an arm: which joints it has, what stands between them, and what servos them.

The arm's joints are those on the way from the world to the body that carries the end-effector site. Whatever else the
model holds (a gripper, a table, free objects) is left alone.
"""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from arm5dof.arm.arm import Arm, Link
from arm5dof.errors import UserError
from arm5dof.runtime import files

HINGE, SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)


def load_arm(source: str | Path | mujoco.MjSpec | mujoco.MjModel, site: str = "ee") -> Arm:
    """Load an arm.

    Args:
        source: An MJCF file (the user's, or one that ships in `mjcf/`), an `MjSpec`, or a compiled `MjModel`.
        site: Name of the site that is the end effector.

    Raises:
        UserError: The file is missing or broken, the site does not exist, or the joints between the world and the
            site are not a chain of limited hinges and slides.

    >>> from arm5dof import load_arm
    >>> load_arm("arm7.xml").dof
    7
    >>> load_arm("arm7.xml", site="flange")
    Traceback (most recent call last):
    arm5dof.errors.UserError: the model has no site 'flange' to use as end effector; it has: ee
    """
    spec, model = _compile(source)
    names = [model.site(i).name for i in range(model.nsite)]
    if site not in names:
        raise UserError(f"the model has no site {site!r} to use as end effector; it has: {', '.join(names) or 'none'}")
    site_id = names.index(site)

    path: list[int] = []
    body = model.site_bodyid[site_id]
    while body:
        path.insert(0, body)
        body = model.body_parentid[body]
    ids = np.array([j for b in path for j in range(model.body_jntadr[b], model.body_jntadr[b] + model.body_jntnum[b])])
    if not len(ids):
        raise UserError(f"no joint moves the site {site!r}: it hangs on the world")
    for j in ids:
        name = model.joint(j).name
        if model.jnt_type[j] not in (HINGE, SLIDE):
            raise UserError(f"joint {name!r} is neither a hinge nor a slide: only serial arms of those can be trained")
        if not model.jnt_limited[j]:
            raise UserError(f'joint {name!r} has no limits: give it range="LOWER UPPER" in the MJCF')

    actuators = np.array([position_actuator(model, j) for j in ids])
    servo = np.array([servo_line(model, a) for a in actuators])
    lower, upper = _limits(model, ids, actuators, servo)
    chain = _chain(model, path, site_id)
    slides = ids[model.jnt_type[ids] == SLIDE]
    zero = model.qpos0[model.jnt_qposadr[slides]]
    travel = np.abs(model.jnt_range[slides] - zero[:, None]).max(-1, initial=0) + np.abs(zero)
    return Arm(
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
        chain=chain,
        reach=float(sum(np.linalg.norm(link.offset) for link in chain[1:]) + travel.sum()),
    )


def _chain(model: mujoco.MjModel, path: list[int], site: int) -> tuple[Link, ...]:
    """Everything between one joint's frame and the next, folded into one constant transform each. A joint's frame
    has its origin in the anchor and its z axis along the joint's axis."""
    links: list[Link] = []
    rotation, offset = np.eye(3), np.zeros(3)

    def move(by_rotation: np.ndarray, by_offset: np.ndarray) -> None:
        nonlocal rotation, offset
        rotation, offset = rotation @ by_rotation, offset + rotation @ by_offset

    for body in path:
        move(np.eye(3), model.body_pos[body])
        move(_matrix(model.body_quat[body]), np.zeros(3))
        first = model.body_jntadr[body]
        for j in range(first, first + model.body_jntnum[body]):
            slides = bool(model.jnt_type[j] == SLIDE)
            align, anchor = _z_towards(model.jnt_axis[j]), model.jnt_pos[j]
            zero = model.qpos0[model.jnt_qposadr[j]]
            move(align, anchor)
            links.append(Link(slides, _clean(rotation), _clean(offset)))
            rotation, offset = np.eye(3), np.zeros(3)
            move(np.eye(3), np.array([0, 0, -zero])) if slides else move(_about_z(-zero), np.zeros(3))
            move(align.T, -align.T @ anchor)
    move(np.eye(3), model.site_pos[site])
    move(_matrix(model.site_quat[site]), np.zeros(3))
    return (*links, Link(False, _clean(rotation), _clean(offset)))


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def _about_z(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def _z_towards(axis: np.ndarray) -> np.ndarray:
    """A rotation that takes the z axis to `axis`, a unit vector."""
    quaternion = np.empty(4)
    mujoco.mju_quatZ2Vec(quaternion, axis)
    return _matrix(quaternion)


def _clean(constants: np.ndarray) -> np.ndarray:
    """Constants with rounding errors about 0 and +-1 removed, so that the terms vanish from the program."""
    nearest = np.round(constants)
    return np.where(np.abs(constants - nearest) < 1e-14, nearest, constants)


def position_actuator(model: mujoco.MjModel, joint: int) -> int:
    """Id of the actuator that servoes a joint's position, or -1."""
    for a in range(model.nu):
        on_joint = model.actuator_trntype[a] == int(mujoco.mjtTrn.mjTRN_JOINT) and model.actuator_trnid[a, 0] == joint
        # A velocity servo has an affine bias too, but none that grows with position.
        affine = model.actuator_biastype[a] == int(mujoco.mjtBias.mjBIAS_AFFINE)
        if on_joint and affine and model.actuator_biasprm[a, 1] and model.actuator_gainprm[a, 0]:
            return a
    return -1


def servo_line(model: mujoco.MjModel, actuator: int) -> tuple[float, float]:
    """Slope and offset of the control that holds a position actuator's joint at q: there gain * control + bias_0 +
    bias_1 * gear * q vanishes."""
    if actuator < 0:
        return 1.0, 0.0
    gain, bias = model.actuator_gainprm[actuator, 0], model.actuator_biasprm[actuator]
    return -bias[1] * model.actuator_gear[actuator, 0] / gain, -bias[0] / gain


def _limits(
    model: mujoco.MjModel, ids: np.ndarray, actuators: np.ndarray, servo: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The joints' ranges where their actuators' control ranges allow them. Raises `UserError` if nothing is left."""
    lower, upper = model.jnt_range[ids].T.copy()
    for k, a in enumerate(actuators):
        if a >= 0 and model.actuator_ctrllimited[a]:
            told = np.sort((model.actuator_ctrlrange[a] - servo[k, 1]) / servo[k, 0])
            lower[k], upper[k] = max(lower[k], told[0]), min(upper[k], told[1])
        if not lower[k] < upper[k]:
            name = model.joint(ids[k]).name
            raise UserError(f"joint {name!r} cannot move: its range and its actuator's ctrlrange leave nothing")
    return lower, upper


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
        spec = mujoco.MjSpec.from_file(str(path))
        return spec, spec.compile()
    except ValueError as error:
        raise UserError(f"MuJoCo cannot read {path}: {error}") from None
