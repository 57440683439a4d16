"""The limits of one worker: one thread in every library, a share of the memory; and whether the kernel killed for memory."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator
from pathlib import Path

from femsense.core.errors import InputError

ONE_THREAD = {
    name: "1"
    for name in (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "NUMBA_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
        "FEMSENSE_WORKERS",
    )
}
"""Environment of a worker. Libraries read it when they are loaded, so it must be set before the process starts."""
SHARE = 0.9
"""Share of the machine's memory that all its workers together may take."""
_OOM_COUNTERS = ("/proc/vmstat", "/sys/fs/cgroup/memory.events", "/sys/fs/cgroup/memory/memory.oom_control")
"""Files in which the kernel counts processes that it killed for memory: of the machine, and of the container."""
_CONTAINER_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")


@contextlib.contextmanager
def environment(values: dict[str, str]) -> Iterator[None]:
    """Set variables of the environment, which child processes inherit, while the block works."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def available_memory() -> int | None:
    """Return the memory of this machine, or of the container if that is less [bytes]; None where it is unknown."""
    found = list[int]()
    with contextlib.suppress(OSError, ValueError, AttributeError):
        found.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    for file in _CONTAINER_LIMITS:
        with contextlib.suppress(OSError, ValueError):
            found.append(int(Path(file).read_text()))
    return min(found, default=None)


def memory_share(workers: int, limit_gb: float | None) -> int | None:
    """Return the memory of one worker [bytes]: as given [GB, 10⁹ bytes], or its share of the machine. Raises InputError."""
    if limit_gb is not None:
        if not limit_gb > 0:
            raise InputError(
                "not an amount of memory", where="--memory", found=limit_gb, expected="gigabytes for each worker, > 0"
            )
        return int(1e9 * limit_gb)
    whole = available_memory()
    return None if whole is None else int(SHARE * whole / max(workers, 1))


def limit_memory(limit: int | None) -> None:
    """Let this process allocate no more than a limit [bytes]: beyond it an allocation raises MemoryError, and nothing is killed.

    `RLIMIT_DATA` counts private writable memory (Linux 4.7). `RLIMIT_AS` would count address space, of which threads,
    compiled code and mapped files reserve gigabytes that are never used.
    """
    try:
        import resource
    except ImportError:  # Windows
        return
    if limit is not None:
        hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
        soft = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def reset_peak() -> None:
    """Restart the measurement of the largest resident memory, where the system can."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_memory() -> int:
    """Return the largest resident memory of this process since `reset_peak` [bytes]; 0 where it is unknown."""
    with contextlib.suppress(OSError):
        found = re.search(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text())
        return 1024 * int(found[1]) if found else 0
    return 0


def oom_kills() -> int:
    """Return the number of processes that the kernel of this machine has killed for memory, from its counters."""
    count = 0
    for file in _OOM_COUNTERS:
        with contextlib.suppress(OSError):
            count += sum(int(n) for n in re.findall(r"^oom_kill (\d+)", Path(file).read_text(), re.MULTILINE))
    return count
