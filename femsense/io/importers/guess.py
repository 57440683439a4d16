"""Which importer a file or folder is for."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

from femsense.core.errors import InputError
from femsense.core.text import did_you_mean
from femsense.io.importers.c3d import open_c3d, read_c3d_header
from femsense.io.importers.csv_tables import header_of
from femsense.io.importers.folders import CLOUDS, PAIRS, folder_kind, open_clouds, open_redwood, open_tum
from femsense.io.importers.foreign import export_hint
from femsense.io.importers.frames import Options, Source
from femsense.io.importers.kinect import open_kinect
from femsense.io.importers.mapping import check_names, check_taken, check_targets, resolved
from femsense.io.importers.mocap_csv import is_mocap_csv, open_mocap_csv, read_export
from femsense.io.importers.plain_csv import open_plain_csv
from femsense.io.importers.ros import list_ros, open_ros
from femsense.io.importers.ros_bag import ENDINGS
from femsense.io.importers.several import camera_names, joined

FORMATS: dict[str, Callable[[Path, Options], Source]] = {
    "ros": open_ros,
    "realsense": open_ros,
    "kinect": open_kinect,
    "c3d": open_c3d,
    "optitrack": open_mocap_csv,
    "vicon": open_mocap_csv,
    "csv": open_plain_csv,
    "tum": open_tum,
    "redwood": open_redwood,
    "clouds": open_clouds,
}
"""Names of `--format`. Each importer says what it finds as a `Source`, whose frames come one after the other."""
WHOLE_DEPTHS = ("ros", "realsense", "tum", "redwood")
"""Formats whose depth images count a unit that may be another."""
SIGNATURES = (
    (b"#ROSBAG V2.0", "ros"),
    (b"\x89MCAP0\r\n", "ros"),
    (b"SQLite format 3\x00", "ros"),
    (b"Format Version,", "optitrack"),
    (b"\x1aE\xdf\xa3", "kinect"),
)
"""How files begin; the ending comes second."""
PACKED = (".zstd", ".zst", ".zip", ".7z", ".tar", ".tgz", ".bz2", ".xz")
UNPACK = "unpack it first (zstd -d, unzip, tar -x); a compressed bag of ROS 2 is read by its folder, which holds metadata.yaml"


def open_source(path: str | Path, options: Options | None = None) -> Source:
    """Return what a file or a folder holds, ready to be read frame by frame.

    Arguments:
        path: the file or folder.
        options: what a person says about it.

    Raises:
        InputError: nothing there, no format that is known, or a choice that a person must make: what can be chosen is named.
    """
    said = options or Options()
    check_targets(said.columns)
    source = _opened(path, said)
    check_names(said.columns, source.names, source.path, said.log_names)
    if not source.views:
        check_taken(said.columns, source.names, source.path)
    return source


def _opened(path: str | Path, said: Options) -> Source:
    """Return a source; whether it has the names of `--map` is not looked at."""
    source = Path(path).expanduser()
    if source.name in ("depth.txt", *PAIRS) and folder_kind(source.parent) == "tum":
        source = source.parent
    if not source.exists():
        names = [item.name for item in source.parent.iterdir()] if source.parent.is_dir() else []
        raise InputError("nothing there", where=source, expected="a file or a folder", hint=did_you_mean(source.name, names))
    name = said.format or guess_format(source)
    if said.base is not None and name not in ("ros", "realsense"):
        raise InputError("frames of coordinates stand in bags only", where=f"--base {said.base}", found=source)
    if said.depth_unit is not None and name not in WHOLE_DEPTHS:
        raise InputError(
            "a unit of depth images is said of what has none, or one of its own",
            where=f"--depth-unit {said.depth_unit:g}",
            found=name or source,
            expected=", ".join(WHOLE_DEPTHS),
        )
    if name not in FORMATS:
        found = f"{source.suffix or 'no ending'}" if name is None else name
        packed = name is None and (source.suffix in PACKED or (source.is_dir() and any(source.glob("*.zstd"))))
        raise InputError(
            "not a format that femsense imports" if name is None else "no such format",
            where=source,
            found=found,
            expected="--format " + "|".join(FORMATS),
            hint=UNPACK if packed else export_hint(source) if name is None else did_you_mean(name, FORMATS),
        )
    return FORMATS[name](source, said)


def open_sources(paths: Sequence[str | Path], options: Options | None = None) -> Source:
    """Return what one or several captures hold; of several each is a camera (or a motion capture) of one recording.

    Arguments:
        paths: files or folders; NAME=PATH names the camera.
        options: what a person says about all of them; a topic that one bag does not hold is another's.

    Raises:
        InputError: as `open_source`; names that stand twice; clocks that do not overlap, also by time of recording.
    """
    said = options or Options()
    source = _one_or_joined(paths, said)
    count = None if source.count is None else -(-source.count // said.every)
    return replace(source, frames=lambda: islice(source.frames(), 0, None, said.every), count=count, free=said.free)


def _one_or_joined(paths: Sequence[str | Path], said: Options) -> Source:
    if len(paths) == 1:
        source = open_source(paths[0], said)
        return source if source.views or not said.shifts else joined({"": source}, source.path, said)
    given = [split_name(path) for path in paths]
    guessed = camera_names([str(path) for _, path in given])
    check_targets(said.columns)
    names = [name or other for (name, _), other in zip(given, guessed)]
    if len(set(names)) < len(names):
        raise InputError(
            "a name of a camera stands twice", where="SOURCE", found=", ".join(names), expected="NAME=PATH with names"
        )
    files = [path for _, path in given]
    try:
        source = joined({name: _one_of(file, said) for name, file in zip(names, files)}, files[0], said)
    except InputError:
        if said.clock != "auto":
            raise
        by_record = replace(said, clock="record")
        sources = {name: _one_of(file, by_record) for name, file in zip(names, files)}
        by_time: Source | None = None
        with contextlib.suppress(InputError):
            by_time = joined(sources, files[0], said)
        if by_time is None:
            raise
        source = replace(by_time, notes=[*by_time.notes, "the devices' clocks differ: times are those of recording"])
    check_names(said.columns, source.names, files[0], said.log_names)
    return source


def _one_of(path: Path, options: Options) -> Source:
    """Return one of several captures, a camera of its own."""
    if options.topics and path.exists() and (options.format or guess_format(path)) in ("ros", "realsense"):
        held = {row["topic"] for row in list_ros(path)["topics"]}
        options = replace(options, topics=[topic for topic in options.topics if topic in held])
    if path.is_file() and (options.format or guess_format(path)) == "csv":
        held_here = resolved(options.columns, header_of(path)[0])
        options = replace(options, columns={old: new for old, new in held_here.items() if old in header_of(path)[0]})
    source = _opened(path, options)
    if source.views:
        raise InputError(
            "a capture with several cameras beside others", where=path, found=", ".join(source.views), expected="one"
        )
    return source


def split_name(text: str | Path) -> tuple[str, Path]:
    """Return the name, empty where none is given, and the path of NAME=PATH."""
    name, mark, path = str(text).partition("=")
    if Path(text).expanduser().exists() or not mark or not re.fullmatch(r"\w[\w-]*", name):
        return "", Path(text).expanduser()
    return name, Path(path).expanduser()


def guess_format(path: Path) -> str | None:
    """Return a key of FORMATS from the first bytes, the ending and the files of a folder; None where nothing fits."""
    if path.is_dir():
        if (path / "metadata.yaml").is_file() or any(item.suffix in (".db3", ".mcap") for item in path.iterdir()):
            return "ros"
        return folder_kind(path)
    with path.open("rb") as stream:
        head = stream.read(512)
    by_content = next((name for begin, name in SIGNATURES if head.startswith(begin)), None)
    ending = path.suffix.lower()
    if by_content is not None or ending in ENDINGS:
        return by_content or "ros"
    if ending == ".c3d" or (len(head) == 512 and head[1] == 0x50 and head[0] == 2):
        return "c3d"
    if ending in (".csv", ".txt", ".tsv") or path.name.lower().endswith((".csv.gz", ".tsv.gz")):
        return _csv_kind(path)
    return "clouds" if ending in CLOUDS else None


def contents(path: Path) -> dict[str, Any]:
    """Return what a capture holds, without reading its frames: for `femsense inspect`.

    Raises:
        InputError: it is broken, empty, or nothing that is known.
    """
    name = guess_format(path)
    if name is None:
        raise InputError(
            "not a format that femsense imports", where=path, found=path.suffix or "no ending", expected=", ".join(FORMATS)
        )
    if name == "ros":
        return {"format": name, **list_ros(path)}
    if name == "c3d":
        header = read_c3d_header(path)
        open_c3d(path, Options(unit=None if header.unit else "mm"))
        table = {
            "frames": header.frames,
            "rate_hz": header.rate,
            "points": list(header.labels),
            "unit": header.unit,
            "up_in_file": header.up,
        }
        return {"format": name, **table}
    if name in ("optitrack", "vicon"):
        export = read_export(path)
        return {
            "format": export.program,
            "markers": [n or "(unnamed)" for n, _ in export.markers],
            "unit": export.unit,
            "rate_hz": export.rate,
        }
    if name == "csv":
        names, headed = header_of(path)
        return {"format": name, "columns": names if headed else len(names)}
    source = FORMATS[name](path, Options(rate=1.0, unit="m"))
    return {"format": name, "frames": source.count, **source.found}


def _csv_kind(path: Path) -> str:
    if not is_mocap_csv(path):
        return "csv"
    return read_export(path).program
