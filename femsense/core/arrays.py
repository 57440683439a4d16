"""Array types, and the coercion of input arrays."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from femsense.core.errors import InputError

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


def freeze(array: npt.ArrayLike, dtype: Any = np.float64) -> npt.NDArray[Any]:
    """Return a C-contiguous read-only array of the given type (a copy where the input was writable)."""
    result = np.array(array, dtype=dtype, order="C")
    result.setflags(write=False)
    return result


def read_only(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a read-only view of an array (a copy where it is not contiguous):
    kernels are compiled once more for arrays that can be written to."""
    view = np.ascontiguousarray(array).view()
    view.setflags(write=False)
    return view


def diagonal(points: FloatArray) -> float:
    """Return the diagonal of the bounding box of points (n, d), in their unit."""
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def rms(vectors: FloatArray) -> float:
    """Return the root mean square length of vectors, shape (…, d)."""
    return float(np.sqrt((vectors**2).sum(axis=-1).mean()))


def spread_evenly(count: int, most: int) -> IntArray:
    """Return at most `most` indices of `count` items, spread evenly, the first and the last among them; shape (k,)."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, most)).round().astype(np.int64))


def as_numbers(values: npt.ArrayLike, name: str, *, expected: object = "numbers", hint: str | None = None) -> FloatArray:
    """Coerce to numbers of any shape. Raises InputError with what was expected and a hint."""
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError("not numbers", where=name, found=repr(values)[:80], expected=expected, hint=hint) from None


def as_points(values: npt.ArrayLike | Iterable[Iterable[float]], name: str = "points") -> FloatArray:
    """Coerce to finite points, shape (n, 3); a single point becomes (1, 3). Raises InputError."""
    try:
        points = np.atleast_2d(np.asarray(values, dtype=np.float64))
    except (TypeError, ValueError):
        raise InputError(f"{name} must be numbers", where=name, found=repr(values)[:80], expected="shape (n, 3)") from None
    if points.size == 0:
        return np.zeros((0, 3))
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{name} has the wrong shape", where=name, found=points.shape, expected="(n, 3)")
    if not np.isfinite(points).all():
        row = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        raise InputError(f"{name} must be finite", where=f"{name}[{row}]", found=points[row].tolist(), expected="finite numbers")
    return points


def as_indices(values: npt.ArrayLike, count: int, name: str = "indices") -> IntArray:
    """Coerce to indices in [0, count), shape (k,). Raises InputError."""
    indices = np.atleast_1d(np.asarray(values))
    if indices.size and not np.issubdtype(indices.dtype, np.integer):
        raise InputError(f"{name} must be integers", where=name, found=indices.dtype, expected="integers")
    if indices.size and (indices.min() < 0 or indices.max() >= count):
        raise InputError(
            f"{name} out of range", where=name, found=(int(indices.min()), int(indices.max())), expected=f"0 … {count - 1}"
        )
    return indices.astype(np.int64)


def rows_alike(*keys: npt.ArrayLike) -> list[IntArray]:
    """Return the rows of each combination of keys, in order of the first key, then the second, …; keys have shape (k,).

    Example:
        >>> [rows.tolist() for rows in rows_alike([0, 1, 0, 1], [2, 2, 2, 3])]
        [[0, 2], [1], [3]]
    """
    table = np.array(keys)
    order = np.lexsort(table[::-1])
    ends = np.flatnonzero((np.diff(table[:, order], axis=1) != 0).any(axis=0)) + 1
    return np.split(order, ends) if len(order) else []
