"""What is said while kernels are compiled."""

from __future__ import annotations

import pytest
from numba import njit

from femsense.app.compiling import COMPILING_TEXT, announced_compiling


@pytest.mark.parametrize(
    "words, expected",
    [(["calibrate", "robot", "recording"], [COMPILING_TEXT]), (["estimate", "--help"], []), (["doctor"], [])],
)
def test_the_first_kernel_is_announced_once_where_kernels_are_used(words: list[str], expected: list[str]) -> None:
    said: list[str] = []
    with announced_compiling(words, said.append):
        assert [njit(lambda x: x + 1)(1), njit(lambda x: x + 2)(1)] == [2, 3]
    njit(lambda x: x + 3)(1)
    assert said == expected


def test_a_kernel_that_is_compiled_already_is_not_announced() -> None:
    said: list[str] = []
    kernel = njit(lambda x: 2 * x)
    kernel(1)
    with announced_compiling(["calibrate"], said.append):
        kernel(2)
    assert said == []
