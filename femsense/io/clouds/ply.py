"""The vertices of PLY files: ascii, and binary of either byte order.

Format: Greg Turk's PLY 1.0. Read here and not through a library, because a shortened file must be an error and not a cloud of
whatever was in memory.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.core.pose import make_pose
from femsense.pointcloud.cloud import PointCloud

Column = npt.NDArray[np.generic]

_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True, eq=False, slots=True)
class _Element:
    name: str
    count: int
    properties: tuple[tuple[str, str], ...]
    """Name and type; the type of a list is `list`."""

    def row_type(self, order: str) -> np.dtype[np.void]:
        return np.dtype([(name, order + _TYPES[kind]) for name, kind in self.properties])

    @property
    def regular(self) -> bool:
        return all(kind != "list" for _, kind in self.properties)


def read_ply_vertices(path: str | Path) -> dict[str, Column]:
    """Return the scalar properties of the vertices of a PLY file by name, each of shape (n,), in the file's own types.

    Raises:
        InputError: no such file, a broken header, fewer data than it promises, lists in or before the vertices.
    """
    file = Path(path)
    if not file.is_file():
        raise InputError("no such file", where=file, expected="a PLY file")
    storage, elements, body = _parse(file.read_bytes(), file)
    index = next((i for i, element in enumerate(elements) if element.name == "vertex"), None)
    if index is None:
        found = ", ".join(element.name for element in elements) or "no elements"
        raise InputError("the PLY header names no vertices", where=file, found=found, expected="element vertex N")
    if not all(element.regular for element in elements[: index + 1]):
        raise InputError(
            "lists in or before the vertices", where=file, found="property list", expected="vertices of plain numbers first"
        )
    _warn_of_more(storage, elements, body, file)
    return _columns(storage, elements, index, body, file)


def ply_viewpoint(path: str | Path) -> FloatArray | None:
    """Return where an element `camera`, as PCL writes it, places the sensor: T_cloud_sensor, shape (4, 4), in the file's unit.

    None where there is none or it is the origin. Raises InputError.
    """
    file = Path(path)
    storage, elements, body = _parse(file.read_bytes(), file)
    index = next((i for i, element in enumerate(elements) if element.name == "camera" and element.count), None)
    if index is None or not all(element.regular for element in elements[: index + 1]):
        return None
    row = _columns(storage, elements, index, body, file)
    keys = [f"{axis}_axis{part}" for part in "xyz" for axis in "xyz"]
    if not {"view_px", "view_py", "view_pz", *keys} <= set(row):
        return None
    R = np.array([float(row[key][0]) for key in keys]).reshape(3, 3)
    T = make_pose(R, [float(row[f"view_p{axis}"][0]) for axis in "xyz"])
    return None if np.allclose(T, np.eye(4), atol=1e-9) else T


def write_ply(path: Path, cloud: PointCloud) -> None:
    """Write a cloud as binary PLY: single precision where that loses nothing, colours as bytes."""
    short = bool(np.array_equal(cloud.points.astype(np.float32).astype(np.float64), cloud.points))
    columns = {axis: ("float" if short else "double", cloud.points[:, i]) for i, axis in enumerate("xyz")}
    if cloud.colors is not None:
        columns |= {name: ("uchar", np.rint(255.0 * cloud.colors[:, i])) for i, name in enumerate(("red", "green", "blue"))}
    vertex = _Element("vertex", len(cloud), tuple((name, kind) for name, (kind, _) in columns.items()))
    rows = np.empty(len(cloud), dtype=vertex.row_type("<"))
    for name, (_, values) in columns.items():
        rows[name] = values
    properties = [f"property {kind} {name}" for name, kind in vertex.properties]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *properties, "end_header", ""]
    path.write_bytes("\n".join(head).encode("ascii") + rows.tobytes())


def _parse(data: bytes, file: Path) -> tuple[str, list[_Element], bytes]:
    """Return the storage format, the elements, and the data after the header."""
    end = data.find(b"end_header")
    line_end = data.find(b"\n", end)
    lines = data[: max(end, 0)].decode("ascii", "replace").splitlines()
    if not lines or lines[0].strip() != "ply" or line_end < 0:
        raise InputError("not a PLY file", where=file, found=repr(data[:30]), expected="a header from `ply` to `end_header`")
    storage, elements = "", list[_Element]()
    for line in lines[1:]:
        words = line.split()
        match words:
            case ["format", name, *_]:
                storage = name
            case ["element", name, count] if count.isdigit():
                elements.append(_Element(name, int(count), ()))
            case ["property", "list", _, _, name] if elements:
                elements[-1] = _with_property(elements[-1], name, "list")
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1] = _with_property(elements[-1], name, kind)
            case [] | ["comment" | "obj_info", *_]:
                continue
            case _:
                raise InputError(
                    "an unknown line in the PLY header", where=file, found=line, expected="format, element, property"
                )
    if storage not in _ORDERS:
        raise InputError("unknown storage", where=file, found=f"format {storage}", expected=", ".join(_ORDERS))
    return storage, elements, data[line_end + 1 :]


def _warn_of_more(storage: str, elements: list[_Element], body: bytes, file: Path) -> None:
    """Warn of a file that holds more than its header announces."""
    if not all(element.regular for element in elements):
        return
    if storage == "ascii":
        more = sum(bool(line.strip()) for line in body.splitlines()) - sum(element.count for element in elements)
        unit = "lines"
    else:
        more = len(body) - sum(e.count * e.row_type(_ORDERS[storage]).itemsize for e in elements)
        more, unit = (0 if not body[len(body) - more :].strip() else more, "bytes")
    if more > 0:
        warnings.warn(f"{file}: {more} {unit} more than the header announces are not read: is its count right?", stacklevel=5)


def _with_property(element: _Element, name: str, kind: str) -> _Element:
    return _Element(element.name, element.count, (*element.properties, (name, kind)))


def _short(file: Path, found: str, expected: str) -> InputError:
    return InputError("a broken or shortened PLY file", where=file, found=found, expected=expected)


def _columns(storage: str, elements: list[_Element], index: int, body: bytes, file: Path) -> dict[str, Column]:
    """Return the columns of an element without lists, which only such elements precede. Raises InputError."""
    before, element = elements[:index], elements[index]
    if storage == "ascii":
        return _read_ascii(body, sum(other.count for other in before), element, file)
    order = _ORDERS[storage]
    kind, start = element.row_type(order), sum(other.count * other.row_type(order).itemsize for other in before)
    if len(body) < start + element.count * kind.itemsize:
        whole = max(len(body) - start, 0) // max(kind.itemsize, 1)
        raise _short(file, f"{whole} whole vertices", f"{element.count} vertices, as the header says")
    rows = np.frombuffer(body, dtype=kind, count=element.count, offset=start)
    return {name: np.ascontiguousarray(rows[name]) for name, _ in element.properties}


def _read_ascii(body: bytes, skip: int, vertex: _Element, file: Path) -> dict[str, Column]:
    text = body.decode("ascii", "replace")
    text = text.replace(",", ".") if re.search(r"\d,\d", text) else text  # decimal commas: nothing else of PLY has commas
    lines = [line.split() for line in text.splitlines() if line.strip()]
    rows = lines[skip : skip + vertex.count]
    width = len(vertex.properties)
    if len(rows) < vertex.count or any(len(row) != width for row in rows):
        bad = next((i for i, row in enumerate(rows) if len(row) != width), len(rows))
        raise _short(file, f"{len(rows)} vertices; vertex {bad} is not whole", f"{vertex.count} vertices of {width} numbers")
    table = np.array(rows, dtype=object).reshape(vertex.count, width)
    try:
        return {name: table[:, i].astype(_TYPES[kind]) for i, (name, kind) in enumerate(vertex.properties)}
    except ValueError as error:
        raise _short(file, str(error), "numbers") from None
