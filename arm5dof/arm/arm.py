"""`Arm`: any serial arm in MJCF, whatever its number of joints.

The arm's joints are those on the way from the world to the body that carries the end-effector site. Whatever else the
model holds (a gripper, a table, free objects) is left alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from arm5dof.errors import UserError
from arm5dof.runtime import files

if TYPE_CHECKING:
    from mujoco import mjx

HINGE, SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)


class Link(NamedTuple):
    """A constant transform, then a joint that turns about or slides along z."""

    slides: bool
    rotation: np.ndarray
    offset: np.ndarray


@dataclass(frozen=True, eq=False)
class Arm:
    """A serial arm. Angles in radians (slides in metres), positions in metres in the world frame.

    Joint vectors `q` have shape (dof,), in order from base to tip; batches are made with `jax.vmap`.
    """

    mj_model: mujoco.MjModel
    joints: np.ndarray
    """Joint ids, (dof,)."""
    qpos: np.ndarray
    """Where the joints stand in `qpos`, (dof,)."""
    dofs: np.ndarray
    """Where they stand in `qvel`, (dof,)."""
    actuators: np.ndarray
    """Ids of the joints' position actuators, (dof,); -1 where a joint has none."""
    servo: np.ndarray
    """Slope and offset of the control that holds a joint in a position, (dof, 2): gears and gains are not all 1."""
    site: int
    """Id of the end-effector site."""
    lower: np.ndarray
    upper: np.ndarray
    """Joint limits, (dof,), narrowed to what the position actuators can be told."""
    chain: tuple[Link, ...]
    """What stands between the joints, (dof + 1,): the last leads from the last joint to the site."""
    reach: float
    """An upper bound on the distance between the first joint and the end effector, metres."""

    @cached_property
    def mjx_model(self) -> mjx.Model:
        """The model as MJX has it. Raises `UserError` if it has something that MJX cannot simulate."""
        from arm5dof.runtime.mjx import mjx  # Half a second to import, and nothing but servo dynamics needs it.

        try:
            with jax.ensure_compile_time_eval():  # It may be wanted first while a program is traced.
                return mjx.put_model(self.mj_model)
        except NotImplementedError as error:
            raise UserError(f"MJX cannot simulate this model ({error}): change it, or use kinematic dynamics") from None

    @property
    def dof(self) -> int:
        """Number of joints."""
        return len(self.joints)

    @property
    def home(self) -> np.ndarray:
        """The middle of every joint's range, (dof,)."""
        return (self.lower + self.upper) / 2

    @property
    def origin(self) -> np.ndarray:
        """The first joint's anchor in the world frame, (3,)."""
        data = mujoco.MjData(self.mj_model)
        mujoco.mj_kinematics(self.mj_model, data)
        return data.xanchor[self.joints[0]].copy()

    def forward(self, q: jax.Array) -> jax.Array:
        """Position of the end-effector site, (..., 3), at joint positions `q` (..., dof). Differentiable."""
        return self._carry(self._motions(q), self.dof)

    def joint_positions(self, q: jax.Array) -> jax.Array:
        """Where the joints are, (..., dof, 3), at joint positions `q` (..., dof); a slide's joint is where it slides
        from."""
        motions = self._motions(q)
        return jnp.stack([self._carry(motions, k) for k in range(self.dof)], axis=-2)

    def _motions(self, q: jax.Array) -> list[list[jax.Array]]:
        """Positions (...) of the joints one by one, their cosines and their sines."""
        # The gradient of a split is one concatenation, that of indexing a sum of padded arrays.
        split = lambda x: [v[..., 0] for v in jax.lax.split(x, (1,) * self.dof, axis=x.ndim - 1)]
        return [split(x) for x in (q, *_cos_sin(q))]

    def _carry(self, motions: list[list[jax.Array]], joints: int) -> jax.Array:
        """The point behind the first so many joints, (..., 3).

        The same function of the same MJCF as `mjx.kinematics`, carried out on one point alone, from tip to base and
        component by component: the critic calls it in every update, where carrying every body along is wasted, and
        `mjx.kinematics` takes seconds to compile.
        """
        values, cosines, sines = motions
        x, y, z = (jnp.full_like(values[0], c) for c in self.chain[joints].offset)
        for k in reversed(range(joints)):
            link = self.chain[k]
            if link.slides:
                z = z + values[k]
            else:
                c, s = cosines[k], sines[k]
                x, y = c * x - s * y, s * x + c * y
            point = (x, y, z)
            x, y, z = (_row(*constants, point) for constants in zip(link.rotation, link.offset, strict=True))
        return jnp.stack([x, y, z], axis=-1)

    def to_joints(self, action: jax.Array) -> jax.Array:
        """Map actions in [-1, 1] to joint positions inside the limits; (..., dof) to (..., dof)."""
        return self.home + action * (self.upper - self.lower) / 2

    def to_ctrl(self, q: jax.Array) -> jax.Array:
        """What to tell the position actuators so that the joints come to rest at `q`; (..., dof) to (..., dof)."""
        return self.servo[:, 0] * q + self.servo[:, 1]

    def to_action(self, q: jax.Array) -> jax.Array:
        """The inverse of `to_joints`."""
        return (q - self.home) * 2 / (self.upper - self.lower)

    def sample(self, key: jax.Array, shape: tuple[int, ...] = ()) -> jax.Array:
        """Joint positions drawn uniformly inside the limits, shape + (dof,), float32."""
        return self.to_joints(jax.random.uniform(key, (*shape, self.dof), minval=-1.0, maxval=1.0))


