# mypy: allow-untyped-decorators, allow-untyped-calls
"""Sums over the nodes of eight elements at once, as LLVM code."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from femsense.fem.linalg.simd_code import INTEGER, declared, function_named, kind_of, number, pointer_at

LANES = 8
"""Number of elements on which `add_gradient` and `add_divergence` work at once."""


@intrinsic
def add_gradient(context: Any, like: Any, to: Any, x: Any, slopes: Any, count: Any) -> Any:
    """Add Σ_a x_ai g_aj to nine rows (i, j) of eight numbers at the address `to`: x of three rows of eight a node, g too,
    of the precision of `like`."""
    del context

    def build(target: Any, builder: Any, signature: Any, values: Any) -> Any:
        builder.call(_lane_function(builder.module, "gradient", like), values[1:])
        return target.get_dummy_value()

    return types.void(like, *[types.int64] * 4), build


@intrinsic
def add_divergence(context: Any, like: Any, to: Any, stress: Any, slopes: Any, count: Any) -> Any:
    """Add Σ_j p_ij g_aj to three rows (i) of eight numbers a node at `to`, p being nine rows (i, j)."""
    del context

    def build(target: Any, builder: Any, signature: Any, values: Any) -> Any:
        builder.call(_lane_function(builder.module, "divergence", like), values[1:])
        return target.get_dummy_value()

    return types.void(like, *[types.int64] * 4), build


def _lane_function(module: Any, name: str, like: Any) -> Any:
    """Return the function of a loop over nodes: nine products each, eight elements at once."""
    letter, kind, _ = kind_of(like)
    function, known = function_named(module, f"femsense_{name}_{letter}", 4)
    if known:
        return function
    wide, given, size = ir.VectorType(ir.DoubleType(), 8), ir.VectorType(kind, 8), 8 if letter == "d" else 4
    multiply_add = declared(module, "llvm.fmuladd.v8f64", wide, [wide] * 3)
    builder = ir.IRBuilder(function.append_basic_block("entry"))
    to, other, slopes, count = function.args
    entry, loop, end = builder.block, function.append_basic_block("loop"), function.append_basic_block("end")
    fixed = to if name == "gradient" else other
    nine = [builder.load(pointer_at(builder, fixed, number(64 * k), wide), align=8) for k in range(9)]
    builder.branch(loop)
    builder.position_at_end(loop)
    node = builder.phi(INTEGER)
    node.add_incoming(number(0), entry)
    sums = []
    if name == "gradient":
        for value in nine:
            sums.append(builder.phi(wide))
            sums[-1].add_incoming(value, entry)
    place, slope = builder.mul(node, number(192)), builder.add(slopes, builder.mul(node, number(24 * size)))
    g = [builder.load(pointer_at(builder, slope, number(8 * size * j), given), align=size) for j in range(3)]
    g = g if letter == "d" else [builder.fpext(value, wide) for value in g]
    row = builder.add(other if name == "gradient" else to, place)
    results = []
    for i in range(3):
        pointer = pointer_at(builder, row, number(64 * i), wide)
        value = builder.load(pointer, align=8)
        if name == "gradient":
            results += [builder.call(multiply_add, [value, g[j], sums[3 * i + j]]) for j in range(3)]
            continue
        for j in range(3):
            value = builder.call(multiply_add, [nine[3 * i + j], g[j], value])
        builder.store(value, pointer, align=8)
    following = builder.add(node, number(1))
    node.add_incoming(following, loop)
    for phi, value in zip(sums, results):
        phi.add_incoming(value, loop)
    builder.cbranch(builder.icmp_signed("<", following, count), loop, end)
    builder.position_at_end(end)
    for k, value in enumerate(results):
        builder.store(value, pointer_at(builder, to, number(64 * k), wide), align=8)
    builder.ret_void()
    return function
