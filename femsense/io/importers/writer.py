"""Frames → a recording folder, written under a temporary name and renamed at the end; memory is that of one frame."""

from __future__ import annotations

import json
import re
import secrets
import shutil
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.errors import FemsenseError, InputError
from femsense.core.text import one_line
from femsense.io.clouds.cloud_checks import cloud_doubts, cloud_problems
from femsense.io.clouds.cloud_files import write_cloud
from femsense.io.files import PART_PREFIX, file_hash, followed, other_files, write_json
from femsense.io.folder_lock import only_writer
from femsense.io.importers.frames import Frame, Images, Source
from femsense.io.importers.images.pictures import write_color, write_depth
from femsense.io.importers.journal import JOURNAL, Entry, Journal, Picture, Seen
from femsense.io.importers.recording_rows import Wanted, actuation_of, another_kind, write_tables
from femsense.io.importers.tables.actuation import ActuationLog
from femsense.io.recording_folder import load_recording
from femsense.model.camera import Camera
from femsense.model.plausibility import doubts_of_recording, warn_of
from femsense.pointcloud.cloud import PointCloud

RECORD = "import.json"
"""Record of the sources and options of an import, in the recording's folder."""
TABLES = ("recording.toml", "frames.csv", "markers.csv", "loads.csv")
OWN_FILES = re.compile(
    "|".join(map(re.escape, (*TABLES, RECORD))) + r"|(clouds|depth|color)/([^/]+/)?\d{6,}\.(ply|png)",
)
"""Names of the files that an import writes: with `--again` only these give way."""
Progress = Callable[..., None]


