"""`femsense import`: from a capture of another program to a recording folder, with notes on it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import femsense
from femsense.core.errors import InputError
from femsense.core.text import plain_name
from femsense.core.units import length_unit
from femsense.io.files import check_no_pipe, check_target, followed
from femsense.io.importers.formats import FORMATS, format_of
from femsense.io.importers.guess import open_sources, split_name
from femsense.io.importers.options import UNITS, Clock, InputOptions, Options
from femsense.io.importers.tables.actuation import read_actuation_log
from femsense.io.importers.tables.csv_tables import header_of
from femsense.io.importers.tables.mapping import Becomes, kind_of_target, mappable
from femsense.io.importers.writer import OWN_FILES, RECORD, check_unchanged, write_recording

Progress = Callable[..., None]
Say = Callable[[str], None]
MANY_FRAMES = 1000
"""A note suggests to thin recordings of more frames than this, since each frame costs time later …"""
ENOUGH_FRAMES = 300
"""… to this number, which is enough where a robot moves slowly."""


def import_into(
    folder: str | Path,
    paths: Sequence[str | Path],
    options: Options,
    *,
    say: Say,
    driven: InputOptions | None = None,
    again: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Import a capture into a recording folder, or return the report of the import in it if it was made from the same.

    Arguments:
        folder: of the recording.
        paths: the captures, one a camera; NAME=PATH names it.
        options: of the user.
        say: called with a line on each step.
        driven: options of the user on the inputs.
        again: repeat the import even if the recording exists.
        progress: called with (frames done, frames in all).

    Raises:
        InputError: a problem of the capture, or other content of the folder.
    """
    options, driven = _spelt(options), driven or InputOptions()
    _check_options(options)
    check_target(folder, folder=True)
    final = followed(folder)
    _check_apart(paths, final)
    identity = _identity(paths, options, driven)
    known = _standing(final, identity, again)
    if known is not None:
        say(f"{final} contains this import already (--again repeats it)")
        return known
    log = None if driven.actuation is None else read_actuation_log(driven.actuation, options)
    source = open_sources(paths, options if driven.actuation is None else _without_log(options, driven.actuation, paths))
    found = write_recording(
        source,
        final,
        identity=identity,
        actuation=driven.inputs,
        zero=driven.zero,
        log=log,
        offset=driven.offset,
        replace=again,
        progress=progress,
    )
    notes = [
        *source.notes,
        *(() if log is None else log.notes),
        *_thinning(found, options),
        *_free(found, options),
        *_in_vain(found["format"], options),
    ]
    return {**found, "notes": notes}


def import_text(folder: str | Path, document: Mapping[str, Any]) -> str:
    """Return the summary of an import as plain text."""
    from femsense.app.inspection.text import section_text

    notes = document.get("notes", [])
    shown = {key: value for key, value in document.items() if key not in ("notes",)}
    count = document["frames"]
    lines = [f"{folder}: a recording of {count} {'frame' if count == 1 else 'frames'}", "", *section_text(shown)]
    lines += ["", *(f"note: {note}" for note in notes)] if notes else []
    return "\n".join(lines)


def _thinning(found: Mapping[str, Any], options: Options) -> tuple[str, ...]:
    """Return the note on a recording of very many frames."""
    frames = int(found["frames"])
    if frames <= MANY_FRAMES:
        return ()
    step = options.every * round(frames / ENOUGH_FRAMES)
    rate = found.get("rate_hz")
    kept = "" if not rate else f", {rate * options.every / step:.3g} a second"
    return (
        f"{frames} frames: calibrate, estimate and improve take time for each; if the robot moves slowly, "
        f"--every {step} keeps about {ENOUGH_FRAMES} of them{kept}",
    )


def _free(found: Mapping[str, Any], options: Options) -> tuple[str, ...]:
    """Return the note on a recording without contact-free frames."""
    if options.free:
        late = [f"{first:g}:{last:g}" for first, last in options.free if first > found["duration_s"] or last < 0]
        return tuple(f"--free {span}: no frame lies there; the frames last {found['duration_s']:.4g} s" for span in late)
    return (
        f"no contact-free frames are declared: --free FROM:TO, seconds of {found['duration_s']:.4g}, or the column free of "
        "frames.csv; calibrate and improve use these frames, and estimate measures noise and model error in them",
    )


