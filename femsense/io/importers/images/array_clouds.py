"""Clouds as NumPy saves them: .npy and .npz, under whatever names people give."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.pointcloud.cloud import PointCloud

PLACES = ("points", "xyz", "cloud", "pts", "pc", "pcd", "vertices", "positions", "coords", "data", "arr_0")
"""Names of places, the likeliest first; without one of them the only array that can be places is taken."""
COLORS = ("colors", "color", "colours", "rgb")
MOST_COLUMNS = 12
"""A cloud has not more columns than this; an array of 3 rows and more columns holds a place a column."""


def read_array_cloud(file: Path) -> PointCloud:
    """Return the cloud of a .npy or .npz file in the file's unit, without points that are not finite or all zero.

    Arrays are (n, 3), (n, 6) with colours, (H, W, 3), or (3, n); fields or arrays x, y, z are columns.

    Raises:
        InputError: not readable, or no array, or several arrays, with a suitable shape.
    """
    try:
        loaded = np.load(file, allow_pickle=False)
        arrays = {"": loaded} if isinstance(loaded, np.ndarray) else {name: loaded[name] for name in loaded.files}
    except (OSError, ValueError, EOFError) as error:
        raise InputError(
            "not readable as a cloud", where=file, found=f"{type(error).__name__}: {error}", expected="rows x y z [r g b]"
        ) from None
    arrays = {name: array for key, given in arrays.items() for name, array in _columns(key, given).items()}
    table = _places(arrays, file)
    kept = np.isfinite(table[:, :3]).all(axis=1) & (table[:, :3] != 0).any(axis=1)
    colors = table[:, 3:6] if table.shape[1] == 6 else _beside(arrays, len(table))
    colors = None if colors is None else colors[kept]
    if colors is not None and colors.size and (colors.min() < 0 or colors.max() > 255):
        colors = None  # normals, or something else
    return PointCloud(table[kept, :3], colors if colors is None or colors.max(initial=0) <= 1 else colors / 255.0)


def _columns(name: str, array: npt.NDArray[Any]) -> dict[str, npt.NDArray[Any]]:
    """Return an array under its name, or the fields of a structured one under theirs."""
    fields = array.dtype.names
    return {name: array} if fields is None else {field: np.ravel(array[field]) for field in fields}


def _places(arrays: Mapping[str, npt.NDArray[Any]], file: Path) -> FloatArray:
    if all(axis in arrays for axis in "xyz") and len({arrays[axis].size for axis in "xyz"}) == 1:
        return np.column_stack([np.ravel(arrays[axis]).astype(np.float64) for axis in "xyz"])
    named = [name for name in PLACES if name in arrays]
    able = [name for name in arrays if name not in COLORS and _table(arrays[name]) is not None]
    chosen = named[:1] or (able if len(able) == 1 else [])
    table = _table(arrays[chosen[0]]) if chosen else None
    if table is None:
        raise InputError(
            "not a cloud" if len(able) < 2 else "several arrays that could be the places",
            where=file,
            found="; ".join(f"{name or 'array'} {array.shape}" for name, array in arrays.items()),
            expected="(n, 3) places, or (n, 6) with colours",
            hint="name the array points",
        )
    return table


def _table(array: npt.NDArray[Any]) -> FloatArray | None:
    """Return an array as rows that begin x, y, z; None where it cannot be that."""
    if array.dtype.kind not in "fiu" or array.ndim not in (2, 3):
        return None
    if array.ndim == 2 and array.shape[0] == 3 and array.shape[1] > MOST_COLUMNS:
        array = array.T
    rows = array.reshape(-1, array.shape[-1])
    return rows.astype(np.float64) if 3 <= rows.shape[1] <= MOST_COLUMNS else None


def _beside(arrays: Mapping[str, npt.NDArray[Any]], count: int) -> FloatArray | None:
    """Return the colours that an array of their own holds, shape (count, 3)."""
    given = next((arrays[name] for name in COLORS if name in arrays), None)
    if given is None or given.size != 3 * count:
        return None
    return (given.T if given.shape[0] == 3 and given.shape != (3, 3) else given).reshape(-1, 3).astype(np.float64)
