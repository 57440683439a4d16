"""Gmsh's meshes (MSH 1, 2, 4.0, 4.1; as text or binary), with numbers that start anywhere and cells of any number of groups.

Format: the Gmsh reference manual, "Gmsh mesh file formats" and its appendix of legacy formats. Read here, because meshio 5.3.5 refuses
version 1 and files of which only some entities are in groups (SaveAll), shifts nodes that count from 0, and keeps one group of several.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import InputError
from femsense.io.meshes.content import MeshContent, indices_of

KINDS = {
    1: ("line", 2),
    2: ("triangle", 3),
    3: ("quad", 4),
    4: ("tetra", 4),
    5: ("hexahedron", 8),
    6: ("wedge", 6),
    7: ("pyramid", 5),
    8: ("line3", 3),
    9: ("triangle6", 6),
    10: ("quad9", 9),
    11: ("tetra10", 10),
    12: ("hexahedron27", 27),
    13: ("wedge18", 18),
    14: ("pyramid14", 14),
    15: ("vertex", 1),
    16: ("quad8", 8),
    17: ("hexahedron20", 20),
    18: ("wedge15", 15),
    19: ("pyramid13", 13),
    20: ("triangle9", 9),
    21: ("triangle10", 10),
    26: ("line4", 4),
    27: ("line5", 5),
    29: ("tetra20", 20),
    30: ("tetra35", 35),
    31: ("tetra56", 56),
}
TET10 = [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]
"""Gmsh's order of the ten nodes to VTK's."""
Block = tuple[int, IntArray, IntArray]
"""Type of the elements, their nodes' numbers (m, k), their groups (m, p)."""


class _Stream:
    """Numbers of a section, one after another: words of a text, or bytes."""

    def __init__(self, body: bytes, *, binary: bool, order: str) -> None:
        self._body, self._binary, self._order, self._at = body, binary, order, 0
        self._words = np.zeros(0) if binary else np.array(body.split(), dtype=np.float64)

    def rows(self, count: int, kinds: str) -> FloatArray:
        """Return `count` rows of numbers, one letter each: i (4 bytes), q (8 bytes), d (a double)."""
        if not kinds:
            return np.zeros((count, 0))
        if not self._binary:
            size = count * len(kinds)
            part = self._words[self._at : self._at + size]
            self._at += size
            return _whole(part, size).reshape(count, len(kinds))
        kind = np.dtype([(str(i), self._order + {"i": "i4", "q": "i8", "d": "f8"}[k]) for i, k in enumerate(kinds)])
        end = self._at + count * kind.itemsize
        table = np.frombuffer(_whole(self._body[self._at : end], end - self._at), dtype=kind)
        self._at = end
        return np.stack([table[str(i)].astype(np.float64) for i in range(len(kinds))], axis=1).reshape(count, len(kinds))

    def one(self, kinds: str) -> list[int]:
        """Return one row as whole numbers."""
        return [int(value) for value in self.rows(1, kinds)[0]]

    def line(self) -> int:
        """Return the integer in a line of text; in the older formats it is the number of entries that follow."""
        if not self._binary:
            return self.one("i")[0]
        end = self._body.index(b"\n", self._at)
        value = int(self._body[self._at : end])
        self._at = end + 1
        return value


Part = TypeVar("Part", FloatArray, bytes)


def _whole(part: Part, size: int) -> Part:
    if len(part) < size:
        raise ValueError("the file ends before the announced number of entries")
    return part


def read_gmsh(path: Path, where: str) -> MeshContent:
    """Return the content of a Gmsh mesh. Raises InputError for unsupported content."""
    data = path.read_bytes()
    if b"\r\n" in data[:200] and b"\0" not in data[:200]:
        data = data.replace(b"\r\n", b"\n")
    try:
        return _parsed(data, where)
    except (ValueError, IndexError, KeyError, OverflowError) as error:
        raise InputError(
            "a broken Gmsh mesh", where=where, found=str(error)[:160], expected="a whole MSH file", hint="save it again from Gmsh"
        ) from None


def _parsed(data: bytes, where: str) -> MeshContent:
    first = data.lstrip()[:200]
    if first.startswith(b"$NOD"):
        nodes = _Stream(_body(data, "NOD"), binary=False, order="<")
        return _content(*_nodes_2(nodes), _elements_of_lines(_body(data, "ELM"), fixed=3), where)
    header = _body(data, "MeshFormat").split(b"\n", 1)
    words = header[0].split()
    version, binary = words[0].decode(), words[1] != b"0"
    order = "<" if not binary or header[1][:4] == b"\x01\0\0\0" else ">"

    def open_section(name: str) -> _Stream:
        return _Stream(_body(data, name), binary=binary, order=order)

    if version.startswith("2"):
        lines = _elements_2(open_section("Elements")) if binary else _elements_of_lines(_body(data, "Elements"), fixed=None)
        return _content(*_nodes_2(open_section("Nodes")), lines, where)
    if not version.startswith("4"):
        raise InputError("a version of Gmsh's format that is not read", where=where, found=version, expected="1, 2.x, 4.0 or 4.1")
    new = version != "4" and not version.startswith("4.0")  # Gmsh writes 4.0 as 4
    groups = _groups(open_section("Entities"), new) if b"$Entities" in data else {}
    return _content(*_nodes_4(open_section("Nodes"), new), _elements_4(open_section("Elements"), new, groups), where)


def _body(data: bytes, name: str) -> bytes:
    begin = re.search(rb"^\$" + name.encode() + rb"[ \t]*\n", data, re.MULTILINE)
    if begin is None:
        raise ValueError(f"no section ${name}")
    end = data.find(b"$End" + name.encode(), begin.end())
    end = data.find(b"$END" + name.encode(), begin.end()) if end < 0 else end
    if end < 0:
        raise ValueError(f"the section ${name} has no end")
    return data[begin.end() : end]


