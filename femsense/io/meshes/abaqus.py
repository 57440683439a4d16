"""Abaqus input files (.inp): nodes and elements in any number of blocks, parts, and one instance with its place.

Format: Abaqus keywords reference, *NODE, *ELEMENT, *PART, *INSTANCE.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.io.meshes.content import MeshContent, indices_of

SOLIDS = {
    4: "tetra",
    10: "tetra10",
    5: "pyramid",
    6: "wedge",
    8: "hexahedron",
    15: "wedge15",
    20: "hexahedron20",
    27: "hexahedron27",
}
SOLID_TYPES = re.compile(r"(?:C3D|DC3D|AC3D|DCC3D|G3D|Q3D)(\d+)")
SHELL_TRIANGLES = ("S3", "S3R", "STRI3", "M3D3", "R3D3", "SFM3D3", "DS3")
REFUSED = ("SYSTEM", "NGEN", "NFILL", "NCOPY", "ELGEN", "ELCOPY", "NMAP")
"""Keywords that move or make nodes and elements."""
Keyword = tuple[int, str, dict[str, str], list[str]]
"""Line, keyword, its options, its data lines."""


@dataclass(slots=True)
class _Mesh:
    """Nodes and elements of a part, an instance or the whole file."""

    nodes: dict[int, tuple[float, ...]] = field(default_factory=dict)
    elements: dict[str, list[list[int]]] = field(default_factory=dict)

    @property
    def solid(self) -> bool:
        return any(kind in SOLIDS.values() for kind in self.elements)


def read_abaqus(path: Path, where: str) -> MeshContent:
    """Return the mesh of an Abaqus input file. Raises InputError for unsupported content."""
    whole, parts = _Mesh(), dict[str, _Mesh]()
    instances: list[tuple[str, _Mesh, FloatArray]] = []
    target, in_assembly = whole, False
    for number, keyword, options, lines in _keywords(path, where):
        place = f"{where}, line {number}"
        if keyword == "PART":
            target = parts.setdefault(options.get("NAME", "").upper(), _Mesh())
        elif keyword == "INSTANCE":
            part = parts.get(options.get("PART", "").upper(), _Mesh())
            target = _Mesh(dict(part.nodes), dict(part.elements))
            instances.append((options.get("NAME", ""), target, _placement(lines, place)))
        elif keyword in ("END PART", "END INSTANCE"):
            target = _Mesh() if in_assembly else whole
        elif keyword == "ASSEMBLY":
            target, in_assembly = _Mesh(), True
        elif keyword == "END ASSEMBLY":
            target, in_assembly = whole, False
        elif keyword in REFUSED:
            raise InputError(
                f"*{keyword} is not read",
                where=place,
                found=f"*{keyword}",
                expected="nodes and elements written out",
                hint="write the file again from Abaqus/CAE, or export the mesh as .vtu, .msh or .bdf",
            )
        elif keyword in ("NODE", "ELEMENT"):
            _add(target, keyword, options, lines, place)
    return _content(*_chosen(whole, parts, instances, where), where)


def _keywords(path: Path, where: str) -> Iterator[Keyword]:
    """Yield the keywords of a file and of those that it includes."""
    current: Keyword | None = None
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), start=1):
        text = line.strip()
        if not text or text.startswith("**"):
            continue
        if not text.startswith("*"):
            if current is not None:
                current[3].append(text)
            continue
        if current is not None:
            yield from _included(current, path, where)
        name, *options = text[1:].split(",")
        pairs = [option.partition("=") for option in options]
        table = {key.strip().upper(): value.strip().strip('"') for key, _, value in pairs if key.strip()}
        current = (number, " ".join(name.upper().split()), table, [])
    if current is not None:
        yield from _included(current, path, where)


def _included(keyword: Keyword, path: Path, where: str) -> Iterator[Keyword]:
    number, name, options, lines = keyword
    if "INPUT" not in options or name not in ("INCLUDE", "NODE", "ELEMENT"):
        yield keyword
        return
    file = path.parent / options["INPUT"]
    if not file.is_file() or file.resolve() == path.resolve():
        raise InputError(
            "a file that this one includes is missing", where=f"{where}, line {number}", found=str(file), expected="a file"
        )
    if name == "INCLUDE":
        yield from _keywords(file, where)
        return
    more = [line.strip() for line in file.read_text(encoding="utf-8", errors="replace").splitlines()]
    yield number, name, options, [*lines, *(line for line in more if line and not line.startswith("*"))]


def _placement(lines: list[str], place: str) -> FloatArray:
    """Return the transform of an instance, shape (4, 4): shifted, then turned about an axis through two points."""
    T = np.eye(4)
    rows = [_numbers(line, place) for line in lines]
    if rows and len(rows[0]) >= 3:
        T[:3, 3] = rows[0][:3]
    if len(rows) > 1 and len(rows[1]) >= 7:
        from scipy.spatial.transform import Rotation

        a, b, angle = np.array(rows[1][:3]), np.array(rows[1][3:6]), np.radians(rows[1][6])
        R = Rotation.from_rotvec(angle * (b - a) / np.linalg.norm(b - a)).as_matrix()
        T = np.vstack([np.column_stack([R, a - R @ a]), [0, 0, 0, 1]]) @ T
    return T


def _numbers(line: str, place: str) -> list[float]:
    try:
        return [float(word) for word in line.replace("D", "E").replace("d", "e").split(",") if word.strip()]
    except ValueError:
        raise InputError("not a number", where=place, found=line[:80], expected="numbers with commas between") from None


def _add(target: _Mesh, keyword: str, options: dict[str, str], lines: list[str], place: str) -> None:
    if keyword == "NODE":
        if options.get("SYSTEM", "R").upper() != "R":
            raise InputError(
                "nodes in cylindrical or spherical coordinates",
                where=place,
                found=f"system={options['SYSTEM']}",
                expected="x, y, z",
            )
        for line in lines:
            number, *xyz = _numbers(line, place)
            target.nodes[int(number)] = (*xyz, 0.0, 0.0, 0.0)[:3]
        return
    name = options.get("TYPE", "").upper()
    solid = SOLID_TYPES.match(name)
    if not solid and name not in SHELL_TRIANGLES:
        return
    count = int(solid[1]) if solid else 3
    kind = SOLIDS.get(count, name) if solid else "triangle"
    words = [int(value) for line in lines for value in _numbers(line, place)]
    rows = len(words) // (1 + count)
    if rows * (1 + count) != len(words):
        raise InputError(
            "a broken block of elements", where=place, found=f"{len(words)} numbers", expected=f"{1 + count} an element"
        )
    table = np.array(words, dtype=np.int64).reshape(rows, 1 + count)
    target.elements.setdefault(kind, []).extend(table[:, 1:].tolist())


def _chosen(
    whole: _Mesh, parts: dict[str, _Mesh], instances: list[tuple[str, _Mesh, FloatArray]], where: str
) -> tuple[_Mesh, FloatArray]:
    """Return the single body and its transformation. Raises InputError if there are several."""
    bodies = [(name, mesh, T) for name, mesh, T in instances if mesh.solid]
    if not instances:
        bodies = [(name, mesh, np.eye(4)) for name, mesh in parts.items() if mesh.solid]
    if whole.solid:
        bodies.append(("outside of parts", whole, np.eye(4)))
    if len(bodies) > 1:
        raise InputError(
            "several parts or instances with solid elements",
            where=where,
            found=", ".join(name for name, _, _ in bodies),
            expected="one body: parts that hang together share their nodes",
            hint="in Abaqus/CAE: Assembly, Merge/Cut Instances, Mesh; then write the input file again",
        )
    if bodies:
        return bodies[0][1], bodies[0][2]
    others = [(mesh, T) for _, mesh, T in instances] or [(mesh, np.eye(4)) for mesh in [*parts.values(), whole] if mesh.nodes]
    return others[0] if others else (whole, np.eye(4))


def _content(mesh: _Mesh, T: FloatArray, where: str) -> MeshContent:
    numbers = np.array(list(mesh.nodes), dtype=np.int64)
    points = np.array(list(mesh.nodes.values()), dtype=np.float64).reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]
    cells = {kind: indices_of(np.array(rows, dtype=np.int64), numbers, where) for kind, rows in mesh.elements.items()}
    return MeshContent(points, cells)
