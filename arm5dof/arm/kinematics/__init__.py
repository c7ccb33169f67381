"""The paper's 5-DOF arm in formulas: Table 1 forward (Eq. 6) and its closed-form inverse."""

from arm5dof.arm.kinematics.dh import TABLE_1, Pose, forward
from arm5dof.arm.kinematics.inverse import Solutions, inverse, unreachable_because

__all__ = ["TABLE_1", "Pose", "Solutions", "forward", "inverse", "unreachable_because"]
