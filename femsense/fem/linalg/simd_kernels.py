# mypy: allow-untyped-decorators, allow-untyped-calls
"""Dense work on fronts too small for a BLAS to pay: tiles that stay in the vector registers, written as LLVM code for the processor at hand.

A tile is up to three registers of rows times six columns. Reading beyond the last row or column of a matrix is harmless (what is
read there reaches no result). Registers are written whole, what stands beyond the last row with its old value: a store with a mask
takes a dozen cycles where there is no AVX-512. The memory must reach PADDING entries beyond its end, and nobody else may write there.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import llvmlite.binding as llvm
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

WIDE = 6
"""Columns of a tile: two nodes."""
BYTES = 64 if llvm.get_host_cpu_features().get("avx512f", False) else 32
"""Size of a register; a processor with smaller ones takes two."""
REGISTERS = 3 if BYTES == 64 else 2
"""Registers of rows in a tile."""
PADDING = 4 * BYTES
"""Entries beyond the end of a matrix that may be read, and written again as they are."""
INTEGER = ir.IntType(64)
LINE = 64
"""Bytes of a line of the cache."""
SIDES = 8
"""Right-hand sides that are solved at once."""
LANES = 8
"""Elements that `add_gradient` and `add_divergence` work on at once."""


@intrinsic
def subtract_product(
    context: Any, like: Any, a: Any, b: Any, step: Any, c: Any, step_c: Any, rows: Any, columns: Any, depth: Any
) -> Any:
    """C (rows, columns ≤ 6) −= A (rows, depth) B (columns, depth)ᵀ; matrices by columns, A and B with `step`, C with `step_c` between them.

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
    """The same, then C ← C L⁻ᵀ for a lower L (columns, columns) by rows, WIDE apart, with the reciprocals of its diagonal on it."""
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


@intrinsic
def fetch_ahead(context: Any, address: Any, size: Any) -> Any:
    """Ask for so many bytes at an address to be brought into the cache, line by line; what lies there does not matter."""
    del context

    def build(target: Any, builder: Any, signature: Any, values: Any) -> Any:
        builder.call(_fetch_function(builder.module), values)
        return target.get_dummy_value()

    return types.void(types.int64, types.int64), build


def _fetch_function(module: Any) -> Any:
    function, known = _function(module, "femsense_fetch", 2)
    if known:
        return function
    builder = ir.IRBuilder(function.append_basic_block("entry"))
    address, size = function.args
    loop, end = function.append_basic_block("loop"), function.append_basic_block("end")
    entry = builder.block
    builder.cbranch(builder.icmp_signed(">", size, _number(0)), loop, end)
    builder.position_at_end(loop)
    at = builder.phi(INTEGER)
    at.add_incoming(_number(0), entry)
    _fetch(builder, builder.add(address, at), LINE)
    further = builder.add(at, _number(LINE))
    at.add_incoming(further, loop)
    builder.cbranch(builder.icmp_signed("<", further, size), loop, end)
    builder.position_at_end(end)
    builder.ret_void()
    return function


def _fetch(builder: Any, address: Any, size: int) -> None:
    """Ask for so many bytes at an address to be brought into the cache, line by line; what lies there does not matter."""
    pointer, word = ir.IntType(8).as_pointer(), ir.IntType(32)
    fetch = _declared(builder.module, "llvm.prefetch.p0", ir.VoidType(), [pointer, word, word, word])
    for line in range(0, size, LINE):
        builder.call(
            fetch, [_at(builder, address, _number(line), ir.IntType(8)), *(ir.Constant(word, value) for value in (0, 2, 1))]
        )


def _builder(name: str, like: Any, *, solves: bool) -> Any:
    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        builder.call(_tile_rows(builder.module, name, like, solves), values[1:])
        return context.get_dummy_value()

    return build


def _kind(like: Any) -> tuple[str, Any, int]:
    """Return a letter, the LLVM type of the numbers of an array, and how many a register holds."""
    return ("f", ir.FloatType(), BYTES // 4) if like.dtype.bitwidth == 32 else ("d", ir.DoubleType(), BYTES // 8)


def _function(module: Any, name: str, count: int) -> tuple[Any, bool]:
    """Return the function of a name with so many integers as arguments, and whether it is there already."""
    if name in module.globals:
        return module.globals[name], True
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [INTEGER] * count), name)
    function.linkage = "internal"
    return function, False


