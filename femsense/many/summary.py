"""One table and one page over all jobs: summary.csv, summary.parquet, summary.html, poison.csv and many.json."""

from __future__ import annotations

import contextlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from markupsafe import Markup

import femsense
from femsense.core.errors import InputError
from femsense.io.files import check_target, json_text, write_beside, write_csv, write_json, write_text
from femsense.io.own_files import FileKind, check_files
from femsense.many.jobs import MANY, RECORDS
from femsense.many.outcome import JobStatus, Outcome, Scalar
from femsense.many.records import read_record
from femsense.report.page import Chapter, render
from femsense.report.words import counted, duration

MANY_FORMAT = "femsense-many-1"
COLUMNS = ("name", "status", "reason", "seconds", "peak_gb", "host", "folder")
"""Columns of every summary; those of the command follow."""
POISON_COLUMNS = ("name", "reason", "deaths")
OWN = {
    MANY: FileKind("many jobs of femsense", b"{", f'"format": "{MANY_FORMAT}'.encode()),
    "summary.csv": FileKind("a summary of femsense", ",".join(COLUMNS).encode()),
    "summary.parquet": FileKind("a summary of femsense", b"PAR1"),
    "summary.html": FileKind("a page of femsense", b"<!DOCTYPE html>", b'content="femsense"'),
    "poison.csv": FileKind("a list of femsense", ",".join(POISON_COLUMNS).encode()),
}
SHOWN_REASON = 300
RESULTS = ("recording.toml", "robot.toml", "run.json", "calibration.json")
"""Each is of one result, in a folder of its own."""


@dataclass(frozen=True, slots=True)
class Line:
    """One line of a summary."""

    outcome: Outcome
    folder: str
    """Of the result, from the folder of the summary; empty where there is none."""


def check_summary_folder(folder: Path) -> None:
    """Raise InputError where a summary cannot be written, or would replace a file that is none of femsense's."""
    check_target(folder, folder=True)
    check_files(folder, OWN)


def check_no_result(folder: Path) -> None:
    """Raise InputError where a folder holds one result: those of many would be mixed with it."""
    found = next((name for name in RESULTS if (folder / name).exists()), None)
    if found is not None:
        raise InputError(
            "the folder contains a single result, not those of several jobs", where=folder, found=found, hint="another -o"
        )


def write_summary(folder: Path, command: str, outcomes: Sequence[Outcome], folders: Mapping[str, Path]) -> None:
    """Write the summary of many jobs.

    Arguments:
        folder: of all results.
        command: that ran.
        outcomes: of the jobs, in their order.
        folders: name of a job → folder of its result.

    Raises:
        InputError: see `check_summary_folder`; or the disk is full.
    """
    lines = [Line(o, _from(folder, folders[o.name]) if folders[o.name].is_dir() else "") for o in outcomes]
    names, rows = table_of(lines)
    write_csv(folder / "summary.csv", names, rows)
    _write_parquet(folder / "summary.parquet", names, rows)
    poisoned = [o for o in outcomes if o.deaths and not o.is_good and o.status in (JobStatus.CRASHED, JobStatus.OUT_OF_MEMORY)]
    if poisoned:
        write_csv(folder / "poison.csv", POISON_COLUMNS, [(o.name, o.reason, o.deaths) for o in poisoned])
    else:
        (folder / "poison.csv").unlink(missing_ok=True)
    write_text(folder / "summary.html", summary_page(folder, command, lines))
    counts = dict(Counter(map(_status, outcomes)))
    document = {"format": MANY_FORMAT, "command": command, "jobs": len(outcomes), "counts": counts}
    write_json(folder / MANY, {**document, "folders": {o.name: line.folder for o, line in zip(outcomes, lines)}})


def read_summary(folder: Path) -> tuple[str, list[Outcome], dict[str, Path]] | None:
    """Return command, outcomes and folders of the many jobs whose results a folder holds; None where it holds none."""
    try:
        document = json.loads((folder / MANY).read_text(encoding="utf-8"))
        if document["format"] != MANY_FORMAT:
            return None
        command, places = str(document["command"]), {str(k): folder / str(v) for k, v in document["folders"].items()}
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return None
    found = {name: read_record(folder / RECORDS / command / f"{name}.json") for name in places}
    return command, [record.outcome for record in found.values() if record is not None], places


