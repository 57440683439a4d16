"""The report on a run: forces over time, contacts, what became of each frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from femsense.report import words
from femsense.report.documents import read_document
from femsense.report.page import Chapter, Html, section, table, tiles, together
from femsense.report.run.document import RunFacts
from femsense.report.run.forces import contacts_table, force_panels, force_text, known_loads_table
from femsense.report.run.frames import frame_panels, status_table
from femsense.report.run.tables import ContactTable, FrameTable, median_of, read_contacts, read_frames, strongest_contact
from femsense.sensing.run_files import RUN_FORMAT


def run_chapter(file: Path, title: str) -> Chapter:
    """Return the report on a run.

    Arguments:
        file: run.json; contacts.csv, frames.csv and states.npz beside it are shown if they are there.
        title: of the chapter.

    Raises:
        InputError: one of them is broken.
    """
    facts = read_document(file, RunFacts, RUN_FORMAT)
    folder = file.parent
    contacts = read_contacts(folder / "contacts.csv") if (folder / "contacts.csv").is_file() else None
    frames = read_frames(folder / "frames.csv") if (folder / "frames.csv").is_file() else None
    body = together(
        _summary(facts, contacts, frames),
        section("Contact forces", force_panels(contacts, frames, folder)),
        section("Known loads", known_loads_table(facts.known_loads)),
        section("Contacts", contacts_table(contacts)),
        section("Frames", status_table(frames), frame_panels(frames)),
        section("Made from", _origin(facts)),
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


def _summary(facts: RunFacts, contacts: ContactTable | None, frames: FrameTable | None) -> Html:
    items = [("Frames ok", f"{facts.frames_ok} of {facts.frames}", "")]
    touched = 0 if contacts is None else len(set(contacts.frame[contacts.sensed].tolist()))
    where = (
        "" if contacts is None else "; ".join(filter(None, [f"in {words.counted(touched, 'frame')}", _undetermined(contacts)]))
    )
    items.append(("Contacts", str(_count(facts, contacts)), where))
    if frames is not None and len(frames):
        rows = frames.good & (frames.contacts > 0) if (frames.good & (frames.contacts > 0)).any() else frames.good
        before, after = median_of(frames.before_m[rows]), median_of(frames.after_m[rows])
        items.append(("Residual with the forces", words.length(after), f"{words.length(before)} without them; median rms"))
    if words.known(facts.timing.ms_per_frame_median):
        items.append(("Time a frame", words.joined(words.number(facts.timing.ms_per_frame_median), "ms"), "median"))
    return tiles(items)


def _origin(facts: RunFacts) -> Html | None:
    recording = Path(facts.inputs.recording.path or "").name
    rows = [
        ["Robot", facts.robot],
        ["Recording", recording],
        ["Time in all", f"{words.number(facts.timing.seconds)} s" if words.known(facts.timing.seconds) else ""],
        ["Versions", ", ".join(f"{name} {version}" for name, version in facts.versions.items())],
    ]
    return table(("Item", "Value"), [row for row in rows if row[1]], caption="run.json beside this file has the hashes.")
