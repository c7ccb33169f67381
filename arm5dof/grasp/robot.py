"""`Robot`: what a grasping program needs of an arm, real or simulated; a simulated one, and one that moves nothing.

A real arm is a class with these five methods. Joint positions are those of the arm's MJCF, in its order, radians; times
are seconds; both motions block until what they move is at rest.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import mujoco
import numpy as np

from arm5dof.arm import Arm
from arm5dof.errors import UserError
from arm5dof.grasp.scene import STILL, TabletopScene
from arm5dof.vision.rendering.simulated import BackEnd, SimulatedCamera, simulated_camera
from arm5dof.vision.synthetic.samples import HEIGHT, WIDTH
from arm5dof.vision.synthetic.scene_builder import CAMERA

FINGER_SPEED = 0.05
"""Of each finger, m/s: slow enough that the first to touch an object pushes it along and does not knock it away."""
PATIENCE = 1.0
"""Seconds to wait for rest after the last target."""
IMAGINED = 0.008
"""An object that a dry run closes on is so much narrower than the gripper was opened for it, metres."""
REST_STEPS = 10
"""Time steps without motion that count as rest."""


class Robot(Protocol):
    """An arm with a gripper and a camera."""

    def joints(self) -> np.ndarray:
        """Joint positions as measured, (dof,), radians."""

    def opening(self) -> float:
        """Distance between the fingers as measured, metres."""

    def move(self, times: np.ndarray, joints: np.ndarray) -> None:
        """Follow a trajectory, straight in joint space from one target to the next, and return when the arm rests.

        Args:
            times: When to be where, seconds from now, (k,), rising and above 0.
            joints: Targets, (k, dof), radians.
        """

    def grip(self, opening: float) -> None:
        """Open or close the gripper, and return when the fingers rest.

        Args:
            opening: Distance between the fingers, metres. One less than an object's width, 0 or below too, holds the
                object: the further below, the firmer.
        """

    def image(self) -> np.ndarray:
        """What the camera sees, RGB uint8 (height, width, 3)."""


class SimulatedRobot:
    """The robot in a scene, moved by its position actuators. It never tells where objects are.

    Args:
        scene: The scene, which it steps.
        width: Of the image, pixels.
        height: Of the image, pixels.
        back_end: What renders the image: see `simulated_camera`.
        on_step: Called every so often while it moves, such as to record a video.
        every: How often, seconds.
    """

    def __init__(
        self,
        scene: TabletopScene,
        width: int = WIDTH,
        height: int = HEIGHT,
        back_end: BackEnd = "auto",
        on_step: Callable[[], object] | None = None,
        every: float = 0.04,
    ) -> None:
        self._model, self._data, self._arm, self._gripper = scene.model, scene.data, scene.arm, scene.gripper
        self._size, self._back_end = (width, height), back_end
        self._renderer: SimulatedCamera | None = None
        self._image, self._imaged = np.empty(0, np.uint8), np.empty(0)
        self._on_step, self._steps, self._stride = on_step, 0, max(1, round(every / self._model.opt.timestep))
        self._target = self.joints()
        self._fingers = self._data.qpos[self._gripper.qpos].copy()

    def joints(self) -> np.ndarray:
        """See `Robot`."""
        return self._data.qpos[self._arm.qpos].copy()

    def opening(self) -> float:
        """See `Robot`."""
        return self._gripper.opening(self._data.qpos[self._gripper.qpos])

    def move(self, times: np.ndarray, joints: np.ndarray) -> None:
        """See `Robot`."""
        times, joints = _checked(times, joints, self._arm.dof)
        arm, from_now = self._arm, self._model.opt.timestep * np.arange(1, self._count(times[-1]) + 1)
        knots = np.concatenate([[0.0], times]), np.concatenate([[self._target], joints])
        targets = np.stack([np.interp(from_now, knots[0], column) for column in knots[1].T], -1)
        targets[-1] = joints[-1]
        self._follow(arm.actuators, arm.servo[:, 0] * targets + arm.servo[:, 1], arm.dofs)
        self._target = joints[-1]

    def grip(self, opening: float) -> None:
        """See `Robot`."""
        target = self._gripper.fingers(opening)
        count = self._count(np.abs(target - self._fingers).max() / FINGER_SPEED)
        targets = np.linspace(self._fingers, target, count + 1)[1:]
        self._follow(self._gripper.actuators, np.stack([self._gripper.to_ctrl(t) for t in targets]), self._gripper.dofs)
        self._fingers = target

    def image(self) -> np.ndarray:
        """See `Robot`."""
        if self._renderer is None:
            self._renderer = simulated_camera(self._model, CAMERA, *self._size, self._back_end)
        if not np.array_equal(self._data.qpos, self._imaged):  # Drawing takes longer than all else.
            mujoco.mj_forward(self._model, self._data)
            self._image, self._imaged = self._renderer.rgb(self._data), self._data.qpos.copy()
        return self._image.copy()

    def _count(self, seconds: float) -> int:
        return max(1, round(seconds / self._model.opt.timestep))

    def _follow(self, actuators: np.ndarray, controls: np.ndarray, dofs: np.ndarray) -> None:
        """Send controls (k, n), one a time step, then wait until what they move rests."""
        for control in controls:
            self._data.ctrl[actuators] = control
            self._step()
        still = 0
        for _ in range(self._count(PATIENCE)):
            still = still + 1 if np.abs(self._data.qvel[dofs]).max() < STILL else 0
            if still == REST_STEPS:
                break
            self._step()

    def _step(self) -> None:
        mujoco.mj_step(self._model, self._data)
        self._steps += 1
        if self._on_step is not None and self._steps % self._stride == 0:
            self._on_step()


class Command(NamedTuple):
    """What a robot would have been told."""

    time: float
    """Seconds since the start."""
    joints: np.ndarray
    """Target, (dof,), radians."""
    opening: float
    """Of the gripper, metres."""


class DryRun:
    """A robot that moves nothing and keeps what it was told.

    Args:
        arm: The arm.
        joints: Where its joints are at first, (dof,), radians.
        opening: Of its gripper at first, metres.
        image: What its camera sees, RGB uint8 (h, w, 3).

    Attributes:
        commands: What it was told so far, in order.
    """

    def __init__(
        self, arm: Arm, joints: np.ndarray | None = None, opening: float = 0.0, image: np.ndarray | None = None
    ) -> None:
        self._dof, self._image, self._opened = arm.dof, image, opening
        start = arm.home if joints is None else np.asarray(joints, float)
        self.commands = [Command(0.0, start, opening)]

    def joints(self) -> np.ndarray:
        """See `Robot`."""
        return self.commands[-1].joints.copy()

    def opening(self) -> float:
        """See `Robot`: what it closes on is taken to be there."""
        now = self.commands[-1].opening
        return now if now > 0 else max(self._opened - IMAGINED, 0.0)

    def move(self, times: np.ndarray, joints: np.ndarray) -> None:
        """See `Robot`."""
        times, joints = _checked(times, joints, self._dof)
        now, opening = self.commands[-1].time, self.commands[-1].opening
        self.commands += [Command(now + float(t), q, opening) for t, q in zip(times, joints, strict=True)]

    def grip(self, opening: float) -> None:
        """See `Robot`."""
        last = self.commands[-1]
        self._opened = opening if opening > 0 else self._opened
        seconds = abs(opening - last.opening) / 2 / FINGER_SPEED
        self.commands.append(Command(last.time + seconds, last.joints, opening))

    def image(self) -> np.ndarray:
        """See `Robot`. Raises `UserError` if none was given."""
        if self._image is None:
            raise UserError("this dry run has no image: give it a photograph")
        return self._image


def _checked(times: np.ndarray, joints: np.ndarray, dof: int) -> tuple[np.ndarray, np.ndarray]:
    times, joints = np.asarray(times, float), np.asarray(joints, float)
    if times.ndim != 1 or not len(times) or joints.shape != (len(times), dof):
        raise UserError(f"a trajectory has times (k,) and joints (k, {dof}), not {times.shape} and {joints.shape}")
    if not np.isfinite(joints).all() or not (np.diff(times, prepend=0) > 0).all():
        raise UserError("a trajectory has finite joints, and times that rise from above 0")
    return times, joints
