"""The simulated camera: colours, depth and segmentation of a MuJoCo scene as one of its cameras sees it.

The geometry is that of `Camera.from_mujoco` to the pixel, whichever back end draws: `software` needs nothing but pip,
`gl` an OpenGL library, which `arm5dof vision doctor` looks for.
"""

from __future__ import annotations

from typing import Literal, Protocol, get_args

import mujoco
import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.rendering import opengl as gl
from arm5dof.vision.rendering.software import SoftwareRenderer

BackEnd = Literal["auto", "gl", "software"]


class SimulatedCamera(Protocol):
    """What both back ends do. `data` must have been through `mj_forward`; it is only read."""

    width: int
    height: int

    def rgb(self, data: mujoco.MjData) -> np.ndarray:
        """The picture, (h, w, 3) uint8."""

    def depth(self, data: mujoco.MjData) -> np.ndarray:
        """Metres along the optical axis, (h, w) float32; infinite where there is nothing."""

    def segmentation(self, data: mujoco.MjData) -> np.ndarray:
        """The id of the geom that is seen, (h, w) int32; -1 where there is none."""


def simulated_camera(
    model: mujoco.MjModel, camera: str, width: int = 640, height: int = 480, back_end: BackEnd = "auto"
) -> SimulatedCamera:
    """The camera `camera` of a model. `auto` draws with OpenGL where that works and in software elsewhere.

    Raises `UserError` for an unknown camera or back end, a picture without pixels, and for `gl` where there is none.
    """
    names = [model.camera(i).name for i in range(model.ncam)]
    if camera not in names:
        raise UserError(f"the model has no camera {camera!r}; it has: {', '.join(names) or 'none'}")
    if min(width, height) < 1:
        raise UserError(f"a picture has at least one pixel, not {width} x {height}")
    if back_end not in get_args(BackEnd):
        raise UserError(f"no back end {back_end!r}: there are {', '.join(get_args(BackEnd))}")
    library = None if back_end == "software" else gl.working()
    if library is not None:
        return gl.GLRenderer(model, camera, width, height, library)
    if back_end == "gl":
        raise UserError("no OpenGL works here; arm5dof vision doctor says why, and back end software needs none")
    return SoftwareRenderer(model, camera, width, height)
