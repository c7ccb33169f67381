"""The pictures that the detector learns from: drawn once into files, and each time changed in other ways.

What there is to find in one is read off a map of which pixel shows which thing. So it stays true when things of
other pictures are pasted into it (Ghiasi et al., 2021).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.detectors.tabletop.proposals import REDUCED
from arm5dof.vision.detectors.tabletop.training.assignment import Labels
from arm5dof.vision.synthetic import textures as patterns
from arm5dof.vision.synthetic.ground_truth import VISIBLE
from arm5dof.vision.synthetic.samples import HEIGHT, WIDTH, shots
from arm5dof.vision.synthetic.scenes import MOST_THINGS

WINDOW = 128
"""Width and height of what the proposer learns from, pixels of the reduced picture."""
PASTED = 4
"""The most things pasted into a window."""
MOST = MOST_THINGS + PASTED
ENLARGED = (0.75, 1.33)
"""How much windows are."""
WHOLE = 0.98
"""A thing of which so much can be seen can be pasted elsewhere."""


@dataclass(frozen=True, eq=False)
class TrainingSet:
    """Pictures of n scenes and the t things in them, scene after scene."""

    pictures: np.ndarray
    """RGB uint8 (n, h, w, 3)."""
    owners: np.ndarray
    """Which of its scene's things a pixel shows, counted from 1, (n, h, w) uint8; 0 for none."""
    scene: np.ndarray
    """In which picture each thing is, (t,) int."""
    boxes: np.ndarray
    """(t, 4) edges, pixels."""
    class_id: np.ndarray
    """(t,) int."""
    visible: np.ndarray
    """Which share of a thing can be seen, (t,)."""
    area: np.ndarray
    """What would be seen of it if nothing hid it, (t,), pixels."""

    def first(self, scene: int) -> int:
        """Number of the first thing in a scene."""
        return int(np.searchsorted(self.scene, scene))


def render(
    folder: Path, count: int, seed: int, progress: Callable[[int], None] = lambda done: None, workers: int | None = None
) -> TrainingSet:
    """Draw `count` scenes, in software, so that they are the same everywhere. Their pictures go into files in a folder,
    1.2 MB a scene, which the training set reads from."""
    pictures = np.lib.format.open_memmap(folder / "pictures.npy", "w+", np.uint8, (count, HEIGHT, WIDTH, 3))
    owners = np.lib.format.open_memmap(folder / "owners.npy", "w+", np.uint8, (count, HEIGHT, WIDTH))
    things: list[tuple[Any, ...]] = []
    for i, shot in enumerate(shots(count, seed, "training", "software", workers)):
        pictures[i], owners[i] = shot.picture, shot.owner
        seen = np.bincount(shot.owner.ravel(), minlength=len(shot.truth) + 1)[1:]
        things += zip([i] * len(seen), shot.truth.xyxy, shot.truth.class_id, shot.truth.visible, seen, strict=True)
        progress(i + 1)
    if not any(thing[3] >= VISIBLE for thing in things):
        raise UserError(f"nothing to find in any of {count} scenes: draw more")
    scene, boxes, class_id, visible, seen = (np.array(column) for column in zip(*things, strict=True))
    return TrainingSet(pictures, owners, scene, boxes, class_id, visible, seen / visible)


def batch(data: TrainingSet, seed: tuple[int, ...], size: int) -> tuple[tuple[np.ndarray], tuple[Labels]]:
    """Reduced windows (size, WINDOW, WINDOW, 3) uint8 and what there is to find in them. The same seed gives the same
    bits."""
    some = [_window(data, rng) for rng in np.random.default_rng(seed).spawn(size)]
    pictures, labels = zip(*some, strict=True)
    return (np.stack(pictures),), (Labels(*(np.stack(rows) for rows in zip(*labels, strict=True))),)


