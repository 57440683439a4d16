"""The report on a run: forces over time, contacts, status of each frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from femsense.report import words
from femsense.report.compare import load_error
from femsense.report.page import Chapter, render
from femsense.report.run.document import SavedRun, saved_run
from femsense.report.run.forces import ROWS, first_of, force_pictures, force_text, listed_contacts
from femsense.report.run.frames import LISTED, column, frame_pictures, median_of, statuses
from femsense.report.text import strongest_contact
from femsense.sensing.run_arrays import sensed, undetermined


def run_chapter(file: Path, title: str) -> Chapter:
    """Return the report on a run.

    Arguments:
        file: run.json; contacts.csv, frames.csv and states.npz next to it are shown if they are there.
        title: of the chapter.

    Raises:
        InputError: one of them is broken.
    """
    run = saved_run(file)
    facts = run.facts
    body = render(
        "run.html",
        facts=facts,
        count=_count(run),
        touched=None if run.contacts is None else len({c.frame for c in sensed(run.contacts)}),
        undetermined=_undetermined(run),
        residual=_residual(run) if run.frames else None,
        forces=force_pictures(run),
        load_error=load_error(facts.known_loads),
        listed=ROWS,
        contacts=listed_contacts(run.contacts or ()),
        statuses=statuses(run.frames or ()),
        listed_statuses=LISTED,
        first_of=first_of,
        frames=frame_pictures(run.frames or ()),
        origin=(
            ("Robot", facts.robot),
            ("Recording", Path(facts.inputs.recording.path or "").name),
            ("Time in all", f"{words.number(facts.timing.seconds)} s" if words.known(facts.timing.seconds) else ""),
            ("Versions", ", ".join(f"{name} {version}" for name, version in facts.versions.items())),
        ),
    )
    return Chapter(title, body, _headline(run), facts.robot)


def _headline(run: SavedRun) -> str:
    facts = run.facts
    base = f"{words.counted(_count(run), 'contact')} in {words.counted(facts.frames, 'frame')}"
    doubted = sum(frame.status != "ok" and np.isfinite(frame.rms_after_m) for frame in run.frames or ())
    lost = facts.frames - facts.frames_ok - doubted
    if lost:
        base += f", {lost} of them without a result"
    if doubted:
        base += f", {doubted} of them not to be trusted"
    strongest = strongest_contact(run.contacts or (), run.frames or ())
    if strongest is None:
        weak = _undetermined(run)
        return f"{base}; {weak}." if weak else f"{base}."
    return f"{base}; largest force {force_text(strongest.force_n, strongest.std_n)} in frame {strongest.frame}."


def _undetermined(run: SavedRun) -> str:
    """Return in how many frames a visible contact has a size that is not determined; nothing where there is none."""
    count = len({c.frame for c in undetermined(run.contacts or ())})
    return f"size not determined in {words.counted(count, 'frame')}" if count else ""


def _count(run: SavedRun) -> int:
    """Return the number of contacts: one over time counts once."""
    return run.facts.contacts if run.contacts is None else len({c.track for c in sensed(run.contacts)})


def _residual(run: SavedRun) -> tuple[float, float]:
    """Return the median residuals without and with the forces [m], of the frames with contact if there are any."""
    good = [frame for frame in run.frames or () if frame.status == "ok"]
    rows = [frame for frame in good if frame.contacts > 0] or good
    return median_of(column(rows, "rms_before_m")), median_of(column(rows, "rms_after_m"))
