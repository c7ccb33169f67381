"""What lies between the detector's two networks: pictures reduced for the one, boxes, and crops for the other."""

from __future__ import annotations

import cv2
import numpy as np

from arm5dof.vision.detectors.tabletop.networks import CROP

REDUCED = (320, 240)
"""Width and height of the picture that the proposer sees, pixels."""
CONTEXT = 1.75
"""How much wider a crop is than the larger side of the box that it is round."""
NARROWEST = 12.0
"""Boxes are taken to be at least so wide and high, pixels."""


def squares(boxes: np.ndarray) -> np.ndarray:
    """Where crops round boxes (n, 4) lie: left, top, and width, (n, 3), pixels."""
    boxes = np.asarray(boxes, float).reshape(-1, 4)
    size = CONTEXT * np.maximum((boxes[:, 2:] - boxes[:, :2]).max(1), NARROWEST)
    return np.column_stack([(boxes[:, :2] + boxes[:, 2:]) / 2 - size[:, None] / 2, size])


def crop(picture: np.ndarray, square: np.ndarray, between: int = cv2.INTER_LINEAR) -> np.ndarray:
    """That square of a picture, (CROP, CROP, 3) uint8. Beyond its edges it goes on as it ends."""
    left, top, size = square
    scale = size / CROP
    # OpenCV counts from the middles of pixels.
    place = np.array([[scale, 0, left + scale / 2 - 0.5], [0, scale, top + scale / 2 - 0.5]])
    how = between | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(picture, place, (CROP, CROP), flags=how, borderMode=cv2.BORDER_REPLICATE))


def to_picture(shares: np.ndarray, squares: np.ndarray) -> np.ndarray:
    """Boxes (n, 4) in shares of crops, in pixels of the picture."""
    return np.tile(squares[:, :2], 2) + shares * squares[:, 2:]


def to_crop(boxes: np.ndarray, squares: np.ndarray) -> np.ndarray:
    """The way back."""
    return (boxes - np.tile(squares[:, :2], 2)) / squares[:, 2:]


def overlap(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Intersection over union of boxes (n, 4) and (m, 4), (n, m)."""
    a, b = np.asarray(a, float)[:, None], np.asarray(b, float)[None]
    shared = np.maximum(np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2]), 0).prod(-1)
    one, other = ((x[..., 2:] - x[..., :2]).prod(-1) for x in (a, b))
    return shared / np.maximum(one + other - shared, 1e-6)
