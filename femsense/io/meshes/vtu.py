"""VTK's XML files of unstructured grids in several pieces (.vtu), and the lists of such files (.pvtu)."""

from __future__ import annotations

import base64
import re
import tempfile
import zlib
from pathlib import Path

import numpy as np

from femsense.core.errors import InputError
from femsense.io.meshes.content import MeshContent

PIECE = re.compile(rb"<Piece\b(?:[^>]*/>|.*?</Piece\s*>)", re.DOTALL)

OWN_HEAD = b'<VTKFile type="UnstructuredGrid" version="0.1" byte_order="LittleEndian" compressor="vtkZLibDataCompressor">'
"""How files begin that `write_mesh` makes, after the line that says XML."""
ARRAY = re.compile(rb'<DataArray type="(Float64|Int64)" Name="(\w+)"[^>]*format="binary">\s*([^<]*)</DataArray>')
OWN_KINDS = {10: ("tetra", 4), 24: ("tetra10", 10)}
"""VTK's number of a kind → its name and how many points it has."""


def read_own(data: bytes) -> MeshContent | None:
    """Return the mesh of a .vtu file as `write_mesh` makes them: one piece, tetrahedra of one kind, compressed,
    without data; else None.

    meshio reads every other file. It takes as long to import as a small mesh takes to solve.
    """
    arrays = {name: (kind, text) for kind, name, text in ARRAY.findall(data)}
    plain = data.count(b"<Piece ") == 1 and data.count(b"<DataArray") == len(arrays) == 4
    if OWN_HEAD not in data[:200] or not plain or set(arrays) != {b"Points", b"connectivity", b"offsets", b"types"}:
        return None
    if [arrays[name][0] for name in (b"Points", b"connectivity", b"offsets", b"types")] != [b"Float64", *[b"Int64"] * 3]:
        return None
    nodes, offsets, kinds = (np.frombuffer(_unpacked(arrays[name][1]), "<i8") for name in (b"connectivity", b"offsets", b"types"))
    kind, width = OWN_KINDS.get(int(kinds[0]), ("", 0)) if len(kinds) else ("", 0)
    if not width or (kinds != kinds[0]).any() or not np.array_equal(offsets, width * np.arange(1, len(kinds) + 1)):
        return None
    points = np.frombuffer(_unpacked(arrays[b"Points"][1]), "<f8")
    return MeshContent(points.reshape(-1, 3).astype(np.float64), {kind: nodes.reshape(-1, width).astype(np.int64)})


def _unpacked(text: bytes) -> bytes:
    """Return what VTK's compressed blocks hold: how many, their size, that of the last, then how long each is compressed;
    each part is base64."""
    count = int.from_bytes(base64.b64decode(text[:8])[:4], "little")
    letters = 4 * -(-4 * (3 + count) // 3)
    sizes = np.frombuffer(base64.b64decode(text[:letters]), "<u4")[3:]
    ends, packed = np.cumsum(sizes), base64.b64decode(text[letters:])
    blocks = [zlib.decompress(packed[end - size : end]) for size, end in zip(sizes.tolist(), ends.tolist())]
    return b"".join(blocks)


def pieces_of(data: bytes) -> list[bytes]:
    """Return the content of a .vtu file as files of one piece each; offsets into appended data stay what they are."""
    end = data.find(b"<AppendedData")
    head, rest = (data, b"") if end < 0 else (data[:end], data[end:])
    found = list(PIECE.finditer(head))
    if len(found) < 2:
        return [data]
    before, after = head[: found[0].start()], head[found[-1].end() :]
    return [before + piece[0] + after + rest for piece in found if not re.search(rb'NumberOfCells\s*=\s*"0"', piece[0][:200])]


def split_pieces(path: Path, folder: tempfile.TemporaryDirectory[str]) -> list[Path]:
    """Return files of one piece each, the file itself where it has one."""
    parts = pieces_of(path.read_bytes())
    if len(parts) == 1:
        return [path]
    files = []
    for i, part in enumerate(parts):
        files.append(Path(folder.name) / f"{i}.vtu")
        files[-1].write_bytes(part)
    return files


def listed_files(path: Path, where: str) -> list[Path]:
    """Return the .vtu files that a .pvtu file lists. Raises InputError where one is missing."""
    names = re.findall(rb'<Piece[^>]*\bSource\s*=\s*"([^"]+)"', path.read_bytes())
    files = [path.parent / name.decode("utf-8", "replace") for name in names]
    missing = next((file for file in files if not file.is_file()), None)
    if not files or missing is not None:
        raise InputError(
            "a piece is missing", where=where, found=str(missing or "no pieces"), expected="the .vtu files that it lists"
        )
    return files
