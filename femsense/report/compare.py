"""The report on what a better model changes: runs next to each other, and the demo's errors against the truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from femsense.io.tables import validated
from femsense.report import words
from femsense.report.documents import read_document, read_json
from femsense.report.page import Chapter, Html, image, section, table, together
from femsense.report.run.document import Demo, DemoRun, KnownLoad, RunFacts
from femsense.sensing.run_files import RUN_FORMAT

PICTURE = 1_500_000
"""Pictures up to this size [bytes] go into the page."""


def comparison_chapter(root: Path, runs: Sequence[Path], title: str) -> Chapter | None:
    """Return the runs of a folder next to each other and, for the demo, their errors against the truth;
    None where neither is there.

    Arguments:
        root: the folder; `demo.json` and `picture.png` are used if the demo wrote them.
        runs: run.json of each run.
        title: of the chapter.

    Raises:
        InputError: a file is broken.
    """
    demo = _demo(root / "demo.json")
    table_of_runs = _runs(root, runs) if len(runs) > 1 else None
    body = together(section("Against the truth", _truth(demo), _picture(root) if demo else None), section("Runs", table_of_runs))
    return Chapter(title, body) if body else None


def _demo(file: Path) -> Demo | None:
    return validated(Demo, read_json(file, "what femsense demo wrote"), file) if file.is_file() else None


def _truth(demo: Demo | None) -> Html | None:
    if demo is None:
        return None
    both = (demo.declared, demo.improved)
    rows = [
        ["Error of force, median", *(words.joined(words.number(r.force_error_n), "N") for r in both)],
        ["Error of force, median, of its size", *(words.percent(r.force_error_share, 1) for r in both)],
        ["Error of place, median", *(words.length(r.place_error_m) for r in both)],
        ["True contacts in frames found", *(_found(r) for r in both)],
        ["Contacts in frames that are none", *(_count(r.contacts_false) for r in both)],
    ]
    shown = [row for row in rows if set(row[1:]) != {words.NOTHING}]
    return table(
        ("Measure", "Declared robot", "Improved robot"),
        shown,
        caption="The recording comes with the true contact forces.",
        numeric=(1, 2),
    )


def _found(run: DemoRun) -> str:
    return words.NOTHING if run.contacts_true is None else f"{_count(run.contacts_found)} of {run.contacts_true}"


def _count(value: int | None) -> str:
    return words.NOTHING if value is None else str(value)


def _picture(root: Path) -> Html | None:
    file = root / "picture.png"
    if not file.is_file() or file.stat().st_size > PICTURE:
        return None
    alt = "The robot with its contact forces, true and sensed, the forces over the frames, and the residual before and after."
    return image(file.read_bytes(), "png", alt=alt, wide=True)


def _runs(root: Path, runs: Sequence[Path]) -> Html | None:
    rows = []
    for file in runs:
        facts = read_document(file, RunFacts, RUN_FORMAT)
        name = file.parent.relative_to(root).as_posix()
        rows.append(
            [
                name if name != "." else "this folder",
                facts.robot,
                f"{facts.frames_ok} of {facts.frames}",
                str(facts.contacts),
                load_error(facts.known_loads),
                words.joined(words.number(facts.timing.ms_per_frame_median), "ms"),
            ]
        )
    headers = ("Run", "Robot", "Frames", "Contacts", "Error at known loads", "Time a frame")
    return table(
        headers,
        rows,
        caption="The runs of this folder; the error at known loads is the median of its size.",
        numeric=(2, 3, 4, 5),
    )


def load_error(loads: Sequence[KnownLoad]) -> str:
    """Return the median size of the force error at known loads, in N and percent."""
    rows = [(load.declared_n, load.sensed_n) for load in loads]
    known = [(d, s) for d, s in rows if d is not None and s is not None and words.known(d) and words.known(s) and d > 0]
    if not known:
        return words.NOTHING
    size = float(np.median([abs(s - d) for d, s in known]))
    share = float(np.median([abs(s / d - 1.0) for d, s in known]))
    factor, unit = words.force_unit(size)
    return f"{words.joined(words.number(factor * size, 2), unit)} ({words.percent(share, 1)})"