def _in_vain(name: str, options: Options) -> tuple[str, ...]:
    """Return notes on options that have no effect on a format."""
    said = {
        "--clock": options.clock != Clock.AUTO,
        "--rate": options.rate is not None,
        "--up": options.up is not None,
        "--unit": options.unit is not None,
        "--topic": bool(options.topics),
    }
    unused = FORMATS[name].unused if name in FORMATS else ()
    return tuple(f"{key} has no effect: {name} has no use for it" for key in unused if said[key])


def _spelt(options: Options) -> Options:
    """Return the options with names in their composed form and the unit as it is usually written."""
    unit = None if options.unit is None else length_unit(options.unit)
    columns = {plain_name(old): plain_name(new) for old, new in options.columns.items()}
    topics = tuple(map(plain_name, options.topics))
    return replace(options, columns=columns, topics=topics, unit=options.unit if unit is None else unit.name)


def _check_options(options: Options) -> None:
    if options.unit is not None and options.unit not in UNITS:
        raise InputError("not a value of --unit", where="--unit", found=options.unit, expected="|".join(UNITS))
    if options.depth_unit is not None and not 0 < options.depth_unit < 1:
        raise InputError("not a unit of depth", where="--depth-unit", found=options.depth_unit, expected="metres, such as 0.001")
    if options.rate is not None and options.rate <= 0:
        raise InputError("not a rate", where="--rate", found=options.rate, expected="frames a second, > 0")


def _without_log(options: Options, log: Path, paths: Sequence[str | Path]) -> Options:
    """Return the options without the mappings of columns of the actuation log.

    For a column that is also in a table of the capture, only a mapping to an input belongs to the log.
    """
    of_log = mappable(header_of(log)[0])
    files = [path for _, path in map(split_name, paths)]
    known = [(file, format_of(file)) for file in files if file.is_file()]
    shared = {name for file, one in known if one is not None and one.columns for name in mappable(list(one.columns(file)))}
    columns = {
        old: new
        for old, new in options.columns.items()
        if old not in of_log or (old in shared and kind_of_target(new) is not Becomes.INPUT)
    }
    return replace(options, columns=columns, log_names=tuple(of_log))


def _identity(paths: Sequence[str | Path], options: Options, driven: InputOptions) -> dict[str, Any]:
    """Return the identity of an import: another file, another time of its change or another option is another import."""
    states = [_state(split_name(path)[1]) for path in paths]
    return {
        "source": states[0] if len(states) == 1 else [*states, list(map(str, paths))],
        "options": asdict(options),
        **asdict(driven),
        "actuation": None if driven.actuation is None else _state(driven.actuation),
        "femsense": femsense.__version__,
    }


def _check_apart(paths: Sequence[str | Path], final: Path) -> None:
    """Raise InputError where a capture is the recording itself, or a part of it that would be replaced."""
    for place in (split_name(path)[1].resolve() for path in paths):
        inside = place.is_relative_to(final.resolve())
        if inside and (place.is_dir() or OWN_FILES.fullmatch(place.relative_to(final.resolve()).as_posix())):
            raise InputError(
                "the recording would replace its own source", where=place, found=f"-o {final}", expected="a new place"
            )


def _state(path: Path) -> list[Any]:
    if not path.exists():
        raise InputError("nothing there", where=path, expected="a file or a folder")
    check_no_pipe([path, *(path.rglob("*") if path.is_dir() else ())])
    files = sorted(item for item in path.rglob("*") if item.is_file()) if path.is_dir() else [path]
    stats = [file.stat() for file in files]
    return [str(path.resolve()), len(files), sum(s.st_size for s in stats), max((s.st_mtime_ns for s in stats), default=0)]


def _standing(final: Path, identity: Mapping[str, Any], again: bool) -> dict[str, Any] | None:
    """Return the report of an earlier import of the same; None where there is none. Raises InputError where other files are in its place."""
    if not final.exists():
        return None
    if final.is_dir() and not any(final.iterdir()):
        return None
    record = final / RECORD
    if not record.is_file():
        raise InputError("the folder exists and is not an import", where=final, expected="a new folder for the recording")
    kept = json.loads(record.read_text(encoding="utf-8"))
    if again:
        check_unchanged(final)
        return None
    if kept.get("identity") == json.loads(json.dumps(identity)):
        return dict(kept["found"])
    raise InputError(
        "the folder holds an import of another source or with other options",
        where=final,
        found=str(kept.get("identity", {}).get("source", ["?"])[0]),
        expected="a new folder, or --again to replace it",
    )
