"""A small subset of ONNX, written and read without a library: a graph of a few operators, its constants, and metadata.

The fields are those of onnx/onnx.proto, in the wire format of Protocol Buffers (a key of field · 8 + type,
then a varint or bytes).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from femsense.core.errors import InputError
from femsense.io.files import write_beside

IR_VERSION, OPSET = 8, 13
"""Of 2021: read by every runtime since."""
FLOAT = 1
VARINT, BYTES = 0, 2
MODEL_IR, MODEL_PRODUCER, MODEL_GRAPH, MODEL_OPSET, MODEL_META = 1, 2, 7, 8, 14
GRAPH_NODE, GRAPH_NAME, GRAPH_INITIALIZER, GRAPH_INPUT, GRAPH_OUTPUT = 1, 2, 5, 11, 12
TENSOR_DIMS, TENSOR_TYPE, TENSOR_NAME, TENSOR_RAW = 1, 2, 8, 9


@dataclass(frozen=True, eq=False, slots=True)
class Node:
    """One operator of a graph."""

    kind: str
    inputs: tuple[str, ...]
    output: str
    integers: Mapping[str, int] = field(default_factory=dict)
    """Its attributes."""


@dataclass(frozen=True, eq=False, slots=True)
class Graph:
    """Operators in order, with their inputs and outputs; every array is (rows, width)."""

    nodes: tuple[Node, ...]
    inputs: Mapping[str, int]
    """Name → width."""
    outputs: Mapping[str, int]
    numbers: Mapping[str, npt.NDArray[np.float32]]
    """Constants by name."""


def write_onnx(path: str | Path, graph: Graph, text: Mapping[str, str]) -> None:
    """Write a graph with metadata, under a temporary name that is renamed at the end."""
    parts = [_bytes(GRAPH_NODE, _node(node)) for node in graph.nodes]
    parts.append(_text(GRAPH_NAME, "femsense"))
    parts += [_bytes(GRAPH_INITIALIZER, _tensor(name, array)) for name, array in graph.numbers.items()]
    parts += [_bytes(GRAPH_INPUT, _value(name, width)) for name, width in graph.inputs.items()]
    parts += [_bytes(GRAPH_OUTPUT, _value(name, width)) for name, width in graph.outputs.items()]
    model = [_number(MODEL_IR, IR_VERSION), _text(MODEL_PRODUCER, "femsense"), _bytes(MODEL_GRAPH, b"".join(parts))]
    model.append(_bytes(MODEL_OPSET, _text(1, "") + _number(2, OPSET)))
    model += [_bytes(MODEL_META, _text(1, key) + _text(2, value)) for key, value in text.items()]
    with write_beside(path) as target:
        target.write_bytes(b"".join(model))


def read_onnx(path: str | Path) -> tuple[dict[str, npt.NDArray[np.float32]], dict[str, str]]:
    """Return the constants and the metadata of an ONNX file. Raises InputError if it is not one."""
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise InputError("cannot be read", where=path, found=error.strerror) from None
    numbers: dict[str, npt.NDArray[np.float32]] = {}
    text: dict[str, str] = {}
    try:
        for number, value in _fields(data):
            if number == MODEL_META:
                entry = dict(_fields(_as_bytes(value)))
                text[_as_bytes(entry[1]).decode()] = _as_bytes(entry[2]).decode()
            elif number == MODEL_GRAPH:
                tensors = [_as_bytes(inner) for key, inner in _fields(_as_bytes(value)) if key == GRAPH_INITIALIZER]
                numbers.update(_read_tensor(tensor) for tensor in tensors)
    except (ValueError, KeyError, IndexError, TypeError) as error:
        raise InputError(
            "not an ONNX model", where=path, found=str(error) or type(error).__name__, expected="a file of femsense learn"
        ) from None
    return numbers, text


# ---- writing --------------------------------------------------------------------------------------------------------


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _number(number: int, value: int) -> bytes:
    return _varint(number << 3 | VARINT) + _varint(value)


def _bytes(number: int, content: bytes) -> bytes:
    return _varint(number << 3 | BYTES) + _varint(len(content)) + content


def _text(number: int, text: str) -> bytes:
    return _bytes(number, text.encode())


def _node(node: Node) -> bytes:
    parts = [_text(1, name) for name in node.inputs] + [_text(2, node.output), _text(4, node.kind)]
    parts += [_bytes(5, _text(1, key) + _number(3, value) + _number(20, 2)) for key, value in node.integers.items()]
    return b"".join(parts)


def _tensor(name: str, array: npt.NDArray[np.float32]) -> bytes:
    dims = b"".join(_number(TENSOR_DIMS, size) for size in array.shape)
    raw = np.ascontiguousarray(array, dtype="<f4").tobytes()
    return dims + _number(TENSOR_TYPE, FLOAT) + _text(TENSOR_NAME, name) + _bytes(TENSOR_RAW, raw)


def _value(name: str, width: int) -> bytes:
    shape = _bytes(1, _text(2, "rows")) + _bytes(1, _number(1, width))
    return _text(1, name) + _bytes(2, _bytes(1, _number(1, FLOAT) + _bytes(2, shape)))


# ---- reading --------------------------------------------------------------------------------------------------------


def _fields(data: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Yield (field number, varint or bytes) of a message. Raises ValueError if it is truncated or of another kind."""
    at = 0
    while at < len(data):
        key, at = _read_varint(data, at)
        size = {1: 8, 5: 4}.get(key & 7, 0)
        if key & 7 == VARINT:
            value, at = _read_varint(data, at)
            yield key >> 3, value
            continue
        if key & 7 == BYTES:
            size, at = _read_varint(data, at)
        elif not size:
            raise ValueError(f"byte {at} begins no field of a model")
        if at + size > len(data):
            raise ValueError("the file ends too early")
        yield key >> 3, data[at : at + size]
        at += size


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while data[at] & 0x80:
        value |= (data[at] & 0x7F) << shift
        shift, at = shift + 7, at + 1
    return value | data[at] << shift, at + 1


