"""What the proposer learns from: windows of the training images, into which objects of others are pasted (Ghiasi et
al., 2021)."""

from __future__ import annotations

import cv2
import numpy as np

from arm5dof.vision.boxes import around_mask, mirror
from arm5dof.vision.detectors.tabletop.detector import PROPOSER_SIZE
from arm5dof.vision.detectors.tabletop.training.assignment import Labels
from arm5dof.vision.detectors.tabletop.training.augment import augment_background, augment_photometric
from arm5dof.vision.detectors.tabletop.training.training_set import TrainingSet
from arm5dof.vision.synthetic.ground_truth import VISIBLE
from arm5dof.vision.synthetic.samples import HEIGHT, WIDTH
from arm5dof.vision.synthetic.scenes import MAX_OBJECTS

WINDOW = 128
"""Width and height of a window, pixels of the image that the proposer sees."""
MAX_PASTED = 4
"""The most objects pasted into a window."""
ROWS = MAX_OBJECTS + MAX_PASTED
"""Of a window's labels."""
SCALES = (0.75, 1.33)
"""By how much windows are enlarged."""
WHOLE = 0.98
"""An object of which so much can be seen can be pasted elsewhere."""


def window_batch(data: TrainingSet, seed: tuple[int, ...], size: int) -> tuple[tuple[np.ndarray], tuple[Labels]]:
    """Draw a batch of windows. The same seed gives the same bits.

    Args:
        data: The images.
        seed: Of the batch.
        size: Number of windows.

    Returns:
        What the proposer is given: RGB uint8 (size, WINDOW, WINDOW, 3); and what there is to find in each window.
    """
    windows = [_window(data, rng) for rng in np.random.default_rng(seed).spawn(size)]
    images, labels = zip(*windows, strict=True)
    return (np.stack(images),), (Labels(*(np.stack(rows) for rows in zip(*labels, strict=True))),)


def _window(data: TrainingSet, rng: np.random.Generator) -> tuple[np.ndarray, Labels]:
    """Part of an image, mostly with an object in it, and with objects of others pasted in, in other light."""
    scale = float(np.exp(rng.uniform(*np.log(SCALES)))) if rng.random() < 0.5 else 1.0
    side = round(WINDOW * WIDTH / PROPOSER_SIZE[0] / scale)
    if rng.random() < 0.8:
        index = rng.integers(len(data.scene))
        scene, middle = int(data.scene[index]), data.boxes[index].reshape(2, 2).mean(0)
        corner = middle - side * rng.uniform(0.1, 0.9, 2)
    else:
        scene, corner = int(rng.integers(len(data.images))), rng.uniform(0, [WIDTH - side, HEIGHT - side])
    left, top = np.clip(corner, 0, [WIDTH - side, HEIGHT - side]).astype(int)
    part = np.s_[scene, top : top + side, left : left + side]
    image, instances = data.images[part].copy(), data.instances[part].copy()
    area = list(data.area[data.first(scene) : data.first(scene + 1)])
    for _ in range(rng.integers(MAX_PASTED + 1)):
        _paste(data, rng, image, instances, area)

    boxes, found, ignored = _labels(instances, area)
    image = augment_background(image, instances, rng)
    boxes = boxes * np.float32(WINDOW / side)
    image = np.asarray(cv2.resize(image, (WINDOW, WINDOW), interpolation=cv2.INTER_AREA))
    if rng.random() < 0.5:
        image, boxes = np.flip(image, 1), mirror(boxes, WINDOW)
    return augment_photometric(np.ascontiguousarray(image), rng), Labels(boxes, found, ignored)


def _paste(data: TrainingSet, rng: np.random.Generator, image: np.ndarray, instances: np.ndarray, area: list) -> None:
    """Put an object of any image where there is none, mirrored, lighter or darker; `area` gets its own appended."""
    index = rng.integers(len(data.scene))
    if data.visible[index] < WHOLE:
        return
    scene, (left, top, right, bottom) = data.scene[index], data.boxes[index].astype(int)
    part = np.s_[scene, top:bottom, left:right]
    mask = data.instances[part] == index - data.first(scene) + 1
    colors = np.clip(data.images[part] * rng.uniform(0.7, 1.3), 0, 255).astype(np.uint8)
    if rng.random() < 0.5:
        mask, colors = mask[:, ::-1], colors[:, ::-1]
    y, x = rng.integers(0, np.array(instances.shape) - mask.shape)
    place = np.s_[y : y + mask.shape[0], x : x + mask.shape[1]]
    if not instances[place].any():
        area.append(data.area[index])
        image[place][mask], instances[place][mask] = colors[mask], len(area)


def _labels(instances: np.ndarray, area: list) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The rows of `Labels` for what a map of instances shows of objects of so many pixels each."""
    boxes = np.tile(np.array([0, 0, 1, 1], np.float32), (ROWS, 1))
    found, ignored = np.zeros(ROWS, bool), np.zeros(ROWS, bool)
    pixels = np.bincount(instances.ravel(), minlength=len(area) + 1)[1:]
    for row, i in enumerate(np.flatnonzero(pixels)):
        boxes[row] = around_mask(instances == i + 1)
        found[row] = pixels[i] >= VISIBLE * area[i]
        ignored[row] = not found[row]
    return boxes, found, ignored
