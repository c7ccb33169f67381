"""What lies between the detector's two networks: crops of an image for the second, and boxes relative to them."""

from __future__ import annotations

import cv2
import numpy as np

from arm5dof.vision.detectors.tabletop.networks import CROP

CONTEXT = 1.75
"""How much wider a crop is than the larger side of the box in its middle."""
MIN_BOX_SIZE = 12.0
"""Boxes are taken to be at least so wide and high, pixels."""


def crop_squares(boxes: np.ndarray) -> np.ndarray:
    """Where to crop an image.

    Args:
        boxes: Edges (n, 4), pixels.

    Returns:
        Left, top, and width of a square around each, (n, 3), pixels, not rounded.
    """
    boxes = np.asarray(boxes, float).reshape(-1, 4)
    size = CONTEXT * np.maximum((boxes[:, 2:] - boxes[:, :2]).max(1), MIN_BOX_SIZE)
    return np.column_stack([(boxes[:, :2] + boxes[:, 2:]) / 2 - size[:, None] / 2, size])


def crop(image: np.ndarray, square: np.ndarray, interpolation: int = cv2.INTER_LINEAR) -> np.ndarray:
    """Cut a square out of an image and resize it. Beyond the image's border its last pixels are repeated.

    Args:
        image: uint8 (h, w) or (h, w, channels).
        square: Left, top, and width (3,), pixels.
        interpolation: OpenCV's flag.

    Returns:
        uint8 (CROP, CROP) or (CROP, CROP, channels).
    """
    left, top, size = square
    scale = size / CROP
    # OpenCV counts from the centers of pixels.
    to_image = np.array([[scale, 0, left + scale / 2 - 0.5], [0, scale, top + scale / 2 - 0.5]])
    flags = interpolation | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(image, to_image, (CROP, CROP), flags=flags, borderMode=cv2.BORDER_REPLICATE))


def boxes_to_image(relative: np.ndarray, squares: np.ndarray) -> np.ndarray:
    """Boxes (n, 4) relative to crops, 0 to 1 across each, in pixels of the image."""
    return np.tile(squares[:, :2], 2) + relative * squares[:, 2:]


def boxes_to_crop(boxes: np.ndarray, squares: np.ndarray) -> np.ndarray:
    """Boxes (n, 4) in pixels of the image, relative to crops, 0 to 1 across each."""
    return (boxes - np.tile(squares[:, :2], 2)) / squares[:, 2:]
