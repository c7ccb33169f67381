"""Camera files: YAML as OpenCV's calibration sample or ROS writes it, to which ours add the pose and the covariance."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from arm5dof.errors import UserError
from arm5dof.runtime import files
from arm5dof.vision.lens import LENSES, Lens

KNOWN_MODELS = {
    "fisheye_model": {"0": "pinhole", "1": "fisheye"},
    "distortion_model": {"plumb_bob": "pinhole", "rational_polynomial": "pinhole", "equidistant": "fisheye"},
}
"""Our names of lens models by what OpenCV's calibration sample says of them, and ROS."""

OTHER_MODELS = ("lens_model", "model_type", "projection_model", "xi")
"""What a file says only if its lens model is another: `xi` is the mirror of OpenCV's omnidirectional one."""


def read(path: Path, hand: np.ndarray | None = None) -> dict[str, Any]:
    """Read a camera file.

    Args:
        path: The file.
        hand: The hand's pose in the base frame, (4, 4), for a camera that was calibrated on the hand; its extrinsics
            are then those in the base frame at that moment.

    Returns:
        The fields of `Camera` by name; arrays are float64.

    Raises:
        UserError: The file is none such, holds impossible values, or has no pose on a hand although `hand` is given.
        OSError: It cannot be read.
    """
    values = _read_yaml(path)
    matrix = _array(path, values, "camera_matrix", (3, 3))
    distortion = _array(path, values, "distortion_coefficients", None)
    if (matrix[2] != (0, 0, 1)).any() or matrix[1, 0] or min(matrix[0, 0], matrix[1, 1]) <= 0:
        raise UserError(f"{path}: camera_matrix is not of the form [fx s cx; 0 fy cy; 0 0 1]")
    lens = _lens(path, values)
    if distortion.size not in LENSES[lens].counts:
        raise UserError(f"{path} has {distortion.size} distortion_coefficients: give {LENSES[lens].wanted}")
    width, height = (_positive_integer(path, values, name) for name in ("image_width", "image_height"))
    mount = "camera" if hand is None else "hand"
    has_extrinsics = f"{mount}_rotation" in values
    if hand is not None and not has_extrinsics:
        raise UserError(f"{path} has no hand_rotation: this camera was not calibrated on a hand")
    rotation = _array(path, values, f"{mount}_rotation", (3, 3)) if has_extrinsics else np.eye(3)
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-6 or np.linalg.det(rotation) < 0:
        raise UserError(f"{path}: {mount}_rotation is no rotation matrix")
    position = _array(path, values, f"{mount}_position", (3,)) if has_extrinsics else np.zeros(3)
    if hand is not None:
        rotation, position = hand[:3, :3] @ rotation, hand[:3, :3] @ position + hand[:3, 3]
    return {
        "matrix": matrix,
        "distortion": distortion,
        "rotation": rotation,
        "position": position,
        "width": width,
        "height": height,
        "has_extrinsics": has_extrinsics,
        "covariance": _covariance(path, values, 10 + distortion.size),
        "lens": lens,
    }


def model_notes(lens: Lens, coefficients: int) -> dict[str, Any]:
    """What says in a camera file which lens model it is, to OpenCV's calibration sample and to ROS."""
    if lens.name == "fisheye":
        return {"fisheye_model": 1, "distortion_model": "equidistant"}
    return {"fisheye_model": 0, "distortion_model": "plumb_bob" if coefficients <= 5 else "rational_polynomial"}


def write(path: Path, values: Mapping[str, Any]) -> None:
    """Write numbers, strings and arrays by name into a YAML file that OpenCV reads. The file appears whole or not."""
    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for name, value in values.items():
        storage.write(name, value)
    files.write_text(path, storage.releaseAndGetString())


def _read_yaml(path: Path) -> dict[str, Any]:
    """What is at the top level of one of OpenCV's or ROS's YAML files: numbers, strings and arrays by name."""
    try:
        text = path.read_text(encoding="utf-8")
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = storage.root()
        return {name: _value(root.getNode(name)) for name in root.keys()}  # noqa: SIM118
    except (cv2.error, UnicodeDecodeError, SystemError):
        raise UserError(f"{path} is no camera file: give a YAML file of OpenCV's or ROS's, or one of ours") from None


def _value(node: cv2.FileNode) -> Any:
    if node.isString():
        return node.string()
    if not node.isMap():
        return node.real()
    # FileNode.mat() writes beyond its memory where a matrix is not as large as it says, and ROS states no type for it.
    numbers, sizes = _items(node.getNode("data")), _items(node.getNode("sizes"))
    size = math.prod(n.real() for n in sizes or (node.getNode("rows"), node.getNode("cols")))
    if size != len(numbers) or not all(n.isReal() or n.isInt() for n in numbers):
        return None
    return np.array([n.real() for n in numbers])


def _items(node: cv2.FileNode) -> list[cv2.FileNode]:
    return [node.at(i) for i in range(node.size())] if node.isSeq() else []


def _lens(path: Path, values: dict[str, Any]) -> str:
    """The lens model of a camera file: OpenCV's usual one unless it says something else."""
    said = {name: _word(values[name]) for name in (*KNOWN_MODELS, *OTHER_MODELS) if _word(values.get(name, ""))}
    lenses = {KNOWN_MODELS.get(name, {}).get(word) for name, word in said.items()}
    if lenses <= {"pinhole"} or lenses == {"fisheye"}:
        return "fisheye" if "fisheye" in lenses else "pinhole"
    words = " and ".join(f"{name} {word}" for name, word in said.items())
    known = "; ".join(f"{name} {', '.join(words)}" for name, words in KNOWN_MODELS.items())
    raise UserError(f"{path} says {words}, which is no lens model that is known: calibrate with one that is ({known})")


def _word(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _array(path: Path, values: dict[str, Any], name: str, shape: tuple[int, ...] | None) -> np.ndarray:
    value = values.get(name)
    if not isinstance(value, np.ndarray) or (shape is not None and value.size != np.prod(shape)):
        raise UserError(f"{path} has no {name} of the right size: is it a camera file of OpenCV's?")
    if not np.isfinite(value).all():
        raise UserError(f"{path}: {name} is not finite")
    return value.astype(float).reshape(shape or -1)


def _positive_integer(path: Path, values: dict[str, Any], name: str) -> int:
    value = values.get(name)
    if not isinstance(value, float) or value < 1 or value != int(value):
        raise UserError(f"{path} has no {name}, a positive number of pixels: is it a camera file of OpenCV's?")
    return int(value)


def _covariance(path: Path, values: dict[str, Any], size: int) -> np.ndarray | None:
    if "camera_covariance" not in values:
        return None
    covariance = _array(path, values, "camera_covariance", (size, size))
    scale = np.sqrt(np.abs(np.diag(covariance)))
    scaled = covariance / np.maximum(np.outer(scale, scale), 1e-30)
    if np.abs(scaled - scaled.T).max() > 1e-6 or np.linalg.eigvalsh(scaled)[0] < -1e-6:
        raise UserError(f"{path}: camera_covariance is no covariance matrix")
    return covariance
