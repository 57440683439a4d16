# mypy: allow-untyped-decorators, allow-untyped-calls
"""Substitution by a few columns of a factor, as LLVM code for the processor at hand."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from femsense.fem.linalg.simd_code import (
    BYTES,
    INTEGER,
    declared,
    either,
    fetch,
    function_named,
    kind_of,
    mask_below,
    masked_access,
    number,
    pointer_at,
    spread,
)

SIDES = 8
"""Number of right-hand sides that the `…_sides` functions solve at once."""


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
    letter, kind, _ = kind_of(like)
    function, known = function_named(module, f"femsense_sides_{name}_{letter}{count}", 5)
    if known:
        return function
    size = 8 if letter == "d" else 4
    line, vector = size * SIDES, ir.VectorType(kind, SIDES)
    builder = ir.IRBuilder(function.append_basic_block("entry"))
    a, step, x, rows, ahead = function.args
    work = _Elimination(builder, kind, vector, a, step)
    values = [builder.load(pointer_at(builder, x, number(line * k), vector), align=size) for k in range(count)]
    if name == "down":
        values = work.forward(values)
    factors = [builder.fneg(value) for value in values]
    column, y, further = (
        [builder.add(at, number(count * size)) for at in work.columns(count)],
        builder.add(x, number(count * line)),
        builder.add(a, ahead),
    )
    entry, loop, end = builder.block, function.append_basic_block("loop"), function.append_basic_block("end")
    builder.cbranch(builder.icmp_signed(">", rows, number(0)), loop, end)
    builder.position_at_end(loop)
    row = builder.phi(INTEGER)
    row.add_incoming(number(0), entry)
    sums = [builder.phi(vector) for _ in values] if name == "up" else []
    fetch(builder, builder.add(further, builder.mul(row, number(count * size))), 1)
    pointer = pointer_at(builder, y, builder.mul(row, number(line)), vector)
    value, place, results = builder.load(pointer, align=size), builder.mul(row, number(size)), []
    for k in range(count):
        part = spread(builder, builder.load(pointer_at(builder, column[k], place, kind), align=size), SIDES)
        if name == "down":
            value = work.add_product(part, factors[k], value)
        else:
            results.append(work.add_product(part, builder.fneg(value), sums[k]))
    if name == "down":
        builder.store(value, pointer, align=size)
    following = builder.add(row, number(1))
    row.add_incoming(following, loop)
    for phi, first, result in zip(sums, values, results):
        phi.add_incoming(first, entry)
        phi.add_incoming(result, loop)
    builder.cbranch(builder.icmp_signed("<", following, rows), loop, end)
    builder.position_at_end(end)
    if name == "up":
        values = work.backward(
            [either(builder, vector, [(first, entry), (result, loop)]) for first, result in zip(values, results)]
        )
    for k, value in enumerate(values):
        builder.store(value, pointer_at(builder, x, number(line * k), vector), align=size)
    builder.ret_void()
    return function


def _column_function(module: Any, name: str, like: Any, count: int) -> Any:
    """Return the function that goes down a few columns a register at a time."""
    letter, kind, lanes = kind_of(like)
    function, known = function_named(module, f"femsense_{name}_{letter}{count}", 5)
    if known:
        return function
    size, vector = BYTES // lanes, ir.VectorType(kind, lanes)
    builder = ir.IRBuilder(function.append_basic_block("entry"))
    a, step, x, rows, ahead = function.args
    work, registers = _Elimination(builder, kind, kind, a, step), _Elimination(builder, kind, vector, a, step)
    load, store = masked_access(builder, kind, lanes)
    align, nothing = ir.Constant(ir.IntType(32), size), ir.Constant(vector, [0.0] * lanes)
    values = [builder.load(pointer_at(builder, x, number(size * k), kind), align=size) for k in range(count)]
    if name == "down":
        values = work.forward(values)
    factors = [spread(builder, builder.fneg(value), lanes) for value in values] if name == "down" else []
    column, y, further = (
        [builder.add(at, number(count * size)) for at in work.columns(count)],
        builder.add(x, number(count * size)),
        builder.add(a, ahead),
    )

    def register(offset: Any, sums: list[Any], take: Callable[[Any], Any], put: Callable[[Any, Any], Any]) -> list[Any]:
        """Write the work on one register of rows; return the sums with it."""
        pointer = pointer_at(builder, y, offset, vector)
        value, results = take(pointer), []
        for k in range(count):
            part = take(pointer_at(builder, column[k], offset, vector))
            if name == "down":
                value = registers.add_product(part, factors[k], value)
            else:
                results.append(registers.add_product(part, value, sums[k]))
        if name == "down":
            put(value, pointer)
        return results

    entry = builder.block
    whole, check, rest, end = (function.append_basic_block(part) for part in ("whole", "check", "rest", "end"))
    builder.cbranch(builder.icmp_signed(">=", rows, number(lanes)), whole, check)
    builder.position_at_end(whole)
    left, offset, *sums = [builder.phi(kind) for kind in (INTEGER, INTEGER, *[vector] * (count if name == "up" else 0))]
    fetch(builder, builder.add(further, builder.mul(offset, number(count))), count * BYTES)
    results = register(
        offset, sums, lambda at: builder.load(at, align=size), lambda value, at: builder.store(value, at, align=size)
    )
    after = [builder.sub(left, number(lanes)), builder.add(offset, number(BYTES)), *results]
    before = [rows, number(0), *[nothing] * len(sums)]
    for phi, first, result in zip((left, offset, *sums), before, after):
        phi.add_incoming(first, entry)
        phi.add_incoming(result, whole)
    builder.cbranch(builder.icmp_signed(">=", after[0], number(lanes)), whole, check)
    builder.position_at_end(check)
    left, offset, *sums = [either(builder, first.type, [(first, entry), (result, whole)]) for first, result in zip(before, after)]
    builder.cbranch(builder.icmp_signed(">", left, number(0)), rest, end)
    builder.position_at_end(rest)  # a store with a mask takes a dozen cycles, but there is one
    mask = mask_below(builder, left, 0, lanes)
    results = register(
        offset,
        sums,
        lambda at: builder.call(load, [at, align, mask, nothing]),
        lambda value, at: builder.call(store, [value, at, align, mask]),
    )
    builder.branch(end)
    builder.position_at_end(end)
    if name == "up":
        add = declared(module, f"llvm.vector.reduce.fadd.v{lanes}f{8 * size}", kind, [kind, vector])
        sums = [either(builder, vector, [(first, check), (result, rest)]) for first, result in zip(sums, results)]
        totals = [builder.call(add, [ir.Constant(kind, -0.0), total], fastmath=("reassoc",)) for total in sums]
        values = work.backward([builder.fsub(value, total) for value, total in zip(values, totals)])
    for k, value in enumerate(values):
        builder.store(value, pointer_at(builder, x, number(size * k), kind), align=size)
    builder.ret_void()
    return function


class _Elimination:
    """What is written about the columns of a matrix at the address `a`, `step` entries apart,
    that begin with a lower triangle."""

    def __init__(self, builder: Any, kind: Any, vector: Any, a: Any, step: Any) -> None:
        self.builder, self.kind, self.vector, self.a, self.step = builder, kind, vector, a, step
        self.size = 8 if isinstance(kind, ir.DoubleType) else 4
        ending = f"f{8 * self.size}" if vector is kind else f"v{vector.count}f{8 * self.size}"
        self._fused = declared(builder.module, f"llvm.fmuladd.{ending}", vector, [vector] * 3)

    def columns(self, count: int) -> list[Any]:
        """Return the addresses of so many columns."""
        return [self.builder.add(self.a, self.builder.mul(self.step, number(self.size * k))) for k in range(count)]

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
            (i, k): builder.load(pointer_at(builder, columns[k], number(self.size * i), self.kind), align=self.size)
            for k in range(count)
            for i in range(k, count)
        }
        turned = {(i, k): builder.fdiv(one, entry) if i == k else builder.fneg(entry) for (i, k), entry in entries.items()}
        return turned if self.vector is self.kind else {at: spread(builder, entry, SIDES) for at, entry in turned.items()}


down_one, down_three, down_six = (_columns("down", count, _column_function) for count in (1, 3, 6))
"""Forward substitution by one, three or six columns (like, a, step, x, rows, ahead). At the address `a` stands a lower triangle T above a
matrix A with `rows` rows, `step` entries from column to column. x ← T⁻¹ x, and y −= A x for the y behind x. The memory `ahead` bytes
further is loaded into the cache meanwhile."""
up_one, up_three, up_six = (_columns("up", count, _column_function) for count in (1, 3, 6))
"""Backward substitution by one, three or six columns, with the arguments of `down_one`: x −= Aᵀ y, then x ← T⁻ᵀ x."""
down_three_sides, down_six_sides = (_columns("down", count, _side_function) for count in (3, 6))
"""Forward substitution as by `down_three`, for SIDES right-hand sides: each row of x and of y is SIDES numbers."""
up_three_sides, up_six_sides = (_columns("up", count, _side_function) for count in (3, 6))
"""Backward substitution as by `up_three`, for SIDES right-hand sides: each row of x and of y is SIDES numbers."""
