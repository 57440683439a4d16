"""The registry of formats: how each is recognised, opened and listed, and which options mean nothing to it. All else asks here."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from femsense.io.importers.c3d import list_c3d, open_c3d
from femsense.io.importers.frames import Source
from femsense.io.importers.images.folders import CLOUDS, folder_kind, open_clouds, open_redwood, open_tum
from femsense.io.importers.images.kinect import open_kinect
from femsense.io.importers.options import Options
from femsense.io.importers.ros.bag import BEGINNINGS, ENDINGS
from femsense.io.importers.ros.source import list_ros, open_ros, topics_of
from femsense.io.importers.tables.csv_tables import header_of
from femsense.io.importers.tables.mocap_csv import Program, list_mocap_csv, open_mocap_csv, program_of
from femsense.io.importers.tables.plain_csv import list_plain_csv, open_plain_csv

TEXT_ENDINGS = (".csv", ".txt", ".tsv", ".trc")
HEAD = 512
"""Bytes at the beginning of a file by which formats are recognised."""


@dataclass(frozen=True, eq=False, slots=True)
class Format:
    """One format."""

    name: str
    """As `--format` takes it."""
    open: Callable[[Path, Options], Source]
    recognises: Callable[[Path, bytes], bool]
    """Called with a path and the first bytes of a file, none of a folder."""
    unused: tuple[str, ...]
    """Options that have no effect on it."""
    list: Callable[[Path], dict[str, Any]] | None = None
    """What it holds, without reading its frames; None: what opening it says."""
    endings: tuple[str, ...] = ()
    """Of files that nothing else has."""
    topics: Callable[[Path], Iterable[str]] | None = None
    """Names that `--topic` takes, where several captures share the option."""
    columns: Callable[[Path], Iterable[str]] | None = None
    """Names that `--map` takes, where a log of actuation or another capture shares the option."""
    whole_depths: bool = False
    """Whether its depth images count a unit that may be another: `--depth-unit`."""
    transforms: bool = False
    """Whether it holds frames of coordinates: `--base`."""


def _never(path: Path, head: bytes) -> bool:
    return False


def _is_bag(path: Path, head: bytes) -> bool:
    if path.is_dir():
        return (path / "metadata.yaml").is_file() or any(item.suffix in (".db3", ".mcap") for item in path.iterdir())
    return path.suffix.lower() in ENDINGS or head.startswith(tuple(begin for begin, _ in BEGINNINGS))


def _is_kinect(path: Path, head: bytes) -> bool:
    return head.startswith(b"\x1aE\xdf\xa3")


def _is_c3d(path: Path, head: bytes) -> bool:
    return path.is_file() and (path.suffix.lower() == ".c3d" or (len(head) == HEAD and head[0] == 2 and head[1] == 0x50))


def _is_text(path: Path) -> bool:
    return path.is_file() and (path.suffix.lower() in TEXT_ENDINGS or path.name.lower().endswith((".csv.gz", ".tsv.gz")))


def _is_export(program: Program, path: Path, head: bytes) -> bool:
    return (_is_text(path) or head.startswith(b"Format Version,")) and program_of(path) is program


def _is_table(path: Path, head: bytes) -> bool:
    return _is_text(path)


def _is_folder(kind: str, path: Path, head: bytes) -> bool:
    return path.is_dir() and folder_kind(path) == kind


def _is_cloud(path: Path, head: bytes) -> bool:
    return _is_folder("clouds", path, head) or (path.is_file() and path.suffix.lower() in CLOUDS)


_EXPORTS = tuple(
    Format(
        program.value,
        open_mocap_csv,
        partial(_is_export, program),
        unused=("--clock",),
        list=list_mocap_csv,
        endings=endings,
    )
    for program, endings in ((Program.OPTITRACK, ()), (Program.VICON, ()), (Program.TRC, (".trc",)), (Program.QUALISYS, ()))
)
_ALL = (
    Format("ros", open_ros, _is_bag, ("--rate",), list_ros, ENDINGS, topics_of, whole_depths=True, transforms=True),
    Format(
        "realsense", open_ros, _never, ("--rate", "--up", "--unit"), list_ros, (), topics_of, whole_depths=True, transforms=True
    ),
    Format("kinect", open_kinect, _is_kinect, ("--clock", "--rate", "--up", "--unit", "--topic"), endings=(".mkv",)),
    Format("c3d", open_c3d, _is_c3d, ("--clock", "--rate"), list_c3d, (".c3d",)),
    *_EXPORTS,
    Format(
        "csv",
        open_plain_csv,
        _is_table,
        ("--clock", "--topic"),
        list_plain_csv,
        (".gz",),
        columns=lambda path: header_of(path)[0],
    ),
    Format("tum", open_tum, partial(_is_folder, "tum"), ("--clock", "--rate", "--up", "--unit", "--topic"), whole_depths=True),
    Format("redwood", open_redwood, partial(_is_folder, "redwood"), ("--clock", "--up", "--unit", "--topic"), whole_depths=True),
    Format("clouds", open_clouds, _is_cloud, ("--clock", "--topic")),
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
    """Return what a capture holds, without reading its frames. Raises InputError: it is broken or empty."""
    if one.list is not None:
        return {"format": one.name, **one.list(path)}
    source = one.open(path, Options(rate=1.0, unit="m"))
    return {"format": one.name, "frames": source.count, **source.found}
