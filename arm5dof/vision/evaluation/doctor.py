"""What can render and what can detect on this machine, found out by doing it, and what to install for the rest.

OpenGL may end a process, so it renders in one of its own, which runs this module with the name of one library and
writes what it measured to standard output.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from arm5dof.vision.detectors.tabletop.detector import TabletopDetector
from arm5dof.vision.detectors.yolov5.layers import Conv
from arm5dof.vision.evaluation.localization import match_truth
from arm5dof.vision.rendering import opengl
from arm5dof.vision.rendering.software import SoftwareRenderer
from arm5dof.vision.synthetic.samples import render_sample
from arm5dof.vision.synthetic.scene_builder import CAMERA
from arm5dof.vision.synthetic.scenes import random_scene

WIDTH, HEIGHT = 320, 240
SIZE = f"{WIDTH} x {HEIGHT}"
SCENES = 3
"""That are rendered to compare back ends, and to detect in."""

OPENCV = "pip uninstall opencv-python opencv-python-headless; pip install 'opencv-python-headless>=5'"

INSTALL = {
    "apt-get": {"egl": "apt-get install libegl1 libgl1", "osmesa": "apt-get install libosmesa6"},
    "dnf": {"egl": "dnf install mesa-libEGL mesa-libGL", "osmesa": "dnf install mesa-libOSMesa"},
    "pacman": {"egl": "pacman -S mesa", "osmesa": "pacman -S mesa"},
    "apk": {"egl": "apk add mesa-egl mesa-gl mesa-dri-gallium", "osmesa": "apk add mesa-osmesa"},
}
"""How to get them, by the program that installs."""

RELU = bytes.fromhex(
    "08083a410a0f0a01781201791a0179220452656c75120472656c755a130a0178120e0a0c080112080a0208010a02080262130a0179120e0a"
    "0c080112080a0208010a02080242040a00100d"
)
"""As small a network as ONNX can hold: two numbers in, y = max(x, 0) out."""


@dataclass(frozen=True)
class Finding:
    """One line of the report."""

    what: str
    """What was tried."""
    works: bool
    detail: str
    """What was measured, or what is wrong."""
    remedy: str = ""
    """What to do so that it works."""


def rendering(broken: str | None = None) -> Iterator[Finding]:
    """What can render, one by one as it is found out, and which of it is chosen.

    Args:
        broken: The value of MUJOCO_GL if MuJoCo cannot be imported with it.
    """
    if broken is not None:
        yield Finding(f"MUJOCO_GL={broken}", False, "MuJoCo cannot be imported with it", "unset MUJOCO_GL")
    yield _software()
    for library in opengl.libraries():
        yield _opengl(library)
    working, choice = opengl.working_library(), os.environ.get("MUJOCO_GL")
    detail = f"OpenGL by {working}" if working else "software"
    yield Finding("chosen", True, detail if choice is None else f"{detail} (MUJOCO_GL={choice})")


def detectors() -> Iterator[Finding]:
    """What can detect, one by one as it is found out."""
    yield _tabletop()
    yield _yolov5()
    yield _onnx()


def _software() -> Finding:
    scene = random_scene(0)
    renderer = SoftwareRenderer(scene.model, CAMERA, WIDTH, HEIGHT)
    try:
        ms = _milliseconds(lambda: renderer.rgb(scene.data))
        return Finding("software", True, f"{ms:.0f} ms an image of {SIZE}")
    except (AttributeError, cv2.error) as error:  # Another OpenCV hides ours, or has overwritten it.
        return Finding("software", False, f"OpenCV {cv2.__version__}: {' '.join(str(error).split())}", OPENCV)


def _opengl(library: str) -> Finding:
    what, error = f"OpenGL by {library}", opengl.problem(library)
    if error is None:
        measured, error = opengl.run_isolated("arm5dof.vision.evaluation.doctor", library)
        if error is None:
            ms, difference, same = json.loads(measured)
            against = f"colors {difference:.1f} of 255 from software's, {same:.2%} of pixels show the same geom"
            return Finding(what, True, f"{ms:.0f} ms; {against}")
    remedies = [commands[library] for tool, commands in INSTALL.items() if library in commands and shutil.which(tool)]
    return Finding(what, False, error, (*remedies, "not needed: software renders the same")[0])


def _tabletop() -> Finding:
    """The detector that ships, on some images of what it was trained for."""
    detector = TabletopDetector()
    samples = [render_sample(number, 0, "evaluation", "software") for number in range(SCENES)]
    present = sum(int(sample.truth.counts.sum()) for sample in samples)
    found = sum(len(match_truth(detector(sample.image), sample.truth)[0]) for sample in samples)
    ms = _milliseconds(lambda: detector(samples[0].image))
    detail = f"found {found} of {present} objects in {SCENES} simulated images, {ms:.1f} ms an image of 640 x 480"
    works = 2 * found > present
    return Finding("what ships", works, detail, "" if works else "pip install --upgrade jax")


def _yolov5() -> Finding:
    """A layer as YOLOv5 has them, against OpenCV's own filter."""
    rng = np.random.default_rng(0)
    image, kernel = rng.random((HEIGHT, WIDTH)).astype(np.float32), rng.random((3, 3)).astype(np.float32)
    layer = Conv(jnp.asarray(kernel[..., None, None]), jnp.zeros(1), (1, 1), (1, 1), False)
    compiled = jax.jit(lambda pixels: layer(pixels[None, ..., None])[0, ..., 0])
    run = lambda: np.asarray(compiled(image))
    expected = cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_CONSTANT)
    error = float(np.abs(run() - expected).max())
    device = jax.devices()[0]
    detail = f"jax {jax.__version__} on {device.device_kind}, {_milliseconds(run):.1f} ms a layer"
    if error > 0.1:  # Accelerators round to 10 bits; sums of nine numbers reach 9.
        return Finding("YOLOv5 weights (.pt)", False, f"{detail}, error {error:.2g}", "pip install --upgrade jax")
    return Finding("YOLOv5 weights (.pt)", True, detail)


