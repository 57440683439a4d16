"""Optional packages of single exports."""

from __future__ import annotations

import importlib
from typing import Any

from femsense.core.errors import InputError


def needed(module: str, *, package: str, extra: str, doing: str) -> Any:
    """Return a module of an optional package.

    Arguments:
        module: its name.
        package, extra: what to install.
        doing: its purpose for the message, such as "writing MCAP".

    Raises:
        InputError: the package is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise InputError(
            f"{doing} needs a package that is not installed",
            where=package,
            found=str(error),
            expected=f"the extra [{extra}]",
            hint=f"pip install 'femsense[{extra}]'",
        ) from None
