# mypy: allow-untyped-decorators, allow-untyped-calls
"""Common parts of functions written as LLVM code: numbers, registers, pointers, masks, prefetching."""

from __future__ import annotations

from typing import Any

import llvmlite.binding as llvm
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

BYTES = 64 if llvm.get_host_cpu_features().get("avx512f", False) else 32
"""Size of a vector register [bytes]. A processor with smaller registers uses two."""
INTEGER = ir.IntType(64)
LINE = 64
"""Size of a cache line [bytes]."""


@intrinsic
def fetch_ahead(context: Any, address: Any, size: Any) -> Any:
    """Prefetch `size` bytes at an address into the cache, line by line; the address need not be valid."""
    del context

    def build(target: Any, builder: Any, signature: Any, values: Any) -> Any:
        builder.call(fetch_function(builder.module), values)
        return target.get_dummy_value()

    return types.void(types.int64, types.int64), build


def fetch_function(module: Any) -> Any:
    function, known = function_named(module, "femsense_fetch", 2)
    if known:
        return function
    builder = ir.IRBuilder(function.append_basic_block("entry"))
    address, size = function.args
    loop, end = function.append_basic_block("loop"), function.append_basic_block("end")
    entry = builder.block
    builder.cbranch(builder.icmp_signed(">", size, number(0)), loop, end)
    builder.position_at_end(loop)
    at = builder.phi(INTEGER)
    at.add_incoming(number(0), entry)
    fetch(builder, builder.add(address, at), LINE)
    further = builder.add(at, number(LINE))
    at.add_incoming(further, loop)
    builder.cbranch(builder.icmp_signed("<", further, size), loop, end)
    builder.position_at_end(end)
    builder.ret_void()
    return function


def fetch(builder: Any, address: Any, size: int) -> None:
    """Prefetch `size` bytes at an address into the cache, line by line; the address need not be valid."""
    pointer, word = ir.IntType(8).as_pointer(), ir.IntType(32)
    fetch = declared(builder.module, "llvm.prefetch.p0", ir.VoidType(), [pointer, word, word, word])
    for line in range(0, size, LINE):
        builder.call(
            fetch, [pointer_at(builder, address, number(line), ir.IntType(8)), *(ir.Constant(word, value) for value in (0, 2, 1))]
        )


def kind_of(like: Any) -> tuple[str, Any, int]:
    """Return a letter, the LLVM type of the numbers of an array, and how many a register holds."""
    return ("f", ir.FloatType(), BYTES // 4) if like.dtype.bitwidth == 32 else ("d", ir.DoubleType(), BYTES // 8)


def function_named(module: Any, name: str, count: int) -> tuple[Any, bool]:
    """Return the function of a name with the given number of integer arguments, and whether it exists already."""
    if name in module.globals:
        return module.globals[name], True
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [INTEGER] * count), name)
    function.linkage = "internal"
    return function, False


def declared(module: Any, name: str, result: Any, arguments: list[Any]) -> Any:
    """Return a function of LLVM's own."""
    return module.globals[name] if name in module.globals else ir.Function(module, ir.FunctionType(result, arguments), name)


def number(value: int) -> Any:
    return ir.Constant(INTEGER, value)


def pointer_at(builder: Any, address: Any, offset: Any, kind: Any) -> Any:
    """Return a pointer `offset` bytes after an address."""
    return builder.inttoptr(builder.add(address, offset), kind.as_pointer())


def mask_below(builder: Any, count: Any, first: int, lanes: int) -> Any:
    """Return which of `lanes` entries from `first` on are below count."""
    vector = ir.VectorType(INTEGER, lanes)
    places = ir.Constant(vector, [first + lane for lane in range(lanes)])
    return builder.icmp_signed("<", places, spread(builder, count, lanes))


def spread(builder: Any, value: Any, lanes: int) -> Any:
    vector = ir.VectorType(value.type, lanes)
    one = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(
        one, ir.Constant(vector, ir.Undefined), ir.Constant(ir.VectorType(ir.IntType(32), lanes), [0] * lanes)
    )


def masked_access(builder: Any, kind: Any, lanes: int) -> tuple[Any, Any]:
    """Return LLVM's masked load and store of a register."""
    vector = ir.VectorType(kind, lanes)
    bits, pointer = ir.VectorType(ir.IntType(1), lanes), vector.as_pointer()
    ending = f"v{lanes}f{64 if isinstance(kind, ir.DoubleType) else 32}.p0"
    load = declared(builder.module, f"llvm.masked.load.{ending}", vector, [pointer, ir.IntType(32), bits, vector])
    store = declared(builder.module, f"llvm.masked.store.{ending}", ir.VoidType(), [vector, pointer, ir.IntType(32), bits])
    return load, store


def either(builder: Any, kind: Any, ways: list[tuple[Any, Any]]) -> Any:
    """Return the value that belongs to the block from which this one is reached."""
    phi = builder.phi(kind)
    for value, block in ways:
        phi.add_incoming(value, block)
    return phi
