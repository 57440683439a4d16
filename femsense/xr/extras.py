"""Packages that only some exports need."""

from __future__ import annotations

import importlib
from typing import Any

from femsense.core.errors import InputError


def needed(module: str, *, package: str, extra: str, doing: str) -> Any:
    """Return a module of a package that an extra brings.

    Arguments:
        module: its name.
        package, extra: what to install.
        doing: what needs it, such as "writing MCAP".

    Raises:
        InputError: it is not there.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise InputError(
            f"{doing} needs a package that is not there",
            where=package,
            found=str(error),
            expected=f"the extra [{extra}]",
            hint=f"pip install 'femsense[{extra}]'",
        ) from None
