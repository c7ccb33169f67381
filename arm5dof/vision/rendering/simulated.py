"""The simulated camera: colors, depth and segmentation of a MuJoCo scene as one of its cameras sees it.

The geometry is that of `Camera.from_mujoco` to the pixel, whichever back end renders: `software` needs nothing but pip,
`gl` an OpenGL library.
"""

from __future__ import annotations

from typing import Literal, Protocol, get_args

import mujoco
import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.rendering import opengl
from arm5dof.vision.rendering.software import SoftwareRenderer

BackEnd = Literal["auto", "gl", "software"]


class SimulatedCamera(Protocol):
    """What both back ends do. `data` must have been through `mj_forward`; it is only read."""

    width: int
    """Of the image, pixels."""
    height: int
    """Of the image, pixels."""

    def rgb(self, data: mujoco.MjData) -> np.ndarray:
        """The image, RGB uint8 (h, w, 3)."""

    def depth(self, data: mujoco.MjData) -> np.ndarray:
        """Metres along the optical axis, (h, w) float32; infinite where there is nothing."""

    def segmentation(self, data: mujoco.MjData) -> np.ndarray:
        """The id of the geom that is seen, (h, w) int32; -1 where there is none."""


def simulated_camera(
    model: mujoco.MjModel, camera: str, width: int = 640, height: int = 480, back_end: BackEnd = "auto"
) -> SimulatedCamera:
    """A camera of a MuJoCo model that can be used to render it.

    Args:
        model: The model.
        camera: The camera's name.
        width: Of the image, pixels.
        height: Of the image, pixels.
        back_end: `gl` renders with OpenGL, `software` without; `auto` with OpenGL where that works.

    Raises:
        UserError: There is no such camera or back end, the image has no pixels, or no OpenGL works for `gl`.
    """
    names = [model.camera(i).name for i in range(model.ncam)]
    if camera not in names:
        raise UserError(f"the model has no camera {camera!r}; it has: {', '.join(names) or 'none'}")
    if min(width, height) < 1:
        raise UserError(f"an image has at least one pixel, not {width} x {height}")
    if back_end not in get_args(BackEnd):
        raise UserError(f"no back end {back_end!r}: there are {', '.join(get_args(BackEnd))}")
    library = None if back_end == "software" else opengl.working_library()
    if library is not None:
        return opengl.GLRenderer(model, camera, width, height, library)
    if back_end == "gl":
        tried = "; ".join(f"{name}: {opengl.problem(name)}" for name in opengl.candidates()) or "MUJOCO_GL forbids it"
        raise UserError(f"no OpenGL works here ({tried}): use the back end software")
    return SoftwareRenderer(model, camera, width, height)
