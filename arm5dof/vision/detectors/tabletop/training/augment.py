"""Changes to training images that leave their labels true."""

from __future__ import annotations

import cv2
import numpy as np

from arm5dof.vision.synthetic import textures


def augment_background(image: np.ndarray, instances: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Sometimes print shapes on everything that is none of the objects, shadows and all.

    Args:
        image: RGB uint8 (h, w, 3).
        instances: Which object a pixel shows, (h, w) uint8; 0 for none.
        rng: The generator.
    """
    if rng.random() < 0.75:
        return image
    height, width = instances.shape
    sheet = cv2.resize(textures.shapes(rng, 128), (width, height))
    printed = cv2.multiply(image, sheet, scale=rng.uniform(0.8, 1.6) / 255)
    return np.asarray(cv2.copyTo(image, (instances > 0).view(np.uint8), printed))


def augment_photometric(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """As if in other light and by another camera: brightness, contrast, tint, blur and noise, at random.

    Args:
        image: RGB uint8 (h, w, 3), contiguous.
        rng: The generator.
    """
    gain, gamma = np.exp(rng.normal(0, 0.15) + rng.normal(0, 0.06, 3)), np.exp(rng.normal(0, 0.12))
    curve = np.linspace(0, 1, 256)[:, None] ** gamma * gain
    image = np.asarray(cv2.LUT(image, (np.clip(curve * 255, 0, 255) + 0.5).astype(np.uint8)[None]))
    if rng.random() < 0.15:
        image = np.asarray(cv2.GaussianBlur(image, (5, 5), rng.uniform(0.3, 1.0)))
    if rng.random() < 0.5:
        cv2.setRNGSeed(int(rng.integers(1 << 31)))  # NumPy takes ten times as long.
        noise = cv2.randn(np.empty(image.shape, np.int8), np.zeros(3), np.full(3, rng.uniform(1, 6)))
        image = np.asarray(cv2.add(image, np.asarray(noise), dtype=cv2.CV_8U))
    return image
