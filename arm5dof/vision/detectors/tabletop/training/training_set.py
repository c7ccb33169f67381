"""`TrainingSet`: the images that the detector learns from, rendered once into files.

What there is to find in one is read off a map of which pixel shows which object. So it stays true when objects of other
images are pasted into it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.synthetic.ground_truth import VISIBLE
from arm5dof.vision.synthetic.samples import HEIGHT, WIDTH, render_samples


@dataclass(frozen=True, eq=False)
class TrainingSet:
    """Images of n scenes and the k objects in them, scene after scene."""

    images: np.ndarray
    """RGB uint8 (n, h, w, 3)."""
    instances: np.ndarray
    """Which of its scene's objects a pixel shows, counted from 1, (n, h, w) uint8; 0 for none."""
    scene: np.ndarray
    """In which image each object is, (k,) int, in ascending order."""
    boxes: np.ndarray
    """(k, 4) edges, pixels."""
    class_id: np.ndarray
    """(k,) int."""
    visible: np.ndarray
    """The share of an object that can be seen, (k,) in (0, 1]."""
    area: np.ndarray
    """What would be seen of it if nothing hid it, (k,), pixels."""

    def first(self, scene: int) -> int:
        """Index of the first object in a scene."""
        return int(np.searchsorted(self.scene, scene))


def render_training_set(
    folder: Path,
    count: int,
    seed: int,
    progress: Callable[[int], object] = lambda done: None,
    workers: int | None = None,
) -> TrainingSet:
    """Render random scenes, in software, so that they are the same everywhere.

    Args:
        folder: Takes their images, 1.2 MB a scene, which the training set reads from.
        count: Number of scenes.
        seed: Of the scenes.
        progress: Called with the number of scenes done.
        workers: Number of processes; None for one a core.

    Raises:
        UserError: There is no object in any of them.
    """
    images = np.lib.format.open_memmap(folder / "images.npy", "w+", np.uint8, (count, HEIGHT, WIDTH, 3))
    instances = np.lib.format.open_memmap(folder / "instances.npy", "w+", np.uint8, (count, HEIGHT, WIDTH))
    rows: list[tuple[Any, ...]] = []
    for i, sample in enumerate(render_samples(count, seed, "training", "software", workers)):
        images[i], instances[i] = sample.image, sample.instances
        truth = sample.truth
        pixels = np.bincount(sample.instances.ravel(), minlength=len(truth) + 1)[1:]
        rows += zip([i] * len(truth), truth.xyxy, truth.class_id, truth.visible, pixels, strict=True)
        progress(i + 1)
    if not any(visible >= VISIBLE for _, _, _, visible, _ in rows):
        raise UserError(f"nothing to find in any of {count} scenes: render more")
    scene, boxes, class_id, visible, pixels = (np.array(column) for column in zip(*rows, strict=True))
    return TrainingSet(images, instances, scene, boxes, class_id, visible, pixels / visible)
