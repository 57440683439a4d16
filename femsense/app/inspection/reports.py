"""Common parts of inspections: collecting problems and notes."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from femsense.core.errors import FemsenseError

Report = dict[str, Any]
Problems = list[FemsenseError | str]
"""Problems, as exceptions or as texts."""


@contextmanager
def collected(problems: Problems, notes: list[str]) -> Iterator[None]:
    """Turn an exception of the block into a problem, and its warnings into notes."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            yield
        except FemsenseError as error:
            problems.append(error)
        except Exception as error:  # a broken file can raise anything in a reader
            problems.append(f"cannot be read: {type(error).__name__}: {error}")
    notes += [str(item.message) for item in caught if issubclass(item.category, UserWarning)]


def attempt(action: Callable[[], Any], problems: Problems) -> Any:
    """Return the result of the action; if it raises, None, with the text among the problems."""
    notes: list[str] = []
    result = None
    with collected(problems, notes):
        result = action()
    for note in notes:
        warnings.warn(note, stacklevel=2)
    return result
