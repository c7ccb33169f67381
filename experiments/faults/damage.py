"""Damage to files: to bytes, to text, and to what is inside a format, so that readers get beyond their first check.

Every function takes a generator and sound content, and returns content that may be anything.
"""

from __future__ import annotations

import csv
import io
import json
import struct
import tomllib
import zipfile
import zlib
from collections.abc import Callable
from typing import Any
from xml.etree import ElementTree

import numpy as np
import tomli_w

Rng = np.random.Generator

NUMBERS = (
    *("0", "-0", "1", "-1", "2", "7", "0.5", "-0.5", "1e-320", "1e-9", "1e9", "1e38", "3.5e38", "1e308", "-1e308"),
    *("nan", "-nan", "inf", "-inf", "NaN", "Infinity", ".inf", ".nan", "255", "65536", "2147483647", "2147483648"),
    *("1e999", "1e400"),
    *("-2147483649", "4294967296", "9223372036854775807", "9223372036854775808", "0x1F", "0b1", "1_000", "1,5", "1/3"),
    *("\u0661\u0662", "\u00bd", "1e", "1e+", "--1", "+1", ".5", "5.", "true", "false", "null", "None", "", "9" * 400),
    *("9" * 5000, "0." + "0" * 400 + "1"),
)  # fmt: skip
"""What may stand where a number does."""

WORDS = (
    *("", " ", "a" * 300, "a" * 70_000, "..", "/", "/dev/null", "~", "-1", "--help", "[/b]", "[bold]x", "%s"),
    *(
        "%d%n",
        "{0}",
        "{x}",
        "\\",
        "\\x",
        "'",
        '"',
        "a\nb",
        "a\tb",
        "a\rb",
        "\x00",
        "\x1b[31m",
        "ä",
        "漢字",
        "🤖",
        "\u202e",
    ),
    *(
        "$HOME",
        "`id`",
        "*",
        "?",
        "[a-",
        "C:\\x",
        "file:///etc/passwd",
        "http://localhost:1/x",
        "module:Class",
        "os:system",
    ),
    *("../../etc/passwd", "reach", "__main__:X", "nan", "1e999", "true", "x" * 255, "\ufeff", "ﬁ", "\ud7ff", "a b c"),
)
"""What may stand where a word does."""

VALUES: tuple[Any, ...] = (
    *(
        0,
        -1,
        1,
        2,
        3,
        10**6,
        2**31,
        2**32,
        2**53 + 1,
        2**63 - 1,
        10**18,
        -(2**63),
        0.0,
        -0.0,
        0.5,
        1e-320,
        1e308,
        -1e308,
    ),
    *(
        float("nan"),
        float("inf"),
        float("-inf"),
        True,
        False,
        "",
        "x",
        "nan",
        [],
        [[]],
        [0],
        [1, 2, 3],
        [None],
        {},
        {"a": 1},
    ),
)
"""What may stand where any value does."""


def pick(rng: Rng, choices: Any) -> Any:
    """One of some."""
    return choices[int(rng.integers(len(choices)))]


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


def damaged_text(rng: Rng, content: bytes) -> bytes:
    """Lines lost, doubled or exchanged, numbers and words that nobody expects, other encodings."""
    text = content.decode(errors="replace")
    lines = text.splitlines(keepends=True) or [""]
    i, j = (int(rng.integers(len(lines))) for _ in range(2))
    match int(rng.integers(10)):
        case 0:
            del lines[i]
        case 1:
            lines.insert(j, lines[i])
        case 2:
            lines[i], lines[j] = lines[j], lines[i]
        case 3:
            return text.encode(pick(rng, ("utf-16", "utf-8-sig", "utf-32", "cp037")), errors="replace")
        case 4:
            return text.replace("\n", pick(rng, ("\r", "\r\n", "\x00", "\u2028", ""))).encode()
        case 5:
            lines.insert(
                i, pick(rng, ("[" * 5000, "{" * 5000, '"', "'''", "<a>" * 5000, "#" * 9, "---\n", "\x00", "="))
            )
        case 6:
            lines[i] = _inserted(rng, lines[i], pick(rng, (*WORDS, *NUMBERS)))
        case 7:
            lines[i] = _inserted(rng, lines[i], pick(rng, "[]{}()<>\"'=:,;#&\\/%\t\n\r\x00é"))
        case _:
            return _replaced_number(rng, text).encode(errors="surrogatepass")
    return "".join(lines).encode(errors="surrogatepass")


def _inserted(rng: Rng, line: str, what: str) -> str:
    at = int(rng.integers(len(line) + 1))
    return line[:at] + what + line[at + int(rng.integers(0, 4)) :]


