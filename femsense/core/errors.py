"""The exceptions of femsense. Physics that fails is a status in a result, not an exception."""

from __future__ import annotations

from pathlib import Path


class FemsenseError(Exception):
    """Base of every error that femsense raises on purpose. `exit_status` is what a command returns."""

    exit_status = 2


class InputError(FemsenseError):
    """Bad input, with its location, what was found, what was expected, and a hint.

    Arguments:
        what: the problem in one sentence.
        where: file, key, row or argument.
        found, expected: short texts or values.
        hint: what to try.
    """

    def __init__(
        self,
        what: str,
        *,
        where: str | Path | None = None,
        found: object = None,
        expected: object = None,
        hint: str | None = None,
    ) -> None:
        self.what, self.where, self.found, self.expected, self.hint = what, where, found, expected, hint
        parts = [f"{where}: {what}" if where is not None else what]
        if found is not None:
            parts.append(f"  found:    {found}")
        if expected is not None:
            parts.append(f"  expected: {expected}")
        if hint is not None:
            parts.append(f"  try:      {hint}")
        super().__init__("\n".join(parts))


class UnitError(InputError):
    """Numbers in another unit than the format's: well formed, but the data do not allow a result (exit status 1)."""

    exit_status = 1


class DataError(FemsenseError):
    """The input is well formed, but the data do not allow a result (exit status 1)."""

    exit_status = 1


class MissingDependency(FemsenseError):
    """An optional package or a system library is missing; the text holds the exact install line."""

    exit_status = 2
