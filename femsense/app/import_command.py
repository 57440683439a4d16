"""`femsense import`: from a capture of another program to a recording folder, and what is said of it."""

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
from femsense.io.importers.frames import UNITS, Clock, Options
from femsense.io.importers.guess import open_sources, split_name
from femsense.io.importers.tables.actuation import read_actuation_log
from femsense.io.importers.tables.csv_tables import header_of
from femsense.io.importers.tables.mapping import Becomes, kind_of_target, mappable
from femsense.io.importers.writer import OWN_FILES, RECORD, check_unchanged, write_recording

Progress = Callable[..., None]
Say = Callable[[str], None]
MANY_FRAMES = 1000
"""Recordings of more frames than this are told how to take fewer: what follows takes time for each …"""
ENOUGH_FRAMES = 300
"""… and where a robot moves slowly, so many say as much."""


def columns_named(columns: Sequence[str]) -> dict[str, str]:
    """Return the mappings NAME=TARGET of `--map` as name in the source → name in the recording. Raises InputError."""
    pairs = [text.rpartition("=") if "@" not in text else text.partition("=") for text in columns]
    for text, (old, mark, new) in zip(columns, pairs):
        if not (old and mark and new):
            raise InputError(
                "not a mapping", where="--map", found=text, expected="NAME=TARGET, such as motor1=cable_north or 3=tip.x"
            )
    return {old: new for old, _, new in pairs}


def shifts_named(shifts: Sequence[str]) -> dict[str, float]:
    """Return the seconds CAMERA=S of `--shift` as camera → seconds. Raises InputError."""
    found: dict[str, float] = {}
    for text in shifts:
        name, _, value = text.rpartition("=")
        try:
            found[name] = float(value)
        except ValueError:
            name = ""
        if not name:
            raise InputError("not a shift of a camera's times", where="--shift", found=text, expected="CAMERA=SECONDS")
    return found


def free_named(ranges: Sequence[str]) -> list[tuple[float, float]]:
    """Return the spans FROM:TO of `--free` [s]. Raises InputError."""
    spans = []
    for text in ranges:
        try:
            first, last = (float(part) for part in text.split(":"))
        except ValueError:
            first, last = 1.0, 0.0
        if first > last:
            raise InputError("not a span of time", where="--free", found=text, expected="FROM:TO, seconds after the first frame")
        spans.append((first, last))
    return spans


