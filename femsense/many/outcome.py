"""The outcome of a job."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

LONGEST_REASON = 1000
"""Letters of a reason that are kept: a summary that travels stays below 10 kB."""

Scalar = str | int | float | bool | None


class JobStatus(StrEnum):
    """How a job has ended."""

    DONE = "done"
    KEPT = "kept"
    """A valid result of the same input was there."""
    NO_RESULT = "no result"
    """The data do not allow one."""
    FAILED = "failed"
    """Wrong usage, bad input, or an internal error."""
    OUT_OF_MEMORY = "out of memory"
    """It needed more memory than a worker may take, or the kernel killed it for memory."""
    DISK_FULL = "disk full"
    CRASHED = "crashed"
    """Its worker died, and not for memory."""


GOOD = frozenset({JobStatus.DONE, JobStatus.KEPT})


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a job has ended, and its result in a few numbers."""

    name: str
    status: JobStatus
    reason: str = ""
    """Why there is no result."""
    row: Mapping[str, Scalar] = field(default_factory=dict)
    """Column of the summary → value."""
    seconds: float = 0.0
    """Wall time of the command [s]."""
    peak_bytes: int = 0
    """Largest resident memory of the worker meanwhile [bytes]; 0 where it is unknown."""
    host: str = ""
    deaths: int = 0
    """How many workers died while they ran it."""

    @property
    def is_good(self) -> bool:
        """Whether its result is there."""
        return self.status in GOOD
