"""The parts of a run, of run.json and of demo.json that a report shows.

Missing parts are left out; a wrong type is an InputError.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from pydantic import ConfigDict, Field

from femsense.io.result_folder import read_document
from femsense.io.tables import Schema, validated
from femsense.sensing.run_files import RUN_FORMAT, read_contacts, read_frames
from femsense.sensing.types import ContactForce, FrameReport

Number = float | None


class Document(Schema):
    """Other keys than those named are ignored; null and NaN stand for unknown values."""

    model_config = ConfigDict(extra="ignore", strict=True, frozen=True, allow_inf_nan=True)


class Input(Document):
    name: str | None = None
    path: str | None = None
    sha256: str | None = None


class KnownLoad(Document):
    frame: int
    declared_n: Number = None
    sensed_n: Number = None
    error_percent: Number = None


class RunInputs(Document):
    robot: Input = Input()
    recording: Input = Input()


class Timing(Document):
    seconds: Number = None
    ms_per_frame_median: Number = None


class RunFacts(Document):
    """run.json."""

    robot: str = ""
    frames: int = 0
    frames_ok: int = 0
    contacts: int = 0
    known_loads: list[KnownLoad] = Field(default_factory=list)
    inputs: RunInputs = RunInputs()
    timing: Timing = Timing()
    versions: dict[str, str] = Field(default_factory=dict)


@dataclass(frozen=True, eq=False, slots=True)
class SavedRun:
    """A run as its folder holds it; any file but run.json may be missing."""

    facts: RunFacts
    contacts: tuple[ContactForce, ...] | None
    """Of contacts.csv; where two of a frame have one track, each has its number in the frame instead."""
    frames: tuple[FrameReport, ...] | None
    """Of frames.csv."""
    folder: Path


def saved_run(file: Path) -> SavedRun:
    """Return the run of a run.json and of the tables next to it. Raises InputError where one of them is broken."""
    facts, folder = validated(RunFacts, read_document(file, RUN_FORMAT), file), file.parent
    contacts = read_contacts(folder / "contacts.csv") if (folder / "contacts.csv").is_file() else None
    frames = read_frames(folder / "frames.csv") if (folder / "frames.csv").is_file() else None
    if contacts is not None and len({(c.frame, c.track) for c in contacts}) < len(contacts):
        contacts = tuple(replace(c, track=c.contact) for c in contacts)
    return SavedRun(facts, contacts, frames, folder)


class DemoRun(Document):
    force_error_n: Number = None
    force_error_share: Number = None
    place_error_m: Number = None
    contacts_found: int | None = None
    contacts_true: int | None = None
    contacts_false: int | None = None


class Demo(Document):
    """demo.json."""

    declared: DemoRun = DemoRun()
    improved: DemoRun = DemoRun()
