"""`arm5dof arm`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from arm5dof.cli.parser import nothing_left
from arm5dof.errors import UserError

if TYPE_CHECKING:
    from arm5dof.arm import Arm

HELP = """\
Tell how a robot's MJCF or URDF is read as an arm: the first thing to run on a new one.

  arm5dof arm my_robot.xml                              joints, end effector, reach, and what may be trained
  arm5dof arm my_robot.xml --site tool0                 another end effector: a site,
  arm5dof arm my_robot.xml --tool "hand 0 0 0.1"        or a place on a body or geom, metres in its frame
  arm5dof arm rover.xml --base chassis                  an arm on a mobile or free base, which is held still
  arm5dof arm my_robot.xml --figure arm.png             a picture, with the end effector's axes: x red, y green, z blue

Joints are those on the way from the world or the base to the end effector; whatever else moves is left alone. A hinge
without limits is trained over one turn. What cannot be an arm is refused with all that is wrong with it.
The same --site, --tool and --base go to arm5dof train --arm my_robot.xml.
"""


def declare(commands: argparse._SubParsersAction) -> None:
    """Add `arm` to the commands."""
    p = commands.add_parser("arm", help="tell how a robot is read, before it is trained", description=HELP)
    p.add_argument("file", metavar="FILE", help="an MJCF or URDF file, or the name of an MJCF that ships")
    p.add_argument(
        "--site", "--tool", default="", help="the end effector; default: the site ee, else what is named like a tool"
    )
    p.add_argument("--base", default="", metavar="BODY", help="hold this body still, with all that carries it")
    p.add_argument("--json", action="store_true", help="print one JSON object, in radians and metres")
    p.add_argument("--figure", type=Path, metavar="OUT.png", help="draw it, its joints in the middle of their ranges")
    p.set_defaults(run=run)


def run(args: argparse.Namespace, rest: list[str]) -> None:
    """`arm5dof arm`."""
    nothing_left(rest, "arm")
    if args.figure is not None:
        from arm5dof.cli.vision.options import writable

        writable(args.figure, (".png",))
    from arm5dof.arm import load_arm
    from arm5dof.runtime import files

    arm = load_arm(args.file, args.site, args.base)
    if not args.json:
        print(arm.table().text(), flush=True)  # MJX takes its time with a robot that has many contacts.
    dynamics = {name: _try(args, name) for name in ("kinematic", "servo")}
    if dynamics["servo"]["works"]:
        dynamics["servo"].update(_settling(arm))
    if args.json:
        print(files.to_json(_as_json(arm, dynamics)))
    else:
        print(f"kinematic dynamics: {'yes' if dynamics['kinematic']['works'] else dynamics['kinematic']['reason']}")
        print(f"servo dynamics: {_servos(dynamics['servo'])}")
    if args.figure is not None:
        _draw(arm, args.figure)


def _try(args: argparse.Namespace, dynamics: str) -> dict[str, Any]:
    """Whether a training would take the robot, else why not, and the physics steps in a control step."""
    from arm5dof.training.config import load_config, make_env

    config = load_config("reach.toml", arm=args.file, site=args.site, base=args.base, dynamics=dynamics)
    try:
        make_env(config).check()
    except UserError as error:
        return {"works": False, "reason": str(error)}
    return {"works": True, "reason": None, "substeps": config.env.substeps}


def _settling(arm: Arm) -> dict[str, Any]:
    """How long the servos take, and for which joints they are computed."""
    from arm5dof.arm.computed_servos import with_servos
    from arm5dof.arm.servos import Servos

    servos = Servos(with_servos(arm))
    computed = [name for name, a in zip(arm.joint_names, arm.actuators, strict=True) if a < 0]
    return {
        "settle_steps": servos.settle_steps,
        "rest_seconds": servos.rest_seconds,
        "computed": computed,
    }


def _servos(servo: dict[str, Any]) -> str:
    """Whether they can be trained, and whether an action gets where it asks for."""
    if not servo["works"]:
        return f"no, {servo['reason']}"
    computed = f" computed for {', '.join(servo['computed'])}" if servo["computed"] else ""
    steps, seconds = servo["settle_steps"], servo["rest_seconds"]
    if steps is not None and steps <= servo["substeps"]:
        return f"yes, the servos{computed} settle in {steps} physics steps, which MJX simulates at every transition"
    if seconds is None:
        return f"yes, but the servos{computed} do not bring the arm to rest: give them damping, or stiffen them"
    return (
        f"yes, the servos{computed} bring the arm to rest {seconds:.2f} s after a move, too long to be simulated at "
        "every transition: C MuJoCo measures what was learnt without"
    )


def _as_json(arm: Arm, dynamics: dict[str, dict[str, Any]]) -> dict[str, Any]:
    import numpy as np

    base, position, rotation = arm.base
    columns = (arm.joint_names, arm.slides, np.isinf(arm.stops).any(-1), arm.lower, arm.upper, arm.actuation)
    return {
        "end_effector": arm.mj_model.site(arm.site).name,
        "chosen": arm.why_site or None,
        "base": {"body": base, "position_m": position.tolist(), "rotation": rotation.tolist()},
        "held": list(arm.held),
        "origin_m": arm.origin.tolist(),
        "reach_m": arm.measured_reach,
        "joints": [
            {
                "name": name,
                "kind": "slide" if slides else "continuous" if endless else "hinge",
                "unit": "m" if slides else "rad",
                "lower": float(lower),
                "upper": float(upper),
                "actuator": actuator,
            }
            for name, slides, endless, lower, upper, actuator in zip(*columns, strict=True)
        ],
        "dynamics": dynamics,
    }


def _draw(arm: Arm, path: Path) -> None:
    """Write a picture of the arm in the middle of its ranges."""
    import cv2
    import mujoco
    import numpy as np

    from arm5dof.arm.chain import path_to
    from arm5dof.vision.rendering.portrait import portrait

    qpos = arm.mj_model.qpos0.copy()
    qpos[arm.qpos] = arm.home
    data = mujoco.MjData(arm.mj_model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(arm.mj_model, data)
    first = arm.mj_model.jnt_bodyid[arm.joints[0]]
    bodies = [b for b in range(arm.mj_model.nbody) if first in path_to(arm.mj_model, b)]  # Its links, and its fingers.
    points = np.stack([*data.xpos[bodies], data.site_xpos[arm.site], arm.base[1]])
    assert arm.mj_spec is not None  # It comes from a file.
    image = portrait(arm.mj_spec, qpos, points, arm.mj_model.site(arm.site).name)
    path.write_bytes(cv2.imencode(".png", image[..., ::-1])[1].tobytes())
