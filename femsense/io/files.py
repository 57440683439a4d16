"""Atomic writing of results under their final names, and hashes of the files that were read."""

from __future__ import annotations

import csv
import errno
import hashlib
import json
import math
import os
import re
import secrets
import shutil
import stat
import tempfile
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from femsense.core.errors import InputError
from femsense.io.own_files import FileKind, check_replaceable

PART_PREFIX = ".part-"
"""Names of unfinished files and folders start so."""
LONGEST_ARRAY = 100
"""A list of points that is longer than this gets a line for each of them in TOML."""


@contextmanager
def write_beside(path: str | Path) -> Iterator[Path]:
    """Yield a free path next to `path`; the file or folder that the block writes there is renamed to `path` at the end.

    The temporary name has the suffix of the final one. If the block raises, the temporary file is removed and `path` is unchanged. A
    folder replaces the whole previous folder. Symbolic links are followed; devices and pipes are written to, not replaced.

    Raises:
        InputError: a path that cannot be written, or exists as another kind of file. FileNotFoundError:
            the block wrote nothing.
    """
    if writes_through(path):
        with _through(Path(path)) as part:
            yield part
        return
    final = followed(path)
    _check_writable(final)
    part = final.with_name(f"{PART_PREFIX}{secrets.token_hex(4)}-{final.name}")
    try:
        yield part
        _check_kind(final, folder=part.is_dir())
        _replace(part, final)
    except OSError as error:
        if PART_PREFIX in str(error.filename) and part.name in str(error.filename) and not isinstance(error, FileNotFoundError):
            raise _refusal(final, error.strerror or "an error of the system") from None
        raise
    finally:
        _remove(part)


def check_target(path: str | Path, *, folder: bool, kind: FileKind | None = None, inputs: Iterable[str | Path] = ()) -> None:
    """Refuse a path at which the result cannot be written, before anything is computed.

    Arguments:
        path: the place.
        folder: a folder is to be written there.
        kind: the kind of file that may be replaced there.
        inputs: input files of the result: none of them is replaced.

    Raises:
        InputError: states the existing file.
    """
    if writes_through(path):
        if folder:
            raise _wrong_kind(path, "a device or a pipe", "a folder")
        return
    final = followed(path)
    nearest = next(place for place in (final, *final.parents) if place.exists())
    if nearest != final and not nearest.is_dir():
        raise _wrong_kind(nearest, "a file", "a folder")
    if nearest != final and not os.access(nearest, os.W_OK):
        raise _refusal(final, f"no right to write in {nearest}")
    if nearest == final:
        _check_writable(final)
        _check_kind(final, folder=folder)
    check_replaceable(final, kind, inputs)


def check_no_pipe(sources: Iterable[Path]) -> None:
    """Refuse pipes and devices as sources: files are read more than once. Raises InputError."""
    pipe = next((item for item in sources if item.exists() and not item.is_file() and not item.is_dir()), None)
    if pipe is not None:
        raise InputError("a pipe or a device cannot be read here", where=pipe, expected="a file", hint="cat it into a file first")


def check_own(folder: Path, own: re.Pattern[str], what: str) -> None:
    """Refuse to replace a folder with files that `own` does not match (relative paths); `what` describes the matching ones in the
    message.

    Unfinished files of femsense do not count; links do. Raises InputError.
    """
    foreign = other_files(folder, own)
    if foreign:
        more = f" and {len(foreign) - 3} more" if len(foreign) > 3 else ""
        raise InputError(
            "other files in the folder would be deleted",
            where=folder,
            found=", ".join(foreign[:3]) + more,
            expected=f"a new folder, or {what} and nothing else",
            hint="another -o",
        )


def other_files(folder: Path, own: re.Pattern[str]) -> list[str]:
    """Return the relative paths below a folder that `own` does not match; links count, unfinished files do not."""
    names = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_symlink() or not path.is_dir())
    return sorted(name for name in names if PART_PREFIX not in name and not own.fullmatch(name))


def writes_through(path: str | Path) -> bool:
    """Return whether a path is a device, a pipe or an open stream, which takes bytes and is not to be replaced by a file."""
    if str(Path(path).absolute()).startswith(("/dev/", "/proc/")):
        return True
    try:
        mode = Path(path).stat().st_mode
    except OSError:
        return False
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))


@contextmanager
def _through(final: Path) -> Iterator[Path]:
    """Yield a path elsewhere; the file that the block writes there goes through the device or pipe."""
    with tempfile.TemporaryDirectory(prefix="femsense-") as folder:
        part = Path(folder) / (final.name if final.suffix else "result")
        yield part
        if part.is_dir():
            raise _wrong_kind(final, "a device or a pipe", "a folder")
        try:
            with part.open("rb") as source, _opened(final) as sink:
                shutil.copyfileobj(source, sink)
        except OSError as error:
            raise _refusal(final, error.strerror or "an error of the system") from None


def _opened(final: Path) -> BinaryIO:
    """Open a device or a pipe for writing; opening a pipe without a reader blocks, which is reported."""
    if final.is_fifo():
        try:
            handle = os.open(final, os.O_WRONLY | os.O_NONBLOCK)
        except OSError as error:
            if error.errno != errno.ENXIO:
                raise
            warnings.warn(f"{final} is a pipe without a reader: waiting for one", stacklevel=2)
        else:
            os.set_blocking(handle, True)
            return os.fdopen(handle, "wb")
    return final.open("r+b" if final.is_block_device() else "wb")


