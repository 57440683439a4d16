"""The registry of formats: in which order they are tried, and which one a file or a folder has."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from femsense.io.importers import c3d
from femsense.io.importers.frames import HEAD, Format
from femsense.io.importers.images import folders, kinect
from femsense.io.importers.options import Options
from femsense.io.importers.ros import source as ros
from femsense.io.importers.tables import mocap_csv, plain_csv

_ALL: tuple[Format, ...] = (
    ros.ROS,
    ros.REALSENSE,
    kinect.KINECT,
    c3d.C3D,
    *mocap_csv.EXPORTS,
    plain_csv.CSV,
    folders.TUM,
    folders.REDWOOD,
    folders.CLOUDS,
)
FORMATS = {one.name: one for one in _ALL}
"""Name → format, in the order in which they are tried."""
CAPTURE_ENDINGS = tuple(ending for one in _ALL for ending in one.endings)
"""Endings of files that only other programs' captures have."""


def format_of(path: Path) -> Format | None:
    """Return the format of a file by its first bytes, then its ending, or of a folder by its files; None where nothing fits."""
    head = b""
    if path.is_file():
        with path.open("rb") as stream:
            head = stream.read(HEAD)
    return next((one for one in _ALL if one.recognises(path, head)), None)


def contents_of(one: Format, path: Path) -> dict[str, Any]:
    """Return the contents of a capture, without reading its frames. Raises InputError if it is broken or empty."""
    if one.list is not None:
        return {"format": one.name, **one.list(path)}
    source = one.open(path, Options(rate=1.0, unit="m"))
    known = {key: value for key, value in source.found.items() if value is not None}
    return {"format": one.name, "frames": source.count, **known}
