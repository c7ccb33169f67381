"""Whether a camera sees the table as those did for which the tabletop detector was trained. From elsewhere it finds
objects where there are none."""

from __future__ import annotations

import numpy as np

from arm5dof.vision.camera import Camera

MIN_DISTANCE, MAX_DISTANCE = 0.5, 1.0
"""From the camera to the table along the optical axis, metres; in training 0.6 to 0.9."""

MIN_ELEVATION = np.deg2rad(30)
"""Of the camera above the table as seen from where it looks, radians; in training 35 degrees and more."""

MAX_ROLL = np.deg2rad(15)
"""About the optical axis, radians; in training a standard deviation of 3 degrees."""

OVERHEAD = np.cos(np.deg2rad(80))
"""A camera that looks straight down has no roll."""


def unlike_training(camera: Camera, table_height: float = 0.0) -> str:
    """Say in what a camera differs from those of the training.

    Args:
        camera: With extrinsics.
        table_height: Of the table in the base frame, metres.

    Returns:
        What is unusual, such as `0.31 m from the table`; empty if nothing is.
    """
    right, down, forward = np.asarray(camera.rotation, float)[2]
    elevation, level = np.arcsin(np.clip(-forward, -1, 1)), np.hypot(right, down)
    roll = np.arctan2(right, -down) if level > OVERHEAD else 0.0
    unusual = []
    if elevation < MIN_ELEVATION:
        unusual.append(f"{np.rad2deg(elevation):.0f} degrees above it")
    if forward < 0:
        distance = (float(camera.position[2]) - table_height) / -forward
        if not MIN_DISTANCE <= distance <= MAX_DISTANCE:
            unusual.insert(0, f"{distance:.2f} m from the table")
    if abs(roll) > MAX_ROLL:
        unusual.append(f"rolled by {np.rad2deg(abs(roll)):.0f} degrees")
    return ", ".join(unusual)
