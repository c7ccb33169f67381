"""A video of a grasp: what the camera sees, with what was detected in it, and the scene from another side."""

from __future__ import annotations

from pathlib import Path

import cv2
import mujoco
import numpy as np

from arm5dof.grasp.evaluation import Observer
from arm5dof.grasp.perception import CameraPerception, Perception, SeenObject
from arm5dof.grasp.scene import TabletopScene
from arm5dof.vision.detections import Detections
from arm5dof.vision.io.annotate import annotate
from arm5dof.vision.io.mp4 import Mp4
from arm5dof.vision.rendering.simulated import simulated_camera
from arm5dof.vision.synthetic.scene_builder import CAMERA, SECOND

RATE = 25.0
"""Frames a second, in the scene's time."""
SIZE = (480, 360)
"""Of either view, pixels."""


class Recorder(Observer):
    """Writes an MP4 while it is told how a grasp goes.

    Args:
        path: Where to.
        scene: The scene.
        perception: The program's own, whose detections are drawn.

    Raises:
        UserError: OpenCV cannot write there.
    """

    def __init__(self, path: Path, scene: TabletopScene, perception: Perception) -> None:
        self._scene, self._inner = scene, perception
        self._views = [simulated_camera(scene.model, name, *SIZE) for name in (CAMERA, SECOND)]
        self._found: Detections | None = None
        self._words = ""
        self._video = Mp4(path, (2 * SIZE[0], SIZE[1]), RATE)
        self.perception = self._look

    def stage(self, words: str) -> None:
        """See `Observer`."""
        self._words = words
        if words != "look":
            self._found = None if words.startswith("lift") else self._found
            self._write(round(RATE / 2))

    def step(self) -> None:
        """See `Observer`."""
        self._write(1)

    def close(self) -> None:
        """Finish the file. Raises `UserError` if it is not whole."""
        self._video.close()
        self._video.check()

    def _look(self, image: np.ndarray) -> list[SeenObject]:
        if isinstance(self._inner, CameraPerception):
            self._found = self._inner.detector(image)
        return self._inner(image)

    def _write(self, times: int) -> None:
        mujoco.mj_forward(self._scene.model, self._scene.data)
        seen, other = (view.rgb(self._scene.data) for view in self._views)
        if self._found is not None:
            scale = SIZE[0] / self._scene.camera.width
            small = Detections(
                self._found.xyxy * scale, self._found.confidence, self._found.class_id, self._found.class_names
            )
            seen = annotate(seen, small)
        frame = np.ascontiguousarray(np.concatenate([seen, other], 1))
        cv2.rectangle(frame, (0, SIZE[1] - 24), (2 * SIZE[0], SIZE[1]), (0, 0, 0), -1)
        cv2.putText(
            frame, self._words, (8, SIZE[1] - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA
        )
        self._video.write(frame, times)
