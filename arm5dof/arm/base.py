"""A base that is held still: the joints that carry it are taken out of a model."""

from __future__ import annotations

import mujoco

from arm5dof.arm.chain import joint_name, joints_of, path_to
from arm5dof.errors import UserError, nearest_hint


def hold_base(
    spec: mujoco.MjSpec | None, model: mujoco.MjModel, base: str
) -> tuple[mujoco.MjSpec | None, mujoco.MjModel, tuple[str, ...]]:
    """Take out the joints of a body and of those that carry it, which leaves it where the MJCF has it (`qpos0`), with
    all that acts on them or measures them, and keyframes.

    Args:
        spec: What the model was compiled from, if it is at hand; it stays as it is.
        model: The compiled model.
        base: The body's name.

    Returns:
        The two without them, and the joints' names. None are left where that has been done before.

    Raises:
        UserError: There is no such body, the model is only at hand compiled, or something else needs those joints.
    """
    bodies = [model.body(i).name for i in range(model.nbody)]
    if base not in bodies:
        raise UserError(f"the model has no body {base!r} to be the base: {nearest_hint(base, [*filter(None, bodies)])}")
    path = path_to(model, bodies.index(base))
    joints = [int(j) for j in joints_of(model, path)]
    if not joints:
        return spec, model, ()
    if spec is None:
        raise UserError(f"a compiled model cannot be held at {base!r}: load the arm from its MJCF")
    held, named = tuple(joint_name(model, j) for j in joints), {model.joint(j).name for j in joints} - {""}
    spec = spec.copy()
    spec.compiler.fusestatic = False  # It would make the base a part of the world.
    for body in [body for body in spec.bodies if body.id in path]:
        for joint in list(body.joints):
            spec.delete(joint)
    joint_type = mujoco.mjtObj.mjOBJ_JOINT
    on_joint = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    lost = [a for a in spec.actuators if a.trntype in on_joint and a.target in named]
    lost += [s for s in spec.sensors if s.objtype == joint_type and s.objname in named]
    lost += [e for e in spec.equalities if e.type == mujoco.mjtEq.mjEQ_JOINT and {e.name1, e.name2} & named]
    for item in (*lost, *spec.keys):
        spec.delete(item)
    try:
        return spec, spec.compile(), held
    except ValueError as error:
        raise UserError(f"the model cannot be held at {base!r}: {' '.join(str(error).split())}") from None
