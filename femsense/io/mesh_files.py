"""Mesh files: tetrahedra in any format that meshio reads, closed surfaces (which `meshing/tetrahedra` fills), element quality."""

from __future__ import annotations

import io
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import InputError
from femsense.core.text import did_you_mean
from femsense.fem.closest_point import FACES
from femsense.fem.mesh import EDGES, TetMesh, element_volumes, oriented
from femsense.io.files import write_beside
from femsense.io.meshes.content import distinct_cells, gathered
from femsense.io.meshes.reading import read_content, reason
from femsense.io.meshing.surface import check_finite, merged, repaired
from femsense.io.meshing.surface_queries import sides
from femsense.io.meshing.tetrahedra import compact, kept_tets, tets_of_surface

SURFACE_ENDINGS = (".ply", ".stl", ".obj", ".off")
SOLID_KINDS = ("tetra", "hexahedron", "wedge", "pyramid", "voxel", "polyhedron", "C3D", "type ")
"""How the names of solid elements begin."""


def read_tets(path: Path, *, where: str | None = None) -> TetMesh:
    """Read a tetrahedral mesh from a file of any format that meshio reads (.msh, .vtu, .inp, …), or fill a closed surface (.stl, .obj, .ply, .off).

    A surface is tetrahedralised on first use; the result is stored next to it (or in the cache folder). Nodes that no tetrahedron uses are
    dropped with a warning. Some programs number the nodes of a tetrahedron in mirrored order, so that every volume is negative; these nodes are
    reordered.

    Arguments:
        path: the file.
        where: location that error messages state, such as a key of robot.toml. Default: the path.

    Returns:
        the mesh: `nodes` in the unit of the file, shape (n, 3), and `tets`, indices of the nodes of each element, corners first, shape (m, 4) for linear
        or (m, 10) for quadratic elements.

    Raises:
        InputError: the file is missing or not readable, it has no tetrahedra, it has other solid elements (hexahedra, …), or its surface is open.
    """
    where = where or str(path)
    _check_exists(path, where)
    if path.suffix.lower() in SURFACE_ENDINGS:
        return tets_of_surface(path, *read_surface(path, where=where), where)
    content = read_content(path, where)
    points, cells = content.points, content.cells
    kinds = [kind for kind in ("tetra", "tetra10") if kind in cells]
    others = [kind for kind in cells if kind.startswith(SOLID_KINDS) and kind not in kinds]
    if others or len(kinds) > 1:
        raise InputError(
            "elements that femsense does not compute with",
            where=where,
            found=", ".join(sorted(cells)),
            expected="tetrahedra of one kind (tetra or tetra10)",
            hint="split them into tetrahedra where the mesh is made",
        )
    if kinds:
        return ordered_tets(points, cells[kinds[0]], where)
    if "triangle" in cells:
        return tets_of_surface(path, *closed_surface(points, cells["triangle"], where), where)
    raise InputError(
        "the mesh has no tetrahedra",
        where=where,
        found=", ".join(sorted(cells)) or "no cells",
        expected="tetra or tetra10 cells, or a closed surface of triangles",
    )


def read_surface(path: Path, *, where: str | None = None) -> tuple[FloatArray, IntArray]:
    """Return points, shape (n, 3), in the file's unit, and triangles, shape (t, 3), of a closed surface. Raises InputError."""
    where = where or str(path)
    _check_exists(path, where)
    points, triangles = read_triangles(path, where=where)
    return closed_surface(points, triangles, where)


def read_triangles(path: Path, *, where: str | None = None) -> tuple[FloatArray, IntArray]:
    """Return points, shape (n, 3), and triangles, shape (t, 3), of a surface file, equal points merged. Raises InputError."""
    import trimesh

    where = where or str(path)
    try:
        source = _with_points(path, where)
        kind = path.suffix.lower().removeprefix(".") if source is not None else None
        surface: Any = trimesh.load_mesh(
            source or str(path), file_type=kind, process=False
        )  # not finite triangles would leave holes
        points, triangles = np.array(surface.vertices, dtype=np.float64), np.array(surface.faces, dtype=np.int64)
    except Exception as error:
        raise InputError(
            "not readable as a surface",
            where=where,
            found=reason(error),
            expected="triangles (ply, stl, obj, off)",
            hint="is the file complete, and does its suffix fit the content?",
        ) from None
    if not len(triangles):
        raise _no_triangles(path, where)
    check_finite(points, where)
    return merged(points, triangles)


NUMBERS = re.compile(rb"[-+]?\d*,?\d+(?:[eE][-+]?\d+)?")


