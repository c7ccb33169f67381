"""Images: the one place where they enter, and the resizing that detectors want.

Everywhere else an image is RGB, uint8, (h, w, 3).
"""

from __future__ import annotations

import warnings
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.opencv import overheard

ORIENTATION_TAG = 0x0112
"""Of EXIF."""


class ImageError(UserError):
    """A file is no image that can be used. Of several files the others may be."""


GREY = 114
"""The borders of a letterboxed image, as YOLO networks were trained with."""


def read(path: str | Path, upright: bool = True) -> np.ndarray:
    """Read an image file.

    Args:
        path: A file of any format that OpenCV reads.
        upright: Turn it as its EXIF orientation tag says. Where a camera model is used, do not: that belongs to the
            sensor's pixels.

    Returns:
        RGB uint8 (h, w, 3).

    Raises:
        ImageError: There is no such file, it cannot be read, or it is damaged or no image.
    """
    path = Path(path)
    if not path.is_file():
        raise ImageError(f"no image {path}: give the path of an image file")
    orientation = 0 if upright else cv2.IMREAD_IGNORE_ORIENTATION
    pixels = decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | orientation)
    try:
        return rgb(pixels[..., ::-1])
    except UserError as error:
        raise ImageError(f"{path}: {error}") from None


def decode(path: Path, flags: int, wanted: str = "a JPEG or PNG file") -> np.ndarray:
    """Read an image file as OpenCV has it.

    Args:
        path: The file.
        flags: OpenCV's `IMREAD_...`.
        wanted: What to give instead of a file that is none.

    Returns:
        Its pixels.

    Warns:
        UserWarning: The library that reads JPEG found damage, and filled in what was missing.

    Raises:
        ImageError: It cannot be read, is no image, has more pixels than OpenCV reads, or is too damaged.
    """
    try:
        content = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise ImageError(f"{path} cannot be read: {error.strerror or error}") from None
    pixels = None
    with suppress(cv2.error), overheard() as said:
        pixels = cv2.imdecode(content, flags) if content.size else None
    if pixels is None:
        raise ImageError(f"{path} is empty, damaged, or no image that OpenCV reads: give {wanted}")
    if damage := [line for line in said if "Corrupt JPEG" in line]:
        warnings.warn(f"{path} may be damaged, look at it: {damage[0]}", stacklevel=3)
    return pixels


def check_some_usable(problems: Collection[str], files: int) -> None:
    """Raise `UserError` if there are problems, one a file, with all of so many files."""
    if problems and len(problems) == files:
        more = f"; and none of the {files - 1} others can be used" if files > 1 else ""
        raise UserError(f"{next(iter(problems))}{more}")


def has_orientation(path: str | Path) -> bool:
    """Whether an image file has an EXIF tag that says to turn or mirror it; not if it is no image."""
    from PIL import Image  # Takes its time to import.

    try:
        with Image.open(path) as image:
            return image.getexif().get(ORIENTATION_TAG, 1) in range(2, 9)
    except Exception:  # Whatever is wrong with it, who reads the image will say.
        return False


def rgb(array: np.ndarray) -> np.ndarray:
    """Convert an image to RGB uint8.

    Args:
        array: One of

            - grey (h, w) or (h, w, 1), which is repeated three times
            - RGB (h, w, 3); channels are never taken for BGR
            - RGBA (h, w, 4), whose alpha is dropped, whatever lies beneath

            as uint8; as uint16, which is divided by 257, so that the whole range becomes the whole range, and rounded;
            or as floating point in [0, 1], which is multiplied by 255 and rounded.

    Returns:
        RGB uint8 (h, w, 3), contiguous; the array itself if it is that already.

    Raises:
        UserError: It is anything else.
    """
    array = np.asarray(array)
    if array.ndim == 2:
        array = array[..., None]
    if array.ndim != 3 or array.shape[2] not in (1, 3, 4) or 0 in array.shape:
        raise UserError(f"an image has shape (h, w), (h, w, 1), (h, w, 3) or (h, w, 4) and is not empty: {array.shape}")
    array = array[..., :3]
    if array.dtype == np.uint16:
        array = ((array.astype(np.uint32) + 128) // 257).astype(np.uint8)
    elif np.issubdtype(array.dtype, np.floating):
        if not np.isfinite(array).all():
            raise UserError("the image holds values that are not finite (NaN or infinite): replace them")
        if array.min() < 0 or array.max() > 1:
            low, high = float(array.min()), float(array.max())
            raise UserError(f"a floating-point image lies in [0, 1], this one in [{low:g}, {high:g}]: scale it")
        array = np.round(array * 255).astype(np.uint8)
    elif array.dtype != np.uint8:
        raise UserError(f"an image is uint8, uint16 or floating point in [0, 1], not {array.dtype}: convert it")
    return np.ascontiguousarray(np.broadcast_to(array, (*array.shape[:2], 3)))


@dataclass(frozen=True, eq=False)
class Letterbox:
    """An image resized to fit a network's input, and the way back to its own pixels.

    Boxes are left, top, right and bottom edges (n, 4), pixels, where pixel i covers [i, i + 1).
    """

    image: np.ndarray
    """RGB uint8 (h, w, 3)."""
    source: tuple[int, int]
    """Width and height of the image that it was made from."""
    inner: tuple[int, int]
    """Width and height of that image inside this one."""
    offset: tuple[int, int]
    """Where it begins in this one: left, top."""

    def to_source(self, xyxy: np.ndarray) -> np.ndarray:
        """Boxes in this image, where they are in the source, clipped to its edges."""
        scale = np.array(self.inner) / np.array(self.source)
        boxes = (np.asarray(xyxy, float) - np.tile(self.offset, 2)) / np.tile(scale, 2)
        return np.clip(boxes, 0, np.tile(self.source, 2))


def letterbox(image: np.ndarray, size: tuple[int, int], stride: int | None = None) -> Letterbox:
    """Fit an image into a network's input, keeping its aspect ratio, between grey borders.

    Args:
        image: RGB uint8 (h, w, 3). It is not copied if it fits as it is.
        size: Width and height of the input, pixels.
        stride: With it the borders are only as wide as it takes to make width and height multiples of it, as YOLOv5
            does: fewer pixels to process, and another input shape for each aspect ratio. Without it they fill the
            whole of `size`.
    """
    height, width = image.shape[:2]
    scale = min(size[0] / width, size[1] / height)
    inner = (max(1, round(width * scale)), max(1, round(height * scale)))
    full = size if stride is None else (-(-inner[0] // stride) * stride, -(-inner[1] // stride) * stride)
    left, top = (full[0] - inner[0]) // 2, (full[1] - inner[1]) // 2
    if full == (width, height):
        return Letterbox(image, full, full, (0, 0))
    canvas = np.full((full[1], full[0], 3), GREY, np.uint8)
    resized = image if inner == (width, height) else cv2.resize(image, inner, interpolation=cv2.INTER_LINEAR)
    canvas[top : top + inner[1], left : left + inner[0]] = resized
    return Letterbox(canvas, (width, height), inner, (left, top))


def check_size(size: int, stride: int = 32) -> None:
    """Raise `UserError` unless a network of that stride can take a square image of `size` pixels."""
    if size < stride or size % stride:
        raise UserError(f"the input size must be a positive multiple of {stride}, got {size}")