def write_recording(
    source: Source,
    folder: str | Path,
    *,
    identity: Mapping[str, Any],
    actuation: str | None = None,
    zero: str | None = None,
    log: ActuationLog | None = None,
    offset: float | None = None,
    replace: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write the frames of a source as a recording, or resume an interrupted import of the same source.

    Arguments:
        source: what an importer found.
        folder: the final place.
        identity: source and options; only an unfinished import with the same identity is resumed.
        actuation: "tension" or "displacement", if the source does not declare it.
        zero: "absolute" or "unknown"; by default tensions are absolute, displacements count from an unknown zero.
        log: inputs with their own clock.
        offset: source time minus the log's time [s]; None estimates it from the motion.
        replace: replace an earlier import once the new one is complete; other files in its folder are kept.
        progress: called with (frames done, total number of frames).

    Returns:
        what was found and written, as in import.json.

    Raises:
        InputError: no frames, no readable image, columns without a meaning, tables that were changed since, another import writing there.
    """
    if replace:
        check_unchanged(followed(folder))
    if log is not None:
        if actuation and log.actuation not in (None, actuation):
            raise another_kind(log.path, actuation, str(log.actuation))
        actuation_of(source, list(log.columns), actuation or log.actuation)  # before the frames are read
    final = followed(folder)
    part = final.with_name(f"{PART_PREFIX}import-{final.name}")
    made = [parent for parent in final.parents if not parent.exists()]
    try:
        with only_writer(final):
            return _write_and_name(source, part, final, identity, Wanted(actuation, zero, log, offset), replace, progress)
    except FemsenseError:
        for parent in made:
            if parent.is_dir() and not any(parent.iterdir()):
                parent.rmdir()
        raise


def _write_and_name(
    source: Source,
    part: Path,
    final: Path,
    identity: Mapping[str, Any],
    wanted: Wanted,
    replace: bool,
    progress: Progress | None,
) -> dict[str, Any]:
    """Write the unfinished folder and rename it. A refused import is removed, an interrupted one can be resumed."""
    try:
        _prepare(part, identity)
        with Journal(part, identity) as journal:
            counts = _write_frames(source, part, journal, progress)
        _check_counts(source, counts, len(journal.times()))
        found = write_tables(source, part, journal, counts, wanted)
        found |= _accepted(source.path, part, final, found)
        tables = {name: file_hash(part / name) for name in TABLES if (part / name).is_file()}
        write_json(part / RECORD, {"identity": identity, "found": found, "tables": tables})
        (part / JOURNAL).unlink()
        _give_name(part, final, replace)
    except FemsenseError:
        shutil.rmtree(part, ignore_errors=True)
        raise
    return found


def _accepted(path: Path, part: Path, final: Path, found: Mapping[str, Any]) -> dict[str, str]:
    """Load the recording as the other commands do, and warn of implausible values.

    Raises:
        InputError: the other commands would refuse it; the message names the source and the final folder.
    """
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            recording = load_recording(part)
            warn_of([*doubts_of_recording(recording), *cloud_problems(recording), *cloud_doubts(recording)])
    except InputError as problem:
        if not found.get("unlabelled_markers"):
            place = str(problem.where).replace(f"{part}/", "")
            where = f"{path}, as {final.name}/{place}" if str(part) in str(problem.where) else problem.where
            raise type(problem)(
                problem.what, where=where, found=problem.found, expected=problem.expected, hint=problem.hint
            ) from None
        return {"not_ready": one_line(problem)}
    for item in caught:
        warnings.warn(str(item.message).replace(str(part), str(final)), stacklevel=4)
    return {}


def _check_counts(source: Source, counts: Mapping[str, int], kept: int) -> None:
    """Warn of frames whose time does not go on, and of fewer or more frames than a file announces.

    Raises:
        InputError: most of the frames are out of order: that clock is none.
    """
    lost = counts["out_of_order"]
    if lost:
        first = f"the first is number {counts['first_back']} in the file"
        hint = "repeated time stamps were rounded, or a clock was set back: export the times with all digits"
        if lost > kept:
            raise InputError(
                "the time does not go on",
                where=source.path,
                found=f"{lost} of {lost + kept} frames are not later than the one before them, {first}",
                expected="frames in order of time",
                hint=hint,
            )
        text = f"{lost} of {lost + kept} frames are dropped, since the time repeats or goes back, {first}"
        warnings.warn(f"{source.path}: {text}; {hint}", stacklevel=4)
    if source.count is not None and abs(lost + kept - source.count) > max(1, source.count // 100):
        warnings.warn(f"{source.path}: {source.count} frames are announced, {lost + kept} were read", stacklevel=4)


def _give_name(part: Path, final: Path, replace: bool) -> None:
    """Rename the finished folder. Raises InputError if the final name exists and must not be replaced."""
    if final.exists() and not (final.is_dir() and (replace or not any(final.iterdir()))):
        raise InputError("the folder exists and is not an import", where=final, expected="a new folder for the recording")
    if not final.exists():
        part.rename(final)
        return
    check_unchanged(final)
    old = final.with_name(f"{PART_PREFIX}{secrets.token_hex(4)}-old-{final.name}")
    final.rename(old)
    part.rename(final)
    for name in other_files(old, OWN_FILES):
        (final / name).parent.mkdir(parents=True, exist_ok=True)
        (old / name).rename(final / name)
    shutil.rmtree(old, ignore_errors=True)


def check_unchanged(folder: Path) -> None:
    """Refuse to replace an import whose tables were changed or extended since. Raises InputError."""
    if not (folder / RECORD).is_file():
        return
    written = json.loads((folder / RECORD).read_text(encoding="utf-8")).get("tables", {})
    there = [name for name in TABLES if (folder / name).exists()]
    changed = [name for name in there if not (folder / name).is_file() or file_hash(folder / name) != written.get(name)]
    if changed:
        raise InputError(
            "tables were changed since the import and would be replaced",
            where=folder,
            found=", ".join(changed),
            expected="the tables as they were imported",
            hint="a new place and the changes made there again; --free FROM:TO instead of a column free",
        )


def _prepare(part: Path, identity: Mapping[str, Any]) -> None:
    if part.is_dir() and not Journal(part, identity).belongs:
        shutil.rmtree(part)
    part.mkdir(parents=True, exist_ok=True)


def _write_frames(source: Source, part: Path, journal: Journal, progress: Progress | None) -> dict[str, int]:
    """Write the frames after those of the journal; return the number of skipped frames."""
    done = journal.done or 0
    last = -np.inf if not done else float(journal.times()[-1])
    number, counts = done, {"out_of_order": 0, "resumed": done, "first_back": 0}
    for frame in _after(source.frames(), done, counts):
        if not frame.time > last:
            counts["out_of_order"] += 1
            counts["first_back"] = counts["first_back"] or number + counts["out_of_order"]
            continue
        journal.add(_write_frame(source, frame, part, number))
        last, number = frame.time, number + 1
        if progress is not None:
            progress(number, source.count or number)
    return counts


def _after(frames: Iterator[Frame], done: int, counts: dict[str, int]) -> Iterator[Frame]:
    """Yield the frames after the first `done` ones with increasing times; those are not decoded."""
    last, passed = -np.inf, 0
    while passed < done:
        frame = next(frames, None)
        if frame is None:
            return
        if frame.time > last:
            last, passed = frame.time, passed + 1
        else:
            counts["out_of_order"] += 1
    yield from frames


def _write_frame(source: Source, frame: Frame, part: Path, number: int) -> Entry:
    looking = [(name, source.views[name], one) for name, one in frame.views.items()] or [("", source, frame)]
    seen = {name: _write_view(own, one, part, name, number) for name, own, one in looking}
    loads = [[*np.asarray(p, dtype=float).tolist(), *np.asarray(f, dtype=float).tolist()] for p, f in frame.loads]
    inputs = {name: float(value) for name, value in frame.inputs.items()}
    return Entry(float(frame.time), inputs, loads, seen, number)


def _write_view(source: Source, frame: Frame, part: Path, view: str, number: int) -> Seen:
    """Write the data of one camera in a frame; with several cameras its name is that of its folders."""
    kind, center = Picture.NONE, None
    if frame.picture is not None:
        try:
            kind, center = _write_picture(source, frame.picture(), part, Path(view) / f"{number:06d}")
        except InputError as problem:
            if number == 0:
                raise
            warnings.warn(f"a frame keeps no picture: {one_line(problem)}", stacklevel=2)
            kind = Picture.BROKEN
    markers = {name: np.asarray(place, dtype=float).tolist() for name, place in frame.markers.items()}
    strangers = np.asarray(frame.unlabelled, dtype=float).reshape(-1, 3)
    if markers:
        strangers = strangers[:0]  # a recording has named markers or unnamed ones in a frame
    if center is None and (markers or len(strangers)):
        center = np.mean([*markers.values(), *strangers.tolist()], axis=0).tolist()
    return Seen(markers, strangers.tolist(), kind, center)


def _write_picture(source: Source, picture: Images | PointCloud, part: Path, name: Path) -> tuple[Picture, list[float] | None]:
    if isinstance(picture, PointCloud):
        file = part / "clouds" / f"{name}.ply"
        file.parent.mkdir(parents=True, exist_ok=True)
        write_cloud(file, picture)
        return Picture.CLOUD, picture.points.mean(axis=0).tolist() if len(picture) else None
    write_depth(part / "depth" / f"{name}.png", picture.depth)
    if picture.color is not None:
        write_color(part / "color" / f"{name}.png", picture.color)
    return Picture.DEPTH, _center(picture, source.camera)


def _center(picture: Images, camera: Camera | None) -> list[float] | None:
    """Return the mean of the points of a depth image [m], without its lens's distortion: it serves to see motion."""
    z = picture.depth[::4, ::4].astype(np.float64) * (1.0 if camera is None else camera.depth_unit)
    if camera is None or not z.any():
        return None
    row, column = np.nonzero(z)
    values = z[row, column]
    x = (4 * column - camera.cx) / camera.fx * values
    y = (4 * row - camera.cy) / camera.fy * values
    return [float(x.mean()), float(y.mean()), float(values.mean())]
