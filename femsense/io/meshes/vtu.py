"""VTK's XML files of unstructured grids in several pieces (.vtu), and the lists of such files (.pvtu)."""

from __future__ import annotations

import re
from pathlib import Path

from femsense.core.errors import InputError

PIECE = re.compile(rb"<Piece\b(?:[^>]*/>|.*?</Piece\s*>)", re.DOTALL)


def pieces_of(data: bytes) -> list[bytes]:
    """Return the content of a .vtu file as files of one piece each; offsets into appended data are unchanged."""
    end = data.find(b"<AppendedData")
    head, rest = (data, b"") if end < 0 else (data[:end], data[end:])
    found = list(PIECE.finditer(head))
    if len(found) < 2:
        return [data]
    before, after = head[: found[0].start()], head[found[-1].end() :]
    return [before + piece[0] + after + rest for piece in found if not re.search(rb'NumberOfCells\s*=\s*"0"', piece[0][:200])]


def split_pieces(path: Path, folder: Path) -> list[Path]:
    """Return files of one piece each, the file itself where it has one."""
    parts = pieces_of(path.read_bytes())
    if len(parts) == 1:
        return [path]
    files = []
    for i, part in enumerate(parts):
        files.append(folder / f"{i}.vtu")
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
