"""What an ONNX file says of itself: its inputs and its metadata.

The file is one protobuf message. The few fields needed are read by their numbers in onnx.proto, without a library.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from arm5dof.errors import UserError

MODEL_GRAPH, MODEL_METADATA = 7, 14
GRAPH_NODE, GRAPH_INITIALIZER, GRAPH_INPUT = 1, 5, 11
NODE_TEXTS, NODE_ATTRIBUTE, ATTRIBUTE_NAME, ATTRIBUTE_TENSOR = (1, 2, 3, 4, 7), 5, 1, 5
TENSOR_DIMS, TENSOR_TYPE, TENSOR_NAME, TENSOR_RAW = 1, 2, 8, 9
BYTES_OF = {1: 4, 2: 1, 3: 1, 4: 2, 5: 2, 6: 4, 7: 8, 9: 1, 10: 2, 11: 8, 12: 4, 13: 8, 16: 2}
"""Of one number of a tensor, by its type."""
VALUE_NAME, VALUE_TYPE = 1, 2
TYPE_TENSOR, TENSOR_KIND, TENSOR_SHAPE, SHAPE_DIM, DIM_VALUE = 1, 1, 2, 1, 1
ENTRY_KEY, ENTRY_VALUE = 1, 2

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
"""Protobuf's wire types."""

MAX_LENGTH = 2**31
"""Of a dimension; a negative number, which leaves it open, is a number of 64 bits without its sign."""


@dataclass(frozen=True)
class Input:
    """A tensor that a network takes."""

    shape: tuple[int | None, ...] | None
    """None where the file leaves a length open, or even how many there are."""
    kind: int
    """Of its numbers, as onnx.proto counts them: 1 is float32, 10 float16."""


@dataclass(frozen=True)
class Description:
    """What an ONNX file says of its network."""

    inputs: tuple[Input, ...]
    metadata: dict[str, str]
    """What its exporter wrote, such as the names of the classes."""


def describe(path: Path) -> Description:
    """Read an ONNX file's description.

    Raises:
        UserError: There is no such file, or it is damaged.
    """
    if not path.is_file():
        raise UserError(f"no file {path}: give an ONNX file")
    try:
        return _model(memoryview(path.read_bytes()))
    except (ValueError, IndexError) as error:
        raise UserError(f"{path} is not an ONNX file, or is damaged ({error}): export or download it again") from None


def _model(message: memoryview) -> Description:
    graphs = _submessages(message, MODEL_GRAPH)
    if len(graphs) != 1:
        raise ValueError("it holds no network")
    constants = {_text(tensor, TENSOR_NAME) for tensor in _submessages(graphs[0], GRAPH_INITIALIZER)}
    # Old files list their weights among the inputs too.
    inputs = [v for v in _submessages(graphs[0], GRAPH_INPUT) if _text(v, VALUE_NAME) not in constants]
    _check_for_opencv(graphs[0])
    entries = _submessages(message, MODEL_METADATA)
    return Description(
        tuple(_input(value) for value in inputs), {_text(e, ENTRY_KEY): _text(e, ENTRY_VALUE) for e in entries}
    )


def _check_for_opencv(graph: memoryview) -> None:
    """Raise `ValueError` for what would not be an error in OpenCV but the end of the process: names that are no text,
    with which it tells of errors, and tensors of other sizes than their shapes."""
    tensors = list(_submessages(graph, GRAPH_INITIALIZER))
    for node in _submessages(graph, GRAPH_NODE):
        attributes = _submessages(node, NODE_ATTRIBUTE)
        names = [name for number in NODE_TEXTS for name in _submessages(node, number)]
        for name in (*names, *(name for a in attributes for name in _submessages(a, ATTRIBUTE_NAME))):
            bytes(name).decode()
        tensors += [tensor for a in attributes for tensor in _submessages(a, ATTRIBUTE_TENSOR)]
    for tensor in tensors:
        shape, kinds, raw = _dims(tensor), _numbers(tensor, TENSOR_TYPE), _submessages(tensor, TENSOR_RAW)
        size = math.prod(shape) * BYTES_OF.get(kinds[-1] if kinds else 0, 0)
        if any(n >= MAX_LENGTH for n in shape) or (raw and size and size != len(raw[-1])):
            raise ValueError(f"the tensor {_text(tensor, TENSOR_NAME)!r} is not as large as its shape")


def _dims(tensor: memoryview) -> list[int]:
    """A tensor's shape: a field for each length, or all in one."""
    shape = _numbers(tensor, TENSOR_DIMS)
    for packed in _submessages(tensor, TENSOR_DIMS):
        at = 0
        while at < len(packed):
            length, at = _varint(packed, at)
            shape.append(length)
    return shape


def _input(value: memoryview) -> Input:
    for number in (VALUE_TYPE, TYPE_TENSOR):
        found = _submessages(value, number)
        if len(found) != 1:
            raise ValueError("an input is no tensor")
        value = found[0]
    kinds, shapes = _numbers(value, TENSOR_KIND), _submessages(value, TENSOR_SHAPE)
    lengths = [_numbers(dim, DIM_VALUE) for shape in shapes[:1] for dim in _submessages(shape, SHAPE_DIM)]
    shape = tuple(n[0] if n and 0 < n[0] < MAX_LENGTH else None for n in lengths)
    return Input(shape if shapes else None, kinds[0] if kinds else 0)


def _text(message: memoryview, number: int) -> str:
    found = _submessages(message, number)
    return bytes(found[0]).decode() if found else ""


def _numbers(message: memoryview, number: int) -> list[int]:
    """Every field of that number that is a number."""
    return [value for n, value in _fields(message) if n == number and isinstance(value, int)]


def _submessages(message: memoryview, number: int) -> list[memoryview]:
    """Every field of that number that is bytes: a message or a text."""
    return [value for n, value in _fields(message) if n == number and isinstance(value, memoryview)]


def _fields(message: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Numbers and values of a message's fields."""
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        wire = key & 7
        if wire == VARINT:
            value, at = _varint(message, at)
            yield key >> 3, value
            continue
        if wire == BYTES:
            length, at = _varint(message, at)
        elif wire in (FIXED32, FIXED64):
            length = 4 if wire == FIXED32 else 8
        else:
            raise ValueError(f"byte {at} begins no field")
        if at + length > len(message):
            raise ValueError("it is cut short")
        yield key >> 3, message[at : at + length]
        at += length


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    """A number in seven-bit pieces, and where it ends."""
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(message):
            raise ValueError("it is cut short")
        byte = message[at]
        at += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, at
    raise ValueError(f"byte {at} begins no number")
