"""The report on a run: forces over time, contacts, what became of each frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from femsense.io.result_folder import read_document
from femsense.io.tables import validated
from femsense.report import words
from femsense.report.compare import load_error
from femsense.report.page import Chapter, render
from femsense.report.run.document import RunFacts
from femsense.report.run.forces import ROWS, ListedContacts, force_pictures, force_text, listed_contacts
from femsense.report.run.frames import LISTED, frame_pictures, statuses
from femsense.report.run.tables import (
    ContactTable,
    FrameTable,
    first_of,
    median_of,
    read_contacts,
    read_frames,
    strongest_contact,
)
from femsense.sensing.run_files import RUN_FORMAT


def run_chapter(file: Path, title: str) -> Chapter:
    """Return the report on a run.

    Arguments:
        file: run.json; contacts.csv, frames.csv and states.npz beside it are shown if they are there.
        title: of the chapter.

    Raises:
        InputError: one of them is broken.
    """
    facts = validated(RunFacts, read_document(file, RUN_FORMAT), file)
    folder = file.parent
    contacts = read_contacts(folder / "contacts.csv") if (folder / "contacts.csv").is_file() else None
    frames = read_frames(folder / "frames.csv") if (folder / "frames.csv").is_file() else None
    listed: ListedContacts | None = None if contacts is None else listed_contacts(contacts)
    body = render(
        "run.html",
        facts=facts,
        count=_count(facts, contacts),
        touched=None if contacts is None else len(set(contacts.frame[contacts.sensed].tolist())),
        undetermined="" if contacts is None else _undetermined(contacts),
        residual=None if frames is None or not len(frames) else _residual(frames),
        forces=force_pictures(contacts, frames, folder),
        load_error=load_error(facts.known_loads),
        listed=ROWS,
        contacts=listed,
        statuses=[] if frames is None else statuses(frames),
        listed_statuses=LISTED,
        first_of=first_of,
        frames=frame_pictures(frames),
        origin=(
            ("Robot", facts.robot),
            ("Recording", Path(facts.inputs.recording.path or "").name),
            ("Time in all", f"{words.number(facts.timing.seconds)} s" if words.known(facts.timing.seconds) else ""),
            ("Versions", ", ".join(f"{name} {version}" for name, version in facts.versions.items())),
        ),
    )
    return Chapter(title, body, _headline(facts, contacts, frames), facts.robot)


def _headline(facts: RunFacts, contacts: ContactTable | None, frames: FrameTable | None) -> str:
    base = f"{words.counted(_count(facts, contacts), 'contact')} in {words.counted(facts.frames, 'frame')}"
    doubted = 0 if frames is None else int((~frames.good & np.isfinite(frames.after_m)).sum())
    lost = facts.frames - facts.frames_ok - doubted
    if lost:
        base += f", {lost} of them without a result"
    if doubted:
        base += f", {doubted} of them not to be trusted"
    strongest = strongest_contact(contacts, frames)
    if contacts is None or strongest is None:
        weak = "" if contacts is None else _undetermined(contacts)
        return f"{base}; {weak}." if weak else f"{base}."
    return (
        f"{base}; largest force {force_text(contacts.size_n[strongest], contacts.std_n[strongest])} in frame "
        f"{contacts.frame[strongest]}."
    )


def _undetermined(contacts: ContactTable) -> str:
    """Return in how many frames a contact was seen whose size is not determined; nothing where there is none."""
    count = len(set(contacts.frame[contacts.undetermined].tolist()))
    return f"size not determined in {words.counted(count, 'frame')}" if count else ""


def _count(facts: RunFacts, contacts: ContactTable | None) -> int:
    """Return how many contacts there are: one over time counts once."""
    return facts.contacts if contacts is None else len(set(contacts.contact[contacts.sensed].tolist()))


def _residual(frames: FrameTable) -> tuple[float, float]:
    """Return the median residuals without and with the forces [m], of the frames with contact if there are any."""
    touched = frames.good & (frames.contacts > 0)
    rows = touched if touched.any() else frames.good
    return median_of(frames.before_m[rows]), median_of(frames.after_m[rows])
