"""The results in a folder and its subfolders: loops, runs and calibrations."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from femsense.calib.files import CALIBRATION_FORMAT
from femsense.core.errors import InputError
from femsense.io.files import PART_PREFIX

HEAD = 400
"""Number of bytes of a JSON file in which its format stands."""


class Kind(StrEnum):
    """Results that a report shows, in the order of their chapters."""

    LOOP = "loop"
    RUN = "run"
    CALIBRATION = "calibration"


MARKERS = {f"{kind}.json": kind for kind in Kind}
"""File whose presence says that a result is there → its kind."""


@dataclass(frozen=True, slots=True)
class Found:
    """One result: its kind, and its file."""

    kind: Kind
    file: Path

    @property
    def folder(self) -> Path:
        return self.file.parent


def find_results(folder: str | Path) -> tuple[Found, ...]:
    """Return the results of a folder, then those of its subfolders: first what holds a loop, then by name.

    Raises:
        InputError: not a folder, or a folder without results.
    """
    root = Path(folder).expanduser()
    if not root.is_dir():
        hint = f"femsense report {root.parent}" if root.is_file() else None
        raise InputError(
            "not a folder", where=root, found="a file" if root.is_file() else "nothing", expected="a folder of results", hint=hint
        )
    inner = sorted(part for part in root.iterdir() if part.is_dir() and not part.name.startswith((".", PART_PREFIX)))
    groups = [
        _in_folder(root),
        *sorted(map(_in_folder, inner), key=lambda group: not any(item.kind is Kind.LOOP for item in group)),
    ]
    found = tuple(item for group in groups for item in group)
    if not found:
        raise InputError(
            "nothing to report on",
            where=root,
            found=_what_is(root),
            expected="loop.json, run.json or calibration.json, there or in a subfolder",
            hint="femsense estimate … -o DIR, femsense improve … -o DIR",
        )
    return found


def _in_folder(folder: Path) -> list[Found]:
    named = [Found(kind, folder / name) for name, kind in MARKERS.items() if (folder / name).is_file()]
    others = [
        Found(Kind.CALIBRATION, file)
        for file in sorted(folder.glob("*.json"))
        if file.name not in MARKERS and _is_calibration(file)
    ]
    return sorted([*named, *others], key=lambda item: list(Kind).index(item.kind))


def _is_calibration(file: Path) -> bool:
    """Return whether a JSON file of another name is a calibration: its format stands first."""
    try:
        with file.open("rb") as stream:
            return f'"{CALIBRATION_FORMAT}"'.encode() in stream.read(HEAD)
    except OSError:
        return False


def _what_is(root: Path) -> str:
    for name, kind in (("recording.toml", "a recording"), ("robot.toml", "a robot")):
        if (root / name).is_file():
            return kind
    names = sorted(part.name for part in root.iterdir())
    return "an empty folder" if not names else ", ".join(names[:5]) + (", …" if len(names) > 5 else "")