def table_of(lines: Sequence[Line]) -> tuple[list[str], list[list[Scalar]]]:
    """Return the names of the columns and the rows of a summary. A column that any job has, all have."""
    own = list(dict.fromkeys(name for line in lines for name in line.outcome.row))
    rows: list[list[Scalar]] = []
    for line in lines:
        o = line.outcome
        peak = round(o.peak_bytes / 1e9, 3) if o.peak_bytes else None
        rows.append(
            [
                o.name,
                _status(o),
                o.reason or None,
                round(o.seconds, 3),
                peak,
                o.host,
                line.folder,
                *(o.row.get(n) for n in own),
            ]
        )
    return [*COLUMNS, *own], rows


def _status(outcome: Outcome) -> str:
    """Return a status as files have it: they are the same whether a result is new or was there."""
    return JobStatus.DONE.value if outcome.status is JobStatus.KEPT else outcome.status.value


def _from(folder: Path, place: Path) -> str:
    with contextlib.suppress(ValueError):
        return place.relative_to(folder).as_posix()
    return place.as_posix()


def _write_parquet(file: Path, names: Sequence[str], rows: Sequence[Sequence[Scalar]]) -> None:
    """Write the table as Parquet, where pyarrow is installed."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        return
    columns = {name: [row[i] for row in rows] for i, name in enumerate(names)}
    arrays = {name: pyarrow.array(_of_one_type(values)) for name, values in columns.items()}
    with write_beside(file) as part:
        parquet.write_table(pyarrow.table(arrays), part)


def _of_one_type(values: Sequence[Scalar]) -> list[Scalar]:
    """Return values as they are where all are numbers or all are texts, else as texts."""
    there = [value for value in values if value is not None]
    if all(isinstance(v, bool) for v in there) or all(isinstance(v, str) for v in there):
        return list(values)
    if all(isinstance(v, int | float) and not isinstance(v, bool) for v in there):
        return [None if v is None else float(v) for v in values]
    return [None if v is None else str(v) for v in values]


# The page


def summary_page(folder: Path, command: str, lines: Sequence[Line]) -> str:
    """Return the page: figures on top, and the table, which can be sorted by each column and filtered by words and by status."""
    outcomes = [line.outcome for line in lines]
    good, ran = sum(o.is_good for o in outcomes), [o for o in outcomes if o.seconds]
    slowest = max(ran, key=lambda o: o.seconds, default=None)
    names, rows = table_of(lines)
    data: dict[str, Any] = {
        "columns": names,
        "rows": [[_shown(cell) for cell in row] for row in rows],
        "links": [_links(folder, line.folder) for line in lines],
    }
    figures = [
        ("jobs", str(len(lines)), f"femsense {command}"),
        ("with a result", str(good), f"{len(lines) - good} without"),
        ("working time", duration(sum(o.seconds for o in ran)), counted(len({o.host for o in ran}), "machine")),
        ("slowest", duration(slowest.seconds) if slowest else "–", slowest.name if slowest else ""),
    ]
    script = files("femsense.many").joinpath("summary.js").read_text(encoding="utf-8")
    text = json_text(data, indent=None).replace("<", "\\u003c")
    body = render("many.html", figures=figures, data=Markup(text), script=Markup(script))
    head = f"{good} of {len(lines)} recordings have a result"
    kind = f"femsense {command}, version {femsense.__version__}"
    return f"{render('page.html', title=folder.absolute().name, kind=kind, chapters=[Chapter('Jobs', body, head)])}\n"


def _shown(cell: Scalar) -> Scalar:
    return cell[: SHOWN_REASON - 1] + "…" if isinstance(cell, str) and len(cell) > SHOWN_REASON else cell


def _links(folder: Path, place: str) -> str:
    """Return where a job's own page stands, from the folder of the summary; its folder where it has none."""
    if not place:
        return ""
    return f"{place}/report.html" if (folder / place / "report.html").is_file() else f"{place}/"