def _with_points(path: Path, where: str) -> io.BytesIO | None:
    """Return a text file whose coordinates have decimal commas with points in their place, with a warning; None for any other file."""
    data = path.read_bytes()
    if b"\0" in data[:1024] or not re.search(rb"\d,\d", data[:65536]):
        return None
    changed, first = [], 0
    for number, line in enumerate(data.splitlines(), start=1):
        words = [word for word in line.split() if word[:1] in b"+-,.0123456789"]
        named = line.lower().startswith((b"solid", b"endsolid", b"#", b"g ", b"o ", b"comment"))
        commas = not named and len(words) > 1 and any(b"," in w for w in words) and all(NUMBERS.fullmatch(w) for w in words)
        first = first or (number if commas else 0)
        changed.append(re.sub(rb"(?<=\d),(?=\d)|(?<![\w,.]),(?=\d)", b".", line) if commas else line)
    if not first:
        return None
    warnings.warn(f"{where}: decimal commas from line {first} on are read as points", stacklevel=4)
    return io.BytesIO(b"\n".join(changed) + b"\n")


def _no_triangles(path: Path, where: str) -> InputError:
    """Return the message for a file without triangles: points alone are a cloud; otherwise the suffix does not fit the content."""
    with path.open("rb") as stream:
        head = stream.read(1_000_000)
    announced, size = int.from_bytes(head[80:84], "little"), path.stat().st_size
    if path.suffix.lower() == ".stl" and size >= 84 and not head.lstrip().startswith(b"solid") and announced:
        return InputError(
            "the content disagrees with its header",
            where=where,
            found=f"{announced} triangles announced, room for {(size - 84) // 50}",
            expected="a whole binary STL file",
            hint="copy or export it again",
        )
    declared = re.search(rb"^element vertex (\d+)", head, re.MULTILINE)
    count = int(declared[1]) if declared else len(re.findall(rb"^v\s", head, re.MULTILINE))
    if count:
        return InputError(
            "the surface has no triangles",
            where=where,
            found=f"a cloud of {count} points",
            expected="triangles",
            hint="reconstruct a closed surface first (MeshLab, Open3D: Poisson reconstruction)",
        )
    return InputError(
        "the surface has no triangles",
        where=where,
        found="no points either",
        expected="triangles",
        hint="does the suffix fit the content?",
    )


def write_mesh(mesh: TetMesh, path: Path) -> None:
    """Write a tetrahedral mesh to a file, in metres.

    Arguments:
        mesh: the mesh; `TetMesh.nodes` are written as they are [m].
        path: the file. Its suffix selects the format (any that meshio writes); .vtu keeps all digits.
    """
    import meshio

    kind = "tetra10" if mesh.is_quadratic else "tetra"
    with write_beside(path) as part:
        meshio.Mesh(np.asarray(mesh.nodes), [(kind, np.asarray(mesh.tets))]).write(part)


def mesh_companions(path: Path) -> list[Path]:
    """Return the files that a mesh needs to load back the same: itself, the other files of its format, kept tetrahedra."""
    pairs = {".node": (".ele",), ".ele": (".node",), ".xdmf": (".h5",), ".xmf": (".h5",)}
    files = [path, *(path.with_suffix(ending) for ending in pairs.get(path.suffix.lower(), ()))]
    if path.suffix.lower() in SURFACE_ENDINGS:
        places = kept_tets(path, *read_surface(path))
        files += [next((place for place in places if place.is_file()), path)]
    return [file for file in dict.fromkeys(files) if file.is_file()]


def radius_ratio(mesh: TetMesh) -> FloatArray:
    """Return 3 × inradius / circumradius of each corner tetrahedron [1], shape (m,): 1 regular, 0 flat."""
    corners = mesh.nodes[mesh.tets[:, :4]]
    a, b, c = (corners[:, i] - corners[:, 0] for i in (1, 2, 3))
    volume = np.abs(element_volumes(mesh))
    faces = [np.cross(a, b), np.cross(b, c), np.cross(c, a), np.cross(b - a, c - a)]
    area = sum(np.linalg.norm(face, axis=1) for face in faces) / 2.0
    opposite = [np.linalg.norm(p, axis=1) * np.linalg.norm(q - r, axis=1) for p, q, r in ((a, b, c), (b, a, c), (c, a, b))]
    s = sum(opposite) / 2.0
    product = s * np.prod([s - side for side in opposite], axis=0)  # 6 V R = √(s (s−p) (s−q) (s−r))
    circumradius_volume = np.sqrt(np.maximum(product, 0.0)) / 6.0
    return np.asarray(
        np.divide(9.0 * volume**2, area * circumradius_volume, out=np.zeros_like(volume), where=circumradius_volume > 0)
    )


def _check_exists(path: Path, where: str) -> None:
    if path.is_file():
        return
    names = [file.name for file in path.parent.iterdir() if file.is_file()] if path.parent.is_dir() else []
    raise InputError("no such mesh file", where=where, found=str(path), expected="a file", hint=did_you_mean(path.name, names))


