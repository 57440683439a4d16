"""Folders of results: written whole or not at all, and documents of one format."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from femsense.core.errors import InputError
from femsense.io.files import PART_PREFIX, check_target, write_beside
from femsense.io.own_files import FileKind, check_files

# Parts


@contextmanager
def results_folder(folder: str | Path, marker: str) -> Iterator[Path]:
    """Yield an empty folder; the files that the block writes there are moved into `folder` at the end, `marker` last.

    A new folder appears in one step. In an existing folder the old marker is removed first, so that a folder with a marker is always
    complete; other files are kept.
    """
    root = Path(folder).expanduser().absolute()
    if not root.exists():
        with write_beside(root) as part:
            part.mkdir(parents=True)
            yield part
        return
    with tempfile.TemporaryDirectory(prefix=PART_PREFIX, dir=root) as scratch:
        yield Path(scratch)
        (root / marker).unlink(missing_ok=True)
        for file in sorted(Path(scratch).iterdir(), key=lambda file: file.name == marker):
            os.replace(file, root / file.name)


def check_folder(root: Path, not_beside: Sequence[str], kinds: Mapping[str, FileKind]) -> None:
    """Raise InputError where results cannot be written into a folder, would mix with a file named in `not_beside`, or replace a
    file of another kind than its name has in `kinds`."""
    foreign = next((name for name in not_beside if (root / name).is_file()), None)
    if foreign is not None:
        raise InputError(
            "the results would mix with the existing files",
            where=root,
            found=foreign,
            expected="a folder of their own",
            hint="another -o",
        )
    if root.exists() and not root.is_dir():
        raise InputError("a file exists where the folder should be written", where=root, expected="a folder", hint="another -o")
    check_target(root, folder=True)
    check_files(root, kinds)


def read_document(file: Path, expected: str) -> dict[str, Any]:
    """Return a JSON object of a format. Raises InputError."""
    document = read_object(file, f"a file of format {expected}")
    if document.get("format") != expected:
        found = repr(document.get("format"))
        raise InputError("another kind of file", where=f"{file}: format", found=found, expected=repr(expected))
    return document


def read_object(file: Path, expected: str = "one JSON object") -> dict[str, Any]:
    """Return a JSON object; `expected` describes the file in messages. Raises InputError."""
    try:
        document = json.loads(file.read_text(encoding="utf-8-sig"))
    except OSError as error:
        missing = isinstance(error, FileNotFoundError)
        raise InputError(
            "cannot be read",
            where=file,
            found=error.strerror,
            expected=expected,
            hint="run the command that writes it first; of many recordings, its summary.csv states why this one has none"
            if missing
            else None,
        ) from None
    except ValueError as error:
        raise InputError("not valid JSON", where=file, found=error, expected=expected) from None
    if not isinstance(document, dict):
        raise InputError("another kind of file", where=file, found=type(document).__name__, expected=expected)
    return document


def value_of(document: Mapping[str, Any], key: str, file: Path) -> Any:
    """Return the value of a key of a document. Raises InputError."""
    if key not in document:
        raise InputError("a key is missing", where=file, found=", ".join(document), expected=key)
    return document[key]


def table_of(document: Mapping[str, Any], key: str, file: Path) -> dict[str, Any]:
    """Return the object of a key of a document. Raises InputError."""
    value = value_of(document, key, file)
    if not isinstance(value, dict):
        raise InputError("not a table", where=f"{file}: {key}", found=repr(value)[:80], expected="an object")
    return value


def numbers_of(document: Mapping[str, Any], key: str, file: Path) -> dict[str, float]:
    """Return the numbers of an object of a document, by name. Raises InputError."""
    return {str(name): number_of(value) for name, value in table_of(document, key, file).items()}


def number_of(value: Any) -> float:
    """Return a number of JSON; null means not finite."""
    return float("nan") if value is None else float(value)


RUN_FILES = ("contacts.csv", "frames.csv", "states.npz", "run.json")
