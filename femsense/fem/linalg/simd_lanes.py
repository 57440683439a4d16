# mypy: allow-untyped-decorators, allow-untyped-calls
"""Sums over the nodes of eight elements at once, as LLVM code.

LLVM makes no vector instructions of such loops by itself: it would have to compare too many addresses to see that nothing overlaps.
They would take five times as long, and all forces of a body 2.5 times (docs/appendix/mechanics-trials.md).
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 8
"""Number of elements on which `add_gradient` and `add_divergence` work at once."""


@intrinsic
def add_gradient(context: Any, like: Any, to: Any, x: Any, slopes: Any, count: Any) -> Any:
    """Add Σ_a x_ai g_aj to nine rows (i, j) of eight numbers at the address `to`: x of three rows of eight a node, g too,
    of the precision of `like`."""
    del context

    def build(target: Any, builder: Any, signature: Any, values: Any) -> Any:
        _, to, x, slopes, count = values
        sums = [cgutils.alloca_once_value(builder, builder.load(at, align=8)) for at in _rows(builder, to, 64, 9)]
        with cgutils.for_range(builder, count) as loop:
            g = _slopes(builder, like, slopes, loop.index)
            places = [builder.load(at, align=8) for at in _rows(builder, x, 64, 3, loop.index)]
            for k, total in enumerate(sums):
                builder.store(_with_product(builder, builder.load(total), places[k // 3], g[k % 3]), total)
        for total, at in zip(sums, _rows(builder, to, 64, 9)):
            builder.store(builder.load(total), at, align=8)
        return target.get_dummy_value()

    return types.void(like, *[types.int64] * 4), build


@intrinsic
def add_divergence(context: Any, like: Any, to: Any, stress: Any, slopes: Any, count: Any) -> Any:
    """Add Σ_j p_ij g_aj to three rows (i) of eight numbers a node at `to`, p being nine rows (i, j)."""
    del context

    def build(target: Any, builder: Any, signature: Any, values: Any) -> Any:
        _, to, stress, slopes, count = values
        p = [builder.load(at, align=8) for at in _rows(builder, stress, 64, 9)]
        with cgutils.for_range(builder, count) as loop:
            g = _slopes(builder, like, slopes, loop.index)
            for i, at in enumerate(_rows(builder, to, 64, 3, loop.index)):
                value = builder.load(at, align=8)
                for j in range(3):
                    value = _with_product(builder, value, p[3 * i + j], g[j])
                builder.store(value, at, align=8)
        return target.get_dummy_value()

    return types.void(like, *[types.int64] * 4), build


def _rows(builder: Any, address: Any, bits: int, count: int, group: Any = None) -> list[Any]:
    """Return pointers to the rows of eight numbers from an address on, or to a later group of as many rows."""
    kind = ir.VectorType(ir.DoubleType() if bits == 64 else ir.FloatType(), LANES).as_pointer()
    if group is not None:
        address = builder.add(address, builder.mul(group, group.type(count * LANES * bits // 8)))
    return [builder.inttoptr(builder.add(address, address.type(row * LANES * bits // 8)), kind) for row in range(count)]


def _slopes(builder: Any, like: Any, address: Any, node: Any) -> list[Any]:
    """Return the three rows of a node's slopes in double precision."""
    bits = like.dtype.bitwidth
    rows = [builder.load(at, align=bits // 8) for at in _rows(builder, address, bits, 3, node)]
    return rows if bits == 64 else [builder.fpext(row, ir.VectorType(ir.DoubleType(), LANES)) for row in rows]


def _with_product(builder: Any, total: Any, a: Any, b: Any) -> Any:
    return builder.fadd(total, builder.fmul(a, b, flags=("contract",)), flags=("contract",))