def _replaced_number(rng: Rng, text: str) -> str:
    """The text with another number in the place of one."""
    spans, start = [], None
    for i, c in enumerate(text + " "):
        if c.isdigit() or (start is not None and c in ".eE+-"):
            start = i if start is None else start
        elif start is not None:
            spans.append((start, i))
            start = None
    if not spans:
        return text + pick(rng, NUMBERS)
    a, b = pick(rng, spans)
    return text[:a] + pick(rng, NUMBERS) + text[b:]


def _changed_tree(rng: Rng, tree: Any) -> Any:
    """A value, or something inside it, lost, doubled, exchanged, renamed or of another type."""
    places: list[tuple[Any, Any]] = []

    def walk(node: Any) -> None:
        for key in node if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ():
            places.append((node, key))
            walk(node[key])

    walk(tree)
    if not places or rng.random() < 0.02:
        return pick(rng, VALUES)
    node, key = pick(rng, places)
    match int(rng.integers(7)):
        case 0:
            del node[key]
        case 1:
            other, there = pick(rng, places)
            value = other[there] if there in other or isinstance(other, list) else 0
            node[key] = json.loads(json.dumps(value, default=str)) if value is not node else 0
        case 2 if isinstance(node, dict):
            node[pick(rng, (*WORDS, key + "x", key[:-1], key.upper()))] = node.pop(key)
        case 3 if isinstance(node, list):
            node += [node[key]] * int(rng.integers(1, 5))
        case 4 if isinstance(node[key], (int, float)):
            node[key] = pick(rng, (-node[key], node[key] * 1e6, node[key] / 1e6, str(node[key]), [node[key]]))
        case 5:
            node[key] = pick(rng, WORDS)
        case _:
            node[key] = pick(rng, VALUES)
    return tree


def damaged_toml(rng: Rng, content: bytes) -> bytes:
    """TOML whose keys and values are others."""
    tree = _changed_tree(rng, tomllib.loads(content.decode()))
    try:
        return tomli_w.dumps(tree).encode()
    except (TypeError, ValueError, AttributeError):
        return damaged_text(rng, content)


def damaged_json(rng: Rng, content: bytes) -> bytes:
    """JSON whose keys and values are others; NaN and Infinity as Python writes them."""
    return json.dumps(_changed_tree(rng, json.loads(content))).encode(errors="surrogatepass")


def damaged_xml(rng: Rng, content: bytes) -> bytes:
    """XML whose elements and attributes are others."""
    root = ElementTree.fromstring(content)
    parents = [(parent, child) for parent in root.iter() for child in parent]
    parent, child = pick(rng, parents)
    names = list(child.attrib)
    match int(rng.integers(8)):
        case 0:
            parent.remove(child)
        case 1:
            parent.insert(0, child)  # Twice in the tree.
        case 2:
            pick(rng, parents)[0].append(ElementTree.fromstring(ElementTree.tostring(child)))
        case 3:
            child.tag = pick(rng, [c.tag for _, c in parents] + ["include", "frame", "x"])
        case 4 if names:
            del child.attrib[pick(rng, names)]
        case 5 if names:
            child.attrib[pick(rng, names)] = pick(rng, [w for w in WORDS if w.isprintable()])
        case 6:
            child.attrib[pick(rng, ("name", "file", "type", "class", "range", "joint", "size", "x"))] = pick(
                rng, ("1", "0 0", "ball", "free", "hinge", "slide", "mesh", "missing.stl")
            )
        case _ if names:
            name = pick(rng, names)
            parts = child.attrib[name].split() or [""]
            parts[int(rng.integers(len(parts)))] = pick(rng, NUMBERS)
            child.attrib[name] = " ".join(parts)
    return ElementTree.tostring(root)


def damaged_csv(rng: Rng, content: bytes) -> bytes:
    """CSV whose rows, columns and cells are others."""
    rows = list(csv.reader(io.StringIO(content.decode())))
    row = pick(rng, rows)
    i = int(rng.integers(len(row)))
    match int(rng.integers(7)):
        case 0:
            del row[i]
        case 1:
            row.insert(i, pick(rng, NUMBERS))
        case 2:
            for one in rows:
                del one[i : i + 1]
        case 3:
            rows[0][int(rng.integers(len(rows[0])))] = pick(rng, (*WORDS, rows[0][0]))
        case 4:
            rows = rows[: int(rng.integers(len(rows)))]
        case 5:
            rows.append(rows[0])
        case _:
            row[i] = pick(rng, (*NUMBERS, *NUMBERS, *WORDS))
    text = io.StringIO()
    csv.writer(text, delimiter=pick(rng, ",,,,;\t"), lineterminator=pick(rng, ("\n", "\r\n"))).writerows(rows)
    return text.getvalue().encode(errors="surrogatepass")


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