def _declared(module: Any, name: str, result: Any, arguments: list[Any]) -> Any:
    """Return a function of LLVM's own."""
    return module.globals[name] if name in module.globals else ir.Function(module, ir.FunctionType(result, arguments), name)


def _number(value: int) -> Any:
    return ir.Constant(INTEGER, value)


def _at(builder: Any, address: Any, offset: Any, kind: Any) -> Any:
    """Return a pointer to what begins `offset` bytes after an address."""
    return builder.inttoptr(builder.add(address, offset), kind.as_pointer())


def _mask(builder: Any, count: Any, first: int, lanes: int) -> Any:
    """Return which of `lanes` entries from `first` on are below count."""
    vector = ir.VectorType(INTEGER, lanes)
    places = ir.Constant(vector, [first + lane for lane in range(lanes)])
    return builder.icmp_signed("<", places, _spread(builder, count, lanes))


def _spread(builder: Any, value: Any, lanes: int) -> Any:
    vector = ir.VectorType(value.type, lanes)
    one = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(
        one, ir.Constant(vector, ir.Undefined), ir.Constant(ir.VectorType(ir.IntType(32), lanes), [0] * lanes)
    )


def _masked(builder: Any, kind: Any, lanes: int) -> tuple[Any, Any]:
    """Return LLVM's masked load and store of a register."""
    vector = ir.VectorType(kind, lanes)
    bits, pointer = ir.VectorType(ir.IntType(1), lanes), vector.as_pointer()
    ending = f"v{lanes}f{64 if isinstance(kind, ir.DoubleType) else 32}.p0"
    load = _declared(builder.module, f"llvm.masked.load.{ending}", vector, [pointer, ir.IntType(32), bits, vector])
    store = _declared(builder.module, f"llvm.masked.store.{ending}", ir.VoidType(), [vector, pointer, ir.IntType(32), bits])
    return load, store


