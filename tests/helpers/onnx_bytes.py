"""Writes small ONNX files by hand: networks that look at an image and put out a constant."""

from __future__ import annotations

from pathlib import Path

import numpy as np

FLOAT, UINT8, INT64 = 1, 2, 7

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
    """One field of a protobuf message; negative numbers are 64 bits long there."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value % 2**64)
    value = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(value)) + value


def node(kind: str, inputs: list[str], output: str, attributes: bytes = b"") -> bytes:
    names = b"".join(field(1, name) for name in inputs)
    return field(1, names + field(2, output) + field(3, output) + field(4, kind) + attributes)


def tensor(name: str, array: np.ndarray) -> bytes:
    kind = INT64 if array.dtype == np.int64 else FLOAT
    dims = b"".join(field(1, n) for n in array.shape)
    return field(5, dims + field(2, kind) + field(8, name) + field(9, array.tobytes()))


def value(number: int, name: str, shape: tuple[int | str, ...] | None, kind: int = FLOAT) -> bytes:
    dims = b"".join(field(1, field(1, n) if isinstance(n, int) else field(2, n)) for n in shape or ())
    tensor_type = field(1, kind) + (b"" if shape is None else field(2, dims))
    return field(number, field(1, name) + field(2, field(1, tensor_type)))


def constant(
    path: Path,
    output: np.ndarray,
    shape: tuple[int | str, ...] | None = (1, 3, "height", "width"),
    metadata: dict[str, str] | None = None,
    masks: np.ndarray | None = None,
    kind: int = FLOAT,
) -> Path:
    """A network whose output is `output`, and a second one `masks`, whatever the image of `shape`."""
    graph = (
        node("GlobalAveragePool", ["images"], "pooled")
        + node("Reshape", ["pooled", "flat"], "row")
        + node("MatMul", ["row", "zero"], "nothing")
        + tensor("flat", np.array([1, 3], np.int64))
        + tensor("zero", np.zeros((3, 1), np.float32))
        + value(11, "images", shape, kind)
        + field(2, "constant")
    )
    for name, array in {"output": output, **({} if masks is None else {"masks": masks})}.items():
        graph += (
            node("Reshape", ["nothing", f"{name} one"], f"{name} none")
            + node("Add", [f"{name} none", f"{name} constant"], name)
            + tensor(f"{name} one", np.ones(array.ndim, np.int64))
            + tensor(f"{name} constant", array.astype(np.float32))
            + value(12, name, array.shape)
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
