"""Axis-aligned boxes: overlap, suppression and conversions.

Unless a name says otherwise a box is `xyxy`: left, top, right and bottom edges, (..., 4), in pixels, where pixel i
covers [i, i + 1).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np


def iou(a: Any, b: Any) -> Any:
    """Intersection over union, 0 for boxes that do not meet.

    JAX arrays can be traced and differentiated; NumPy arrays are calculated with in float64.

    Args:
        a: Boxes (..., 4).
        b: Boxes (..., 4) that broadcast with them: `iou(a[:, None], b)` is every one with every other, (n, m).

    Returns:
        (...) in [0, 1].
    """
    xp, intersection, union, _ = _areas(a, b)
    return intersection / xp.maximum(union, 1e-6)


def giou(a: Any, b: Any) -> Any:
    """Generalized intersection over union (Rezatofighi et al., 2019): less by the share of the smallest box around both
    that neither covers, so that it says how far apart boxes are that do not meet.

    Args:
        a: Boxes (..., 4), NumPy or JAX arrays as for `iou`.
        b: Boxes (..., 4) that broadcast with them.

    Returns:
        (...) in (-1, 1].
    """
    xp, intersection, union, hull = _areas(a, b)
    return intersection / xp.maximum(union, 1e-6) - (hull - union) / xp.maximum(hull, 1e-6)


def nms(xyxy: np.ndarray, scores: np.ndarray, iou: float, group: np.ndarray | None = None) -> np.ndarray:
    """Non-maximum suppression: of the boxes of a group that overlap by more than a threshold the best stays.

    Args:
        xyxy: Boxes (n, 4).
        scores: (n,).
        iou: The threshold, in [0, 1].
        group: (n,) int, such as classes; without it all boxes are of one group.

    Returns:
        Indices of the boxes that stay, (k,) int, the highest score first.
    """
    if not len(xyxy):
        return np.empty(0, int)
    # OpenCV moves groups apart by the largest coordinate, which is far enough only if none is negative.
    corner = xyxy[:, :2] - xyxy[:, :2].min(0, initial=0)
    xywh = np.concatenate([corner, xyxy[:, 2:] - xyxy[:, :2]], axis=1)
    group = np.zeros(len(xyxy), int) if group is None else group
    return np.asarray(cv2.dnn.NMSBoxesBatched(xywh.tolist(), scores.tolist(), group.tolist(), 0.0, iou), int)


def from_center_size(cxcywh: np.ndarray) -> np.ndarray:
    """Boxes (n, 4) given by the x and y of their centers, width and height."""
    return np.concatenate([cxcywh[:, :2] - cxcywh[:, 2:] / 2, cxcywh[:, :2] + cxcywh[:, 2:] / 2], axis=1)


def mirror(xyxy: np.ndarray, width: float) -> np.ndarray:
    """Boxes (..., 4) in the mirror image, left and right exchanged, of an image so wide."""
    mirrored = xyxy.copy()
    mirrored[..., [0, 2]] = width - xyxy[..., [2, 0]]
    return mirrored


def around_mask(mask: np.ndarray) -> tuple[int, int, int, int]:
    """The smallest box around what a mask (h, w), bool, marks; all zeros if that is nothing."""
    left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
    return left, top, left + width, top + height


def _areas(a: Any, b: Any) -> tuple[Any, Any, Any, Any]:
    """The module, `numpy` or `jax.numpy`, and the areas of the intersection, the union, and the box around both."""
    traced = [x for x in (a, b) if hasattr(x, "__array_namespace__") and not isinstance(x, np.ndarray)]
    xp = traced[0].__array_namespace__() if traced else np
    if not traced:
        a, b = np.asarray(a, float), np.asarray(b, float)
    low, high = xp.maximum(a[..., :2], b[..., :2]), xp.minimum(a[..., 2:], b[..., 2:])
    intersection = xp.maximum(high - low, 0).prod(-1)
    outer = xp.maximum(a[..., 2:], b[..., 2:]) - xp.minimum(a[..., :2], b[..., :2])
    area_a, area_b = (xp.maximum(x[..., 2:] - x[..., :2], 0).prod(-1) for x in (a, b))
    return xp, intersection, area_a + area_b - intersection, outer.prod(-1)
