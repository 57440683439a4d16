"""The report on the gain of a better model: runs next to each other, and the demo's errors against the truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from markupsafe import Markup

from femsense.io.result_folder import read_document, read_object
from femsense.io.tables import validated
from femsense.report import words
from femsense.report.drawing import image
from femsense.report.page import Chapter, render
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
    file = root / "demo.json"
    demo = validated(Demo, read_object(file, "what femsense demo wrote"), file) if file.is_file() else None
    rows = [] if demo is None else list(zip(MEASURES, _errors(demo.declared), _errors(demo.improved)))
    compared = [_run(root, file) for file in runs] if len(runs) > 1 else []
    body = render("comparison.html", demo=demo, truth=rows, picture=_picture(root), runs=compared)
    return Chapter(title, body) if body else None


MEASURES = (
    "Error of force, median",
    "Error of force, median, of its size",
    "Error of place, median",
    "True contacts in frames found",
    "Contacts in frames that are none",
)


def _errors(run: DemoRun) -> list[str]:
    """Return the errors of a run of the demo against the truth, in the order of MEASURES."""
    none, found = words.NOTHING, run.contacts_found
    return [
        words.joined(words.number(run.force_error_n), "N"),
        words.percent(run.force_error_share, 1),
        words.length(run.place_error_m),
        none if run.contacts_true is None else f"{none if found is None else found} of {run.contacts_true}",
        none if run.contacts_false is None else str(run.contacts_false),
    ]


def _picture(root: Path) -> Markup:
    file = root / "picture.png"
    if not file.is_file() or file.stat().st_size > PICTURE:
        return Markup()
    alt = "The robot with its contact forces, true and sensed, the forces over the frames, and the residual before and after."
    return image(file.read_bytes(), "png", alt=alt, wide=True)


def _run(root: Path, file: Path) -> tuple[str, RunFacts, str]:
    """Return the name of a run, its facts and its error at known loads."""
    facts = validated(RunFacts, read_document(file, RUN_FORMAT), file)
    name = file.parent.relative_to(root).as_posix()
    return name if name != "." else "this folder", facts, load_error(facts.known_loads)


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
