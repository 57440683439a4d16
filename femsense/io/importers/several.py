"""Several cameras, or cameras and a motion capture, as one source: their frames are brought together by time."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import InputError
from femsense.io.importers.frames import Frame, Source
from femsense.io.importers.options import Options
from femsense.io.importers.tables.input_samples import nearest_in_time

OVERLAP = 0.5
"""Clocks are one where the times that two sources share are this share of the shorter one."""


@dataclass(frozen=True, eq=False, slots=True)
class Match:
    """Which frames belong together."""

    times: FloatArray
    """Of the frames of the recording [s], shape (F,)."""
    of: Mapping[str, IntArray]
    """Camera → index of its frame (of those that time goes on in), −1 where none is near, each (F,)."""


def joined(sources: Mapping[str, Source], path: Path, options: Options) -> Source:
    """Return several sources as one whose frames contain the data of each at that time.

    The frames are those of the first source with images; of each other source the nearest in time is used, at most half a frame away.
    Inputs and loads come from the first source that has them.

    Arguments:
        sources: camera → its source.
        path: for messages.
        options: `shifts` are added to a camera's times.

    Raises:
        InputError: a shift for an unknown camera, or clocks that do not overlap.
    """
    unknown = [name for name in options.shifts if name not in sources]
    if unknown:
        raise InputError("no such camera", where="--shift", found=unknown[0], expected=", ".join(sources))
    times = {name: _times(source) + options.shifts.get(name, 0.0) for name, source in sources.items()}
    main = next((name for name, source in sources.items() if _has_pictures(source)), next(iter(sources)))
    _require_one_clock(times, main, path)
    step = float(np.median(np.diff(times[main]))) if len(times[main]) > 1 else np.inf
    match = Match(times[main], {name: nearest_in_time(times[main], times[name], 0.5 * step) for name in sources})
    alone = {name: int(len(times[name]) - len(np.unique(i[i >= 0]))) for name, i in match.of.items()}
    notes = [f"{name}: {note}" for name, source in sources.items() for note in source.notes]
    notes += [f"{name}: {count} frames without one of {main} near in time are left out" for name, count in alone.items() if count]
    kinds = dict.fromkeys(source.actuation for source in sources.values() if source.actuation)
    return Source(
        path,
        partial(_frames, dict(sources), match, main),
        actuation=next(iter(kinds), None),
        count=len(match.times),
        notes=notes,
        views=dict(sources),
        format="several",
        names={name: kind for source in sources.values() for name, kind in source.names.items()},
    )


def camera_names(labels: list[str]) -> list[str]:
    """Return camera names: the differing part of their paths or topics; cam1, cam2, … if that is not a valid name."""
    parts = [[part for part in re.split(r"[/\\]", label) if part] for label in labels]
    for column in zip(*parts):
        names = [re.sub(r"[\s.,;\"]+", "_", Path(part).stem) for part in column]
        if len(set(names)) == len(names) and all(re.fullmatch(r"\w[\w-]*", name) for name in names):
            return names
    return [f"cam{i + 1}" for i in range(len(labels))]


def _rising(frames: Iterator[Frame]) -> Iterator[Frame]:
    """Yield the frames that time goes on in."""
    last = -np.inf
    for frame in frames:
        if frame.time > last:
            last = frame.time
            yield frame


def _times(source: Source) -> FloatArray:
    """Return the times of a source's frames [s]; no picture is decoded."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # reported when the frames are written
        return np.fromiter((frame.time for frame in _rising(source.frames())), dtype=np.float64)


def _has_pictures(source: Source) -> bool:
    first = next(source.frames(), None)
    return first is not None and first.picture is not None


def _require_one_clock(times: Mapping[str, FloatArray], main: str, path: Path) -> None:
    for name, own in times.items():
        if not len(own):
            raise InputError("no frames", where=f"{path}: {name}", expected="frames of each camera")
        first, last = max(own[0], times[main][0]), min(own[-1], times[main][-1])
        if name != main and last - first < OVERLAP * min(np.ptp(own), np.ptp(times[main])):
            spans = "; ".join(f"{n} {t[0]:.3f} … {t[-1]:.3f} s" for n, t in times.items())
            raise InputError(
                "cameras whose times do not overlap",
                where=path,
                found=spans,
                expected=f"one clock, or --shift {name}=SECONDS (added to the times of {name})",
                hint=f"if both began together: --shift {name}={times[main][0] - own[0]:.3f}",
            )


def _frames(sources: Mapping[str, Source], match: Match, main: str) -> Iterator[Frame]:
    streams = {name: enumerate(_rising(source.frames())) for name, source in sources.items()}
    held: dict[str, tuple[int, Frame]] = {}
    for k, time in enumerate(match.times.tolist()):
        views: dict[str, Frame] = {}
        for name, stream in streams.items():
            wanted = int(match.of[name][k])
            while wanted >= 0 and (name not in held or held[name][0] < wanted):
                held[name] = next(stream)
            if wanted >= 0 and held[name][0] == wanted:
                views[name] = held[name][1]
        yield _moment(time, views, main)


def _moment(time: float, views: Mapping[str, Frame], main: str) -> Frame:
    ordered = [views[main], *(frame for name, frame in views.items() if name != main)]
    inputs = {name: value for frame in reversed(ordered) for name, value in frame.inputs.items()}
    loads = next((frame.loads for frame in ordered if len(frame.loads)), ())
    alone = {name: replace(frame, inputs={}, loads=()) for name, frame in views.items()}
    return Frame(time, inputs=inputs, loads=loads, views=alone)