@jax.custom_jvp
def _cos_sin(q: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Computed once, and kept for the gradient: XLA would do it again for every term that they appear in."""
    return jax.lax.optimization_barrier((jnp.cos(q), jnp.sin(q)))


@_cos_sin.defjvp
def _cos_sin_jvp(
    primals: tuple[jax.Array], tangents: tuple[jax.Array]
) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
    cosine, sine = _cos_sin(*primals)
    return (cosine, sine), (-sine * tangents[0], cosine * tangents[0])


def load_arm(source: str | Path | mujoco.MjSpec, site: str = "ee") -> Arm:
    """Load an arm from an MJCF file (the user's, or one that ships in `mjcf/`) or from an `MjSpec`.

    Raises `UserError` if the file is missing or broken, the site does not exist, or the joints between the world and
    the site are not a chain of limited hinges and slides.
    """
    model = _compile(source)
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

    actuators = np.array([_position_actuator(model, j) for j in ids])
    servo = np.array([_servo(model, a) for a in actuators])
    lower, upper = _limits(model, ids, actuators, servo)
    chain = _chain(model, path, site_id)
    slides = ids[model.jnt_type[ids] == SLIDE]
    zero = model.qpos0[model.jnt_qposadr[slides]]
    travel = np.abs(model.jnt_range[slides] - zero[:, None]).max(-1, initial=0) + np.abs(zero)
    return Arm(
        mj_model=model,
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
    return (*links, Link(False, np.eye(3), _clean(offset)))


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


def _row(rotation: np.ndarray, offset: float, point: tuple[jax.Array, ...]) -> jax.Array:
    """One component of a transformed point; terms that are zero for this arm are left out of the program."""
    terms = [float(r) * p for r, p in zip(rotation, point, strict=True) if r]
    return sum(terms[1:], start=terms[0] + float(offset))


def _position_actuator(model: mujoco.MjModel, joint: int) -> int:
    """Id of the actuator that servoes a joint's position, or -1."""
    for a in range(model.nu):
        on_joint = model.actuator_trntype[a] == int(mujoco.mjtTrn.mjTRN_JOINT) and model.actuator_trnid[a, 0] == joint
        # A velocity servo has an affine bias too, but none that grows with position.
        affine = model.actuator_biastype[a] == int(mujoco.mjtBias.mjBIAS_AFFINE)
        if on_joint and affine and model.actuator_biasprm[a, 1] and model.actuator_gainprm[a, 0]:
            return a
    return -1


def _servo(model: mujoco.MjModel, actuator: int) -> tuple[float, float]:
    """Slope and offset of the control at which gain * control + bias_0 + bias_1 * gear * q vanishes."""
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


def _compile(source: str | Path | mujoco.MjSpec) -> mujoco.MjModel:
    if isinstance(source, mujoco.MjSpec):
        try:
            return source.compile()
        except ValueError as error:
            raise UserError(f"MuJoCo cannot compile the model: {' '.join(str(error).split())}") from None
    path = files.find("mjcf", source)
    if path is None:
        known = ", ".join(files.shipped("mjcf", ".xml"))
        raise UserError(f"no MJCF file {str(source)!r}: give a path, or one of those shipped: {known}")
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise UserError(f"MuJoCo cannot read {path}: {error}") from None
