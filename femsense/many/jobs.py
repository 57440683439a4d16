"""A job: one command on one recording. Lists of jobs come from paths, from globs, or from a table (CSV or Parquet)."""

from __future__ import annotations

import glob
import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from femsense.core.errors import InputError
from femsense.core.packages import needed
from femsense.core.text import one_line
from femsense.io.tables import read_csv

RECORDS = ".many"
"""Folder below the folder of all results that holds one record and one log for each job."""
MANY = "many.json"
"""File that lists the results of a folder of many."""
SUMMARY = (MANY, "summary.csv", "summary.parquet", "summary.html", "poison.csv")
"""Files next to the results: `recordings/*` matches them too, and they are no recordings."""
GLOB = "*?["


@dataclass(frozen=True, slots=True)
class Job:
    """One task: paths and words only, so that it is small wherever it is sent."""

    name: str
    """Of its results: the folder below the folder of all results."""
    words: tuple[str, ...]
    """The command with its arguments, as on a command line."""
    reads: tuple[Path, ...]
    """Files and folders that the result depends on."""
    writes: Path
    """The file or folder that it makes."""
    record: Path
    """File that holds its outcome."""


@dataclass(frozen=True, slots=True)
class Row:
    """One row of a table of jobs: column → text, without empty cells."""

    cells: dict[str, str]
    where: str
    """File and line, for messages."""
    folder: Path
    """Relative paths in the cells start here."""


def is_glob(text: str | Path) -> bool:
    """Return whether a text is a pattern of paths rather than a path that exists."""
    return any(sign in str(text) for sign in GLOB) and not Path(text).expanduser().exists()


def expanded(paths: Iterable[str | Path]) -> list[Path]:
    """Return absolute paths: patterns replaced by what they match, sorted; a folder of many results by these.

    Raises InputError for a pattern without a match.
    """
    found = list[Path]()
    for path in paths:
        text = str(Path(path).expanduser())
        if not is_glob(text):
            found += parts_of(Path(text).absolute()) or [Path(text).absolute()]
            continue
        matches = sorted(Path(match).absolute() for match in glob.glob(text, recursive=True))
        if not matches:
            raise InputError("nothing matches this pattern", where=text, expected="files or folders")
        found += matches
    return [path for path in found if path.name not in (*SUMMARY, RECORDS)] if len(found) > 1 else found


def parts_of(folder: Path) -> list[Path]:
    """Return the folders of the results that a folder of many results holds; none where it is another folder."""
    try:
        places = json.loads((folder / MANY).read_text(encoding="utf-8"))["folders"].values()
        return [folder / place for place in places if place and (folder / place).is_dir() and place != "."]
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return []


def names_of(paths: Sequence[Path]) -> list[str]:
    """Return one name for each path: its last part without an ending; where two are alike, with the folders above it.

    Raises InputError where a path occurs twice.
    """
    twice = [path for path, count in Counter(paths).items() if count > 1]
    if twice:
        raise InputError("the same path occurs twice", where=twice[0], expected="each path once")
    parts = [(*path.parts[1:-1], path.name if path.is_dir() else path.stem) for path in paths]
    depth = 1
    names = [own[-1] for own in parts]
    while len(set(names)) < len(names) and depth < max(map(len, parts)):
        depth += 1
        names = ["-".join(own[-depth:]) for own in parts]
    return names if len(set(names)) == len(names) else [f"{name}-{i:04d}" for i, name in enumerate(names)]


def read_table(file: Path) -> list[Row]:
    """Return the rows of a table of jobs, CSV or Parquet. Raises InputError, and MissingDependency for Parquet without pyarrow."""
    folder = file.parent.absolute()
    if file.suffix == ".parquet":
        lines = _parquet_rows(file)
        return [
            Row({name: _text(value) for name, value in line.items() if value is not None}, f"{file}, row {i + 1}", folder)
            for i, line in enumerate(lines)
        ]
    table = read_csv(file, required=(), prefixes=("",))
    columns = [table.text(name) for name in table.columns]
    return [
        Row({name: cells[i] for name, cells in zip(table.columns, columns) if cells[i]}, table.place(i), folder)
        for i in range(len(table))
    ]


def _parquet_rows(file: Path) -> list[dict[str, Any]]:
    needed("pyarrow.parquet", "dask", "reading Parquet (or give the table as CSV)")
    from pyarrow import ArrowException
    from pyarrow.parquet import read_table as read

    try:
        return list(read(file).to_pylist())
    except (OSError, ArrowException) as error:
        raise InputError("not a Parquet table", where=file, found=one_line(error, 120)) from None


def _text(value: object) -> str:
    return " ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
