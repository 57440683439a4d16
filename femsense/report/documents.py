"""JSON documents of a report: what a key may hold, and how they are read.

What is missing is left out; a wrong type is an InputError.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ConfigDict

from femsense.core.errors import InputError
from femsense.core.text import short
from femsense.io.tables import Schema, read_text, validated

Number = float | None


class Document(Schema):
    """Other keys than those named are left alone; null and NaN stand for what is not known."""

    model_config = ConfigDict(extra="ignore", strict=True, frozen=True, allow_inf_nan=True)


DocumentType = TypeVar("DocumentType", bound=Document)


class Input(Document):
    name: str | None = None
    path: str | None = None
    sha256: str | None = None


def read_document(file: Path, schema: type[DocumentType], expected: str) -> DocumentType:
    """Return a checked JSON document of a format.

    Arguments:
        file: the document.
        schema: what it holds.
        expected: its `format`.

    Raises:
        InputError: not readable, not JSON, another format, or a key of the wrong type; with the key and what was found.
    """
    document = read_json(file, f"a file of format {expected}")
    if document.get("format") != expected:
        raise InputError(
            "another kind of file", where=f"{file}: format", found=short(document.get("format")), expected=repr(expected)
        )
    return validated(schema, document, file)


def read_json(file: Path, expected: str) -> dict[str, Any]:
    """Return a JSON object; `expected` says what the file should be. Raises InputError."""
    try:
        document = json.loads(read_text(file))
    except ValueError as error:
        raise InputError("not valid JSON", where=file, found=error, expected=expected) from None
    if not isinstance(document, dict):
        raise InputError("another kind of file", where=file, found=short(document), expected=expected)
    return document