def ordered_tets(points: FloatArray, tets: IntArray, where: str) -> TetMesh:
    """Return the mesh with its corner nodes first, each tetrahedron once, all elements turned where all are inverted."""
    tets = _from_zero(tets, len(points), where)
    unused = len(points) - len(np.unique(tets))
    if unused:
        warnings.warn(f"{where}: {unused} nodes that belong to no tetrahedron were dropped", stacklevel=4)
    kept, _ = distinct_cells(tets)
    if len(kept) < len(tets):
        warnings.warn(
            (
                f"{where}: {len(tets) - len(kept)} of {len(tets)} tetrahedra occur twice (once for each physical "
                f"group?): each is used once"
            ),
            stacklevel=4,
        )
    mesh = compact(points, tets[kept])
    _check_faces(mesh, where)
    if mesh.is_quadratic:
        _check_middles(mesh, where)
    volumes = element_volumes(mesh)
    return oriented(mesh) if len(volumes) and (volumes < 0).all() else mesh


def tet_values(path: Path, name: str, where: str) -> npt.NDArray[np.generic]:
    """Return the cell data of each tetrahedron of `read_tets`, shape (m, p), with p components.

    Raises:
        InputError: no tetrahedra, or no such cell data.
    """
    content = read_content(path, where)
    kind = next((kind for kind in ("tetra", "tetra10") if kind in content.cells), None)
    if kind is None:
        raise InputError("the mesh file has no cell data", where=where, found=path.name, expected="a mesh of tetrahedra")
    values = content.data.get(name, {}).get(kind)
    if values is None:
        known = " | ".join(key for key, kinds in content.data.items() if kind in kinds)
        raise InputError("no such cell data in the mesh file", where=where, found=repr(name), expected=known or "none there")
    return gathered(np.asarray(values), *distinct_cells(_from_zero(content.cells[kind], len(content.points), where)))


def _from_zero(tets: IntArray, count: int, where: str) -> IntArray:
    """Return the elements with nodes counted from zero. Raises InputError where a node does not exist.

    Readers of formats that count from one take one away: a file that counts from zero then begins at −1.
    """
    low, high = (int(tets.min()), int(tets.max())) if tets.size else (0, count - 1)
    if low == -1 and high < count - 1:
        warnings.warn(f"{where}: the nodes of the elements count from 0 where this format counts from 1: read so", stacklevel=5)
        return tets + 1
    if low >= 1 and high == count:
        warnings.warn(f"{where}: the nodes of the elements count from 1 where this format counts from 0: read so", stacklevel=5)
        return tets - 1
    if low < 0 or high >= count:
        raise InputError(
            "an element names a node that does not exist",
            where=where,
            found=low if low < 0 else high,
            expected=f"0 … {count - 1}",
            hint="does the file count its nodes from 0 where its format counts from 1?" if low < 0 else None,
        )
    return tets


def _check_faces(mesh: TetMesh, where: str) -> None:
    """Refuse overlapping elements: a face belongs to one or two tetrahedra. Raises InputError."""
    faces = np.sort(mesh.tets[:, FACES].reshape(-1, 3), axis=1)
    count = np.unique(faces, axis=0, return_counts=True)[1]
    if len(count) and (count > 2).any():
        raise InputError(
            "tetrahedra that overlap",
            where=where,
            found=f"{int((count > 2).sum())} faces of more than two tetrahedra",
            expected="each face belongs to one or two",
            hint="is a part of the mesh written twice, or meshed twice?",
        )
    if len(count) and not (count == 1).any():
        raise InputError("the mesh has no surface", where=where, found="no face of one tetrahedron only", expected="a body")


def _check_middles(mesh: TetMesh, where: str) -> None:
    ends = mesh.nodes[mesh.tets[:, EDGES]]
    off = np.linalg.norm(mesh.nodes[mesh.tets[:, 4:]] - ends.mean(axis=2), axis=2)
    length = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2)
    bad = np.flatnonzero((off > 0.25 * length).any(axis=1))
    if len(bad):
        raise InputError(
            "mid-edge nodes that are not in the middle of their edges",
            where=where,
            found=f"{len(bad)} of {len(mesh.tets)} elements, the first is number {bad[0]}",
            expected="the order of VTK: corners 0 1 2 3, then the edges 01 12 02 03 13 23",
        )


def closed_surface(points: FloatArray, triangles: IntArray, where: str) -> tuple[FloatArray, IntArray]:
    """Return the surface, outward, inner shells as cavities, as it is otherwise.

    Raises InputError where it is open or in parts.
    """
    points, triangles = merged(points, triangles)
    count = sides(triangles)[2]
    if (count != 2).any():
        raise InputError(
            "the surface is not closed",
            where=where,
            found=f"{int((count == 1).sum())} edges with one triangle, {int((count > 2).sum())} with more than two",
            expected="every edge between two triangles",
            hint="femsense mesh SURFACE -o ROBOT closes holes and repairs the surface",
        )
    made = repaired(points, triangles, where=where)
    return np.array(made.points), np.array(made.triangles)
