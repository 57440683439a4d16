"""The exceptions of femsense. Physics that fails is a status in a result, not an exception."""

from __future__ import annotations

from pathlib import Path


class FemsenseError(Exception):
    """Base of every error that femsense raises on purpose. `exit_status` is what a command returns."""

    exit_status = 2


class InputError(FemsenseError):
    """Raised when a file or an argument is invalid. The message states the location, the value found, the value expected, and a remedy.

    The arguments are attributes afterwards. A command that raises it returns exit status 2.

    Arguments:
        what: the problem, one sentence.
        where: location of the problem: file, key, row or argument.
        found: the invalid value.
        expected: the values that would be valid.
        hint: a remedy.

    Example:
        >>> import femsense as fs
        >>> try:
        ...     fs.load_robot("fingre")
        ... except fs.InputError as error:
        ...     print(error)
        fingre: no such robot
          found:    neither a folder, nor a file, nor a known name
          expected: a folder with robot.toml, or one of: arm, finger, four-leg, gripper, pneu-finger
          try:      did you mean 'finger'?
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
    """Raised when the input is valid but the data do not allow a result, such as a recording with too few markers (exit status 1)."""

    exit_status = 1


class MissingDependency(FemsenseError):
    """Raised when an optional package or a system library is missing. The message contains the exact install command."""

    exit_status = 2
