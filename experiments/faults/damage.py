"""Damage to text files: to their lines and numbers, and to what is inside a format, so that readers get beyond their
first check.

Every function takes a generator and sound content, and returns content that may be anything.
"""

from __future__ import annotations

import csv
import io
import json
import tomllib
from typing import Any
from xml.etree import ElementTree

import tomli_w
from values import NUMBERS, VALUES, WORDS, Rng, pick


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