def _as_bytes(value: int | bytes) -> bytes:
    if not isinstance(value, bytes):
        raise ValueError("a number where a message is expected")
    return value


def _read_tensor(tensor: bytes) -> tuple[str, npt.NDArray[np.float32]]:
    shape: list[int] = []
    content: dict[int, int | bytes] = {}
    for number, value in _fields(tensor):
        if number == TENSOR_DIMS and isinstance(value, int):
            shape.append(value)
        content[number] = value
    if content[TENSOR_TYPE] != FLOAT:
        raise ValueError(f"numbers of type {content[TENSOR_TYPE]!r} (expected 1, float)")
    array = np.frombuffer(_as_bytes(content[TENSOR_RAW]), dtype="<f4").reshape(shape)
    return _as_bytes(content[TENSOR_NAME]).decode(), array


def network_nodes(name: str, kind: str, source: str) -> tuple[Sequence[Node], Sequence[str]]:
    """Return the operators of one network of `proprioception.network` on the array `source`, and the names of its constants.

    The output is called `name`; its constants are `name.centre`, `name.scale`, `name.B` and so on, as in `network_numbers`.
    """
    n = name
    nodes = [Node("Sub", (source, f"{n}.centre"), f"{n}.moved"), Node("Mul", (f"{n}.moved", f"{n}.scale"), f"{n}.z")]
    nodes += [Node("MatMul", (f"{n}.z", f"{n}.C"), f"{n}.linear"), Node("Add", (f"{n}.linear", f"{n}.d"), n + ".straight")]
    constants = ["centre", "scale", "C", "d"]
    if kind == "linear":
        return [*nodes, Node("Identity", (f"{n}.straight",), n)], constants
    nodes += [Node("MatMul", (f"{n}.z", f"{n}.B"), f"{n}.Bz"), Node("Add", (f"{n}.Bz", f"{n}.b"), f"{n}.a")]
    if kind == "radial":
        nodes += [Node("Mul", (f"{n}.z", f"{n}.z"), f"{n}.zz"), Node("MatMul", (f"{n}.zz", f"{n}.half"), f"{n}.own")]
        nodes += [Node("Add", (f"{n}.a", f"{n}.own"), f"{n}.exponent"), Node("Exp", (f"{n}.exponent",), f"{n}.phi")]
        constants.append("half")
    else:
        nodes.append(Node("Relu" if kind == "relu" else "Sigmoid", (f"{n}.a",), f"{n}.phi"))
    nodes += [Node("MatMul", (f"{n}.phi", f"{n}.A"), f"{n}.curved"), Node("Add", (f"{n}.curved", f"{n}.straight"), n)]
    return nodes, [*constants, "A", "B", "b"]
