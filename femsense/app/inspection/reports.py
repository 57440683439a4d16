"""What every inspection does: collect problems and notes."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from femsense.core.errors import FemsenseError

Report = dict[str, Any]
Problems = list[FemsenseError | str]
"""What is wrong, as errors that would be raised or as texts."""


@contextmanager
def collected(problems: Problems, notes: list[str]) -> Iterator[None]:
    """Turn what the block raises into a problem, and its warnings into notes."""
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
    """Return what the action returns; None where it raises, with the text among the problems."""
    notes: list[str] = []
    result = None
    with collected(problems, notes):
        result = action()
    for note in notes:
        warnings.warn(note, stacklevel=2)
    return result
