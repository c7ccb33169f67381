"""A picture of a robot that stands alone, for people: the camera is put where all of it is seen."""

from __future__ import annotations

import mujoco
import numpy as np

from arm5dof.vision.rendering.simulated import simulated_camera

CAMERA, FOVY = "portrait", 35.0
DIRECTION = np.array([1.0, -1.2, 0.7])
"""From the robot to the camera."""
BACKGROUND = 255


def portrait(
    spec: mujoco.MjSpec, qpos: np.ndarray, points: np.ndarray, site: str, width: int = 800, height: int = 800
) -> np.ndarray:
    """Render a robot, with the axes of a site: x red, y green, z blue.

    Args:
        spec: The robot, which stays as it is.
        qpos: Of all its joints, (nq,).
        points: What is to be seen, (n, 3), metres in the world frame.
        site: Name of the site.
        width: Of the image, pixels.
        height: Of the image, pixels.

    Returns:
        The image, RGB uint8 (height, width, 3), white where there is nothing.
    """
    spec = spec.copy()
    center = (points.min(0) + points.max(0)) / 2
    radius = 1.25 * max(float(np.linalg.norm(points - center, axis=1).max()), 1e-3)
    back = DIRECTION / np.linalg.norm(DIRECTION)
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    turn = np.empty(4)
    mujoco.mju_mat2Quat(turn, np.stack([right, np.cross(back, right), back], axis=1).ravel())
    at = center + back * radius / np.sin(np.radians(FOVY / 2))
    spec.worldbody.add_camera(name=CAMERA, pos=at, quat=turn, fovy=FOVY)
    _add_axes(spec, site, 0.25 * radius)
    spec.stat.extent = radius  # So that the near and the far plane enclose the robot, whatever else the model says.
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.35] * 3, [0.6] * 3
    spec.visual.map.znear, spec.visual.map.zfar = 0.05, 50.0

    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    camera = simulated_camera(model, CAMERA, width, height)
    image = camera.rgb(data).copy()
    image[camera.segmentation(data) < 0] = BACKGROUND
    return image


def _add_axes(spec: mujoco.MjSpec, site: str, length: float) -> None:
    """Three capsules along the axes of a site's frame, which touch and weigh nothing."""
    place = spec.site(site)
    start = np.array(place.pos)
    for i, axis in enumerate(np.eye(3)):
        end, color = np.empty(3), [*(0.9 * axis + 0.05), 1.0]
        mujoco.mju_rotVecQuat(end, length * axis, np.array(place.quat) / np.linalg.norm(place.quat))
        place.parent.add_geom(
            name=f"{CAMERA} axis {'xyz'[i]}",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[*start, *(start + end)],
            size=[0.04 * length, 0, 0],
            rgba=color,
            contype=0,
            conaffinity=0,
            mass=0,
            group=2,
        )
