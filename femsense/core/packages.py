"""Optional packages: those of the extras, imported where a function needs them."""

from __future__ import annotations

import importlib
from typing import Any

from femsense.core.errors import MissingDependency
from femsense.core.text import one_line


def needed(module: str, extra: str, doing: str) -> Any:
    """Return a module of an optional package.

    Arguments:
        module: its name.
        extra: the extra of femsense that installs it.
        doing: its purpose for the message, such as "writing MCAP".

    Raises:
        MissingDependency: the package is not installed; the text holds the line that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingDependency(f"{doing}: {one_line(error)}\n  try:      pip install 'femsense[{extra}]'") from None


def installed_version(package: str) -> str | None:
    """Return the version of an installed package; None where it is not installed."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(package)
    except PackageNotFoundError:
        return None
