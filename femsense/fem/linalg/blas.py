# mypy: allow-untyped-decorators
"""Three routines of the BLAS that SciPy brings, for compiled kernels. Matrices are addresses; they are stored by columns."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import types
from numba.extending import get_cython_function_address, intrinsic

from femsense.core.kernels import njit

PLAIN = 2
"""Place of N (not transposed) in `Blas.letters`, before that of T (transposed)."""


class Blas(NamedTuple):
    """Addresses of the routines for one kind of numbers, and memory for their arguments, which BLAS reads by address.

    Each call of a kernel has a `Blas` of its own, because two threads must not write to the same arguments.
    """

    gemm: int
    syrk: int
    trsm: int
    letters: npt.NDArray[np.uint8]
    """L (lower), R (right), N (not transposed), T (transposed)."""
    numbers: npt.NDArray[np.int32]
    """Sizes and leading dimensions, shape (6,)."""
    scalars: npt.NDArray[Any]
    """α and β, shape (2,)."""


def blas_of(kind: str) -> Blas:
    """Return the routines for numbers of kind "d" (double) or "f" (single)."""
    gemm_at, syrk_at, trsm_at = _ADDRESSES[kind]
    letters = np.frombuffer(b"LRNT", np.uint8)
    return Blas(gemm_at, syrk_at, trsm_at, letters, np.zeros(6, np.int32), np.zeros(2, kind))


def _addresses(prefix: str) -> tuple[int, ...]:
    return tuple(get_cython_function_address("scipy.linalg.cython_blas", prefix + name) for name in ("gemm", "syrk", "trsm"))


_ADDRESSES = {"d": _addresses("d"), "f": _addresses("s")}


@intrinsic
def _call(typing_context: Any, address: Any, arguments: Any) -> Any:
    """Call a Fortran routine at an address; all its arguments are pointers, given as a tuple of integers."""
    del typing_context

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        integer = ir.IntType(64)
        kind = ir.FunctionType(ir.VoidType(), [integer] * len(arguments))
        pointers = [builder.extract_value(values[1], i) for i in range(len(arguments))]
        builder.call(builder.inttoptr(values[0], kind.as_pointer()), pointers)
        return context.get_dummy_value()

    return types.void(address, arguments), build


@intrinsic
def numbers_at(typing_context: Any, like: Any, address: Any) -> Any:
    """Return a pointer to numbers of the kind of the array `like`. It has neither length nor reference count, so that loops stay short."""
    del typing_context

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.inttoptr(values[1], context.get_value_type(signature.return_type))

    return types.CPointer(like.dtype)(like, address), build


@njit(cache=True)
def gemm(
    blas: Blas,
    turn_a: bool,
    turn_b: bool,
    m: int,
    n: int,
    k: int,
    alpha: float,
    a: int,
    step_a: int,
    b: int,
    step_b: int,
    beta: float,
    c: int,
    step_c: int,
) -> None:
    """C (m, n) ← α A (m, k) B (k, n) + β C. If `turn_a` is set, the matrix at `a` is Aᵀ, and likewise for B. `step` is the distance of two
    columns in memory."""
    numbers, scalars = blas.numbers, blas.scalars
    numbers[0], numbers[1], numbers[2], numbers[3], numbers[4], numbers[5] = m, n, k, step_a, step_b, step_c
    scalars[0], scalars[1] = alpha, beta
    plain, at, alpha_at = blas.letters.ctypes.data + PLAIN, numbers.ctypes.data, scalars.ctypes.data
    beta_at, way_a, way_b = alpha_at + scalars.itemsize, plain + turn_a, plain + turn_b
    _call(blas.gemm, (way_a, way_b, at, at + 4, at + 8, alpha_at, a, at + 12, b, at + 16, beta_at, c, at + 20))


@njit(cache=True)
def syrk(blas: Blas, n: int, k: int, alpha: float, a: int, step_a: int, c: int, step_c: int) -> None:
    """Lower half of C (n, n) ← α A Aᵀ with A (n, k)."""
    numbers, scalars = blas.numbers, blas.scalars
    numbers[0], numbers[1], numbers[2], numbers[3] = n, k, step_a, step_c
    scalars[0], scalars[1] = alpha, 0.0
    lower, at, alpha_at = blas.letters.ctypes.data, numbers.ctypes.data, scalars.ctypes.data
    _call(blas.syrk, (lower, lower + PLAIN, at, at + 4, alpha_at, a, at + 8, alpha_at + scalars.itemsize, c, at + 12))


@njit(cache=True)
def trsm(blas: Blas, turn: bool, m: int, n: int, a: int, step_a: int, b: int, step_b: int) -> None:
    """B (m, n) ← B A⁻¹ with the lower triangle A (n, n); B A⁻ᵀ if A is to turn."""
    numbers, scalars = blas.numbers, blas.scalars
    numbers[0], numbers[1], numbers[2], numbers[3] = m, n, step_a, step_b
    scalars[0] = 1.0
    lower, at = blas.letters.ctypes.data, numbers.ctypes.data
    right, plain = lower + 1, lower + PLAIN
    _call(blas.trsm, (right, lower, plain + turn, plain, at, at + 4, scalars.ctypes.data, a, at + 8, b, at + 12))
