"""Photographs of boards, drawn through a camera that is known."""

from __future__ import annotations

import functools
import struct
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from arm5dof.vision.calibration.charuco import Charuco
from arm5dof.vision.calibration.checkerboard import Checkerboard
from arm5dof.vision.camera import Camera

TRUE = Camera(
    matrix=np.array([[700, 0, 321.5], [0, 705, 236], [0, 0, 1.0]]),
    distortion=np.array([-0.2, 0.05, 1e-3, -5e-4, 0]),
    rotation=np.eye(3),
    position=np.zeros(3),
    width=640,
    height=480,
)

KNOWN = TRUE.replace(covariance=np.diag(np.square([0.5, 0.5, 0.5, 0.5, *[1e-3] * 5, *[0] * 6])))
"""How one knows it."""

BOARD = Checkerboard(8, 5, 0.03)

OVERSAMPLING = 2


@functools.cache
def rays() -> np.ndarray:
    """Where the true camera's pixels, and those between them, look on the plane at depth 1, (h, w, 2)."""
    u, v = (np.arange(OVERSAMPLING * n) for n in (TRUE.width, TRUE.height))
    pixels = (np.stack(np.meshgrid(u, v), -1) + 0.5) / OVERSAMPLING - 0.5
    plane = cv2.undistortPoints(pixels.reshape(-1, 1, 2), *TRUE.opencv)
    return plane.reshape(pixels.shape)


def photograph(drawing: np.ndarray, metres_per_pixel: float, origin: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """What the true camera sees of a drawing whose pixel `origin` is the board's origin, at the board's pose (4, 4)
    in the camera's frame."""
    homography = np.linalg.inv(np.c_[pose[:3, :2], pose[:3, 3]])
    place = rays() @ homography[:, :2].T + homography[:, 2]
    place = (place[..., :2] / place[..., 2:] / metres_per_pixel + origin).astype(np.float32)
    image = cv2.remap(drawing, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderValue=200)
    return cv2.resize(image, (TRUE.width, TRUE.height), interpolation=cv2.INTER_AREA)


def poses(rng: np.random.Generator, n: int, center: tuple[float, float], distance: float = 0.5) -> Iterator[np.ndarray]:
    """Board poses (4, 4) in front of the camera, tilted by up to 40 degrees."""
    for _ in range(n):
        turn, _ = cv2.Rodrigues(np.array([*rng.uniform(-0.7, 0.7, 2), rng.uniform(-1, 1)]))
        pose = np.eye(4)
        pose[:3, :3] = turn
        at = np.array([*rng.uniform(-0.06, 0.06, 2), distance * rng.uniform(0.9, 1.3)])
        pose[:3, 3] = at - turn @ [*center, 0]
        yield pose


def draw(board: Checkerboard | Charuco) -> tuple[np.ndarray, float, np.ndarray]:
    """A drawing, its metres per pixel, and the pixel of the board's origin."""
    scale = 24
    if isinstance(board, Charuco):
        image = board.opencv.generateImage((scale * board.columns, scale * board.rows), marginSize=0)
        return image, board.square / scale, np.array([scale - 0.5, scale - 0.5])
    squares = np.indices((board.rows + 1, board.columns + 1)).sum(0) % 2 * 255
    image = np.pad(np.kron(squares, np.ones((scale, scale))).astype(np.uint8), scale, constant_values=255)
    return image, board.square / scale, np.array([2 * scale - 0.5, 2 * scale - 0.5])


def matrix(rotation: Rotation, position: Sequence[float]) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.as_matrix(), position
    return pose


def vast_png(bits: int = 8) -> bytes:
    """A PNG file whose header tells of 40000 x 40000 pixels, more than OpenCV reads."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", 40000, 40000, bits, 0, 0, 0, 0)
    parts = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(100))) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + parts


CAMERA = matrix(Rotation.from_euler("xyz", [0.4, -0.3, 1.1]), [0.05, -0.02, 0.04])
"""On the hand, or beside the arm."""

OTHER = matrix(Rotation.from_euler("xyz", [0.2, 0.1, -0.5]), [0.3, 0.1, 0.02])
"""The board's pose, where it lies or in the hand."""


def photograph_board(folder: Path) -> tuple[list[Path], np.ndarray]:
    """Photographs of a board in a folder, and its poses (4, 4) in the camera's frame; the last shows none."""
    rng = np.random.default_rng(3)
    seen = list(poses(rng, 10, (0.1, 0.06)))
    paths = [folder / f"{i}.png" for i in range(len(seen) + 1)]
    for path, pose in zip(paths, seen, strict=False):
        cv2.imwrite(str(path), photograph(*draw(BOARD), pose))
    cv2.imwrite(str(paths[-1]), np.full((480, 640), 128, np.uint8))
    return paths, np.array([*seen, seen[0]])


def hand_poses(seen: np.ndarray, eye_in_hand: bool) -> np.ndarray:
    """The hand's poses (n, 4, 4) at which the camera sees the board so."""
    return OTHER @ np.linalg.inv(CAMERA @ seen) if eye_in_hand else CAMERA @ seen @ np.linalg.inv(OTHER)


def write_poses(path: Path, arm: np.ndarray, names: Sequence[str]) -> Path:
    """A CSV file of the hand's poses (n, 4, 4) and photographs."""
    turns = np.roll(Rotation.from_matrix(arm[:, :3, :3]).as_quat(), 1, axis=1)
    rows = [",".join(map(str, [n, *a[:3, 3], *q])) for n, a, q in zip(names, arm, turns, strict=True)]
    path.write_text("\n".join(["image,x,y,z,qw,qx,qy,qz", *rows]))
    return path
