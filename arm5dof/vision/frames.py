"""`Frame`: an image from a source of images, and what is known of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from arm5dof.vision.camera import Camera


@dataclass(frozen=True, eq=False)
class Frame:
    """One image of a folder, a video, a camera or a simulation."""

    name: str
    """Of the file as it was given, or of the camera."""
    image: np.ndarray
    """RGB uint8 (h, w, 3)."""
    time: float | None = None
    """Seconds since the beginning of the video, or since the camera's first frame; None for a photograph."""
    turned: bool = False
    """Whether it was turned or mirrored as the photograph's EXIF orientation tag says."""
    camera: Camera | None = None
    """The camera that a simulated image was rendered for, known exactly; None for real images."""
