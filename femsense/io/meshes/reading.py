"""Mesh files of any known format, read completely or refused with a reason."""

from __future__ import annotations

import contextlib
import io
import re
import tempfile
from pathlib import Path

import numpy as np

from femsense.core.errors import InputError
from femsense.io.meshes import tetgen
from femsense.io.meshes.abaqus import read_abaqus
from femsense.io.meshes.content import MeshContent, joined
from femsense.io.meshes.gmsh import read_gmsh
from femsense.io.meshes.vtu import listed_files, split_pieces

NASTRAN = (".bdf", ".nas", ".fem")


def file_format(path: Path) -> str | None:
    """Return meshio's name of the format from the file's content; None if only the suffix determines it."""
    with path.open("rb") as stream:
        head = stream.read(512).lstrip()
    starts = (
        (b"# vtk DataFile", "vtk"),
        (b"$MeshFormat", "gmsh"),
        (b"$NOD", "gmsh"),
        (b"MeshVersionFormatted", "medit"),
        (b"<Xdmf", "xdmf"),
    )
    if b"<VTKFile" in head:
        return "pvtu" if b"PUnstructuredGrid" in head else "vtu"
    return next((name for start, name in starts if head.startswith(start)), None)


def read_content(path: Path, where: str) -> MeshContent:
    """Return the content of a mesh file; points must be finite and three-dimensional. Raises InputError."""
    try:
        content = _read(path, where)
    except InputError:
        raise
    except ModuleNotFoundError as error:  # meshio needs h5py for XDMF, MED and other formats in HDF5
        raise InputError(
            "this format of meshes needs a package that is not there",
            where=where,
            found=error.name,
            hint=f"pip install {error.name}",
        ) from None
    except (Exception, SystemExit) as error:
        raise InputError(
            "not readable as a mesh",
            where=where,
            found=reason(error),
            expected="tetrahedra in a format that meshio reads (vtu, vtk, msh, …)",
            hint="decimal commas? Write points" if _has_decimal_commas(path) else None,
        ) from None
    points = content.points
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(
            "not a mesh in space", where=where, found=f"points of shape {points.shape}", expected="three coordinates a point"
        )
    if not np.isfinite(points).all():
        bad = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        raise InputError(
            "a node is not finite", where=where, found=f"node {bad}: {points[bad].tolist()}", expected="finite coordinates"
        )
    return content


def _read(path: Path, where: str) -> MeshContent:
    kind = file_format(path)
    if kind == "gmsh" or (kind is None and path.suffix.lower() == ".msh" and b"$Nodes" in path.read_bytes()[:4096]):
        return read_gmsh(path, where)
    if path.suffix.lower() == ".inp" and kind is None:
        return read_abaqus(path, where)
    if path.suffix.lower() in tetgen.ENDINGS and kind is None:
        return tetgen.read_tetgen(path, where)
    if kind == "pvtu":
        return joined(read_content(file, str(file)) for file in listed_files(path, where))
    if kind == "vtu":
        with tempfile.TemporaryDirectory(prefix="femsense-") as folder:
            return joined([_through_meshio(file, kind) for file in split_pieces(path, Path(folder))])
    if path.suffix.lower() in NASTRAN and b"BEGIN BULK" not in (data := path.read_bytes()):
        with tempfile.TemporaryDirectory(prefix="femsense-") as place:  # Gmsh omits the line, and meshio requires it
            whole = Path(place, path.name)
            whole.write_bytes(b"BEGIN BULK\n" + data)
            return _through_meshio(whole, kind)
    return _through_meshio(path, kind)


def _through_meshio(path: Path, kind: str | None) -> MeshContent:
    """Return the content by meshio, which may print and exit."""
    import meshio

    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        mesh = meshio.read(path, file_format=kind)
    cells = {name: np.asarray(data, dtype=np.int64) for name, data in mesh.cells_dict.items()}
    return MeshContent(np.asarray(mesh.points, dtype=np.float64), cells, dict(mesh.cell_data_dict))


def _has_decimal_commas(path: Path) -> bool:
    """Whether lines of a text file are numbers with commas in them."""
    with path.open("rb") as stream:
        head = stream.read(65536)
    return b"\0" not in head and re.search(rb"(?m)^\s*[-+]?\d+,\d+(?:\s+[-+]?\d+,\d+)+\s*$", head) is not None


def reason(error: BaseException) -> str:
    """Return the message of a reader's exception in one short line."""
    text = str(error).strip().splitlines()
    return (
        f"{type(error).__name__}: {text[0][:120]}"
        if text and not isinstance(error, SystemExit)
        else "another format, or a broken file"
    )
