"""Networks in ONNX files, run by OpenCV, or by ONNX Runtime where that is installed and asked for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from arm5dof.errors import UserError
from arm5dof.vision.opencv import quiet

Run = Callable[[np.ndarray], list[np.ndarray]]
"""Takes an input (1, 3, h, w), float32; returns the outputs. Raises `UserError` where the network cannot take it."""


def open_network(path: Path, onnxruntime: bool = False) -> Run:
    """Make a network ready to run.

    Args:
        path: The file.
        onnxruntime: Run it by ONNX Runtime on the CPU.

    Raises:
        UserError: The network cannot be read, or ONNX Runtime is not installed.
    """
    return _by_onnxruntime(path) if onnxruntime else _by_opencv(path)


def _by_opencv(path: Path) -> Run:
    try:
        with quiet():
            network = cv2.dnn.readNetFromONNX(str(path))
            names = network.getUnconnectedOutLayersNames()
    except cv2.error as error:
        reason = _reason(error.err or error)
        raise UserError(
            f"OpenCV cannot read this network ({reason}): export it anew, or run it by ONNX Runtime"
        ) from None

    def run(blob: np.ndarray) -> list[np.ndarray]:
        try:
            with quiet():
                network.setInput(blob)
                return [np.asarray(x) for x in network.forward(names)]
        except cv2.error as error:
            raise _does_not_run(blob, error.err or error) from None

    return run


def _by_onnxruntime(path: Path) -> Run:
    try:
        import onnxruntime
    except ImportError as error:
        raise UserError(f"ONNX Runtime is not installed ({error}): pip install 'arm5dof[onnx]'") from None
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # Only what is fatal.
    # Its errors have no class in common but the one that all have.
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise UserError(f"ONNX Runtime cannot read it ({_reason(error)}): export it anew") from None
    taken = session.get_inputs()[0]
    dtype = np.float16 if taken.type == "tensor(float16)" else np.float32

    def run(blob: np.ndarray) -> list[np.ndarray]:
        try:
            return [np.asarray(x) for x in session.run(None, {taken.name: blob.astype(dtype)})]
        except Exception as error:
            raise _does_not_run(blob, error) from None

    return run


def _does_not_run(blob: np.ndarray, error: object) -> UserError:
    height, width = blob.shape[2:]
    return UserError(
        f"the network does not run at {width} x {height} pixels ({_reason(error)}): give the size that it was "
        "exported for"
    )


def _reason(error: object) -> str:
    """A library's own words, without further lines."""
    return (str(error).strip().splitlines() or ["no reason given"])[0][:200]
