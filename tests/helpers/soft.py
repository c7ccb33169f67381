"""An arm whose servos are too slow for a control step."""

from __future__ import annotations

import mujoco

from arm5dof.arm import Arm, load_arm
from arm5dof.runtime import files


def soft_arm() -> Arm:
    """The paper's arm with servos as hobby arms have them: slow, and gravity pulls them down."""
    spec = mujoco.MjSpec.from_file(str(files.find("mjcf", "reach.xml")))
    for servo in spec.actuators:
        servo.gainprm[0], servo.biasprm[1], servo.biasprm[2] = 20, -20, -2
    for body in spec.bodies:
        body.gravcomp = 0
    return load_arm(spec)