def _window(data: TrainingSet, rng: np.random.Generator) -> tuple[np.ndarray, Labels]:
    """Part of a picture, mostly with something in it, and with things of others pasted in, in other light."""
    scale = float(np.exp(rng.uniform(*np.log(ENLARGED)))) if rng.random() < 0.5 else 1.0
    side = round(WINDOW * WIDTH / REDUCED[0] / scale)
    if rng.random() < 0.8:
        thing = rng.integers(len(data.scene))
        scene, middle = int(data.scene[thing]), data.boxes[thing].reshape(2, 2).mean(0)
        corner = middle - side * rng.uniform(0.1, 0.9, 2)
    else:
        scene, corner = int(rng.integers(len(data.pictures))), rng.uniform(0, [WIDTH - side, HEIGHT - side])
    left, top = np.clip(corner, 0, [WIDTH - side, HEIGHT - side]).astype(int)
    part = np.s_[scene, top : top + side, left : left + side]
    picture, owner = data.pictures[part].copy(), data.owners[part].copy()
    area = list(data.area[data.first(scene) : data.first(scene + 1)])
    for _ in range(rng.integers(PASTED + 1)):
        _paste(data, rng, picture, owner, area)

    boxes, found, ignored = _labels(owner, area)
    picture = overprinted(picture, owner, rng)
    boxes = boxes * np.float32(WINDOW / side)
    picture = np.asarray(cv2.resize(picture, (WINDOW, WINDOW), interpolation=cv2.INTER_AREA))
    if rng.random() < 0.5:
        picture = np.flip(picture, 1)
        boxes[:, [0, 2]] = WINDOW - boxes[:, [2, 0]]
    return relit(np.ascontiguousarray(picture), rng), Labels(boxes, found, ignored)


def _paste(data: TrainingSet, rng: np.random.Generator, picture: np.ndarray, owner: np.ndarray, area: list) -> None:
    """Put a thing of any picture where there is none, mirrored, lighter or darker."""
    thing = rng.integers(len(data.scene))
    if data.visible[thing] < WHOLE:
        return
    scene, (left, top, right, bottom) = data.scene[thing], data.boxes[thing].astype(int)
    part = np.s_[scene, top:bottom, left:right]
    mask = data.owners[part] == thing - data.first(scene) + 1
    colours = np.clip(data.pictures[part] * rng.uniform(0.7, 1.3), 0, 255).astype(np.uint8)
    if rng.random() < 0.5:
        mask, colours = mask[:, ::-1], colours[:, ::-1]
    y, x = rng.integers(0, np.array(owner.shape) - mask.shape)
    place = np.s_[y : y + mask.shape[0], x : x + mask.shape[1]]
    if not owner[place].any():
        area.append(data.area[thing])
        picture[place][mask], owner[place][mask] = colours[mask], len(area)


def _labels(owner: np.ndarray, area: list) -> Labels:
    boxes, found, ignored = (
        np.tile(np.array([0, 0, 1, 1], np.float32), (MOST, 1)),
        np.zeros(MOST, bool),
        np.zeros(MOST, bool),
    )
    seen = np.bincount(owner.ravel(), minlength=len(area) + 1)[1:]
    for row, i in enumerate(np.flatnonzero(seen)):
        left, top, width, height = cv2.boundingRect((owner == i + 1).view(np.uint8))
        boxes[row] = left, top, left + width, top + height
        found[row] = seen[i] >= VISIBLE * area[i]
        ignored[row] = not found[row]
    return Labels(boxes, found, ignored)


def overprinted(picture: np.ndarray, owner: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Sometimes with shapes printed on everything that is none of the things, shadows and all."""
    if rng.random() < 0.75:
        return picture
    height, width = owner.shape
    sheet = cv2.resize(patterns.shapes(rng, 128), (width, height))
    printed = cv2.multiply(picture, sheet, scale=rng.uniform(0.8, 1.6) / 255)
    return np.asarray(cv2.copyTo(picture, (owner > 0).view(np.uint8), printed))


def relit(picture: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """In other light, by another camera: brightness, contrast, tint, blur and noise."""
    gain, gamma = np.exp(rng.normal(0, 0.15) + rng.normal(0, 0.06, 3)), np.exp(rng.normal(0, 0.12))
    curve = np.linspace(0, 1, 256)[:, None] ** gamma * gain
    picture = np.asarray(cv2.LUT(picture, (np.clip(curve * 255, 0, 255) + 0.5).astype(np.uint8)[None]))
    if rng.random() < 0.15:
        picture = np.asarray(cv2.GaussianBlur(picture, (5, 5), rng.uniform(0.3, 1.0)))
    if rng.random() < 0.5:
        cv2.setRNGSeed(int(rng.integers(1 << 31)))  # NumPy takes ten times as long.
        noise = cv2.randn(np.empty(picture.shape, np.int8), np.zeros(3), np.full(3, rng.uniform(1, 6)))
        picture = np.asarray(cv2.add(picture, np.asarray(noise), dtype=cv2.CV_8U))
    return picture