# Nodes: their numbers (n,) and points (n, 3)


def _nodes_2(stream: _Stream) -> tuple[IntArray, FloatArray]:
    rows = stream.rows(stream.line(), "iddd")
    return rows[:, 0].astype(np.int64), rows[:, 1:]


def _nodes_4(stream: _Stream, new: bool) -> tuple[IntArray, FloatArray]:
    blocks = stream.one("qqqq" if new else "qq")[0]
    numbers, points = [np.zeros(0, dtype=np.int64)], [np.zeros((0, 3))]
    for _ in range(blocks):
        first, second, parametric, count = stream.one("iiiq")
        dimension = first if new else second
        more = "d" * (dimension if parametric else 0)
        if new:
            numbers.append(stream.rows(count, "q")[:, 0].astype(np.int64))
            points.append(stream.rows(count, "ddd" + more)[:, :3])
        else:
            rows = stream.rows(count, "iddd" + more)
            numbers.append(rows[:, 0].astype(np.int64))
            points.append(rows[:, 1:4])
    return np.concatenate(numbers), np.vstack(points)


# Elements


def _elements_of_lines(body: bytes, *, fixed: int | None) -> list[Block]:
    """Return the elements of the formats of one line each: number, type, (number of groups, groups …), nodes.

    Arguments:
        body: the section.
        fixed: number of words between type and nodes, of which the first is the group; None: the third word is the number of groups.
    """
    lines = body.split(b"\n")
    count, lines = int(lines[0]), [line for line in lines[1:] if line.strip()]
    if len(lines) != count:
        raise ValueError(f"{len(lines)} elements where {count} are announced")
    alike: dict[tuple[int, int], list[bytes]] = {}
    for line in lines:
        words = line.split(None, 3)
        alike.setdefault((int(words[1]), int(words[2]) if fixed is None else fixed), []).append(line)
    blocks = []
    for (kind, tags), rows in alike.items():
        head = 3 + tags if fixed is None else 2 + fixed
        table = np.array(b" ".join(rows).split(), dtype=np.int64).reshape(len(rows), head + _size(kind))
        first = 3 if fixed is None else 2
        blocks.append((kind, table[:, head:], table[:, first : first + min(tags, 1)]))
    return blocks


def _elements_2(stream: _Stream) -> list[Block]:
    """Return the elements of a binary file of version 2."""
    blocks, left = [], stream.line()
    while left > 0:
        kind, count, tags = stream.one("iii")
        rows = stream.rows(count, "i" * (1 + tags + _size(kind))).astype(np.int64)[:, 1:]
        blocks.append((kind, rows[:, tags:], rows[:, : min(tags, 1)]))
        left -= count
    return blocks


def _groups(stream: _Stream, new: bool) -> dict[tuple[int, int], list[int]]:
    """Return the physical groups of each entity: (dimension, number) → groups."""
    groups: dict[tuple[int, int], list[int]] = {}
    for dimension, count in enumerate(stream.one("qqqq")):
        box = "ddd" if new and dimension == 0 else "dddddd"
        for _ in range(count):
            number = int(stream.rows(1, "i" + box)[0, 0])
            groups[dimension, number] = stream.one("i" * stream.one("q")[0])
            if dimension:
                stream.rows(stream.one("q")[0], "i")
    return groups


def _elements_4(stream: _Stream, new: bool, groups: dict[tuple[int, int], list[int]]) -> list[Block]:
    blocks = []
    for _ in range(stream.one("qqqq" if new else "qq")[0]):
        first, second, kind, count = stream.one("iiiq")
        entity = (first, second) if new else (second, first)
        rows = stream.rows(count, ("q" if new else "i") * (1 + _size(kind))).astype(np.int64)
        tags = np.repeat([[abs(tag) for tag in groups.get(entity, [])] or [0]], count, axis=0)
        blocks.append((kind, rows[:, 1:], tags))
    return blocks


def _size(kind: int) -> int:
    if kind not in KINDS:
        raise ValueError(f"elements of type {kind}")
    return KINDS[kind][1]


def _content(numbers: IntArray, points: FloatArray, blocks: Sequence[Block], where: str) -> MeshContent:
    """Return the content with indices from 0 in place of numbers."""
    known = np.sort(numbers)
    if (np.diff(known) == 0).any():
        raise InputError(
            "a node occurs twice", where=where, found=f"node {int(known[:-1][np.diff(known) == 0][0])}", expected="each node once"
        )
    cells: dict[str, list[IntArray]] = {}
    tags: dict[str, list[IntArray]] = {}
    for kind, nodes, groups in blocks:
        name = KINDS[kind][0] if kind in KINDS else f"type {kind}"
        index = indices_of(nodes, numbers, where)
        cells.setdefault(name, []).append(index[:, TET10] if name == "tetra10" else index)
        tags.setdefault(name, []).append(groups if groups.shape[1] else np.zeros((len(nodes), 1), dtype=np.int64))
    return MeshContent(
        points,
        {name: np.concatenate(parts) for name, parts in cells.items()},
        {"gmsh:physical": {name: _padded(parts) for name, parts in tags.items()}},
    )


def _padded(parts: Sequence[IntArray]) -> IntArray:
    """Return the groups of all blocks, shape (m, p); a block with fewer repeats its first."""
    width = max(part.shape[1] for part in parts)
    return np.concatenate([np.hstack([part, np.repeat(part[:, :1], width - part.shape[1], axis=1)]) for part in parts])
