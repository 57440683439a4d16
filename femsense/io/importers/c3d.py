"""C3D files of motion capture (https://www.c3d.org): points over time, in the unit that the file names.

Read here, one frame after the other: `ezc3d` 1.7.2 loads the whole file, refuses numbers of big-endian machines and ends at frame
65 535; `c3d` 0.6.0 reads no frame of a longer file.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.core.text import plain_name
from femsense.io.importers.frames import HEAD, Format, Source
from femsense.io.importers.motion_capture import Row, capture_source, tracks_of
from femsense.io.importers.options import Options

BLOCK = 512
MOST = 65535
"""Largest count of the header; some writers stop there without the longer count of TRIAL."""
INTEL, DEC, MIPS = 84, 85, 86
"""The processors whose numbers a file holds: little-endian, VAX, big-endian."""

OUTPUTS = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS", "REACTIONS")
"""Parameters of POINT that name tracks which are no places: results of a model of the body."""


@dataclass(frozen=True, eq=False, slots=True)
class Header:
    """Header and parameters of a C3D file."""

    points: int
    analog: int
    """Analog values a frame."""
    frames: int
    rate: float
    """[1/s]."""
    scale: float
    """Of integer coordinates; negative where they are floats."""
    data_at: int
    """Byte at which the frames begin."""
    processor: int
    labels: tuple[str, ...]
    unit: str | None
    up: str | None
    """The vertical axis as the file has it, such as "+Y"."""
    outputs: frozenset[str] = frozenset()
    """Labels that are no places (angles, forces …)."""
    disagreements: tuple[str, ...] = ()
    """Contradictions of header and parameters."""


def open_c3d(path: Path, options: Options) -> Source:
    """Return a C3D file as a source.

    Raises:
        InputError: not a C3D file, no points, truncated before the first whole frame, or no unit.
    """
    header = read_c3d_header(path)
    if not header.points:
        raise InputError("no points", where=path, found=f"{header.analog} analog values a frame", expected="markers over time")
    whole = min(header.frames, _whole_frames(path, header))
    if header.frames == MOST:
        whole = _whole_frames(path, header)
    if not whole:
        raise InputError(
            "a C3D file without a whole frame",
            where=path,
            found=f"{path.stat().st_size} bytes",
            expected=f"{header.frames} frames",
        )
    kept = [k for k, label in enumerate(header.labels) if label not in header.outputs or label in options.topics]
    if not kept:
        raise InputError(
            "no markers", where=path, found=f"results of a model only: {', '.join(header.labels)}", expected="tracks of markers"
        )
    notes = [f"the file is cut off: {whole} of {header.frames} frames"] if whole < header.frames else []
    notes += [f"the header counts to {MOST} only: {whole} frames by the size of the file"] if whole > header.frames else []
    notes += header.disagreements
    left_out = [name for name in header.labels if name in header.outputs]
    notes += [f"model outputs, which are not positions, are left out: {', '.join(left_out)}"] if left_out else []
    tracks = tracks_of(header.labels)
    return capture_source(
        path,
        [tracks[k] for k in kept],
        partial(_rows, path, header, whole, kept),
        options,
        unit=header.unit,
        found={"up_in_file": header.up, "frames_declared": header.frames},
        count=whole,
        notes=notes,
    )


def list_c3d(path: Path) -> dict[str, Any]:
    """Return the contents that a C3D file declares. Raises InputError."""
    header = read_c3d_header(path)
    source = open_c3d(path, Options(unit=None if header.unit else "mm"))
    points = [name for name in header.labels if name not in header.outputs]
    return {
        "frames": header.frames,
        "rate_hz": header.rate,
        "points": points,
        "no_places": sorted(header.outputs & set(header.labels)) or None,
        "unit": header.unit,
        "up_in_file": header.up,
        "notes": list(source.notes) or None,
    }


def read_c3d_header(path: Path) -> Header:
    """Return the header and the parameters of a C3D file. Raises InputError."""
    with path.open("rb") as stream:
        head = stream.read(BLOCK)
        if len(head) < BLOCK or head[1] != 0x50:
            raise InputError(
                "not a C3D file", where=path, found=f"{len(head)} bytes that begin {head[:2]!r}", expected="a header of 512 bytes"
            )
        stream.seek((head[0] - 1) * BLOCK)
        block = stream.read(4)
        count, processor = (block[2], block[3]) if len(block) == 4 else (0, 0)
        if processor not in (INTEL, DEC, MIPS):
            raise InputError("unknown numbers in a C3D file", where=path, found=f"processor {processor}", expected="84, 85 or 86")
        body = stream.read(max(count * BLOCK, BLOCK) - 4)
    values = _Numbers(processor)
    words = np.frombuffer(head, dtype=values.u2)
    first, last = int(words[3]), int(words[4])
    parameters = _parameters(body, values, path)
    points = int(words[1])
    rate = values.real(head[20:24])
    labels = _labels(parameters, points)
    frames = _frame_count(parameters, last - first + 1)
    outputs = _outputs(parameters)
    return Header(
        points,
        int(words[2]),
        frames,
        _scalar(parameters.get(("POINT", "RATE")), rate) or rate or 1.0,
        values.real(head[12:16]),
        (_data_block(parameters, int(words[8])) - 1) * BLOCK,
        processor,
        labels,
        _text(parameters.get(("POINT", "UNITS"))),
        _up(parameters),
        outputs,
        _disagreements(parameters, points, rate, last - first + 1),
    )


def _outputs(parameters: Parameters) -> frozenset[str]:
    """Return the labels that POINT:ANGLES, FORCES … and the further groups of POINT:TYPE_GROUPS name."""
    kinds = _texts(parameters, "TYPE_GROUPS")
    groups = {*OUTPUTS, *(kind.upper() for kind in kinds if "MARKER" not in kind.upper() and "LABEL" not in kind.upper())}
    return frozenset(name for group in groups for name in _texts(parameters, group) if name)


def _disagreements(parameters: Parameters, points: int, rate: float, frames: int) -> tuple[str, ...]:
    """Return the differences between the header and the parameters of a file; the header describes the stored data."""
    used = int(_scalar(parameters.get(("POINT", "USED")), points))
    other_rate = _scalar(parameters.get(("POINT", "RATE")), rate)
    labels, names = len([name for name in _texts(parameters, "LABELS") if name]), parameters.get(("POINT", "LABELS"))
    found = [f"the header has {points} points, POINT:USED says {used}: the header's are read"] if used != points else []
    if rate and other_rate and abs(other_rate / rate - 1.0) > 1e-3:
        found.append(f"the header has {rate:g} frames a second, POINT:RATE {other_rate:g}: the second is taken")
    if names is not None and labels < min(points, 255):
        found.append(f"{points} points, but {labels} labels: the rest are called point{labels + 1} …")
    stored = int(_scalar(parameters.get(("POINT", "FRAMES")), frames))
    if 0 < stored < MOST and stored != frames and 0 < frames < MOST:
        found.append(f"the header has {frames} frames, POINT:FRAMES says {stored}")
    return tuple(found)


def _texts(parameters: Parameters, name: str) -> list[str]:
    """Return the texts of a parameter of POINT and of those that continue it (NAME2, NAME3 …)."""
    found: list[str] = []
    for key in (name, *(f"{name}{k}" for k in range(2, 10))):
        value = parameters.get(("POINT", key), [])
        found += [value] if isinstance(value, str) else [str(item) for item in value] if isinstance(value, list) else []
    return found


def _rows(path: Path, header: Header, whole: int, kept: Sequence[int]) -> Iterator[Row]:
    size = _frame_size(header)
    with path.open("rb") as stream:
        stream.seek(header.data_at)
        for number in range(whole):
            yield Row(number / header.rate, _points(stream.read(size), header)[kept], {})


def _whole_frames(path: Path, header: Header) -> int:
    """Return how many frames the file holds, without the zeros that fill its last block."""
    size = _frame_size(header)
    count = max(path.stat().st_size - header.data_at, 0) // size
    with path.open("rb") as stream:
        for _ in range(min(count, BLOCK // size)):
            stream.seek(header.data_at + (count - 1) * size)
            if any(stream.read(size)):
                break
            count -= 1
    return count


def _frame_size(header: Header) -> int:
    return (4 * header.points + header.analog) * (4 if header.scale < 0 else 2)


def _points(data: bytes, header: Header) -> FloatArray:
    """Return the places in the file's unit, shape (points, 3); NaN where a point is missing (residual −1)."""
    values = _Numbers(header.processor)
    if header.scale < 0:
        table = values.reals(data[: 16 * header.points]).reshape(-1, 4)
        return np.where(table[:, 3:] < 0, np.nan, table[:, :3])
    words = np.frombuffer(data[: 8 * header.points], dtype=values.i2).reshape(-1, 4)
    return np.where(words[:, 3:] < 0, np.nan, words[:, :3] * header.scale)


