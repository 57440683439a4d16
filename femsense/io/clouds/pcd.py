"""PCD files with all their fields (labels too), read by pypcd4: ascii, binary and binary_compressed.

pypcd4 is strict about headers and spaces, and splits fields of several values. Entries that older writers omit (VERSION, COUNT, WIDTH and
HEIGHT) are added before reading, and such fields are joined afterwards.
"""

from __future__ import annotations

import io
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.core.pose import make_pose

Column = npt.NDArray[np.generic]

MOST_OF_A_LINE = 65536
"""A line of a header that is longer [bytes] belongs to something else."""


def read_pcd_fields(path: str | Path) -> dict[str, Column]:
    """Return the columns of a PCD file by name, each of shape (n,), or (n, count) where a field holds several values.

    Values are not filtered or converted: points without depth are NaN, `rgba` is a packed integer, `label` is kept.

    Raises:
        InputError: no such file, a broken header, fewer data than it declares.
    """
    from pypcd4 import PointCloud

    file = Path(path)
    if not file.is_file():
        raise InputError("no such file", where=file, expected="a PCD file")
    lines, body = _split(file.read_bytes(), file)
    _check_points(lines, file)
    header = _header(lines, file)
    if header.data == "ascii":
        body = body.replace(b",", b".")  # decimal commas: nothing else of PCD has commas
        body = b"\n".join(b" ".join(line.split()) for line in body.splitlines() if line.strip())
    _check_size(body, header, file)
    stream = io.BufferedReader(io.BytesIO(header.compose_header().encode() + body))
    try:
        rows = np.atleast_1d(PointCloud.from_fileobj(stream).pc_data)
    except (ValueError, TypeError, RuntimeError) as error:
        raise _short(file, str(error), f"{header.points} rows of {sum(header.count)} numbers") from None
    if len(rows) != header.points:
        raise _short(file, f"{len(rows)} rows", f"{header.points} rows of {sum(header.count)} numbers")
    return {name: _column(rows, name, header) for name in header.fields if not name.startswith(PADDING)}


def pcd_viewpoint(path: str | Path) -> FloatArray | None:
    """Return the sensor pose of the header, T_cloud_sensor, shape (4, 4), translation in the file's unit; None for the origin of the
    cloud. Raises InputError."""
    from scipy.spatial.transform import Rotation

    file = Path(path)
    with file.open("rb") as stream:
        words = _split(stream.read(MOST_OF_A_LINE), file)[0].get("VIEWPOINT", [])
    try:
        x, y, z, qw, qx, qy, qz = (float(word) for word in words)
        T = make_pose(Rotation.from_quat([qx, qy, qz, qw]).as_matrix(), [x, y, z])
    except ValueError:  # not seven numbers, or a zero quaternion: no pose
        return None
    return None if np.allclose(T, np.eye(4), atol=1e-9) else T


def _check_points(words: dict[str, list[str]], file: Path) -> None:
    """Refuse a header whose WIDTH × HEIGHT are not its POINTS. Raises InputError."""
    sides, points = [*words.get("WIDTH", []), *words.get("HEIGHT", [])], words.get("POINTS", [])
    if (
        len(sides) == 2
        and len(points) == 1
        and "".join([*sides, *points]).isdigit()
        and int(sides[0]) * int(sides[1]) != int(points[0])
    ):
        raise InputError(
            "a PCD header that contradicts itself",
            where=file,
            found=f"WIDTH {sides[0]}, HEIGHT {sides[1]}, POINTS {points[0]}",
            expected="WIDTH × HEIGHT = POINTS",
        )


PADDING = "#$%&~~"
"""Prefix that pypcd4 adds to fields named `_`, which are padding."""


def _split(data: bytes, file: Path) -> tuple[dict[str, list[str]], bytes]:
    """Return the words of the header by their key, and the data behind it."""
    header: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in header:
        end = data.find(b"\n", start)
        if end < 0 or end - start > MOST_OF_A_LINE:
            raise InputError("not a PCD file", where=file, found=repr(data[:30]), expected="a header that ends with a line DATA")
        words = data[start:end].decode("ascii", "replace").split()
        if words and not words[0].startswith("#"):
            header[words[0].upper()] = words[1:]
        start = end + 1
    return header, data[start:]


def _header(words: dict[str, list[str]], file: Path) -> Any:
    """Return the header as pypcd4 understands it."""
    from pydantic import ValidationError
    from pypcd4 import MetaData
    from pypcd4.pypcd4 import PCD_TYPE_TO_NUMPY_TYPE

    names, sides = words.get("FIELDS", []), words.get("WIDTH", []) + words.get("HEIGHT", [])
    points = words.get("POINTS") or ([str(int(sides[0]) * int(sides[1]))] if len(sides) == 2 and "".join(sides).isdigit() else [])
    filled = {"COUNT": ["1"] * len(names)} | words | {"VERSION": ["0.7"], "POINTS": points, "WIDTH": points, "HEIGHT": ["1"]}
    try:
        header = MetaData.parse_header([f"{key} {' '.join(values)}" for key, values in filled.items()])
    except ValidationError as error:
        problem = error.errors()[0]
        key = str(problem["loc"][0]).upper()
        raise InputError(
            "a broken PCD header", where=file, found=" ".join([key, *words.get(key, [])]), expected=problem["msg"]
        ) from None
    except (ValueError, IndexError) as error:
        raise InputError("a broken PCD header", where=file, found=str(error), expected="whole numbers") from None
    kinds = list(zip(header.type, header.size))
    if {len(header.type), len(header.size), len(header.count)} != {len(names)} or not set(kinds) <= set(PCD_TYPE_TO_NUMPY_TYPE):
        found = f"TYPE {' '.join(header.type)}, SIZE {' '.join(map(str, header.size))}, COUNT {' '.join(map(str, header.count))}"
        raise InputError(
            "unknown field types", where=file, found=found, expected=f"{len(names)} of F (4, 8), U or I (1, 2, 4, 8)"
        )
    return header


def _check_size(body: bytes, header: Any, file: Path) -> None:
    """Raise InputError where there are fewer binary data than the header promises."""
    size = header.points * header.build_dtype().itemsize
    if header.data == "binary" and len(body) < size:
        raise _short(file, f"{len(body)} bytes of data", f"{size} bytes")
    if header.data == "binary" and body[size:].strip(b"\0\r\n "):
        text = f"{len(body) - size} bytes more than the header announces are not read: is POINTS right?"
        warnings.warn(f"{file}: {text}", stacklevel=5)
    if header.data == "binary_compressed":
        packed, unpacked = struct.unpack("<II", body[:8]) if len(body) >= 8 else (0, 0)
        if unpacked != size or len(body) < 8 + packed:
            found = f"{max(len(body) - 8, 0)} bytes that unpack to {unpacked}"
            raise _short(file, found, f"{packed} bytes that unpack to {size}")


def _short(file: Path, found: str, expected: str) -> InputError:
    return InputError("a broken or shortened PCD file", where=file, found=found, expected=expected)


def _column(rows: npt.NDArray[Any], name: str, header: Any) -> Column:
    """Return a field; one of several values is a column each in `rows`, in the order of the file where it is compressed."""
    count = header.count[header.fields.index(name)]
    if count == 1:
        return np.ascontiguousarray(rows[name])
    parts = [rows[f"{name}__{k:04d}"] for k in range(count)]
    if header.data == "binary_compressed":  # all values of the first point, then those of the next one
        return np.concatenate(parts).reshape(len(rows), count)
    return np.stack(parts, axis=1)
