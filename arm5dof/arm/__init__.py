"""The arm: any serial arm in MJCF, its forward kinematics, and the paper's closed form."""

from arm5dof.arm.arm import Arm, Pose
from arm5dof.arm.loading import load_arm

__all__ = ["Arm", "Pose", "load_arm"]
