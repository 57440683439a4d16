"""Identify the format of a file or folder, and open it as a source."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

from femsense.core.errors import InputError
from femsense.core.text import did_you_mean
from femsense.io.importers.foreign import export_hint
from femsense.io.importers.formats import FORMATS, contents_of, format_of
from femsense.io.importers.frames import Format, Source
from femsense.io.importers.images.folders import PAIRS, is_tum
from femsense.io.importers.options import Clock, Options
from femsense.io.importers.several import camera_names, joined
from femsense.io.importers.tables.mapping import check_names, check_taken, check_targets, resolved

PACKED = (".zstd", ".zst", ".zip", ".7z", ".tar", ".tgz", ".bz2", ".xz")
FEW_CAMERAS = 8
"""Largest number of captures without names that are taken for the cameras of one recording. It is also the number of entries of a folder that
are examined to find out whether the folder holds captures."""
UNPACK = "unpack it first (zstd -d, unzip, tar -x); a compressed bag of ROS 2 is read by its folder, which holds metadata.yaml"


def open_source(path: str | Path, options: Options | None = None) -> Source:
    """Return the contents of a file or folder as a source that is read frame by frame.

    Arguments:
        path: the file or folder.
        options: of the user.

    Raises:
        InputError: there is no such file, the format is unknown, or the user must choose; the message lists the choices.
    """
    said = options or Options()
    check_targets(said.columns)
    source = _opened(path, said)
    check_names(said.columns, source.names, source.path, said.log_names)
    if not source.views:
        check_taken(said.columns, source.names, source.path)
    return source


def _opened(path: str | Path, said: Options) -> Source:
    """Return a source, without a check that the columns named by `--map` exist in it."""
    source = Path(path).expanduser()
    if source.name in ("depth.txt", *PAIRS) and is_tum(source.parent):
        source = source.parent
    if not source.exists():
        names = [item.name for item in source.parent.iterdir()] if source.parent.is_dir() else []
        raise InputError("nothing there", where=source, expected="a file or a folder", hint=did_you_mean(source.name, names))
    one = _format(source, said)
    if said.base is not None and not one.transforms:
        raise InputError("coordinate frames exist in bags only", where=f"--base {said.base}", found=source)
    if said.depth_unit is not None and not one.whole_depths:
        raise InputError(
            "--depth-unit for a source without depth images, or with a unit of its own",
            where=f"--depth-unit {said.depth_unit:g}",
            found=one.name,
            expected=", ".join(name for name, other in FORMATS.items() if other.whole_depths),
        )
    return one.opened(source, said)


def _format(source: Path, said: Options) -> Format:
    """Return the format that the options name; without a name, identify it. Raises InputError."""
    one = FORMATS.get(said.format) if said.format else format_of(source)
    if one is not None:
        return one
    packed = not said.format and (source.suffix in PACKED or (source.is_dir() and any(source.glob("*.zstd"))))
    raise InputError(
        "no such format" if said.format else "not a format that femsense imports",
        where=source,
        found=said.format or source.suffix or "no ending",
        expected="--format " + "|".join(FORMATS),
        hint=UNPACK
        if packed
        else did_you_mean(said.format, FORMATS)
        if said.format
        else export_hint(source) or _hint_of_many(source),
    )


def _hint_of_many(folder: Path) -> str | None:
    """Return a hint how to import a folder of captures; None if the folder holds no captures."""
    if not folder.is_dir() or not any(format_of(item) for item in sorted(folder.iterdir())[:FEW_CAMERAS]):
        return None
    return f"a folder of captures: --jobs '{folder}/*' makes a recording of each"


def open_sources(paths: Sequence[str | Path], options: Options | None = None) -> Source:
    """Return the contents of one or more captures as a single source.

    Several captures must belong to the same recording: each is a camera or a motion capture.

    Arguments:
        paths: files or folders; NAME=PATH names the camera.
        options: of the user, for all captures; a topic may be in any of the bags.

    Raises:
        InputError: as `open_source`; duplicate names; clocks that do not overlap, not even by recording time.
    """
    said = options or Options()
    if len(paths) > FEW_CAMERAS and not any("=" in str(path) for path in paths):
        raise InputError(
            "too many captures for the cameras of one recording",
            where=str(paths[0]),
            found=f"{len(paths)} sources",
            expected=f"up to {FEW_CAMERAS}, or NAME=SOURCE",
            hint="--jobs with a pattern in quotation marks makes a recording of each: --jobs 'bags/*'",
        )
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
        raise InputError("a camera name occurs twice", where="SOURCE", found=", ".join(names), expected="NAME=PATH with names")
    files = [path for _, path in given]
    try:
        source = joined({name: _one_of(file, said) for name, file in zip(names, files)}, files[0], said)
    except InputError:
        if said.clock != Clock.AUTO:
            raise
        by_record = replace(said, clock=Clock.RECORD)
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
    """Return one of several captures as a source; it must hold a single camera."""
    one = _format(path, options) if path.exists() else None
    if one is not None and one.topics is not None and options.topics:
        held = set(one.topics(path))
        options = replace(options, topics=[topic for topic in options.topics if topic in held])
    if one is not None and one.columns is not None:
        names = list(one.columns(path))
        mine = {old: new for old, new in resolved(options.columns, names).items() if old in names}
        options = replace(options, columns=mine)
    source = _opened(path, options)
    if source.views:
        raise InputError(
            "a capture with several cameras together with others", where=path, found=", ".join(source.views), expected="one"
        )
    return source


def split_name(text: str | Path) -> tuple[str, Path]:
    """Return the name and the path of NAME=PATH; an empty name if only a path is given."""
    name, mark, path = str(text).partition("=")
    if Path(text).expanduser().exists() or not mark or not re.fullmatch(r"\w[\w-]*", name):
        return "", Path(text).expanduser()
    return name, Path(path).expanduser()


def guess_format(path: Path) -> str | None:
    """Identify a format of FORMATS by the first bytes, the ending, or the files of a folder; return its name, None if there is none."""
    one = format_of(path)
    return None if one is None else one.name


def contents(path: Path) -> dict[str, Any]:
    """Return the contents of a capture for `femsense inspect`, without reading its frames.

    Raises:
        InputError: the capture is broken, empty, or of an unknown format.
    """
    return contents_of(_format(path, Options()), path)
