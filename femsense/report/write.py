"""From a folder of results to one HTML file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from femsense.core.errors import InputError
from femsense.io.files import check_target, write_text
from femsense.io.own_files import REPORT
from femsense.report.calibration import calibration_chapter
from femsense.report.compare import comparison_chapter
from femsense.report.found import Found, Kind, find_results
from femsense.report.loop.chapter import loop_chapter
from femsense.report.page import Chapter, render
from femsense.report.run.chapter import run_chapter

CHAPTERS: dict[Kind, tuple[str, Callable[[Path, str], Chapter]]] = {
    Kind.LOOP: ("What the model lacks", loop_chapter),
    Kind.RUN: ("Forces", run_chapter),
    Kind.CALIBRATION: ("Calibration", calibration_chapter),
}
"""Kind of result → title of its chapter, and the function that makes it of a file."""


def write_report(folder: str | Path, path: str | Path | None = None) -> Path:
    """Write the figures and tables of a folder of results as one HTML file that needs nothing else.

    Arguments:
        folder: output folder of `femsense improve`, `estimate` or `calibrate`, or a folder that contains such folders.
        path: the HTML file. Default: report.html in the folder.

    Returns:
        the path of the HTML file.

    Raises:
        InputError: the folder does not exist or contains no results, a result is broken, or `path` is a folder or a file of another kind.
    """
    root = Path(folder).expanduser()
    target = root / "report.html" if path is None else Path(path).expanduser()
    if target.is_dir():
        raise InputError(
            "a folder exists where the file should be written",
            where=target,
            expected="the name of a file",
            hint=str(target / "report.html"),
        )
    text = report_html(root)
    check_target(target, folder=False, kind=REPORT)
    write_text(target, text)
    return target


def report_html(folder: str | Path) -> str:
    """Return the report of a folder as HTML. Raises InputError; see `write_report`."""
    root = Path(folder).expanduser()
    found = find_results(root)
    chapters = [CHAPTERS[item.kind][1](item.file, _title(item, root, found)) for item in found]
    loops = sum(item.kind is Kind.LOOP for item in found)
    compared = comparison_chapter(
        root, [item.file for item in found if item.kind is Kind.RUN], "What it changes" if loops else "Comparison"
    )
    chapters[loops:loops] = [compared] if compared else []
    subject = next((chapter.subject for chapter in chapters if chapter.subject), "") or root.resolve().name
    return f"{render('page.html', title=subject, chapters=chapters)}\n"


def _title(item: Found, root: Path, found: Sequence[Found]) -> str:
    """Return the title of a chapter: its kind, and where it stands if others are of the same kind or it is not of this folder."""
    place = item.folder.relative_to(root).as_posix()
    alike = [other for other in found if other.kind == item.kind and other.folder == item.folder]
    if len(alike) > 1:
        place = item.file.relative_to(root).as_posix()
    title = CHAPTERS[item.kind][0]
    return title if place == "." else f"{title} ({place})"
