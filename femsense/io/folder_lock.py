"""One command at a time writes a folder: the kernel holds the lock, and lets it go when a command ends or is killed."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from femsense.core.errors import InputError
from femsense.io.files import PART_PREFIX, followed

try:
    import fcntl
except ImportError:  # Windows has none: two commands are not prevented there
    fcntl = None  # type: ignore[assignment]


@contextmanager
def only_writer(folder: str | Path) -> Iterator[None]:
    """Keep other commands out of a folder of results while the block works.

    A file next to the folder is locked and names the working command. A killed command leaves the file behind unlocked. On a file system
    without locks nothing is prevented.

    Raises:
        InputError: another command is working there.
    """
    final, handle = followed(Path(folder).expanduser()), None
    with contextlib.suppress(OSError):
        handle = _locked(final)
    if handle is None:
        yield
        return
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            lock_of(final).unlink()
        os.close(handle)


def lock_of(folder: Path) -> Path:
    """Return the file that is locked while a command writes into a folder."""
    return folder.with_name(f"{PART_PREFIX}lock-{folder.name}")


def _locked(final: Path) -> int | None:
    """Return the open file with its lock; None where there are no locks. Raises OSError, and InputError as `only_writer`."""
    file = lock_of(final)
    file.parent.mkdir(parents=True, exist_ok=True)
    while fcntl is not None:
        handle = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            process = os.read(handle, 20).decode(errors="replace")
            os.close(handle)
            if isinstance(error, BlockingIOError):
                raise InputError(
                    "another command is writing into this folder",
                    where=final,
                    found=f"process {process}, which holds {file.name} beside it",
                    expected="one command at a time",
                    hint="wait until it ends, or another -o",
                ) from None
            raise
        if _is_at(handle, file):
            os.ftruncate(handle, 0)
            os.write(handle, str(os.getpid()).encode())
            return handle
        os.close(handle)  # the previous holder has just removed it
    return None


def _is_at(handle: int, file: Path) -> bool:
    """Return whether an open file still exists at a path."""
    try:
        return os.path.samestat(os.fstat(handle), file.stat())
    except OSError:
        return False
