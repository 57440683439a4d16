"""Markers over time, whatever file holds them: which are taken, under which name, in which unit, turned which way up."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray
from femsense.core.errors import InputError
from femsense.io.importers.frames import Frame, Source, check_size, unit_of, upright
from femsense.io.importers.options import Options
from femsense.io.importers.tables.mapping import Becomes

NAMELESS = "*"
"""Prefix of the labels of unnamed tracks (Vicon Nexus)."""
LOOKED_AT = 500
"""Number of first rows whose extent is compared with that of a scene."""


@dataclass(frozen=True, slots=True)
class Track:
    """One marker over time."""

    name: str
    """"" for an unidentified marker."""
    label: str
    """The name in the file, with the subject."""

    def is_one_of(self, names: Sequence[str]) -> bool:
        return self.name in names or self.label in names

    def renamed(self, columns: Mapping[str, str]) -> str:
        """Return the name in the recording."""
        return columns.get(self.label, columns.get(self.name, self.name)).removeprefix("marker.")


@dataclass(frozen=True, eq=False, slots=True)
class Row:
    """One moment of a capture."""

    time: float
    """[s]."""
    places: FloatArray
    """Of all tracks in the file's unit, shape (tracks, 3); not finite or 0, 0, 0 where a marker is hidden."""
    inputs: Mapping[str, float]
    """As of `Frame`."""


def tracks_of(labels: Sequence[str]) -> list[Track]:
    """Return the tracks of labels such as Finger:tip: the subject goes, unless another subject has a marker of the same name."""
    bare = [label.rpartition(":")[2] for label in labels]
    names = [name if name and bare.count(name) == 1 else label for label, name in zip(labels, bare)]
    return [Track("" if last.startswith(NAMELESS) else name, label) for label, last, name in zip(labels, bare, names)]


def capture_source(
    path: Path,
    tracks: Sequence[Track],
    rows: Callable[[], Iterator[Row]],
    options: Options,
    *,
    unit: str | None,
    found: Mapping[str, Any],
    notes: Sequence[str],
    names: Mapping[str, Sequence[Becomes]] | None = None,
    count: int | None = None,
    actuation: str | None = None,
    actuation_by_unit: bool = False,
) -> Source:
    """Return a capture of markers as a source.

    Arguments:
        path, count, actuation, actuation_by_unit: as of `Source`.
        tracks: the markers that can be taken; two of the same name get numbers.
        rows: starts from the first row at each call.
        options: tracks to take, their names, unit and vertical axis.
        unit: declared in the file; None where it declares none.
        names: as of `Source`; by default those of the tracks, and their labels.
        found, notes: in addition to the unit, the vertical axis and the count of tracks without a name.

    Raises:
        InputError: none of the tracks that a person named, or a unit that is not known.
    """
    chosen = [k for k, track in enumerate(tracks) if not options.topics or track.is_one_of(options.topics)]
    if tracks and not chosen:
        raise InputError(
            "no markers", where=path, found=", ".join(sorted({t.label or t.name for t in tracks})), expected="one of them"
        )
    renamed = _numbered([tracks[k].renamed(options.columns) for k in chosen])
    extent = _extent(np.array([row.places[chosen] for row in islice(rows(), LOOKED_AT)]))
    scale = unit_of(options, unit, path, extent) if chosen else 1.0
    if len(chosen) > 1:
        check_size(scale * extent, path)

    def frames() -> Iterator[Frame]:
        for row in rows():
            places = upright(scale * row.places[chosen], options.up)
            seen = [(name, place) for name, place, lost in zip(renamed, places, _hidden(places)) if not lost]
            named = {name: place for name, place in seen if name}
            yield Frame(row.time, markers=named, unlabelled=[place for name, place in seen if not name], inputs=row.inputs)

    what = {"unit": options.unit or unit, "up": options.up or "as in the file", **found}
    known = dict.fromkeys([*(t.name for t in tracks if t.name), *(t.label for t in tracks if t.name)], (Becomes.MARKER,))
    remarks = [*_notes_of_nameless(renamed), *notes]
    return Source(
        path,
        frames,
        found=what,
        actuation=actuation,
        actuation_by_unit=actuation_by_unit,
        count=count,
        notes=remarks,
        names=known if names is None else names,
    )


def _hidden(places: FloatArray) -> BoolArray:
    return np.asarray(~np.isfinite(places).all(axis=-1) | (places == 0.0).all(axis=-1))


def _extent(places: FloatArray) -> float:
    """Return the largest side of the box around places (rows, tracks, 3), in their unit; 0 where none is seen."""
    seen = places.reshape(-1, 3)[~_hidden(places).ravel()]
    return float(np.ptp(seen, axis=0).max()) if len(seen) else 0.0


def _numbered(names: Sequence[str]) -> list[str]:
    """Return unique names: the second tip becomes tip_2."""
    before = [names[:k].count(name) for k, name in enumerate(names)]
    return [f"{name}_{count + 1}" if name and count else name for name, count in zip(names, before)]


def _notes_of_nameless(names: Sequence[str]) -> list[str]:
    nameless = list(names).count("")
    if nameless and nameless < len(names):
        return [f"{nameless} tracks have no name: they are left out of frames that show named markers"]
    return [f"{nameless} tracks have no name: the column marker stays empty, calibration assigns them"] if nameless else []
