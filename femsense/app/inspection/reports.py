"""What every inspection does: collect problems and notes, and read objects of JSON."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from femsense.core.errors import FemsenseError, InputError

Report = dict[str, Any]


@contextmanager
def collected(problems: list[str], notes: list[str]) -> Iterator[None]:
    """Turn what the block raises into a problem, and its warnings into notes."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            yield
        except FemsenseError as error:
            problems.append(str(error))
        except Exception as error:  # whatever a broken file makes of a reader
            problems.append(f"cannot be read: {type(error).__name__}: {error}")
    notes += [str(item.message) for item in caught if issubclass(item.category, UserWarning)]


def attempt(action: Callable[[], Any], problems: list[str]) -> Any:
    """Return what the action returns; None where it raises, with the text among the problems."""
    notes: list[str] = []
    result = None
    with collected(problems, notes):
        result = action()
    for note in notes:
        warnings.warn(note, stacklevel=2)
    return result


def read_object(file: Path) -> dict[str, Any]:
    """Return a JSON object. Raises InputError."""
    try:
        data = json.loads(file.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError) as error:
        raise InputError("not valid JSON", where=file, found=str(error), expected="one JSON object") from None
    if not isinstance(data, dict):
        raise InputError("not a JSON object", where=file, found=type(data).__name__, expected="one JSON object")
    return data
