"""Files written by femsense, identified by their first bytes and content: only these are replaced by a new result of the same kind."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from femsense.core.errors import InputError

ENDS = 1 << 20
"""Number of bytes at both ends of a file that are searched for the identifying text."""


@dataclass(frozen=True)
class FileKind:
    """The identifying properties of a file that femsense wrote."""

    name: str
    """As messages call it."""
    begins: bytes
    """Its first bytes."""
    holds: bytes = b""
    """Further text near its beginning or end."""

    def fits(self, file: Path) -> bool:
        """Return whether a file is of this kind. Raises OSError where it cannot be read."""
        with file.open("rb") as stream:
            head = stream.read(ENDS)
            stream.seek(max(0, file.stat().st_size - ENDS))
            return head.startswith(self.begins) and (self.holds in head or self.holds in stream.read())


def _document(name: str, form: str) -> FileKind:
    """Return the kind of a JSON file of a format, of any version."""
    return FileKind(name, b"{", f'"format": "{form}-'.encode())


CALIBRATION = _document("a calibration of femsense", "femsense-calibration")
MOTION = _document("a motion of femsense reach", "femsense-motion")
GLB = FileKind("a .glb file of femsense", b"glTF", b'"generator":"femsense"')
USDZ = FileKind("a .usdz file of femsense", b"PK", b"robot.usdc")
MCAP = FileKind("an .mcap file of femsense export", b"\x89MCAP", b"/femsense/")
RERUN = FileKind("a .rrd file of femsense export", b"RRF", b"femsense")
MODEL = FileKind("a model of femsense learn", b"\x08", b"\x12\x08femsense")
REPORT = FileKind("a report of femsense", b"<!DOCTYPE html>", b'<meta name="generator" content="femsense">')
SCRIPT = FileKind("a script of femsense improve --plan", b"# written by femsense")
RUN = {
    "contacts.csv": FileKind("contacts of femsense estimate", b"frame,time_s,contact,x_m,y_m,z_m,", b",force_n,std_n,source"),
    "frames.csv": FileKind("frames of femsense estimate", b"frame,time_s,status,contacts,"),
    "states.npz": FileKind("states of femsense estimate", b"PK", b"nodes_m.npy"),
    "calibration.json": CALIBRATION,
    "run.json": _document("a run of femsense estimate", "femsense-run"),
}
"""Name → kind, in the folder of a run; so the others."""
LOOP = {
    "loop.json": _document("a loop of femsense improve", "femsense-loop"),
    "correction.json": _document("a correction of femsense improve", "femsense-correction"),
}
PICTURE = FileKind("a picture of femsense", b"\x89PNG", b"femsense")
FORCE_MAP = {
    "forces.csv": FileKind("forces of femsense simulate --plan", b"x_m,y_m,z_m,normal_std_n,tangent_std_n,visible"),
    "forces.glb": GLB,
    "forces.png": PICTURE,
}
VIEW = {
    "contacts.json": FileKind("contacts of femsense view", b"{", b'"format":"femsense-contacts-'),
    "robot.glb": GLB,
}
DEMO = {
    "demo.json": FileKind("figures of femsense demo", b"{", b'"declared": {'),
    "robot.glb": GLB,
    "picture.png": PICTURE,
    "report.html": REPORT,
}


def check_replaceable(file: Path, kind: FileKind | None, inputs: Iterable[str | Path] = ()) -> None:
    """Refuse a path that exists as another kind of file, or is an input; an empty file is replaced.

    `kind` None accepts any kind.

    Raises:
        InputError: states the existing file.
    """
    if not file.exists():
        return
    if any(Path(path).exists() and file.samefile(path) for path in inputs):
        raise InputError("the result would replace its own input", where=file, expected="a new name", hint="another -o")
    if kind is None:
        return
    expected = f"a new name, or {kind.name}"
    if not file.is_file():
        raise InputError("no file exists there", where=file, expected=expected, hint="another -o")
    try:
        fits = not file.stat().st_size or kind.fits(file)
    except OSError as error:
        raise InputError("cannot be read", where=file, found=error.strerror, expected=expected, hint="another -o") from None
    if not fits:
        with file.open("rb") as stream:
            found = f"a file that begins with {stream.read(24)!r}"
        raise InputError("another file would be replaced", where=file, found=found, expected=expected, hint="another -o")


def check_files(folder: Path, kinds: Mapping[str, FileKind]) -> None:
    """Refuse a folder where files of these names are of other kinds. Raises InputError."""
    for name, kind in kinds.items():
        check_replaceable(folder / name, kind)
