"""Pictures of random scenes with what there is to find in them, drawn by all of the machine's cores."""

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
class Shot:
    """A picture of a scene."""

    picture: np.ndarray
    """RGB uint8 (h, w, 3)."""
    owner: np.ndarray
    """Which of the things in `truth` a pixel shows, counted from 1, (h, w) uint8; 0 for none."""
    truth: Truth
    camera: Camera


def shoot(number: int, seed: int, style: Style, back_end: BackEnd) -> Shot:
    """The picture of that number in a series. The same seed, style and back end give the same bits."""
    scene = random_scene((seed, number), style)
    camera = simulated_camera(scene.model, CAMERA, WIDTH, HEIGHT, back_end)
    segmentation = camera.segmentation(scene.data)
    seen = Camera.from_mujoco(scene.model, CAMERA, WIDTH, HEIGHT, scene.data)
    return Shot(camera.rgb(scene.data), _owner(scene, segmentation), truth(scene, segmentation), seen)


def shots(count: int, seed: int, style: Style, back_end: BackEnd, workers: int | None = None) -> Iterator[Shot]:
    """The first `count` pictures of a series, in order."""
    return in_order(partial(shoot, seed=seed, style=style, back_end=back_end), count, workers)


def in_order(function: Callable[[int], T], count: int, workers: int | None = None) -> Iterator[T]:
    """What a function makes of 0, 1, 2, ..., in as many processes as there are cores, or `workers`."""
    with multiprocessing.get_context("spawn").Pool(min(workers or xla.cores(), count), _start) as pool:
        yield from pool.imap(function, range(count), chunksize=4)


def _owner(scene: Scene, segmentation: np.ndarray) -> np.ndarray:
    """Things are counted as `truth` does: those that can be seen, in the scene's order."""
    thing = np.zeros(scene.model.ngeom + 1, int)
    for i, placed in enumerate(scene.things, 1):
        thing[placed.geoms] = i
    seen = thing[segmentation]
    number = np.cumsum(np.bincount(seen.ravel(), minlength=len(scene.things) + 1)[1:] > 0)
    return np.array([0, *number], np.uint8)[seen]


def _start() -> None:
    """In every process: it has one core, so one thread will do, and an interrupt is its parent's affair."""
    cv2.setNumThreads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
