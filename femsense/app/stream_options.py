"""Which options of `femsense stream` and `femsense view` go together: what would do nothing is refused."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from femsense.core.errors import InputError


def need_stream(runs: Sequence[Path], sensors: str | None, *, drag: bool) -> None:
    """Raise InputError unless there are runs or sensors; both go together where sensors measure what is dragged."""
    if runs and sensors is not None:
        need_with("RUN with --sensors", True, "--drag", drag)
    else:
        need_one(runs, sensors)


def need_one(runs: Sequence[Path], source: str | None) -> None:
    """Raise InputError unless there are runs or a live source, and not both."""
    if bool(runs) == (source is not None):
        found = "both" if runs else "neither"
        raise InputError("either a run or a live source", where="RUN", found=found, expected="RUN, --sensors or --stream")


def need_model(sensors: str | None, model: Path | None) -> None:
    """Raise InputError where sensors come without a model, or a model without sensors."""
    if (sensors is None) != (model is None):
        raise InputError("sensors go with a model", where="--sensors", expected="--sensors SOURCE --model MODEL")


def need_with(option: str, given: bool, other: str, there: bool) -> None:
    """Raise InputError where an option is given that does nothing without another."""
    if given and not there:
        raise InputError(f"{option} does nothing without {other}", where=option, found=f"no {other}", expected=f"{other} too")


def is_encrypted(address: str | None) -> bool:
    """Return whether an address says that what travels is encrypted."""
    return (address or "").partition("://")[0] in ("https", "wss", "mqtts")
