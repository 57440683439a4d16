"""The only coercion of input arrays."""

from __future__ import annotations

import numpy as np
import pytest

from femsense.core.arrays import as_indices, as_points, freeze, spread_evenly
from femsense.core.errors import InputError


def test_frozen_arrays_are_copies_that_nobody_changes() -> None:
    source = np.ones((2, 3), order="F")
    frozen = freeze(source)
    source[:] = 5
    assert (frozen == 1).all() and frozen.flags.c_contiguous and not frozen.flags.writeable
    with pytest.raises(ValueError, match="read-only"):
        frozen[0, 0] = 2
    assert freeze([1, 2], np.int64).dtype == np.int64


def test_points_of_every_kind_become_rows() -> None:
    np.testing.assert_array_equal(as_points([1, 2, 3]), [[1.0, 2, 3]])
    assert as_points(np.zeros((5, 3), dtype=np.float32)).dtype == np.float64
    assert as_points([]).shape == (0, 3) and as_points(()).shape == (0, 3) and as_points(np.zeros((0, 3))).shape == (0, 3)


@pytest.mark.parametrize(
    ("values", "texts"),
    [
        ([[1, 2]], ["wrong shape", "(1, 2)", "(n, 3)"]),
        (np.zeros((2, 2, 3)), ["wrong shape", "(2, 2, 3)"]),
        ([[0, 0, 0], [1, np.nan, 0]], ["must be finite", "tips[1]"]),
        ([[0, 0, np.inf]], ["must be finite", "tips[0]"]),
        ([["a", "b", "c"]], ["must be numbers"]),
        ([[1, 2, 3], [4, 5]], ["must be numbers"]),
    ],
)
def test_what_are_no_points(values: object, texts: list[str]) -> None:
    with pytest.raises(InputError) as error:
        as_points(values, "tips")  # type: ignore[arg-type]
    for text in [*texts, "tips"]:
        assert text in str(error.value)


def test_indices_are_whole_numbers_in_range() -> None:
    found = as_indices(np.array([0, 4], dtype=np.uint8), 5)
    assert found.dtype == np.int64 and found.tolist() == [0, 4]
    assert as_indices(3, 5).tolist() == [3]
    assert len(as_indices([], 5)) == 0


@pytest.mark.parametrize(("values", "text"), [([0.0, 1.0], "must be integers"), ([5], "out of range"), ([-1, 2], "out of range")])
def test_what_are_no_indices(values: list[float], text: str) -> None:
    with pytest.raises(InputError, match=text):
        as_indices(values, 5, "nodes")


@pytest.mark.parametrize(("count", "most", "chosen"), [(10, 4, [0, 3, 6, 9]), (2, 4, [0, 1]), (5, 1, [0]), (0, 4, [])])
def test_indices_are_spread_from_the_first_to_the_last(count: int, most: int, chosen: list[int]) -> None:
    assert spread_evenly(count, most).tolist() == chosen
