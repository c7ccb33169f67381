"""Boxes and names drawn into images, for people."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from arm5dof.vision.detections import Detections

PALETTE = ((230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66), (0, 114, 178), (213, 94, 0), (204, 121, 167))
"""RGB. Okabe and Ito's colours, which people with any colour vision tell apart; the classes take turns."""

BLACK, WHITE = (0, 0, 0), (255, 255, 255)


def annotate(image: np.ndarray, detections: Detections, labels: Sequence[str] | None = None) -> np.ndarray:
    """Draw boxes and labels, the most confident on top.

    Args:
        image: RGB uint8, (h, w, 3).
        detections: The boxes; they may lie outside the image.
        labels: One for each box; without them, its class and confidence.

    Returns:
        A new image of the same kind.
    """
    if labels is None:
        each = zip(detections.data["class_name"], detections.confidence, strict=True)
        labels = [f"{name} {confidence:.2f}" for name, confidence in each]
    image = np.ascontiguousarray(image).copy()
    height, width = image.shape[:2]
    line = max(1, round(max(height, width) / 400))
    for one, label in reversed(list(zip(detections, labels, strict=True))):
        colour = PALETTE[int(one.class_id[0]) % len(PALETTE)]
        # Edges outside the image stay outside, at numbers that OpenCV can take.
        left, top, right, bottom = (
            int(v) for v in np.round(np.clip(one.xyxy[0], -9 * line, max(image.shape) + 9 * line))
        )
        if left < width and top < height and right > 0 and bottom > 0:
            # The rim keeps a box in sight before what is of its own colour.
            for edge, thickness in ((ink(colour), line + 2), (colour, line)):
                cv2.rectangle(image, (left, top), (right - 1, bottom - 1), edge, thickness)
            _label(image, label, (left, top), colour, line)
    return image


def ink(colour: tuple[int, int, int]) -> tuple[int, int, int]:
    """Black or white, whichever stands out more against an RGB colour by WCAG 2's contrast."""
    share = np.array(colour) / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return BLACK if float(linear @ [0.2126, 0.7152, 0.0722]) > 0.179 else WHITE


def _label(image: np.ndarray, text: str, corner: tuple[int, int], colour: tuple[int, int, int], line: int) -> None:
    """Text on a ground of its own above a box's corner, or below it where there is no room, moved into the image."""
    font, scale, weight = cv2.FONT_HERSHEY_SIMPLEX, max(0.5, max(image.shape) / 1300), max(1, line // 2)
    (width, height), below = cv2.getTextSize(text, font, scale, weight)
    width, height, below = width + 2 * line, height + line, below + line
    left = max(0, min(corner[0], image.shape[1] - width))
    bottom = max(corner[1], height + below)
    cv2.rectangle(image, (left, bottom - height - below), (left + width, bottom), colour, cv2.FILLED)
    cv2.putText(image, text, (left + line, bottom - below), font, scale, ink(colour), weight, cv2.LINE_AA)
