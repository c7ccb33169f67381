"""What is true of a scene, for scoring and in the place of what a program sees: no program that is scored knows it."""

from __future__ import annotations

import mujoco
import numpy as np

from arm5dof.grasp.perception import SeenObject
from arm5dof.grasp.scene import TabletopScene
from arm5dof.vision.detections import Detections
from arm5dof.vision.objects import CLASS_NAMES
from arm5dof.vision.rendering.simulated import simulated_camera
from arm5dof.vision.synthetic.ground_truth import Truth, truth
from arm5dof.vision.synthetic.scene_builder import CAMERA


class TruePositions:
    """A `Perception` that knows where the objects of a scene are, whatever an image shows."""

    def __init__(self, scene: TabletopScene) -> None:
        self._scene = scene

    def __call__(self, image: np.ndarray) -> list[SeenObject]:
        """See `Perception`."""
        positions = self._scene.object_poses()[0]
        return [
            SeenObject(one.catalogue_object.name, 1.0, position, 0.0)
            for one, position in zip(self._scene.objects, positions, strict=True)
        ]


class TrueBoxes:
    """A `Detector` that makes no mistakes: it finds what counts in the detector's own evaluation."""

    class_names = CLASS_NAMES

    def __init__(self, scene: TabletopScene) -> None:
        self._scene = scene

    def __call__(self, image: np.ndarray) -> Detections:
        """What counts in the scene now."""
        found = shown(self._scene)
        rows = found.counts
        return Detections(found.xyxy[rows], found.visible[rows], found.class_id[rows], CLASS_NAMES)


def shown(scene: TabletopScene) -> Truth:
    """What the camera of a scene shows now."""
    mujoco.mj_forward(scene.model, scene.data)
    camera = simulated_camera(scene.model, CAMERA, scene.camera.width, scene.camera.height)
    return truth(scene, camera.segmentation(scene.data))


def in_sight(scene: TabletopScene) -> set[int]:
    """The objects that count in the detector's own evaluation, before anything moved: half of them or more is shown."""
    found = shown(scene)
    return {i for i, at in enumerate(scene.start) if (np.abs(found.position[found.counts] - at).max(1) < 1e-6).any()}
