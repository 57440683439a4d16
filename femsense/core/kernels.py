"""Kernels: functions that numba compiles once and caches.
Those that were kept are loaded without the rules by which numba compiles.

numba brings all its rules of typing and lowering into memory before it looks whether a kernel was kept.
Those take as long as importing numba itself, and a kernel that was kept needs none of them.
`benchmarks/first_minute.py` prints what that saves.
"""

from __future__ import annotations

import atexit
import gc
from collections.abc import Callable
from typing import Any

collecting = gc.isenabled()
gc.disable()
try:
    import numba
    from numba.core.caching import FunctionCache
    from numba.core.runtime import rtsys
finally:
    if collecting:
        gc.enable()

atexit.register(
    gc.freeze
)  # the interpreter looks through all of numba's objects several times at its end, and finds nothing to do


class KeptKernels(FunctionCache):  # type: ignore[misc]
    """Numba's cache of a kernel; the compiler is loaded only if the cache has no matching entry."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the kernel for a signature, or None, after which numba compiles it."""
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            kept = self._load_overload(sig, target_context)
            if kept is not None:
                return kept
        target_context.refresh()
        return None


def njit(*arguments: Any, cache: bool = False, **options: Any) -> Any:
    """Return `numba.njit`; with `cache`, machine code is cached next to the module and loaded from there."""
    if arguments:
        return numba.njit(*arguments, **options)
    plain = numba.njit(**options)

    def compiled(function: Callable[..., Any]) -> Any:
        kernel = plain(function)
        if cache:
            kernel._cache = KeptKernels(function)
        return kernel

    return compiled