# Parameters

Parameters = dict[tuple[str, str], Any]


class _Numbers:
    """Numbers as one kind of processor writes them."""

    def __init__(self, processor: int) -> None:
        order = ">" if processor == MIPS else "<"
        self.vax = processor == DEC
        self.i2, self.u2, self.f4 = np.dtype(order + "i2"), np.dtype(order + "u2"), np.dtype(order + "f4")

    def real(self, data: bytes) -> float:
        return float(self.reals(data)[0])

    def reals(self, data: bytes) -> FloatArray:
        """Return single-precision numbers; those of the VAX have their halves exchanged and an exponent higher by two."""
        if not self.vax:
            return np.frombuffer(data, dtype=self.f4).astype(np.float64)
        halves = np.frombuffer(data, dtype="<u2").reshape(-1, 2)[:, ::-1]
        return np.ascontiguousarray(halves).view("<f4")[:, 0].astype(np.float64) / 4.0


def _parameters(body: bytes, values: _Numbers, path: Path) -> Parameters:
    """Return (group, name) → value: a text, a list of texts or an array."""
    groups: dict[int, str] = {}
    raw: list[tuple[int, str, Any]] = []
    at = 0
    try:
        while at + 4 < len(body):
            length, group = struct.unpack_from("<bb", body, at)
            if length == 0 or group == 0:
                break
            name_end = at + 2 + abs(length)
            name = body[at + 2 : name_end].decode("latin-1").strip().upper()
            step = int(np.frombuffer(body[name_end : name_end + 2], dtype=values.i2)[0])
            if group < 0:
                groups[-group] = name
            else:
                raw.append((group, name, _value(body[name_end + 2 :], values)))
            if step <= 0:
                break
            at = name_end + step
    except (struct.error, IndexError, ValueError) as error:
        raise InputError(
            "broken parameters in a C3D file", where=path, found=str(error), expected="a whole parameter section"
        ) from None
    return {(groups.get(group, str(group)), name): value for group, name, value in raw}


