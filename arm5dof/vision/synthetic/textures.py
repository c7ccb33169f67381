"""Random textures for tables, floors, objects and paper: two families that have none in common.

Each takes a generator and a size and returns an image, RGB uint8 (size, size, 3).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np

Texture = Callable[[np.random.Generator, int], np.ndarray]


def random_color(rng: np.random.Generator, hue: float | None = None, vivid: float = 0.0) -> np.ndarray:
    """A color, RGB (3,) in [0, 1]: any, or of a `hue` in degrees, and no duller than `vivid` in [0, 1]."""
    if hue is None:
        hue, grey = rng.uniform(0, 360), rng.random() < 0.2 and not vivid
    else:
        hue, grey = (hue + rng.uniform(-10, 10)) % 360, False
    saturation = 0.05 if grey else rng.uniform(max(vivid, 0.1), 1)
    hsv = np.array([[[hue, saturation, rng.uniform(max(0.15, 0.8 * vivid), 1)]]], np.float32)
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB), float)[0, 0]


def checker(rng: np.random.Generator, size: int) -> np.ndarray:
    """A checkerboard."""
    i, j = np.mgrid[:size, :size] * int(rng.choice([2, 4, 8, 16])) // size
    return _between(rng, (i + j) % 2, contrast=rng.uniform(0.05, 1))


def clouds(rng: np.random.Generator, size: int) -> np.ndarray:
    """Smooth noise."""
    return _between(rng, _noise(rng, size), contrast=rng.uniform(0.1, 1))


def planks(rng: np.random.Generator, size: int) -> np.ndarray:
    """Boards with grain and seams."""
    boards = int(rng.choice([2, 4, 8]))
    tone = np.repeat(rng.random(boards), size // boards)[:, None]
    grain = cv2.resize(rng.random((size // 2, 4)).astype(np.float32), (size, size), interpolation=cv2.INTER_CUBIC)
    seam = (np.arange(size) % (size // boards) > 0)[:, None]
    return _between(rng, (0.6 * tone + 0.4 * grain) * seam, contrast=rng.uniform(0.1, 0.7))


def plain(rng: np.random.Generator, size: int) -> np.ndarray:
    """One color."""
    return _between(rng, np.zeros((size, size)), contrast=0.0)


def stripes(rng: np.random.Generator, size: int) -> np.ndarray:
    """Stripes, straight or wavy, sharp or soft."""
    i, j = np.mgrid[:size, :size] / size
    along = rng.integers(-8, 9) * i + rng.integers(1, 9) * j + rng.uniform(0, 0.5) * _noise(rng, size)
    share = 0.5 + 0.5 * np.sin(2 * np.pi * along)
    return _between(rng, share > rng.random() if rng.random() < 0.5 else share, contrast=rng.uniform(0.1, 1))


def dots(rng: np.random.Generator, size: int) -> np.ndarray:
    """Dots in rows, every other row shifted."""
    n, radius = int(rng.choice([3, 4, 6, 10, 16])), rng.uniform(0.15, 0.48)
    i, j = np.mgrid[:size, :size] * n / size
    return _between(rng, np.hypot((i + 0.5 * (np.floor(j) % 2)) % 1 - 0.5, j % 1 - 0.5) < radius, rng.uniform(0.1, 1))


def splinters(rng: np.random.Generator, size: int) -> np.ndarray:
    """Cells around random points, each of its own tone."""
    points = rng.random((int(rng.integers(6, 60)), 2)) * size
    i, j = np.mgrid[: size // 2, : size // 2] * 2 + 1
    apart = np.abs(np.stack([i, j], -1)[:, :, None] - points)
    nearest = (np.minimum(apart, size - apart) ** 2).sum(-1).argmin(-1)
    tone = rng.random(len(points))[nearest].astype(np.float32)
    tone = cv2.resize(tone, (size, size), interpolation=cv2.INTER_NEAREST)
    return _between(rng, tone, contrast=rng.uniform(0.1, 1))


def strokes(rng: np.random.Generator, size: int) -> np.ndarray:
    """Bent lines, one over the other."""
    share = np.full((size, size), rng.random(), np.float32)
    for _ in range(rng.integers(5, 60)):
        line = (rng.uniform(0, size, 2) + rng.normal(0, size / 8, (4, 2)).cumsum(0)).astype(np.int32)
        cv2.polylines(share, [line], False, rng.random(), int(rng.integers(1, 8)), cv2.LINE_AA)
    return _between(rng, share, contrast=rng.uniform(0.1, 1))


def tiles(rng: np.random.Generator, size: int) -> np.ndarray:
    """Tiles with joints, each of its own tone."""
    n, joint = int(rng.choice([2, 3, 5, 8])), int(rng.integers(1, 5))
    i, j = np.mgrid[:size, :size]
    grout = (i * n % size < joint * n) | (j * n % size < joint * n)
    tone = rng.random((n, n))[i * n // size, j * n // size]
    return _between(rng, np.where(grout, 1, 0.4 * tone), contrast=rng.uniform(0.1, 0.8))


def marble(rng: np.random.Generator, size: int) -> np.ndarray:
    """Veins."""
    i, j = np.mgrid[:size, :size] / size
    waves = rng.integers(1, 5, 2)
    veins = np.abs(np.sin(np.pi * (waves[0] * i + waves[1] * j + rng.uniform(0.5, 2) * _noise(rng, size))))
    return _between(rng, veins ** rng.uniform(0.3, 3), contrast=rng.uniform(0.1, 0.9))


def granite(rng: np.random.Generator, size: int) -> np.ndarray:
    """Grains."""
    grains = cv2.resize(rng.random((size // 2, size // 2)).astype(np.float32), (size, size))
    return _between(rng, grains > rng.uniform(0.5, 0.9), contrast=rng.uniform(0.1, 0.6))


def weave(rng: np.random.Generator, size: int) -> np.ndarray:
    """Woven threads."""
    i, j = np.mgrid[:size, :size] * 2 * np.pi * int(rng.choice([4, 8, 16, 32])) / size
    return _between(rng, 0.5 + 0.25 * (np.sin(i) + np.sin(j)) * np.sign(np.sin(i / 2) * np.sin(j / 2) + 1e-9))


def text(rng: np.random.Generator, size: int) -> np.ndarray:
    """Printed paper: lines of dark words on white, and sometimes a figure."""
    page = np.full((size, size), 1.0)
    line = int(rng.integers(size // 32, size // 10))
    for top in range(line, size - line, 2 * line):
        left = line
        while left < size - 2 * line:
            right = left + int(rng.integers(line, 6 * line))
            page[top : top + line, left : min(right, size - line)] = rng.uniform(0, 0.5)
            left = right + line
    if rng.random() < 0.4:
        center = tuple(int(v) for v in rng.integers(size // 4, 3 * size // 4, 2))
        cv2.circle(page, center, int(rng.integers(size // 10, size // 4)), rng.uniform(0, 0.6), -1)
    ink, paper = random_color(rng) * 0.4, np.full(3, rng.uniform(0.8, 1))
    return _mix(page, ink, paper)


def shapes(rng: np.random.Generator, size: int) -> np.ndarray:
    """Printed paper: shapes of many colors, full or in outline, on white."""
    page = np.full((size, size, 3), 255 * rng.uniform(0.8, 1))
    for _ in range(rng.integers(1, 12)):
        ink, middle = (255 * random_color(rng)).tolist(), rng.uniform(0, size, 2)
        width = -1 if rng.random() < 0.5 else int(rng.integers(1, 8))
        half, turned = rng.uniform(0.02, 0.25, 2) * size, rng.uniform(0, 360)
        if rng.random() < 0.4:
            half = half.max() if rng.random() < 0.5 else half
            axes = (int(v) for v in np.broadcast_to(half, 2))
            cv2.ellipse(page, middle.astype(int).tolist(), tuple(axes), turned, 0, 360, ink, width, cv2.LINE_AA)
        else:
            angles = np.deg2rad(turned) + 2 * np.pi * np.arange(sides := int(rng.integers(2, 7))) / sides
            corners = middle + half * np.stack([np.cos(angles), np.sin(angles)], -1)
            cv2.polylines(page, [corners.astype(np.int32)], True, ink, max(width, 1), cv2.LINE_AA)
            if width < 0:
                cv2.fillPoly(page, [corners.astype(np.int32)], ink, cv2.LINE_AA)
    return page.astype(np.uint8)


def target(rng: np.random.Generator, size: int) -> np.ndarray:
    """Printed paper: rings around a center."""
    i, j = np.mgrid[:size, :size] / size - rng.uniform(0.3, 0.7, (2, 1, 1))
    rings = np.sin(np.hypot(i, j) * rng.uniform(20, 90)) > rng.uniform(-0.7, 0.7)
    return _mix(rings, random_color(rng) * 0.4, np.full(3, rng.uniform(0.8, 1)))


def bars(rng: np.random.Generator, size: int) -> np.ndarray:
    """Printed paper: bars of many widths, or a square code."""
    cells = rng.random((1, 48) if rng.random() < 0.5 else (16, 16)) < 0.5
    code = cv2.resize(cells.astype(np.float32), (size, size), interpolation=cv2.INTER_NEAREST)
    margin = size // 10
    code[:margin] = code[-margin:] = code[:, :margin] = code[:, -margin:] = 1
    return _mix(code, random_color(rng) * 0.3, np.full(3, rng.uniform(0.8, 1)))


class Family(NamedTuple):
    """What surfaces look like, and what is printed on paper."""

    surfaces: tuple[Texture, ...]
    papers: tuple[Texture, ...]


TRAINING = Family((checker, clouds, planks, plain, stripes, dots, splinters, strokes), (text, checker, shapes, dots))
EVALUATION = Family((tiles, marble, granite, weave), (target, bars))


def _noise(rng: np.random.Generator, size: int) -> np.ndarray:
    """Smooth noise of five octaves, (size, size) in [0, 1]."""
    total = np.zeros((size, size), np.float32)
    roughness = rng.uniform(0.4, 0.8)
    for octave in range(1, 6):
        cells = rng.random((2**octave + 1, 2**octave + 1)).astype(np.float32)
        total += roughness**octave * cv2.resize(cells, (size, size), interpolation=cv2.INTER_CUBIC)
    total -= total.min()
    return total / total.max()


def _between(rng: np.random.Generator, share: np.ndarray, contrast: float = 1.0) -> np.ndarray:
    """A random color where `share` (size, size) is 0, and where it is 1 one that differs by `contrast`; both are
    duller than objects may be."""
    first, second = (0.7 * random_color(rng) + 0.3 * rng.uniform(0.2, 0.9) for _ in range(2))
    return _mix(share, first, first + contrast * (second - first))


def _mix(share: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    image = first + np.asarray(share, float)[..., None] * (second - first)
    return np.clip(np.round(image * 255), 0, 255).astype(np.uint8)
