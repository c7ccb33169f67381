"""`GLRenderer`: MuJoCo's own OpenGL rendering, where there is an OpenGL, and finding out whether there is.

A missing or broken library can end the process, so that is tried out in another one, which runs this module with the
library's name. MuJoCo chooses by MUJOCO_GL when it is imported, and a wrong choice makes that import fail; here
contexts are opened by name instead, at any time.
"""

from __future__ import annotations

import ctypes.util
import importlib
import os
import subprocess
import sys
from functools import cache
from typing import Any

import mujoco
import numpy as np

from arm5dof.errors import UserError
from arm5dof.runtime import files
from arm5dof.vision.rendering.meshes import capacity

PROBE_S = 60.0
"""A probe that takes longer has failed."""

FORBIDDEN = ("disable", "disabled", "off", "false", "0")
"""Values of MUJOCO_GL that forbid OpenGL."""

SHARED = {"egl": "EGL", "osmesa": "OSMesa"}
"""The system's shared library that each needs, where it needs one."""

GEOM = int(mujoco.mjtObj.mjOBJ_GEOM)


class GLRenderer:
    """A camera of a MuJoCo model, rendered by OpenGL. `data` must have been through `mj_forward`.

    Args:
        model: The model.
        camera: The camera's name.
        width: Of the image, pixels.
        height: Of the image, pixels.
        library: One that `problem` finds nothing wrong with; with any other this may end the process.
    """

    def __init__(self, model: mujoco.MjModel, camera: str, width: int, height: int, library: str) -> None:
        self.model, self.width, self.height = model, width, height
        self._scene = mujoco.MjvScene(model, maxgeom=capacity(model))
        self._option, self._viewer = mujoco.MjvOption(), mujoco.MjvCamera()
        self._viewer.type, self._viewer.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, model.camera(camera).id
        self._window = _window(library)
        self._window.make_current()
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_resizeOffscreen(width, height, self._context)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR

    def rgb(self, data: mujoco.MjData) -> np.ndarray:
        """The image, RGB uint8 (h, w, 3)."""
        return self._render(data, False)[0]

    def depth(self, data: mujoco.MjData) -> np.ndarray:
        """Metres along the optical axis, (h, w) float32; infinite where there is nothing."""
        buffer = self._render(data, True)[1].astype(float)
        near, far = (z * self.model.stat.extent for z in (self.model.vis.map.znear, self.model.vis.map.zfar))
        inverse = buffer * (1 / near - 1 / far) + 1 / far
        return np.where(buffer > 0, 1 / inverse, np.inf).astype(np.float32)

    def segmentation(self, data: mujoco.MjData) -> np.ndarray:
        """The id of the geom that is seen, (h, w) int32; -1 where there is none."""
        colors = self._render(data, True)[0].astype(np.int32)
        number = colors @ np.array([1, 1 << 8, 1 << 16], np.int32)
        ids = np.full(self._scene.ngeom + 1, -1, np.int32)
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.objtype == GEOM:
                ids[geom.segid + 1] = geom.objid
        return ids[number]

    def _render(self, data: mujoco.MjData, identify: bool) -> tuple[np.ndarray, np.ndarray]:
        """Colors, or with `identify` numbers of geoms as colors, and the depth buffer."""
        self._window.make_current()
        categories = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self.model, data, self._option, None, self._viewer, categories, self._scene)
        for flag in (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR):
            self._scene.flags[flag] = identify
        image = np.empty((self.height, self.width, 3), np.uint8)
        buffer = np.empty((self.height, self.width), np.float32)
        rectangle = mujoco.MjrRect(0, 0, self.width, self.height)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        mujoco.mjr_render(rectangle, self._scene, self._context)
        mujoco.mjr_readPixels(image, buffer, rectangle, self._context)
        return np.ascontiguousarray(image[::-1]), buffer[::-1]


def libraries() -> tuple[str, ...]:
    """The OpenGL libraries that MuJoCo can use on this system, best first."""
    return {"linux": ("egl", "osmesa", "glfw"), "darwin": ("cgl", "glfw")}.get(sys.platform, ("glfw",))


def candidates() -> tuple[str, ...]:
    """Those of them that may be tried: the one that MUJOCO_GL names, or all; none if it forbids OpenGL."""
    chosen = os.environ.get("MUJOCO_GL", "").strip().lower()
    if chosen in FORBIDDEN:
        return ()
    return (chosen,) if chosen in libraries() else libraries()


@cache
def working_library() -> str | None:
    """The first library that renders an image, None if none does. The answer holds until the process ends."""
    return next((name for name in candidates() if problem(name) is None), None)


@cache
def problem(library: str) -> str | None:
    """What goes wrong when a library renders an image, in a process of its own; None if nothing does."""
    if library == "glfw" and sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
        return "there is no display"
    _, error = run_isolated("arm5dof.vision.rendering.opengl", library)
    shared = SHARED.get(library)
    if error is not None and shared and ctypes.util.find_library(shared) is None:
        return f"lib{shared} is not installed"
    return error


def run_isolated(module: str, library: str) -> tuple[str, str | None]:
    """Run a module of ours in a process of its own, which OpenGL may end.

    Args:
        module: Its full name; it is run as `python -m` does.
        library: Its one argument.

    Returns:
        What it writes to standard output, and what goes wrong, None if nothing does.
    """
    environment = {name: value for name, value in os.environ.items() if name not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, [str(files.PACKAGE.parent), os.environ.get("PYTHONPATH")]))
    command = [sys.executable, "-m", module, library]
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PROBE_S, check=False)
    except subprocess.TimeoutExpired:
        return "", f"no answer within {PROBE_S:g} s"
    lines = done.stderr.strip().splitlines()
    error = lines[-1].strip() if lines else f"the process ended with status {done.returncode}"
    return done.stdout, error if done.returncode else None


@cache
def _window(library: str) -> Any:
    """The one OpenGL context of this process; every model has its own resources in it."""
    return importlib.import_module(f"mujoco.{library}").GLContext(64, 64)


def _probe(library: str) -> None:
    """Render a red ball and check the image. Raises whatever goes wrong."""
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><light pos="0 0 3"/><geom size="0.5" rgba="1 0 0 1"/>'
        '<camera name="above" pos="0 0 2"/></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = GLRenderer(model, "above", 64, 48, library)
    red, green, _ = renderer.rgb(data)[24, 32]
    if not (red > 100 and red > 2 * int(green) and renderer.segmentation(data)[24, 32] == 0):
        raise UserError("renders, but not what it should")


if __name__ == "__main__":
    _probe(sys.argv[1])
