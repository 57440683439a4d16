# mypy: allow-untyped-decorators, allow-untyped-calls
"""Dense products and triangular solves on fronts too small for BLAS: tiles in vector registers, as LLVM code for the present processor.

A tile is up to three registers of rows times six columns. Entries beyond the last row or column of a matrix are read, but do not affect the
result. Registers are written whole, with the old values beyond the last row, because a masked store takes a dozen cycles without AVX-512.
The memory must therefore extend PADDING entries beyond its end, and no other thread may write there.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from femsense.fem.linalg.simd_code import (
    BYTES,
    INTEGER,
    declared,
    function_named,
    kind_of,
    mask_below,
    number,
    pointer_at,
    spread,
)

WIDE = 6
"""Number of columns of a tile: two nodes."""
REGISTERS = 3 if BYTES == 64 else 2
"""Number of registers that hold the rows of a tile."""
PADDING = 4 * BYTES
"""Number of entries beyond the end of a matrix that kernels may read, and write back unchanged."""


@intrinsic
def subtract_product(
    context: Any, like: Any, a: Any, b: Any, step: Any, c: Any, step_c: Any, rows: Any, columns: Any, depth: Any
) -> Any:
    """C (rows, columns ≤ 6) −= A (rows, depth) B (columns, depth)ᵀ; matrices by columns, A and B with `step`,
    C with `step_c` between them.

    `like` is an array of the numbers in question, matrices are given by their addresses.
    """
    del context
    return types.void(like, *[types.int64] * 8), _builder("subtract", like, solves=False)


@intrinsic
def write_product(
    context: Any, like: Any, a: Any, b: Any, step: Any, c: Any, step_c: Any, rows: Any, columns: Any, depth: Any
) -> Any:
    """The same with C ← −A Bᵀ, whatever was there."""
    del context
    return types.void(like, *[types.int64] * 8), _builder("write", like, solves=False)


@intrinsic
def subtract_and_solve(
    context: Any, like: Any, a: Any, b: Any, step: Any, c: Any, step_c: Any, rows: Any, columns: Any, depth: Any, L: Any
) -> Any:
    """The same, then C ← C L⁻ᵀ for a lower L (columns, columns) by rows, WIDE apart,
    with the reciprocals of its diagonal on it."""
    del context
    return types.void(like, *[types.int64] * 9), _builder("solve", like, solves=True)


@intrinsic
def add_run(context: Any, like: Any, to: Any, source: Any, count: Any) -> Any:
    """Add `count` numbers at the address `source` to those at `to`."""
    del context

    def build(target: Any, builder: Any, signature: Any, values: Any) -> Any:
        builder.call(_run_function(builder.module, like), values[1:])
        return target.get_dummy_value()

    return types.void(like, types.int64, types.int64, types.int64), build


def _builder(name: str, like: Any, *, solves: bool) -> Any:
    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        builder.call(_tile_rows(builder.module, name, like, solves), values[1:])
        return context.get_dummy_value()

    return build


def _tile_rows(module: Any, name: str, like: Any, solves: bool) -> Any:
    """Return the function that goes through the rows of a product, as many registers at a time as are needed."""
    letter, _, lanes = kind_of(like)
    arguments = 9 if solves else 8
    function, known = function_named(module, f"femsense_{name}_{letter}", arguments)
    if known:
        return function
    builder = ir.IRBuilder(function.append_basic_block("entry"))
    a, b, step, c, step_c, rows, columns, depth, *rest = function.args
    loop, end = function.append_basic_block("loop"), function.append_basic_block("end")
    entry = builder.block
    builder.cbranch(builder.icmp_signed(">", rows, number(0)), loop, end)
    builder.position_at_end(loop)
    row = builder.phi(INTEGER)
    row.add_incoming(number(0), entry)
    left = builder.sub(rows, row)
    offset = builder.mul(row, number(BYTES // lanes))
    given = [builder.add(a, offset), b, step, builder.add(c, offset), step_c, left, columns, depth, *rest]
    after = function.append_basic_block("after")
    for registers in range(1, REGISTERS + 1):
        here, other = function.append_basic_block(), function.append_basic_block()
        if registers < REGISTERS:
            builder.cbranch(builder.icmp_signed("<=", left, number(registers * lanes)), here, other)
        else:
            builder.branch(here)
        builder.position_at_end(here)
        builder.call(_tile(module, name, like, registers, solves), given)
        builder.branch(after)
        builder.position_at_end(other)
    builder.unreachable()
    builder.position_at_end(after)
    following = builder.add(row, number(REGISTERS * lanes))
    row.add_incoming(following, after)
    builder.cbranch(builder.icmp_signed("<", following, rows), loop, end)
    builder.position_at_end(end)
    builder.ret_void()
    return function


def _tile(module: Any, name: str, like: Any, registers: int, solves: bool) -> Any:
    """Return the function of one tile with the given number of registers of rows."""
    letter, kind, lanes = kind_of(like)
    function, known = function_named(module, f"femsense_{name}_{letter}{registers}", 9 if solves else 8)
    if known:
        return function
    size, vector = BYTES // lanes, ir.VectorType(kind, lanes)
    builder = ir.IRBuilder(function.append_basic_block("entry"))
    a, b, step, c, step_c, rows, columns, depth, *rest = function.args
    multiply_add = declared(module, f"llvm.fmuladd.v{lanes}{'f64' if letter == 'd' else 'f32'}", vector, [vector] * 3)
    bytes_a, bytes_c = builder.mul(step, number(size)), builder.mul(step_c, number(size))
    sums, end = _products(builder, (a, b, bytes_a, depth), (kind, lanes, registers), multiply_add)
    fence = declared(  # without it LLVM makes a masked store of what follows
        module, f"llvm.arithmetic.fence.v{lanes}{'f64' if letter == 'd' else 'f32'}", vector, [vector]
    )
    written = mask_below(builder, rows, (registers - 1) * lanes, lanes)
    done: list[list[Any]] = []
    for n in range(WIDE):
        here = function.append_basic_block()
        builder.cbranch(builder.icmp_signed(">", columns, number(n)), here, end)
        builder.position_at_end(here)
        column = builder.add(c, builder.mul(bytes_c, number(n)))
        done.append([])
        for v in range(registers):
            pointer = pointer_at(builder, column, number(v * BYTES), vector)
            there = builder.load(pointer, align=size)
            value = builder.fneg(sums[n][v]) if name == "write" else builder.fsub(there, sums[n][v])
            if solves:
                value = _eliminated(builder, value, [d[v] for d in done[:n]], rest[0], (n, size, kind, lanes))
            done[n].append(value)
            if v == registers - 1:
                value = builder.call(fence, [builder.select(written, value, there)])
            builder.store(value, pointer, align=size)
    builder.branch(end)
    builder.position_at_end(end)
    builder.ret_void()
    return function


def _products(
    builder: Any, given: tuple[Any, ...], shape: tuple[Any, int, int], multiply_add: Any
) -> tuple[list[list[Any]], Any]:
    """Write the loop over the depth; return A Bᵀ by columns, in registers, and the block where the function ends."""
    a, b, bytes_a, depth = given
    kind, lanes, registers = shape
    vector, size, function, entry = ir.VectorType(kind, lanes), BYTES // lanes, builder.function, builder.block
    loop, after, end = (function.append_basic_block(name) for name in ("depth", "after", "end"))
    nothing = ir.Constant(vector, [0.0] * lanes)
    builder.cbranch(builder.icmp_signed(">", depth, number(0)), loop, after)
    builder.position_at_end(loop)
    k, at = builder.phi(INTEGER), builder.phi(INTEGER)
    k.add_incoming(number(0), entry)
    at.add_incoming(number(0), entry)
    sums = [[builder.phi(vector) for _ in range(registers)] for _ in range(WIDE)]
    column, row = builder.add(a, at), builder.add(b, at)
    left = [builder.load(pointer_at(builder, column, number(v * BYTES), vector), align=size) for v in range(registers)]
    following = []
    for n in range(WIDE):
        one = spread(builder, builder.load(pointer_at(builder, row, number(n * size), kind)), lanes)
        following.append([builder.call(multiply_add, [left[v], one, sums[n][v]]) for v in range(registers)])
    k_next, at_next = builder.add(k, number(1)), builder.add(at, bytes_a)
    k.add_incoming(k_next, loop)
    at.add_incoming(at_next, loop)
    for n in range(WIDE):
        for v in range(registers):
            sums[n][v].add_incoming(nothing, entry)
            sums[n][v].add_incoming(following[n][v], loop)
    builder.cbranch(builder.icmp_signed("<", k_next, depth), loop, after)
    builder.position_at_end(after)
    result = [[builder.phi(vector) for _ in range(registers)] for _ in range(WIDE)]
    for n in range(WIDE):
        for v in range(registers):
            result[n][v].add_incoming(nothing, entry)
            result[n][v].add_incoming(following[n][v], loop)
    return result, end


def _eliminated(builder: Any, value: Any, known: list[Any], L: Any, shape: tuple[int, int, Any, int]) -> Any:
    """Return (value − Σ known L[n, m]) / L[n, n]."""
    n, size, kind, lanes = shape
    for m, other in enumerate(known):
        factor = spread(builder, builder.load(pointer_at(builder, L, number((n * WIDE + m) * size), kind)), lanes)
        value = builder.fsub(value, builder.fmul(other, factor, flags=("contract",)), flags=("contract",))
    inverse = spread(builder, builder.load(pointer_at(builder, L, number((n * WIDE + n) * size), kind)), lanes)
    return builder.fmul(value, inverse)


def _run_function(module: Any, like: Any) -> Any:
    """Return the function that adds a run of numbers, a register at a time. The remainder is added in halves of a register, because the next run
    may begin right behind."""
    letter, kind, lanes = kind_of(like)
    function, known = function_named(module, f"femsense_add_{letter}", 3)
    if known:
        return function
    size = BYTES // lanes
    builder = ir.IRBuilder(function.append_basic_block("entry"))
    to, source, count = function.args

    def add(at: Any, width: int) -> None:
        kinds = ir.VectorType(kind, width) if width > 1 else kind
        pointer = pointer_at(builder, to, at, kinds)
        more = builder.load(pointer_at(builder, source, at, kinds), align=size)
        builder.store(builder.fadd(builder.load(pointer, align=size), more), pointer, align=size)

    entry, loop, end = builder.block, function.append_basic_block("loop"), function.append_basic_block("end")
    whole = builder.and_(count, number(-lanes))
    builder.cbranch(builder.icmp_signed(">", whole, number(0)), loop, end)
    builder.position_at_end(loop)
    done = builder.phi(INTEGER)
    done.add_incoming(number(0), entry)
    add(builder.mul(done, number(size)), lanes)
    following = builder.add(done, number(lanes))
    done.add_incoming(following, loop)
    builder.cbranch(builder.icmp_signed("<", following, whole), loop, end)
    builder.position_at_end(end)
    width = lanes // 2
    while width:
        here, after = function.append_basic_block(), function.append_basic_block()
        builder.cbranch(builder.icmp_signed("!=", builder.and_(count, number(width)), number(0)), here, after)
        builder.position_at_end(here)
        add(builder.mul(builder.and_(count, number(-2 * width)), number(size)), width)
        builder.branch(after)
        builder.position_at_end(after)
        width //= 2
    builder.ret_void()
    return function