def _tile_rows(module: Any, name: str, like: Any, solves: bool) -> Any:
    """Return the function that goes through the rows of a product, as many registers at a time as are needed."""
    letter, _, lanes = _kind(like)
    arguments = 9 if solves else 8
    function, known = _function(module, f"femsense_{name}_{letter}", arguments)
    if known:
        return function
    builder = ir.IRBuilder(function.append_basic_block("entry"))
    a, b, step, c, step_c, rows, columns, depth, *rest = function.args
    loop, end = function.append_basic_block("loop"), function.append_basic_block("end")
    entry = builder.block
    builder.cbranch(builder.icmp_signed(">", rows, _number(0)), loop, end)
    builder.position_at_end(loop)
    row = builder.phi(INTEGER)
    row.add_incoming(_number(0), entry)
    left = builder.sub(rows, row)
    offset = builder.mul(row, _number(BYTES // lanes))
    given = [builder.add(a, offset), b, step, builder.add(c, offset), step_c, left, columns, depth, *rest]
    after = function.append_basic_block("after")
    for registers in range(1, REGISTERS + 1):
        here, other = function.append_basic_block(), function.append_basic_block()
        if registers < REGISTERS:
            builder.cbranch(builder.icmp_signed("<=", left, _number(registers * lanes)), here, other)
        else:
            builder.branch(here)
        builder.position_at_end(here)
        builder.call(_tile(module, name, like, registers, solves), given)
        builder.branch(after)
        builder.position_at_end(other)
    builder.unreachable()
    builder.position_at_end(after)
    following = builder.add(row, _number(REGISTERS * lanes))
    row.add_incoming(following, after)
    builder.cbranch(builder.icmp_signed("<", following, rows), loop, end)
    builder.position_at_end(end)
    builder.ret_void()
    return function


def _tile(module: Any, name: str, like: Any, registers: int, solves: bool) -> Any:
    """Return the function of one tile with so many registers of rows."""
    letter, kind, lanes = _kind(like)
    function, known = _function(module, f"femsense_{name}_{letter}{registers}", 9 if solves else 8)
    if known:
        return function
    size, vector = BYTES // lanes, ir.VectorType(kind, lanes)
    builder = ir.IRBuilder(function.append_basic_block("entry"))
    a, b, step, c, step_c, rows, columns, depth, *rest = function.args
    multiply_add = _declared(module, f"llvm.fmuladd.v{lanes}{'f64' if letter == 'd' else 'f32'}", vector, [vector] * 3)
    bytes_a, bytes_c = builder.mul(step, _number(size)), builder.mul(step_c, _number(size))
    sums, end = _products(builder, (a, b, bytes_a, depth), (kind, lanes, registers), multiply_add)
    fence = _declared(  # without it LLVM makes a masked store of what follows
        module, f"llvm.arithmetic.fence.v{lanes}{'f64' if letter == 'd' else 'f32'}", vector, [vector]
    )
    written = _mask(builder, rows, (registers - 1) * lanes, lanes)
    done: list[list[Any]] = []
    for n in range(WIDE):
        here = function.append_basic_block()
        builder.cbranch(builder.icmp_signed(">", columns, _number(n)), here, end)
        builder.position_at_end(here)
        column = builder.add(c, builder.mul(bytes_c, _number(n)))
        done.append([])
        for v in range(registers):
            pointer = _at(builder, column, _number(v * BYTES), vector)
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
    builder.cbranch(builder.icmp_signed(">", depth, _number(0)), loop, after)
    builder.position_at_end(loop)
    k, at = builder.phi(INTEGER), builder.phi(INTEGER)
    k.add_incoming(_number(0), entry)
    at.add_incoming(_number(0), entry)
    sums = [[builder.phi(vector) for _ in range(registers)] for _ in range(WIDE)]
    column, row = builder.add(a, at), builder.add(b, at)
    left = [builder.load(_at(builder, column, _number(v * BYTES), vector), align=size) for v in range(registers)]
    following = []
    for n in range(WIDE):
        one = _spread(builder, builder.load(_at(builder, row, _number(n * size), kind)), lanes)
        following.append([builder.call(multiply_add, [left[v], one, sums[n][v]]) for v in range(registers)])
    k_next, at_next = builder.add(k, _number(1)), builder.add(at, bytes_a)
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
        factor = _spread(builder, builder.load(_at(builder, L, _number((n * WIDE + m) * size), kind)), lanes)
        value = builder.fsub(value, builder.fmul(other, factor, flags=("contract",)), flags=("contract",))
    inverse = _spread(builder, builder.load(_at(builder, L, _number((n * WIDE + n) * size), kind)), lanes)
    return builder.fmul(value, inverse)


def _run_function(module: Any, like: Any) -> Any:
    """Return the function that adds a run of numbers, a register at a time and what is left in halves of one: the next run may begin right after."""
    letter, kind, lanes = _kind(like)
    function, known = _function(module, f"femsense_add_{letter}", 3)
    if known:
        return function
    size = BYTES // lanes
    builder = ir.IRBuilder(function.append_basic_block("entry"))
    to, source, count = function.args

    def add(at: Any, width: int) -> None:
        kinds = ir.VectorType(kind, width) if width > 1 else kind
        pointer = _at(builder, to, at, kinds)
        more = builder.load(_at(builder, source, at, kinds), align=size)
        builder.store(builder.fadd(builder.load(pointer, align=size), more), pointer, align=size)

    entry, loop, end = builder.block, function.append_basic_block("loop"), function.append_basic_block("end")
    whole = builder.and_(count, _number(-lanes))
    builder.cbranch(builder.icmp_signed(">", whole, _number(0)), loop, end)
    builder.position_at_end(loop)
    done = builder.phi(INTEGER)
    done.add_incoming(_number(0), entry)
    add(builder.mul(done, _number(size)), lanes)
    following = builder.add(done, _number(lanes))
    done.add_incoming(following, loop)
    builder.cbranch(builder.icmp_signed("<", following, whole), loop, end)
    builder.position_at_end(end)
    width = lanes // 2
    while width:
        here, after = function.append_basic_block(), function.append_basic_block()
        builder.cbranch(builder.icmp_signed("!=", builder.and_(count, _number(width)), _number(0)), here, after)
        builder.position_at_end(here)
        add(builder.mul(builder.and_(count, _number(-2 * width)), _number(size)), width)
        builder.branch(after)
        builder.position_at_end(after)
        width //= 2
    builder.ret_void()
    return function


@intrinsic
def add_gradient(context: Any, like: Any, to: Any, x: Any, slopes: Any, count: Any) -> Any:
    """Add Σ_a x_ai g_aj to nine rows (i, j) of eight numbers at the address `to`: x of three rows of eight a node, g too, of the precision of `like`."""
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
    letter, kind, _ = _kind(like)
    function, known = _function(module, f"femsense_{name}_{letter}", 4)
    if known:
        return function
    wide, given, size = ir.VectorType(ir.DoubleType(), 8), ir.VectorType(kind, 8), 8 if letter == "d" else 4
    multiply_add = _declared(module, "llvm.fmuladd.v8f64", wide, [wide] * 3)
    builder = ir.IRBuilder(function.append_basic_block("entry"))
    to, other, slopes, count = function.args
    entry, loop, end = builder.block, function.append_basic_block("loop"), function.append_basic_block("end")
    fixed = to if name == "gradient" else other
    nine = [builder.load(_at(builder, fixed, _number(64 * k), wide), align=8) for k in range(9)]
    builder.branch(loop)
    builder.position_at_end(loop)
    node = builder.phi(INTEGER)
    node.add_incoming(_number(0), entry)
    sums = []
    if name == "gradient":
        for value in nine:
            sums.append(builder.phi(wide))
            sums[-1].add_incoming(value, entry)
    place, slope = builder.mul(node, _number(192)), builder.add(slopes, builder.mul(node, _number(24 * size)))
    g = [builder.load(_at(builder, slope, _number(8 * size * j), given), align=size) for j in range(3)]
    g = g if letter == "d" else [builder.fpext(value, wide) for value in g]
    row = builder.add(other if name == "gradient" else to, place)
    results = []
    for i in range(3):
        pointer = _at(builder, row, _number(64 * i), wide)
        value = builder.load(pointer, align=8)
        if name == "gradient":
            results += [builder.call(multiply_add, [value, g[j], sums[3 * i + j]]) for j in range(3)]
            continue
        for j in range(3):
            value = builder.call(multiply_add, [nine[3 * i + j], g[j], value])
        builder.store(value, pointer, align=8)
    following = builder.add(node, _number(1))
    node.add_incoming(following, loop)
    for phi, value in zip(sums, results):
        phi.add_incoming(value, loop)
    builder.cbranch(builder.icmp_signed("<", following, count), loop, end)
    builder.position_at_end(end)
    for k, value in enumerate(results):
        builder.store(value, _at(builder, to, _number(64 * k), wide), align=8)
    builder.ret_void()
    return function


def _columns(name: str, count: int, write: Callable[[Any, str, Any, int], Any]) -> Any:
    """Return the intrinsic of what `write` writes for so many columns."""

    @intrinsic
    def columns(context: Any, like: Any, a: Any, step: Any, x: Any, rows: Any, ahead: Any) -> Any:
        del context

        def build(target: Any, builder: Any, signature: Any, values: Any) -> Any:
            builder.call(write(builder.module, name, like, count), values[1:])
            return target.get_dummy_value()

        return types.void(like, *[types.int64] * 5), build

    return columns


def _side_function(module: Any, name: str, like: Any, count: int) -> Any:
    """Return the function that goes down a few columns row by row, SIDES right-hand sides at once."""
    letter, kind, _ = _kind(like)
    function, known = _function(module, f"femsense_sides_{name}_{letter}{count}", 5)
    if known:
        return function
    size = 8 if letter == "d" else 4
    line, vector = size * SIDES, ir.VectorType(kind, SIDES)
    builder = ir.IRBuilder(function.append_basic_block("entry"))
    a, step, x, rows, ahead = function.args
    work = _Elimination(builder, kind, vector, a, step)
    values = [builder.load(_at(builder, x, _number(line * k), vector), align=size) for k in range(count)]
    if name == "down":
        values = work.forward(values)
    factors = [builder.fneg(value) for value in values]
    column, y, further = (
        [builder.add(at, _number(count * size)) for at in work.columns(count)],
        builder.add(x, _number(count * line)),
        builder.add(a, ahead),
    )
    entry, loop, end = builder.block, function.append_basic_block("loop"), function.append_basic_block("end")
    builder.cbranch(builder.icmp_signed(">", rows, _number(0)), loop, end)
    builder.position_at_end(loop)
    row = builder.phi(INTEGER)
    row.add_incoming(_number(0), entry)
    sums = [builder.phi(vector) for _ in values] if name == "up" else []
    _fetch(builder, builder.add(further, builder.mul(row, _number(count * size))), 1)
    pointer = _at(builder, y, builder.mul(row, _number(line)), vector)
    value, place, results = builder.load(pointer, align=size), builder.mul(row, _number(size)), []
    for k in range(count):
        part = _spread(builder, builder.load(_at(builder, column[k], place, kind), align=size), SIDES)
        if name == "down":
            value = work.add_product(part, factors[k], value)
        else:
            results.append(work.add_product(part, builder.fneg(value), sums[k]))
    if name == "down":
        builder.store(value, pointer, align=size)
    following = builder.add(row, _number(1))
    row.add_incoming(following, loop)
    for phi, first, result in zip(sums, values, results):
        phi.add_incoming(first, entry)
        phi.add_incoming(result, loop)
    builder.cbranch(builder.icmp_signed("<", following, rows), loop, end)
    builder.position_at_end(end)
    if name == "up":
        values = work.backward(
            [_either(builder, vector, [(first, entry), (result, loop)]) for first, result in zip(values, results)]
        )
    for k, value in enumerate(values):
        builder.store(value, _at(builder, x, _number(line * k), vector), align=size)
    builder.ret_void()
    return function


def _column_function(module: Any, name: str, like: Any, count: int) -> Any:
    """Return the function that goes down a few columns a register at a time."""
    letter, kind, lanes = _kind(like)
    function, known = _function(module, f"femsense_{name}_{letter}{count}", 5)
    if known:
        return function
    size, vector = BYTES // lanes, ir.VectorType(kind, lanes)
    builder = ir.IRBuilder(function.append_basic_block("entry"))
    a, step, x, rows, ahead = function.args
    work, registers = _Elimination(builder, kind, kind, a, step), _Elimination(builder, kind, vector, a, step)
    load, store = _masked(builder, kind, lanes)
    align, nothing = ir.Constant(ir.IntType(32), size), ir.Constant(vector, [0.0] * lanes)
    values = [builder.load(_at(builder, x, _number(size * k), kind), align=size) for k in range(count)]
    if name == "down":
        values = work.forward(values)
    factors = [_spread(builder, builder.fneg(value), lanes) for value in values] if name == "down" else []
    column, y, further = (
        [builder.add(at, _number(count * size)) for at in work.columns(count)],
        builder.add(x, _number(count * size)),
        builder.add(a, ahead),
    )

    def register(offset: Any, sums: list[Any], take: Callable[[Any], Any], put: Callable[[Any, Any], Any]) -> list[Any]:
        """Write the work on one register of rows; return the sums with it."""
        pointer = _at(builder, y, offset, vector)
        value, results = take(pointer), []
        for k in range(count):
            part = take(_at(builder, column[k], offset, vector))
            if name == "down":
                value = registers.add_product(part, factors[k], value)
            else:
                results.append(registers.add_product(part, value, sums[k]))
        if name == "down":
            put(value, pointer)
        return results

    entry = builder.block
    whole, check, rest, end = (function.append_basic_block(part) for part in ("whole", "check", "rest", "end"))
    builder.cbranch(builder.icmp_signed(">=", rows, _number(lanes)), whole, check)
    builder.position_at_end(whole)
    left, offset, *sums = [builder.phi(kind) for kind in (INTEGER, INTEGER, *[vector] * (count if name == "up" else 0))]
    _fetch(builder, builder.add(further, builder.mul(offset, _number(count))), count * BYTES)
    results = register(
        offset, sums, lambda at: builder.load(at, align=size), lambda value, at: builder.store(value, at, align=size)
    )
    after = [builder.sub(left, _number(lanes)), builder.add(offset, _number(BYTES)), *results]
    before = [rows, _number(0), *[nothing] * len(sums)]
    for phi, first, result in zip((left, offset, *sums), before, after):
        phi.add_incoming(first, entry)
        phi.add_incoming(result, whole)
    builder.cbranch(builder.icmp_signed(">=", after[0], _number(lanes)), whole, check)
    builder.position_at_end(check)
    left, offset, *sums = [
        _either(builder, first.type, [(first, entry), (result, whole)]) for first, result in zip(before, after)
    ]
    builder.cbranch(builder.icmp_signed(">", left, _number(0)), rest, end)
    builder.position_at_end(rest)  # a store with a mask takes a dozen cycles, but there is one
    mask = _mask(builder, left, 0, lanes)
    results = register(
        offset,
        sums,
        lambda at: builder.call(load, [at, align, mask, nothing]),
        lambda value, at: builder.call(store, [value, at, align, mask]),
    )
    builder.branch(end)
    builder.position_at_end(end)
    if name == "up":
        add = _declared(module, f"llvm.vector.reduce.fadd.v{lanes}f{8 * size}", kind, [kind, vector])
        sums = [_either(builder, vector, [(first, check), (result, rest)]) for first, result in zip(sums, results)]
        totals = [builder.call(add, [ir.Constant(kind, -0.0), total], fastmath=("reassoc",)) for total in sums]
        values = work.backward([builder.fsub(value, total) for value, total in zip(values, totals)])
    for k, value in enumerate(values):
        builder.store(value, _at(builder, x, _number(size * k), kind), align=size)
    builder.ret_void()
    return function


class _Elimination:
    """What is written about the columns of a matrix at the address `a`, `step` entries apart, that begin with a lower triangle."""

    def __init__(self, builder: Any, kind: Any, vector: Any, a: Any, step: Any) -> None:
        self.builder, self.kind, self.vector, self.a, self.step = builder, kind, vector, a, step
        self.size = 8 if isinstance(kind, ir.DoubleType) else 4
        ending = f"f{8 * self.size}" if vector is kind else f"v{vector.count}f{8 * self.size}"
        self._fused = _declared(builder.module, f"llvm.fmuladd.{ending}", vector, [vector] * 3)

    def columns(self, count: int) -> list[Any]:
        """Return the addresses of so many columns."""
        return [self.builder.add(self.a, self.builder.mul(self.step, _number(self.size * k))) for k in range(count)]

    def add_product(self, a: Any, b: Any, c: Any) -> Any:
        return self.builder.call(self._fused, [a, b, c])

    def forward(self, values: list[Any]) -> list[Any]:
        """Return T⁻¹ times some values, T the triangle."""
        values, T = list(values), self._triangle(len(values))
        for k in range(len(values)):
            values[k] = self.builder.fmul(values[k], T[k, k])
            for i in range(k + 1, len(values)):
                values[i] = self.add_product(T[i, k], values[k], values[i])
        return values

    def backward(self, values: list[Any]) -> list[Any]:
        """Return T⁻ᵀ times some values."""
        values, T = list(values), self._triangle(len(values))
        for k in reversed(range(len(values))):
            for i in reversed(range(k + 1, len(values))):
                values[k] = self.add_product(T[i, k], values[i], values[k])
            values[k] = self.builder.fmul(values[k], T[k, k])
        return values

    def _triangle(self, count: int) -> dict[tuple[int, int], Any]:
        """Return the reciprocals of the diagonal of T and its other entries with their sign turned."""
        builder, columns, one = self.builder, self.columns(count), ir.Constant(self.kind, 1.0)
        entries = {
            (i, k): builder.load(_at(builder, columns[k], _number(self.size * i), self.kind), align=self.size)
            for k in range(count)
            for i in range(k, count)
        }
        turned = {(i, k): builder.fdiv(one, entry) if i == k else builder.fneg(entry) for (i, k), entry in entries.items()}
        return turned if self.vector is self.kind else {at: _spread(builder, entry, SIDES) for at, entry in turned.items()}


def _either(builder: Any, kind: Any, ways: list[tuple[Any, Any]]) -> Any:
    """Return the value that belongs to the block from which this one is reached."""
    phi = builder.phi(kind)
    for value, block in ways:
        phi.add_incoming(value, block)
    return phi


down_one, down_three, down_six = (_columns("down", count, _column_function) for count in (1, 3, 6))
"""(like, a, step, x, rows, ahead): for a matrix at the address `a`, its columns `step` entries apart, that begins with a lower triangle T and goes on with
`rows` rows A: x ← T⁻¹ x, and y −= A x for the y behind x. What lies `ahead` bytes further is brought into the cache meanwhile."""
up_one, up_three, up_six = (_columns("up", count, _column_function) for count in (1, 3, 6))
"""The same with x −= Aᵀ y, and x ← T⁻ᵀ x."""
down_three_sides, down_six_sides = (_columns("down", count, _side_function) for count in (3, 6))
up_three_sides, up_six_sides = (_columns("up", count, _side_function) for count in (3, 6))
"""The same for SIDES right-hand sides: each row of x and of y is SIDES numbers."""
