"""Damage to files that are no text: to their bytes, and to what is inside a format, so that readers get beyond their
first check. Functions are as those of `damage`."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Callable

import numpy as np
from values import WORDS, Rng, pick


def damaged_bytes(rng: Rng, content: bytes) -> bytes:
    """Bits flipped, cut short, blocks moved, repeated, overwritten or lost."""
    data = bytearray(content)
    if not data:
        return rng.bytes(int(rng.integers(1, 64)))
    at = lambda: int(rng.integers(len(data)))
    match int(rng.integers(9)):
        case 0:
            for _ in range(int(rng.integers(1, 9))):
                data[at()] ^= 1 << int(rng.integers(8))
        case 1:
            del data[at() :]
        case 2:
            start, length = at(), int(rng.integers(1, 65))
            del data[start : start + length]
        case 3:
            start, length = at(), int(rng.integers(1, 257))
            data[start:start] = data[start : start + length] * int(rng.integers(1, 5))
        case 4:
            a, b, length = at(), at(), int(rng.integers(1, 129))
            data[a : a + length], data[b : b + length] = data[b : b + length], data[a : a + length]
        case 5:
            values = (0, -1, 1, 2**31 - 1, -(2**31), 2**16, 255)
            number = struct.pack(pick(rng, ("<i", ">i")), pick(rng, values))
            start = at()
            data[start : start + 4] = number
        case 6:
            start, length = at(), int(rng.integers(1, 257))
            data[start : start + length] = bytes([pick(rng, (0, 255, 10, 128))]) * length
        case 7:
            data += rng.bytes(int(rng.integers(1, 300)))
        case _:
            start, length = at(), int(rng.integers(1, 65))
            data[start : start + length] = rng.bytes(length)
    return bytes(data)


def damaged_zip(rng: Rng, content: bytes, inside: Callable[[Rng, str, bytes], bytes]) -> bytes:
    """An archive, its checksums right, with a member that is damaged, lost, renamed or there twice."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = [(info, archive.read(info)) for info in archive.infolist()]
    i = int(rng.integers(len(members)))
    info, data = members[i]
    match int(rng.integers(6)):
        case 0:
            del members[i]
        case 1:
            renamed = zipfile.ZipInfo(pick(rng, [w for w in WORDS if w and w.isprintable() and len(w) < 999]))
            members[i] = renamed, data
        case 2:
            members.append((info, inside(rng, info.filename, data)))
        case _:
            members[i] = info, inside(rng, info.filename, data)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for info, data in members:
            archive.writestr(info.filename, data, info.compress_type)
    return buffer.getvalue()


def damaged_array(rng: Rng, name: str, content: bytes) -> bytes:
    """A `.npy` with other numbers, type or shape; or a pickle, which is what an object array is."""
    array = np.load(io.BytesIO(content), allow_pickle=False)
    match int(rng.integers(7)):
        case 0:
            array = (
                array.astype(pick(rng, ("f8", "f2", "i4", "U3", "c8", "?", "M8[s]", ">f4")), casting="unsafe")
                if array.dtype.kind == "f"
                else array[:0]
            )
        case 1:
            array = array.reshape(-1)[: int(rng.integers(array.size + 1))]
        case 2 if array.dtype.kind == "f" and array.size:
            array = array.copy()
            array.reshape(-1)[int(rng.integers(array.size))] = pick(rng, (np.nan, np.inf, 6e4, -6e4))
        case 3:
            array = array[None]
        case 4:
            return content.replace(
                b"'shape': (", pick(rng, (b"'shape': (9999999999, ", b"'shape': (-1, ", b"'shape': (0, ")), 1
            )
        case 5:
            return content.replace(b"'descr': '<", b"'descr': '|O", 1)
        case _:
            return damaged_bytes(rng, content)
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def damaged_png(rng: Rng, content: bytes) -> bytes:
    """A PNG of another stated size, depth or kind, or with a chunk lost, doubled or damaged, its checksums right."""
    chunks, at = [], 8
    while at + 12 <= len(content):
        length = struct.unpack(">I", content[at : at + 4])[0]
        chunks.append((content[at + 4 : at + 8], content[at + 8 : at + 8 + length]))
        at += 12 + length
    i = int(rng.integers(len(chunks)))
    kind, data = chunks[i]
    match int(rng.integers(4)):
        case 0:
            header = bytearray(chunks[0][1])
            where = int(rng.integers(5))
            if where < 2:
                header[4 * where : 4 * where + 4] = struct.pack(
                    ">I", pick(rng, (0, 1, 65_535, 2**20, 2**31 - 1, 2**32 - 1))
                )
            else:
                header[6 + where] = pick(rng, (0, 1, 2, 3, 4, 6, 16, 255))
            chunks[0] = chunks[0][0], bytes(header)
        case 1:
            del chunks[i]
        case 2:
            chunks.insert(int(rng.integers(len(chunks))), chunks[i])
        case _:
            chunks[i] = kind, damaged_bytes(rng, data)
    packed = (struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks)
    return content[:8] + b"".join(packed)


def damaged_message(rng: Rng, content: bytes) -> bytes:
    """A protobuf message, its lengths right, with a field, or one inside it, that is lost, doubled or another."""
    fields = _fields(content)
    if not fields:
        return damaged_bytes(rng, content)
    i = int(rng.integers(len(fields)))
    number, wire, value = fields[i]
    match int(rng.integers(8)):
        case 0:
            del fields[i]
        case 1:
            fields.insert(int(rng.integers(len(fields))), fields[i])
        case 2:
            fields[i] = pick(rng, (1, 2, 5, 7, 8, 11, 14, 31)), wire, value
        case _ if isinstance(value, int):
            fields[i] = number, wire, pick(rng, (0, 1, 2, 7, 255, 2**31, 2**63, 2**64 - 1))
        case _:
            fields[i] = number, wire, damaged_message(rng, value) if rng.random() < 0.8 else damaged_bytes(rng, value)
    return b"".join(
        _varint(n << 3 | w) + (_varint(v) if isinstance(v, int) else (_varint(len(v)) if w == 2 else b"") + v)
        for n, w, v in fields
    )


def _fields(content: bytes) -> list[tuple[int, int, int | bytes]]:
    """Numbers, wire types and values of a message's fields; none if it is no message."""
    found: list[tuple[int, int, int | bytes]] = []
    at = 0

    def number() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = content[at]
            at += 1
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value

    try:
        while at < len(content):
            key = number()
            if key >> 3 == 0 or key & 7 not in (0, 1, 2, 5):
                return []
            if key & 7 == 0:
                found.append((key >> 3, 0, number()))
                continue
            length = {1: 8, 5: 4}.get(key & 7) or number()
            found.append((key >> 3, key & 7, content[at : at + length]))
            at += length
    except IndexError:
        return []
    return found if at == len(content) else []


def _varint(n: int) -> bytes:
    out = bytearray()
    while n > 127:
        out.append(n & 127 | 128)
        n >>= 7
    return bytes(out) + bytes([n])
