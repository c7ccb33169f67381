"""Writes PyTorch's `.pt` files by hand, byte by byte: without PyTorch, and with faults that it would not write."""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

STORAGES = {"float16": "HalfStorage", "float32": "FloatStorage", "float64": "DoubleStorage", "int64": "LongStorage"}


class Raw(bytes):
    """Opcodes, written as they are."""


class Shell:
    """An object of some class with a state."""

    def __init__(self, kind: str, **state: Any) -> None:
        self.kind, self.state = kind, state


class Writer:
    """A pickle, and the storages it speaks of."""

    def __init__(self) -> None:
        self.records: dict[str, bytes] = {}

    def write(self, value: Any) -> bytes:
        """The opcodes that build a value."""
        match value:
            case Raw():
                return value
            case None:
                return b"N"
            case bool():
                return b"\x88" if value else b"\x89"
            case int():
                return b"\x8a\x08" + struct.pack("<q", value)
            case float():
                return b"G" + struct.pack(">d", value)
            case str():
                return b"X" + struct.pack("<I", len(value.encode())) + value.encode()
            case tuple():
                return b"(" + b"".join(map(self.write, value)) + b"t"
            case list():
                return b"](" + b"".join(map(self.write, value)) + b"e"
            case dict():
                return b"}(" + b"".join(self.write(x) for item in value.items() for x in item) + b"u"
            case Shell():
                return named(*value.kind.rsplit(".", 1)) + b")\x81" + self.write(value.state) + b"b"
            case np.ndarray():
                steps = tuple(step // value.itemsize for step in value.strides)
                return self.tensor(value, 0, value.shape, steps)
        raise TypeError(type(value))

    def tensor(self, numbers: np.ndarray, offset: Any, size: Any, stride: Any, numel: int | None = None) -> Raw:
        """A tensor that looks at the numbers in some way."""
        key = str(len(self.records))
        self.records[key] = numbers.tobytes()
        kind = Raw(named("torch", STORAGES[numbers.dtype.name]))
        pid = self.write(("storage", kind, key, "cpu", numbers.size if numel is None else numel)) + b"Q"
        hooks = Raw(named("collections", "OrderedDict") + b")R")
        arguments = self.write((Raw(pid), offset, size, stride, False, hooks))
        return Raw(named("torch._utils", "_rebuild_tensor_v2") + arguments + b"R")


def named(module: str, name: str) -> Raw:
    return Raw(b"c" + f"{module}\n{name}\n".encode())


def save(path: Path, value: Any, writer: Writer | None = None, compression: int = zipfile.ZIP_STORED) -> Path:
    """Write a file as PyTorch does."""
    writer = writer or Writer()
    text = b"\x80\x02" + writer.write(value) + b"."
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr("archive/data.pkl", text)
        for key, content in writer.records.items():
            archive.writestr(f"archive/data/{key}", content)
    return path
