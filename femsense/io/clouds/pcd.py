# mypy: allow-untyped-decorators
"""PCD files with all their fields (labels too): ascii, binary and binary_compressed.

Format: the header of the Point Cloud Library, version 0.7; compressed data are one LZF stream with the fields one after another.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from numba import njit

from femsense.core.errors import InputError

Column = npt.NDArray[np.generic]
ByteArray = npt.NDArray[np.uint8]

_TYPES = {"F": "f", "U": "u", "I": "i"}
_SIZES = {"F": (4, 8), "U": (1, 2, 4, 8), "I": (1, 2, 4, 8)}


@dataclass(frozen=True, eq=False, slots=True)
class _Layout:
    names: tuple[str, ...]
    types: tuple[np.dtype[np.generic], ...]
    counts: tuple[int, ...]
    points: int
    storage: str

    @property
    def row_type(self) -> np.dtype[np.void]:
        return np.dtype([(f"{i}", t, (c,)) for i, (t, c) in enumerate(zip(self.types, self.counts))])


def read_pcd_fields(path: str | Path) -> dict[str, Column]:
    """Return the columns of a PCD file by name, each of shape (n,), or (n, count) where a field holds several values.

    Nothing is left out or converted: points without depth are NaN, `rgba` is a packed integer, `label` stays.

    Raises:
        InputError: no such file, a broken header, fewer data than it promises.
    """
    file = Path(path)
    if not file.is_file():
        raise InputError("no such file", where=file, expected="a PCD file")
    header, body = _split(file.read_bytes(), file)
    layout = _parse(header, file)
    readers = {"ascii": _read_ascii, "binary": _read_rows, "binary_compressed": _read_compressed}
    columns = readers[layout.storage](body, layout, file)
    return {name: column for name, column in zip(layout.names, columns) if name != "_"}


# --- header -----------------------------------------------------------------------------------------------------------


def _split(data: bytes, file: Path) -> tuple[dict[str, list[str]], bytes]:
    header: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in header:
        end = data.find(b"\n", start)
        if end < 0 or end - start > 65536:
            raise InputError("not a PCD file", where=file, found=repr(data[:30]), expected="a header that ends with a line DATA")
        words = data[start:end].decode("ascii", "replace").split()
        if words and not words[0].startswith("#"):
            header[words[0].upper()] = words[1:]
        start = end + 1
    return header, data[start:]


def _parse(header: dict[str, list[str]], file: Path) -> _Layout:
    names = header.get("FIELDS", [])
    if not names:
        raise InputError("the PCD header names no fields", where=file, found=", ".join(header), expected="a line FIELDS x y z …")
    sizes = _integers(header, "SIZE", len(names), file)
    counts = _integers(header, "COUNT", len(names), file) if "COUNT" in header else (1,) * len(names)
    letters = header.get("TYPE", [])
    if len(letters) != len(names) or any(size not in _SIZES.get(letter, ()) for letter, size in zip(letters, sizes)):
        found = f"TYPE {' '.join(letters)}, SIZE {' '.join(map(str, sizes))}"
        raise InputError(
            "unknown field types", where=file, found=found, expected=f"{len(names)} of F (4, 8), U or I (1, 2, 4, 8)"
        )
    storage = " ".join(header["DATA"])
    if storage not in ("ascii", "binary", "binary_compressed"):
        raise InputError("unknown storage", where=file, found=f"DATA {storage}", expected="ascii, binary or binary_compressed")
    types = tuple(np.dtype(f"<{_TYPES[letter]}{size}") for letter, size in zip(letters, sizes))
    return _Layout(tuple(names), types, counts, _point_count(header, file), storage)


def _integers(header: dict[str, list[str]], key: str, length: int, file: Path) -> tuple[int, ...]:
    words = header.get(key, [])
    if len(words) != length or not all(word.isdigit() and int(word) > 0 for word in words):
        raise InputError(
            "a broken PCD header", where=file, found=f"{key} {' '.join(words)}", expected=f"{key} with {length} numbers > 0"
        )
    return tuple(int(word) for word in words)


def _point_count(header: dict[str, list[str]], file: Path) -> int:
    words = header.get("POINTS", [])
    if len(words) == 1 and words[0].isdigit():
        return int(words[0])
    sides = header.get("WIDTH", []) + header.get("HEIGHT", [])
    if len(sides) == 2 and all(word.isdigit() for word in sides):
        return int(sides[0]) * int(sides[1])
    raise InputError(
        "the PCD header does not say how many points", where=file, found=f"POINTS {' '.join(words)}", expected="POINTS n"
    )


# --- data -------------------------------------------------------------------------------------------------------------


def _short(file: Path, found: str, expected: str) -> InputError:
    return InputError("a broken or shortened PCD file", where=file, found=found, expected=expected)


def _column(values: Column) -> Column:
    return np.ascontiguousarray(values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values)


def _read_ascii(body: bytes, layout: _Layout, file: Path) -> list[Column]:
    width = sum(layout.counts)
    rows = [line.split() for line in body.decode("ascii", "replace").splitlines() if line.strip()]
    if len(rows) != layout.points or any(len(row) != width for row in rows):
        bad = next((i for i, row in enumerate(rows) if len(row) != width), len(rows))
        raise _short(file, f"{len(rows)} rows; row {bad} is not whole", f"{layout.points} rows of {width} numbers")
    table = np.array(rows, dtype=object).reshape(layout.points, width)
    ends = np.cumsum(layout.counts)
    try:
        return [_column(table[:, end - c : end].astype(t)) for t, c, end in zip(layout.types, layout.counts, ends)]
    except ValueError as error:
        raise _short(file, str(error), "numbers") from None


def _read_rows(body: bytes, layout: _Layout, file: Path) -> list[Column]:
    size = layout.points * layout.row_type.itemsize
    if len(body) < size:
        raise _short(file, f"{len(body)} bytes of data", f"{size} bytes")
    rows = np.frombuffer(body, dtype=layout.row_type, count=layout.points)
    return [_column(rows[f"{i}"]) for i in range(len(layout.names))]


def _read_compressed(body: bytes, layout: _Layout, file: Path) -> list[Column]:
    size = layout.points * layout.row_type.itemsize
    sizes = np.frombuffer(body[:8], dtype="<u4") if len(body) >= 8 else np.zeros(2, dtype="<u4")
    packed, unpacked = int(sizes[0]), int(sizes[1])
    if unpacked != size or len(body) < 8 + packed:
        found = f"{max(len(body) - 8, 0)} bytes that unpack to {unpacked}"
        raise _short(file, found, f"{packed} bytes that unpack to {size}")
    data = np.zeros(size, dtype=np.uint8)
    done = _unpack_lzf(np.frombuffer(body, dtype=np.uint8, count=packed, offset=8), data)
    if done != size:
        raise _short(file, f"the compressed stream ends after {max(done, 0)} bytes", f"{size} bytes")
    return _slabs(data, layout)


def _slabs(data: ByteArray, layout: _Layout) -> list[Column]:
    columns: list[Column] = []
    start = 0
    for kind, count in zip(layout.types, layout.counts):
        end = start + layout.points * count * kind.itemsize
        columns.append(_column(data[start:end].view(kind).reshape(layout.points, count)))
        start = end
    return columns


@njit(cache=True)
def _unpack_lzf(source: ByteArray, target: ByteArray) -> int:
    """Unpack an LZF stream; return the number of bytes written, −1 where the stream is broken.

    A control byte below 32 copies that many plus one bytes. Any other holds a length (its upper three bits, 7: the next byte
    is added) plus two, and a distance (its lower five bits and the next byte) plus one back into what was written.
    """
    read, written = 0, 0
    while read < len(source):
        control = int(source[read])
        read += 1
        if control < 32:
            length = control + 1
            if read + length > len(source) or written + length > len(target):
                return -1
            target[written : written + length] = source[read : read + length]
            read += length
            written += length
            continue
        length = control >> 5
        if read + (2 if length == 7 else 1) > len(source):
            return -1
        if length == 7:
            length += int(source[read])
            read += 1
        back = written - ((control & 31) << 8) - int(source[read]) - 1
        read += 1
        length += 2
        if back < 0 or written + length > len(target):
            return -1
        for i in range(length):
            target[written + i] = target[back + i]
        written += length
    return written
