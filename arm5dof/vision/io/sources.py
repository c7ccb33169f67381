"""Where images come from: photographs, folders of them, a video, a camera, or random scenes drawn for the purpose. One
after another, as frames."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Generator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision import images
from arm5dof.vision.frames import Frame
from arm5dof.vision.opencv import quiet

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")
"""What counts as a photograph in a folder; a file that is named may be called anything."""

DEFAULT_SCENES = 10
"""How many random scenes are drawn unless a number is given."""

DEFAULT_RATE = 30.0
"""Frames per second where a video or camera does not say."""

TEXT_CODEC = cv2.VideoWriter.fourcc(*"ansi")
"""What FFmpeg calls a text file, which it shows as if it were typed onto a screen."""

MAX_MISSING_S = 0.5
"""What may be missing at a video's end. What it states of its length is an estimate in some formats, and its sound may
be a little longer than its images."""


Frames = Generator[Frame, None, None]
"""To be closed, which lets go of the file or camera. Raises `UserError` where it cannot go on."""


@dataclass(frozen=True, eq=False)
class Source:
    """Frames, and what is known of them beforehand."""

    frames: Frames
    length: int | None
    """How many there will be, as far as that is known."""
    rate: float | None = None
    """Frames per second of a video or camera; None for images by themselves, which may be of many sizes."""
    live: bool = False
    """A camera: its frames come when they come, and it goes on until somebody stops it."""
    has_cameras: bool = False
    """Random scenes: each frame brings its camera, known exactly."""
    unread: list[str] = field(default_factory=list)
    """What is wrong with each photograph that was left out, among those that frames were taken from so far."""


def open_source(given: Sequence[str], upright: bool = True) -> Source:
    """Open what is named.

    Args:
        given: The number of a camera, `simulated` or `simulated:N` for random scenes, a video file, or any number of
            photographs and folders of them.
        upright: Turn photographs as their EXIF orientation tags say; not where a camera model is used.

    Returns:
        Its frames, and what is known of them beforehand.

    Raises:
        UserError: It is none of these, or several that do not go together.
    """
    if len(given) == 1 and re.fullmatch(r"\d{1,3}", given[0]):
        return camera(int(given[0]))
    if len(given) == 1 and (match := re.fullmatch(r"simulated(?::(\d{1,6}))?", given[0])):
        return simulated(int(match[1] or DEFAULT_SCENES))
    paths = [Path(text) for text in given]
    for path in paths:
        if not path.exists():
            raise UserError(f"no image, video or folder {str(path)!r}")
    videos = [path for path in paths if _is_video(path)]
    if videos and len(paths) > 1:
        raise UserError(f"{videos[0]} is no image: give one video by itself, or photographs and folders of them")
    return video(videos[0]) if videos else photographs(image_files(paths), upright)


def image_files(given: Sequence[Path]) -> list[Path]:
    """Find photographs.

    Args:
        given: Files and folders.

    Returns:
        The files, and those in the folders whose suffix is one of `IMAGE_SUFFIXES`, each once, in order.

    Raises:
        UserError: There is no such file or folder, or a folder holds no images.
    """
    found: dict[Path, None] = {}
    for path in given:
        if path.is_dir():
            inside = sorted(p for p in path.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file())
            if not inside:
                raise UserError(f"folder {path} holds no images ({', '.join(IMAGE_SUFFIXES)})")
            found.update(dict.fromkeys(inside))
        elif path.is_file():
            found[path] = None
        else:
            raise UserError(f"no image and no folder {str(path)!r}")
    return list(found)


def photographs(paths: Sequence[Path], upright: bool = True) -> Source:
    """Image files, one after another, turned as their EXIF orientation tags say if they are to be `upright`. One that
    is no image is left out and noted in `Source.unread`; the frames raise `UserError` if all are."""
    unread: list[str] = []

    def frames() -> Frames:
        for path in paths:
            try:
                image = images.read(path, upright)
            except images.ImageError as error:
                unread.append(str(error))
            else:
                yield Frame(str(path), image, turned=upright and images.has_orientation(path))
        images.check_some_usable(unread, len(paths))

    return Source(frames(), len(paths), unread=unread)


def video(path: Path) -> Source:
    """A video file. Raises `UserError` if it is none that FFmpeg reads; its frames do where it ends before its time."""
    with quiet():
        # FFmpeg takes what stands before a colon for a protocol, unless a slash comes first.
        capture = cv2.VideoCapture(str(path.absolute()), cv2.CAP_FFMPEG)
    if not capture.isOpened() or int(capture.get(cv2.CAP_PROP_FOURCC)) == TEXT_CODEC:
        raise UserError(f"{path} is empty, damaged, or no image or video that OpenCV reads: give an MP4 or AVI file")
    rate = _rate(capture)
    stated = max(0, round(capture.get(cv2.CAP_PROP_FRAME_COUNT)))

    def frames() -> Frames:
        end = 0.0
        try:
            while (image := _next(capture)) is not None:
                start = capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
                end = start + 1 / rate
                yield Frame(str(path), image, start)
        finally:
            capture.release()
        if end == 0:
            raise UserError(f"{path} is a video without a picture: it is damaged or cut short")
        if end < stated / rate - MAX_MISSING_S:
            raise UserError(f"{path} breaks off after {end:.1f} of {stated / rate:.1f} s: it is damaged or cut short")

    return Source(frames(), stated or None, rate)


def camera(index: int) -> Source:
    """A camera of this machine, counted from 0. Raises `UserError` if it cannot be opened; its frames do when it is
    taken away."""
    with quiet():
        capture = cv2.VideoCapture(index)
    if not capture.isOpened():
        raise UserError(f"no camera {index} can be opened: plug it in, close what else uses it, or give another number")

    def frames() -> Frames:
        first = None
        try:
            while (image := _next(capture)) is not None:
                now = time.monotonic()
                first = now if first is None else first
                yield Frame(f"camera{index}", image, now - first)
        finally:
            capture.release()
        raise UserError(f"camera {index} gives no picture{' any more' if first else ''}: was it unplugged or closed?")

    return Source(frames(), None, _rate(capture), live=True)


def simulated(count: int) -> Source:
    """The first `count` random scenes in the style of evaluation, 640 x 480. Raises `UserError` for none."""
    if count < 1:
        raise UserError(f"{count} scenes are none: ask for one or more")
    from arm5dof.vision.synthetic.samples import render_sample  # MuJoCo takes its time to import.

    names = (f"scene{number}.png" for number in range(count))
    samples = ((name, render_sample(number, 0, "evaluation", "auto")) for number, name in enumerate(names))
    return Source((Frame(name, one.image, camera=one.camera) for name, one in samples), count, has_cameras=True)


def read_depth(path: Path) -> np.ndarray:
    """Read a depth image as most depth cameras write it: one channel of 16 bits, in millimetres.

    Args:
        path: A PNG file.

    Returns:
        (h, w) float64, metres; zero where the depth is missing.

    Raises:
        ImageError: It cannot be read, is damaged, has more pixels than OpenCV reads, or is no such image.
    """
    wanted = "a PNG file with one channel of 16 bits, in millimetres"
    pixels = images.decode(path, cv2.IMREAD_UNCHANGED, wanted)
    if pixels.dtype != np.uint16 or pixels.ndim != 2:
        raise images.ImageError(f"{path} is no depth image: give {wanted}")
    return pixels / 1000


def _is_video(path: Path) -> bool:
    """Whether a file is to be read as a video: it neither is called an image nor begins like one."""
    return path.is_file() and path.suffix.lower() not in IMAGE_SUFFIXES and not cv2.haveImageReader(str(path))


def _rate(capture: cv2.VideoCapture) -> float:
    rate = capture.get(cv2.CAP_PROP_FPS)
    return rate if math.isfinite(rate) and rate > 0 else DEFAULT_RATE


def _next(capture: cv2.VideoCapture) -> np.ndarray | None:
    """The next frame, RGB uint8 (h, w, 3); None if there is none."""
    with quiet():
        found, image = capture.read()
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB) if found else None