def import_into(
    folder: str | Path,
    paths: Sequence[str | Path],
    options: Options,
    *,
    say: Say,
    inputs: str | None = None,
    zero: str | None = None,
    actuation: str | Path | None = None,
    offset: float | None = None,
    again: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Import a capture into a recording folder, or return what stands there if it was made from the same.

    Arguments:
        folder: of the recording.
        paths: the captures, one a camera; NAME=PATH names it.
        options: what a person says about it.
        say: told in one line what happens beside.
        inputs: what cables' values are, "tension" or "displacement", where the capture does not say.
        zero: "absolute" or "unknown".
        actuation: a CSV file with the inputs over time.
        offset: the frames' time minus that file's [s]; None finds it from the motion.
        again: import anew although the recording is there.
        progress: called with (frames done, frames in all).

    Raises:
        InputError: whatever is wrong with the capture, or another thing at this place.
    """
    options = _spelt(options)
    _check_options(options, inputs, zero)
    check_target(folder, folder=True)
    final = followed(folder)
    _check_apart(paths, final)
    identity = _identity(paths, options, inputs, zero, actuation, offset)
    known = _standing(final, identity, again)
    if known is not None:
        say(f"{final} holds this import already (--again makes it anew)")
        return known
    log = None if actuation is None else read_actuation_log(actuation, options)
    source = open_sources(paths, options if actuation is None else _without_log(options, Path(actuation), paths))
    found = write_recording(
        source,
        final,
        identity=identity,
        actuation=inputs,
        zero=zero,
        log=log,
        offset=offset,
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
    """Return what was imported as plain text."""
    from femsense.app.inspection.text import section_text

    notes = document.get("notes", [])
    shown = {key: value for key, value in document.items() if key not in ("notes",)}
    count = document["frames"]
    lines = [f"{folder}: a recording of {count} {'frame' if count == 1 else 'frames'}", "", *section_text(shown)]
    lines += ["", *(f"note: {note}" for note in notes)] if notes else []
    return "\n".join(lines)


def _thinning(found: Mapping[str, Any], options: Options) -> tuple[str, ...]:
    """Return what is said of a recording of very many frames."""
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
    """Return what is said of a recording that does not tell when nothing touches the robot."""
    if options.free:
        late = [f"{first:g}:{last:g}" for first, last in options.free if first > found["duration_s"] or last < 0]
        return tuple(f"--free {span}: no frame lies there; the frames last {found['duration_s']:.4g} s" for span in late)
    return (
        f"nothing says when nothing touches the robot: --free FROM:TO, seconds of {found['duration_s']:.4g}, or the column free of "
        "frames.csv; calibrate and improve use these frames, and estimate learns from them how well camera and model agree",
    )


def _in_vain(name: str, options: Options) -> tuple[str, ...]:
    """Return what is said of options that have no effect on a format."""
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


def _check_options(options: Options, inputs: str | None, zero: str | None) -> None:
    for name, value, allowed in (
        ("--unit", options.unit, tuple(UNITS)),
        ("--up", options.up, ("x", "y", "z")),
        ("--clock", options.clock, (Clock.AUTO, Clock.HEADER, Clock.RECORD)),
        ("--inputs", inputs, ("tension", "displacement")),
        ("--zero", zero, ("absolute", "unknown")),
    ):
        if value is not None and value not in allowed:
            raise InputError(f"not a value of {name}", where=name, found=value, expected="|".join(allowed))
    if options.every < 1:
        raise InputError("not a count of frames", where="--every", found=options.every, expected="1, 2, …")
    if options.depth_unit is not None and not 0 < options.depth_unit < 1:
        raise InputError("not a unit of depth", where="--depth-unit", found=options.depth_unit, expected="metres, such as 0.001")
    if options.rate is not None and options.rate <= 0:
        raise InputError("not a rate", where="--rate", found=options.rate, expected="frames a second, > 0")


def _without_log(options: Options, log: Path, paths: Sequence[str | Path]) -> Options:
    """Return the options without the mappings that are about columns of the log of actuation.

    Of a column that stands in a table of the capture too, only a mapping to an input is the log's alone.
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


def _identity(
    paths: Sequence[str | Path],
    options: Options,
    inputs: str | None,
    zero: str | None,
    actuation: str | Path | None,
    offset: float | None,
) -> dict[str, Any]:
    """Return what an import is made from: another file, another time of its change or another option is another import."""
    states = [_state(split_name(path)[1]) for path in paths]
    return {
        "source": states[0] if len(states) == 1 else [*states, list(map(str, paths))],
        "options": asdict(options),
        "inputs": inputs,
        "zero": zero,
        "actuation": None if actuation is None else _state(Path(actuation)),
        "offset": offset,
        "femsense": femsense.__version__,
    }


def _check_apart(paths: Sequence[str | Path], final: Path) -> None:
    """Raise InputError where a capture is the recording itself, or a part of it that would be replaced."""
    for place in (split_name(path)[1].resolve() for path in paths):
        inside = place.is_relative_to(final.resolve())
        if inside and (place.is_dir() or OWN_FILES.fullmatch(place.relative_to(final.resolve()).as_posix())):
            raise InputError(
                "the recording would replace what it is made from", where=place, found=f"-o {final}", expected="a new place"
            )


def _state(path: Path) -> list[Any]:
    if not path.exists():
        raise InputError("nothing there", where=path, expected="a file or a folder")
    check_no_pipe([path, *(path.rglob("*") if path.is_dir() else ())])
    files = sorted(item for item in path.rglob("*") if item.is_file()) if path.is_dir() else [path]
    stats = [file.stat() for file in files]
    return [str(path.resolve()), len(files), sum(s.st_size for s in stats), max((s.st_mtime_ns for s in stats), default=0)]


def _standing(final: Path, identity: Mapping[str, Any], again: bool) -> dict[str, Any] | None:
    """Return what an earlier import of the same says; None where there is none. Raises InputError where something else stands."""
    if not final.exists():
        return None
    if final.is_dir() and not any(final.iterdir()):
        return None
    record = final / RECORD
    if not record.is_file():
        raise InputError(
            "something stands there already", where=final, found="no import of femsense", expected="a new place for the recording"
        )
    kept = json.loads(record.read_text(encoding="utf-8"))
    if again:
        check_unchanged(final)
        return None
    if kept.get("identity") == json.loads(json.dumps(identity)):
        return dict(kept["found"])
    raise InputError(
        "another import stands there already",
        where=final,
        found=str(kept.get("identity", {}).get("source", ["?"])[0]),
        expected="a new place, or --again to replace it",
    )