def followed(path: str | Path) -> Path:
    """Return where a path leads, links followed. Raises InputError: links that lead to themselves."""
    final = Path(path).absolute()
    try:
        return final.resolve() if final.is_symlink() else final
    except (OSError, RuntimeError):
        raise _refusal(final, "links that lead to themselves") from None


def _check_writable(final: Path) -> None:
    """Make the parent folder; refuse write-protected paths. Raises InputError."""
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _refusal(final, f"{error.strerror}: {final.parent}") from None
    if not os.access(final.parent, os.W_OK):
        raise _refusal(final, f"no right to write in {final.parent}")
    if final.exists() and (not os.access(final, os.W_OK) or not final.stat().st_mode & 0o222):
        raise _refusal(final, "it is read-only")


def _check_kind(final: Path, *, folder: bool) -> None:
    if final.exists() and final.is_dir() != folder:
        raise _wrong_kind(final, *(("a file", "a folder") if folder else ("a folder", "a file")))


def _refusal(final: Path, found: str) -> InputError:
    return InputError("cannot be written", where=final, found=found, expected="a place that can be written", hint="another -o")


def _wrong_kind(final: str | Path, found: str, wanted: str) -> InputError:
    return InputError(
        f"{found} stands where {wanted} is to be written", where=final, expected=f"a new name, or {wanted}", hint="another -o"
    )


def write_text(path: str | Path, text: str) -> None:
    """Write text as UTF-8 with plain line feeds."""
    with write_beside(path) as part:
        part.write_text(text, encoding="utf-8", newline="\n")


def write_json(path: str | Path, data: Any) -> None:
    """Write JSON. Arrays become lists, paths strings, numbers that are not finite null (JSON has no other word)."""
    write_text(path, json_text(data) + "\n")


def json_text(data: Any, *, indent: int | None = 2) -> str:
    """Return data as strict JSON text; see `write_json`."""
    return json.dumps(plain(data), indent=indent, ensure_ascii=False, allow_nan=False)


def write_toml(path: str | Path, document: Mapping[str, Any], *, comment: str = "") -> None:
    """Write a TOML document, after a line of comment if one is given.

    Arrays become lists; numbers are written so that they read back the same; points stay on one line.
    """
    import tomli_w

    text = _on_one_line(tomli_w.dumps(plain(document, nonfinite=True)))
    write_text(path, f"# {comment}\n{text}" if comment else text)


def write_csv(path: str | Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a CSV file with a header. Numbers read back the same; None and NaN become empty cells."""
    with write_beside(path) as part, part.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows([_cell(value) for value in row] for row in rows)


def file_hash(path: str | Path) -> str:
    """Return the SHA-256 of a file's content, 64 hexadecimal digits."""
    with Path(path).open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def folder_hash(folder: str | Path) -> str:
    """Return a SHA-256 of the names and contents of all files in a folder and below (unfinished ones do not count)."""
    root = Path(folder)
    digest = hashlib.sha256()
    files = {file.relative_to(root).as_posix(): file for file in root.rglob("*") if file.is_file()}
    for name, file in sorted(files.items()):
        if PART_PREFIX not in name:
            digest.update(f"{name}\0{file_hash(file)}\n".encode())
    return digest.hexdigest()


def plain(value: Any, *, nonfinite: bool = False) -> Any:
    """Return the value made of dict, list, str, int, float, bool and None only.

    Arguments:
        value: may hold arrays, numpy numbers, tuples, paths.
        nonfinite: keep inf and nan (TOML has them); else they become None.
    """
    if isinstance(value, Mapping):
        return {str(key): plain(item, nonfinite=nonfinite) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist(), nonfinite=nonfinite)
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item, nonfinite=nonfinite) for item in value]
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not math.isfinite(value) and not nonfinite:
        return None
    return value


def _on_one_line(toml: str) -> str:
    """Return TOML with its arrays of numbers, and short arrays of those, on one line each (a string never holds a line feed)."""
    rows = re.sub(r"\[((?:\n +[-+\w.]+,)+)\n *\]", lambda found: f"[{', '.join(found[1].replace(',', ' ').split())}]", toml)
    return re.sub(r"\[((?:\n +\[[^\[\]\n]*\],)+)\n *\]", _joined, rows)


def _joined(found: re.Match[str]) -> str:
    joined = f"[{', '.join(line.strip().rstrip(',') for line in found[1].strip().splitlines())}]"
    return joined if len(joined) <= LONGEST_ARRAY else found[0]


def _cell(value: object) -> object:
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    return int(value) if isinstance(value, bool) else value


def _replace(part: Path, final: Path) -> None:
    """Give the finished file or folder its final name."""
    if not part.is_dir():
        _flush(part)
        os.replace(part, final)
        return
    if not final.exists():
        os.replace(part, final)
        return
    old = final.with_name(f"{PART_PREFIX}{secrets.token_hex(4)}-old-{final.name}")
    os.replace(final, old)
    try:
        os.replace(part, final)
    except OSError:
        os.replace(old, final)
        raise
    _remove(old)


def _flush(path: Path) -> None:
    """Flush the content to disk before the rename, so that after a crash either the old or the new file exists."""
    with path.open("r+b") as stream:
        os.fsync(stream.fileno())


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
