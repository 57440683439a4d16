"""List what a user can do: commands with their options, formats that are read and written, keys, columns, effects, public names.

python scripts/capabilities.py                 the list, one capability a line
python scripts/capabilities.py --since FILE    which lines of an older list are gone; exit status 1 if any is
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import Any

import typer.main
from file_pages import page

import femsense
from femsense.app.cli import app
from femsense.io import own_files
from femsense.io.importers import guess
from femsense.model.effects import FORMS


def capabilities() -> Iterator[str]:
    """Yield one line for each thing that a user can ask for, give or get."""
    for name, command in typer.main.get_command(app).commands.items():  # type: ignore[attr-defined]
        yield f"command {name}"
        for parameter in command.params:
            yield f"command {name}: {' '.join([*parameter.opts, *parameter.secondary_opts])} {_value(parameter)}"
    yield from (f"import --format {name}" for name in guess.FORMATS)
    yield from (f"effect {form.name}: {', '.join(form.keys)}" for form in FORMS)
    for group in (own_files.RUN, own_files.LOOP, own_files.FORCE_MAP, own_files.VIEW, own_files.DEMO):
        yield from (f"writes {name}: {kind.name}" for name, kind in group.items())
    yield from (f"writes {kind.name}" for kind in vars(own_files).values() if isinstance(kind, own_files.FileKind))
    table = ""
    for line in page().splitlines():
        table = line if line.startswith("###") else table
        if line.startswith("| `"):
            yield f"file {table.strip('# ')}: {line.split(' | ')[0].strip('| ')}"
    yield from (f"femsense.{name}" for name in sorted(femsense.__all__))


def _value(parameter: Any) -> str:
    """Return what a parameter takes, and its default."""
    if getattr(parameter, "is_flag", False):
        takes = "flag"
    else:
        type_ = parameter.type_descriptor.annotation
        choices = isinstance(type_, type) and issubclass(type_, Enum)
        takes = "|".join(choice.value for choice in type_) if choices else parameter.metavar or "value"
    several = ", several" if parameter.multiple or parameter.nargs != 1 else ""
    default = parameter.default.value if isinstance(parameter.default, Enum) else parameter.default
    return f"({takes}{several}, {'required' if parameter.required else f'default {default}'})"


def main() -> int:
    parser = argparse.ArgumentParser(description="List what a user can do, or which of an older list is gone.")
    parser.add_argument("--since", type=Path, metavar="FILE", help="an older list")
    since = parser.parse_args().since
    now = list(dict.fromkeys(capabilities()))
    if since is None:
        print(*now, sep="\n")
        return 0
    gone = [line for line in since.read_text(encoding="utf-8").splitlines() if line not in set(now)]
    print(*(gone or ["nothing is gone"]), sep="\n")
    return 1 if gone else 0


if __name__ == "__main__":
    sys.exit(main())