def _onnx() -> Finding:
    what, detail = "YOLO networks (.onnx)", f"OpenCV {cv2.__version__}"
    try:
        network = cv2.dnn.readNetFromONNX(np.frombuffer(RELU, np.uint8))
        network.setInput(np.array([[-1, 2]], np.float32))
        if not np.array_equal(network.forward(), [[0, 2]]):
            raise ValueError("its sums are wrong")
    except (cv2.error, ValueError) as error:
        reason = " ".join(str(error).split())
        return Finding(what, False, f"{detail}: {reason}", OPENCV)
    return Finding(what, True, detail)


def _milliseconds(run: Callable[[], object]) -> float:
    """The shortest of some runs, after one that may have to prepare."""
    run()
    times = []
    for _ in range(5):
        started = time.perf_counter()
        run()
        times.append(time.perf_counter() - started)
    return 1e3 * min(times)


def _measure(library: str) -> tuple[float, float, float]:
    """Milliseconds an image by an OpenGL library, its mean difference from software's of 255, and the share of pixels
    where the two see the same geom."""
    times, differences, same = [], [], []
    for number in range(SCENES):
        scene = random_scene(number)
        theirs = opengl.GLRenderer(scene.model, CAMERA, WIDTH, HEIGHT, library)
        ours = SoftwareRenderer(scene.model, CAMERA, WIDTH, HEIGHT)
        times.append(_milliseconds(lambda theirs=theirs, scene=scene: theirs.rgb(scene.data)))  # type: ignore[misc]
        differences.append(np.abs(theirs.rgb(scene.data).astype(int) - ours.rgb(scene.data)).mean())
        same.append((theirs.segmentation(scene.data) == ours.segmentation(scene.data)).mean())
    return min(times), float(np.mean(differences)), float(np.mean(same))


if __name__ == "__main__":
    sys.stdout.write(json.dumps(_measure(sys.argv[1])))
