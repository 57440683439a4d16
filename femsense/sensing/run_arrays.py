"""A run as arrays and as a table, for notebooks and scripts."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import BoolArray, FloatArray
from femsense.core.errors import MissingDependency

AXES = "xyz"
NOISE = 3.0
"""A force is significant above this many standard deviations."""


class RunLike(Protocol):
    """The part of a run that these functions use."""

    @property
    def contacts(self) -> tuple[Any, ...]: ...
    @property
    def frames(self) -> tuple[Any, ...]: ...
    @property
    def robot(self) -> Any: ...


def forces_of(run: RunLike) -> FloatArray:
    """Return the forces of the tracks [N], shape (frames, tracks, 3); nan in frames without the track."""
    return _filled(run, "force_n_xyz")


def positions_of(run: RunLike) -> FloatArray:
    """Return the contact points of the tracks on the deformed body [m], shape (frames, tracks, 3); nan in frames without the track."""
    return _filled(run, "position_m")


def sensed(contacts: Iterable[Any]) -> list[Any]:
    """Return the contacts with a significant force. A given contact point without a force is not a contact."""
    return [c for c in contacts if more_than_noise(c.force_n, c.std_n, c.force_n_xyz, c.force_std_n_xyz)]


def undetermined(contacts: Iterable[Any]) -> list[Any]:
    """Return the visible contacts whose force is not significant."""
    contacts = list(contacts)
    felt = {id(c) for c in sensed(contacts)}
    return [c for c in contacts if c.source == "cloud" and id(c) not in felt]


def undetermined_text(force_n: float, std_n: float) -> str:
    """Return the note about a visible contact whose force is not significant."""
    return f"contact, size not determined ({force_n:.2g} ± {std_n:.2g} N)"


def more_than_noise(size_n: npt.ArrayLike, std_n: npt.ArrayLike, force_n: FloatArray, force_std_n: FloatArray) -> BoolArray:
    """Return whether forces are significant: their magnitude (k,), or one of their components (k, 3), exceeds NOISE standard deviations.

    Slender bodies are sensitive to transverse forces and insensitive to axial ones. A contact can therefore be significant although its
    magnitude is poorly determined. Components without a standard deviation (0 or nan) are ignored.
    """
    size_n = np.asarray(size_n)
    component = (np.abs(force_n) >= NOISE * force_std_n) & (force_std_n > 0.0)
    return np.asarray((size_n > 0.0) & (~(size_n < NOISE * np.asarray(std_n)) | component.any(axis=-1)))


def count_of(run: RunLike) -> int:
    """Return the number of contacts of a run; a track counts once."""
    felt = {id(contact) for contact in sensed(run.contacts)}
    return len({track for contact, track in zip(run.contacts, identities_of(run)) if id(contact) in felt})


def tracks_of(run: RunLike) -> tuple[int, ...]:
    """Return the tracks of the contacts, in the order of the second axis of `forces_of`; the numbers in the frame if two contacts of a
    frame have the same track.
    """
    return tuple(sorted(set(identities_of(run))))


def data_frame_of(run: RunLike) -> Any:
    """Return the contacts as a pandas DataFrame, one row a contact and frame, columns as in contacts.csv.

    Raises:
        MissingDependency: without pandas.
    """
    try:
        import pandas
    except ImportError:
        raise MissingDependency('a table needs pandas: pip install "femsense[pandas]"') from None
    return pandas.DataFrame([_row(contact) for contact in run.contacts], columns=list(_columns()))


def describe_run(run: RunLike) -> str:
    """Return a summary of a run in one line, with the largest force of the frames that are ok."""
    ok = {frame.frame for frame in run.frames if frame.status == "ok"}
    count, sizes = count_of(run), [contact.force_n for contact in sensed(run.contacts) if contact.frame in ok]
    forces = f"{count} contact{'s' if count > 1 else ''}" if count else "no contact"
    largest = f", up to {max(sizes):.3g} N" if sizes else ", in frames that are not ok" if count else ""
    return f"Run({run.robot.name}: {len(run.frames)} frames, {len(ok)} ok; {forces}{largest})"


def _filled(run: RunLike, field: str) -> FloatArray:
    rows = {frame.frame: i for i, frame in enumerate(run.frames)}
    columns = {track: j for j, track in enumerate(tracks_of(run))}
    values = np.full((len(rows), len(columns), 3), np.nan)
    for contact, track in zip(run.contacts, identities_of(run)):
        values[rows[contact.frame], columns[track]] = getattr(contact, field)
    return values


def identities_of(run: RunLike) -> list[int]:
    """Return the identity of each contact of a run."""
    distinct = len({(contact.frame, contact.track) for contact in run.contacts}) == len(run.contacts)
    return [contact.track if distinct else contact.contact for contact in run.contacts]


def _columns() -> tuple[str, ...]:
    vectors = [f"{name}{axis}{unit}" for name, unit in (("", "_m"), ("n", ""), ("f", "_n")) for axis in AXES]
    spreads = [f"{axis}_std_m" for axis in AXES], [f"f{axis}_std_n" for axis in AXES]
    return ("frame", "time_s", "contact", *vectors, "force_n", "std_n", "source", "track", *spreads[0], "radius_m", *spreads[1])


def _row(c: Any) -> list[Any]:
    vectors = np.concatenate([c.position_m, c.normal, c.force_n_xyz]).tolist()
    known = [c.force_n, c.std_n, c.source, c.track]
    return [c.frame, c.time_s, c.contact, *vectors, *known, *c.position_std_m.tolist(), c.radius_m, *c.force_std_n_xyz.tolist()]
