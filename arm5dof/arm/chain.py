"""What stands between the joints of an MJCF's chain, and what the joints are called."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

HINGE, SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)


class Link(NamedTuple):
    """A constant transform, then a joint that turns about or slides along z."""

    slides: bool
    rotation: np.ndarray
    offset: np.ndarray


def path_to(model: mujoco.MjModel, body: int) -> list[int]:
    """Ids of the bodies from the world, which is left out, to one of them."""
    path: list[int] = []
    while body:
        path.insert(0, body)
        body = int(model.body_parentid[body])
    return path


def joints_of(model: mujoco.MjModel, bodies: list[int]) -> np.ndarray:
    """Ids of the joints of some bodies, in order."""
    return np.array(
        [j for b in bodies for j in range(model.body_jntadr[b], model.body_jntadr[b] + model.body_jntnum[b])]
    )


def joint_name(model: mujoco.MjModel, joint: int) -> str:
    """Its name; `joint_<id>` where the MJCF gives none, which no other joint is called."""
    if name := model.joint(joint).name:
        return str(name)
    name, others = f"joint_{joint}", {model.joint(j).name for j in range(model.njnt)}
    while name in others:
        name += "_"
    return name


def fold(model: mujoco.MjModel, path: list[int], site: int) -> tuple[Link, ...]:
    """Everything between one joint's frame and the next, folded into one constant transform each. A joint's frame
    has its origin in the anchor and its z axis along the joint's axis."""
    links: list[Link] = []
    rotation, offset = np.eye(3), np.zeros(3)

    def move(by_rotation: np.ndarray, by_offset: np.ndarray) -> None:
        nonlocal rotation, offset
        rotation, offset = rotation @ by_rotation, offset + rotation @ by_offset

    for body in path:
        move(np.eye(3), model.body_pos[body])
        move(matrix(model.body_quat[body]), np.zeros(3))
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
    move(matrix(model.site_quat[site]), np.zeros(3))
    return (*links, Link(False, _clean(rotation), _clean(offset)))


def matrix(quaternion: np.ndarray) -> np.ndarray:
    """The rotation matrix (3, 3) of a unit quaternion (4,), w first."""
    nine = np.empty(9)
    mujoco.mju_quat2Mat(nine, quaternion)
    return nine.reshape(3, 3)


def _about_z(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def _z_towards(axis: np.ndarray) -> np.ndarray:
    """A rotation that takes the z axis to `axis`, a unit vector."""
    quaternion = np.empty(4)
    mujoco.mju_quatZ2Vec(quaternion, axis)
    return matrix(quaternion)


def _clean(constants: np.ndarray) -> np.ndarray:
    """Constants with rounding errors about 0 and +-1 removed, so that the terms vanish from the program."""
    nearest = np.round(constants)
    return np.where(np.abs(constants - nearest) < 1e-14, nearest, constants)
