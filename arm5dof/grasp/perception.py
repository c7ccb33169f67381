"""What a grasping program knows of the table: objects by class, where they are, and how sure that is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from arm5dof.errors import UserError
from arm5dof.grasp.outline import size_misfit
from arm5dof.vision.boxes import iou
from arm5dof.vision.camera import Camera
from arm5dof.vision.detections import Detector
from arm5dof.vision.detectors.loading import load_detector
from arm5dof.vision.detectors.tabletop.detector import TabletopDetector
from arm5dof.vision.localization.common import cut_edges
from arm5dof.vision.localization.solids import CATALOGUE_SOLIDS
from arm5dof.vision.localization.table_plane import by_plane


@dataclass(frozen=True, eq=False)
class SeenObject:
    """An object that was seen."""

    name: str
    """Of its class."""
    confidence: float
    """Of the detector, in [0, 1]."""
    position: np.ndarray | None
    """Of its center in the base frame, (3,), metres; None if it could not be located."""
    std: float
    """The largest standard deviation of the position in any direction, metres; NaN without one."""
    failure: str = ""
    """Why it has no position."""
    eye: np.ndarray | None = None
    """Where it was seen from, (3,), metres, base frame, if that is known: were it higher than thought, it would be
    nearer to that."""


FAINT = 0.07
"""What is seen with less confidence at a second look is not told."""
SURE = 0.25
"""Of less confidence, something counts only where nothing more certain is."""
MISFIT, UNLIKE = 0.2, 0.1
"""What looks so much larger or smaller than its class would there, as a logarithm, is of another class or half hidden:
it is so many times as sure."""
SAME = 0.3
"""Boxes whose intersection over union is larger may be of one object."""

Perception = Callable[[np.ndarray], list[SeenObject]]
"""From an RGB image (h, w, 3) uint8 to what is seen in it, the surest first."""


def detectors() -> tuple[Detector, Detector]:
    """The detector that ships, for a quick look; and for a second one, slower, that shows what is faint too."""
    return load_detector(), TabletopDetector(confidence=FAINT, iou=0.45, tta=True, windows=True)


class CameraPerception:
    """A detector, and a calibrated camera whose place is known; objects stand on the table.

    Of what lies half in the picture, its edge is no edge of the object: see `by_plane`.

    Args:
        detector: What finds objects.
        camera: What takes the images, with extrinsics.
        box_std: Standard deviation of the edges of the detector's boxes, pixels.

    Raises:
        UserError: The camera has no extrinsics.
    """

    def __init__(self, detector: Detector, camera: Camera, box_std: float = 1.0) -> None:
        if not camera.has_extrinsics:
            raise UserError("the camera has no extrinsics: find its pose first (arm5dof.vision.calibration)")
        self.detector, self.camera, self.box_std = detector, camera, box_std

    def __call__(self, image: np.ndarray) -> list[SeenObject]:
        """See `Perception`. Raises `UserError` for an image of another size than the camera's."""
        if image.shape[:2] != (self.camera.height, self.camera.width):
            size, wanted = f"{image.shape[1]} x {image.shape[0]}", f"{self.camera.width} x {self.camera.height}"
            raise UserError(f"the image is {size}, the camera was calibrated for {wanted}: give one of its own")
        detections = self.detector(image)
        found = by_plane(detections, self.camera, CATALOGUE_SOLIDS, box_std=self.box_std, cut=True)
        eye = np.asarray(self.camera.position, float)
        names = detections.data["class_name"]
        confidence = detections.confidence.astype(float)
        for i, failure in enumerate(found.failure):
            if not failure and self._is_misfit(str(names[i]), detections.xyxy[i], found.position[i]):
                confidence[i] *= UNLIKE
        sure = confidence >= SURE
        same = (iou(detections.xyxy[:, None], detections.xyxy[sure]) > SAME).any(1)
        seen = [
            SeenObject(
                str(names[i]),
                float(confidence[i]),
                None if failure else found.position[i],
                float("nan") if failure else float(np.sqrt(np.linalg.eigvalsh(found.covariance[i])[-1])),
                failure,
                eye,
            )
            for i, failure in enumerate(found.failure)
            if sure[i] or not same[i]
        ]
        return sorted(seen, key=lambda one: -one.confidence)

    def _is_misfit(self, name: str, box: np.ndarray, position: np.ndarray) -> bool:
        if cut_edges(box[None], self.camera).any():
            return False
        return size_misfit(name, box, position, self.camera) > MISFIT