def _value(data: bytes, values: _Numbers) -> Any:
    kind, count = struct.unpack_from("<bB", data, 0)
    shape = list(data[2 : 2 + count])
    size = int(np.prod(shape)) if shape else 1
    start = 2 + count
    if kind == -1:
        text = data[start : start + size]
        if len(shape) < 2:
            return _decoded(text)
        return [_decoded(text[i : i + shape[0]]) for i in range(0, size, shape[0])] if shape[0] else []
    if kind == 4:
        return values.reals(data[start : start + 4 * size])
    return np.frombuffer(data[start : start + kind * size], dtype=values.u2 if kind == 2 else np.uint8)


def _decoded(text: bytes) -> str:
    """Return a text in UTF-8, also where its last letter is cut off by the width of its field, else in Latin-1, without its padding."""
    try:
        return plain_name(text.decode("utf-8"))
    except UnicodeDecodeError as error:
        cut = error.reason == "unexpected end of data"
        return plain_name(text[: error.start].decode("utf-8") if cut else text.decode("latin-1"))


def _labels(parameters: Parameters, points: int) -> tuple[str, ...]:
    found = _texts(parameters, "LABELS")
    found = [name or f"point{k + 1}" for k, name in enumerate(found[:points])]
    return tuple(found + [f"point{k + 1}" for k in range(len(found), points)])


def _frame_count(parameters: Parameters, header: int) -> int:
    """Return the number of frames; above 65535 it does not fit into the header."""
    start, end = parameters.get(("TRIAL", "ACTUAL_START_FIELD")), parameters.get(("TRIAL", "ACTUAL_END_FIELD"))
    if start is None or end is None or len(start) < 2 or len(end) < 2:
        long = _scalar(parameters.get(("POINT", "LONG_FRAMES")), 0.0)
        return int(long) or max(header, 0)
    first, last = int(start[0]) + 65536 * int(start[1]), int(end[0]) + 65536 * int(end[1])
    return last - first + 1 if last >= first else max(header, 0)


def _data_block(parameters: Parameters, header: int) -> int:
    return int(_scalar(parameters.get(("POINT", "DATA_START")), header)) or header


def _scalar(value: Any, default: float) -> float:
    return float(value[0]) if isinstance(value, np.ndarray) and len(value) else default


def _text(value: Any) -> str | None:
    text = value[0] if isinstance(value, list) and value else value
    return str(text) if isinstance(text, str) and text else None


def _up(parameters: Parameters) -> str | None:
    return _text(parameters.get(("POINT", "Y_SCREEN")))


def _is_c3d(path: Path, head: bytes) -> bool:
    return path.is_file() and (path.suffix.lower() == ".c3d" or (len(head) == HEAD and head[0] == 2 and head[1] == 0x50))


C3D = Format("c3d", open_c3d, _is_c3d, ("--clock", "--rate"), list_c3d, (".c3d",))
