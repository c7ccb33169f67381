"""Writes small ONNX files by hand: networks that look at an image and put out a constant."""

from __future__ import annotations

from pathlib import Path

import numpy as np

FLOAT, INT64 = 1, 7

NAMES = ("cube", "ball")
SIZE = 64
"""Side of the image that `output` is for."""
STRIDES = (8, 16, 32)


def varint(n: int) -> bytes:
    out = bytearray()
    while n > 127:
        out.append(n & 127 | 128)
        n >>= 7
    return bytes(out) + bytes([n])


def field(number: int, value: int | str | bytes) -> bytes:
    """One field of a protobuf message."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    value = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(value)) + value


def node(kind: str, inputs: list[str], output: str, attributes: bytes = b"") -> bytes:
    names = b"".join(field(1, name) for name in inputs)
    return field(1, names + field(2, output) + field(3, output) + field(4, kind) + attributes)


def tensor(name: str, array: np.ndarray) -> bytes:
    kind = INT64 if array.dtype == np.int64 else FLOAT
    dims = b"".join(field(1, n) for n in array.shape)
    return field(5, dims + field(2, kind) + field(8, name) + field(9, array.tobytes()))


def value(number: int, name: str, shape: tuple[int | str, ...]) -> bytes:
    dims = b"".join(field(1, field(1, n) if isinstance(n, int) else field(2, n)) for n in shape)
    return field(number, field(1, name) + field(2, field(1, field(1, FLOAT) + field(2, dims))))


def constant(
    path: Path,
    output: np.ndarray,
    shape: tuple[int | str, ...] = (1, 3, "height", "width"),
    metadata: dict[str, str] | None = None,
) -> Path:
    """A network whose output is `output`, whatever the image of `shape`."""
    graph = (
        node("GlobalAveragePool", ["images"], "pooled")
        + node("Reshape", ["pooled", "flat"], "row")
        + node("MatMul", ["row", "zero"], "nothing")
        + node("Reshape", ["nothing", "one"], "none")
        + node("Add", ["none", "constant"], "output")
        + field(2, "constant")
        + tensor("flat", np.array([1, 3], np.int64))
        + tensor("zero", np.zeros((3, 1), np.float32))
        + tensor("one", np.ones(output.ndim, np.int64))
        + tensor("constant", output.astype(np.float32))
        + value(11, "images", shape)
        + value(12, "output", output.shape)
    )
    entries = b"".join(field(14, field(1, k) + field(2, v)) for k, v in (metadata or {}).items())
    path.write_bytes(field(1, 8) + field(7, graph) + field(8, field(1, "") + field(2, 13)) + entries)
    return path


def cells(anchors: int) -> np.ndarray:
    """Column, row and stride of every row of the output."""
    rows = []
    for stride in STRIDES:
        x, y = np.meshgrid(np.arange(SIZE // stride), np.arange(SIZE // stride))
        rows += [np.stack([x.ravel(), y.ravel(), np.full(x.size, stride)], axis=1)] * anchors
    return np.concatenate(rows).astype(float)


def output(kind: str, classes: int = 2) -> np.ndarray:
    """One box, centre (20, 28), 16 x 24 pixels, class "ball", in each network's own terms."""
    column, row, stride = cells(3 if kind == "yolov5" else 1).T
    centre = np.stack([(column + 0.5) * stride, (row + 0.5) * stride], axis=1)
    size = np.full_like(centre, 5)
    i = int(np.flatnonzero((column == 2) & (row == 3) & (stride == 8))[0])
    centre[i], size[i] = (20, 28), (16, 24)
    scores, objectness = np.zeros((len(centre), classes)), np.zeros((len(centre), 1))
    scores[i, 1], objectness[i] = 0.9, 0.8
    if kind == "yolov8":
        return np.concatenate([centre, size, scores], axis=1).T[None]
    if kind == "yolox":
        centre = centre / stride[:, None] - np.stack([column, row], axis=1)
        size = np.log(size / stride[:, None])
    return np.concatenate([centre, size, objectness, scores], axis=1)[None]
