"""Images of random scenes with what there is to find in them, rendered by all of the machine's cores."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import cv2
import numpy as np

from arm5dof.runtime import xla
from arm5dof.vision.camera import Camera
from arm5dof.vision.rendering.simulated import BackEnd, simulated_camera
from arm5dof.vision.synthetic.ground_truth import Truth, truth
from arm5dof.vision.synthetic.scene_builder import CAMERA
from arm5dof.vision.synthetic.scenes import Scene, Style, random_scene

T = TypeVar("T")
WIDTH, HEIGHT = 640, 480


@dataclass(frozen=True, eq=False)
class Sample:
    """An image of a random scene, labelled."""

    image: np.ndarray
    """RGB uint8 (h, w, 3)."""
    instances: np.ndarray
    """Which of the objects in `truth` a pixel shows, counted from 1, (h, w) uint8; 0 for none."""
    truth: Truth
    camera: Camera
    """What took it, known exactly."""


def render_sample(number: int, seed: int, style: Style, back_end: BackEnd) -> Sample:
    """Render one image of a series. The same arguments give the same bits.

    Args:
        number: Which one, from 0.
        seed: Of the series.
        style: See `random_scene`.
        back_end: See `simulated_camera`.
    """
    scene = random_scene((seed, number), style)
    renderer = simulated_camera(scene.model, CAMERA, WIDTH, HEIGHT, back_end)
    segmentation = renderer.segmentation(scene.data)
    camera = Camera.from_mujoco(scene.model, CAMERA, WIDTH, HEIGHT, scene.data)
    return Sample(renderer.rgb(scene.data), _instances(scene, segmentation), truth(scene, segmentation), camera)


def render_samples(
    count: int, seed: int, style: Style, back_end: BackEnd, workers: int | None = None
) -> Iterator[Sample]:
    """The first `count` images of a series, in order, rendered by one process a core, or `workers`."""
    return parallel_map(partial(render_sample, seed=seed, style=style, back_end=back_end), count, workers)


def parallel_map(function: Callable[[int], T], count: int, workers: int | None = None) -> Iterator[T]:
    """What a function returns for 0 to `count` - 1, in order.

    Args:
        function: What can be pickled, as can what it returns.
        count: How often it is called.
        workers: Number of processes; None for one a core.
    """
    with multiprocessing.get_context("spawn").Pool(min(workers or xla.cores(), count), _start) as pool:
        yield from pool.imap(function, range(count), chunksize=4)


def _instances(scene: Scene, segmentation: np.ndarray) -> np.ndarray:
    """Objects are counted as `truth` does: those that can be seen, in the scene's order."""
    number_of_geom = np.zeros(scene.model.ngeom + 1, int)
    for i, placed in enumerate(scene.objects, 1):
        number_of_geom[placed.geoms] = i
    in_scene = number_of_geom[segmentation]
    shown = np.bincount(in_scene.ravel(), minlength=len(scene.objects) + 1)[1:] > 0
    return np.array([0, *np.cumsum(shown)], np.uint8)[in_scene]


def _start() -> None:
    """In every process: it has one core, so one thread will do, and an interrupt is its parent's affair."""
    cv2.setNumThreads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
