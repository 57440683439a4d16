"""contacts.csv and frames.csv of a run, as columns."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, IntArray
from femsense.io.tables import Table, read_csv
from femsense.sensing.run_arrays import more_than_noise
from femsense.sensing.run_files import CONTACT_COLUMNS, FRAME_COLUMNS, MORE_CONTACT_COLUMNS, NOTE_COLUMN


@dataclass(frozen=True, eq=False, slots=True)
class ContactTable:
    """contacts.csv."""

    frame: IntArray
    contact: IntArray
    """Who each is over the frames: its track; its number in the frame where two of a frame have one track, or there is none."""
    time_s: FloatArray
    place_m: FloatArray
    """shape (k, 3)."""
    force_n: FloatArray
    """shape (k, 3)."""
    size_n: FloatArray
    std_n: FloatArray
    force_std_n: FloatArray
    """shape (k, 3), nan where it is not there."""
    source: tuple[str, ...]

    @property
    def sensed(self) -> npt.NDArray[np.bool_]:
        """Whose force is more than noise may make."""
        return more_than_noise(self.size_n, self.std_n, self.force_n, self.force_std_n)

    @property
    def undetermined(self) -> npt.NDArray[np.bool_]:
        """Which a camera saw and whose force is not more than noise may make."""
        return np.array([source == "cloud" for source in self.source], dtype=bool) & ~self.sensed

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True, eq=False, slots=True)
class FrameTable:
    """frames.csv."""

    frame: IntArray
    time_s: FloatArray
    status: tuple[str, ...]
    contacts: IntArray
    matched: IntArray
    before_m: FloatArray
    after_m: FloatArray
    ms: FloatArray
    tension_n: dict[str, FloatArray]
    pressure_pa: dict[str, FloatArray]

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def good(self) -> npt.NDArray[np.bool_]:
        return np.array([status == "ok" for status in self.status], dtype=bool)


def read_contacts(file: Path) -> ContactTable:
    """Return contacts.csv. Raises InputError."""
    table_ = read_csv(file, required=CONTACT_COLUMNS, optional=MORE_CONTACT_COLUMNS)
    values = table_.numbers(("time_s", *CONTACT_COLUMNS[3:14]), empty_is_nan=True)
    frames = table_.integers("frame")
    told = [name for name in MORE_CONTACT_COLUMNS[-3:] if name in table_.columns]
    deviations = table_.numbers(told, empty_is_nan=True) if len(told) == 3 else np.full((len(frames), 3), np.nan)
    return ContactTable(
        frames,
        _identities(table_, frames),
        values[:, 0],
        values[:, 1:4],
        values[:, 7:10],
        values[:, 10],
        values[:, 11],
        deviations,
        table_.text("source"),
    )


def _identities(table_: Table, frames: IntArray) -> IntArray:
    tracks = table_.integers("track") if "track" in table_.columns else np.zeros(len(frames), dtype=np.int64)
    distinct = len(np.unique(np.column_stack([frames, tracks]), axis=0)) == len(frames)
    return tracks if distinct and "track" in table_.columns else table_.integers("contact")


def read_frames(file: Path) -> FrameTable:
    """Return frames.csv. Raises InputError."""
    table_ = read_csv(file, required=FRAME_COLUMNS, optional=(NOTE_COLUMN,), prefixes=("tension_", "pressure_"))
    cables = [c for c in table_.columns if c.startswith("tension_")]
    chambers = [c for c in table_.columns if c.startswith("pressure_")]
    values = table_.numbers(("time_s", "rms_before_m", "rms_after_m", "ms", *cables, *chambers), empty_is_nan=True)
    tension = {c.removeprefix("tension_").removesuffix("_n"): values[:, 4 + j] for j, c in enumerate(cables)}
    pressure = {c.removeprefix("pressure_").removesuffix("_pa"): values[:, 4 + len(cables) + j] for j, c in enumerate(chambers)}
    return FrameTable(
        table_.integers("frame"),
        values[:, 0],
        table_.text("status"),
        table_.integers("contacts"),
        table_.integers("matched"),
        values[:, 1],
        values[:, 2],
        values[:, 3],
        tension,
        pressure,
    )


def strongest_contact(contacts: ContactTable | None, frames: FrameTable | None) -> int | None:
    """Return the row of the largest force above the noise in the frames that are ok, as the terminal names it; None where there is none."""
    if contacts is None:
        return None
    bad = [] if frames is None else frames.frame[~frames.good].tolist()
    size = np.where(np.isin(contacts.frame, bad) | ~contacts.sensed, np.nan, contacts.size_n)
    return None if not np.isfinite(size).any() else int(np.nanargmax(size))


def median_of(values: FloatArray) -> float:
    """Return the median of what is finite; nan where nothing is."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def first_of(count: int, shown: int, file: str) -> str:
    """Return a note on what a table leaves out; empty where it shows all."""
    return f" The first {shown} of {count}; all of them are in {file}." if count > shown else ""
