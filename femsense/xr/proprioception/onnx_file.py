"""The ONNX file of a model: the graph of its networks, their constants, and metadata."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from femsense.core.errors import InputError
from femsense.io.files import write_beside
from femsense.xr.proprioception.network import Units

if TYPE_CHECKING:
    from onnx import NodeProto, ValueInfoProto

IR_VERSION, OPSET = 8, 13
"""Of 2021: read by every runtime since."""
Numbers = Mapping[str, npt.NDArray[np.float32]]
"""Constants by name."""


def write_onnx(
    path: str | Path,
    nodes: Sequence[NodeProto],
    numbers: Numbers,
    *,
    inputs: Mapping[str, int],
    outputs: Mapping[str, int],
    text: Mapping[str, str],
) -> None:
    """Write a graph with metadata, under a temporary name that is renamed at the end.

    Arguments:
        path: path of the file.
        nodes, numbers: operators in order, and their constants.
        inputs, outputs: name → width; every array is (rows, width).
        text: metadata.
    """
    from onnx import TensorProto, helper, numpy_helper

    def arrays(widths: Mapping[str, int]) -> list[ValueInfoProto]:
        return [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["rows", width]) for name, width in widths.items()]

    constants = [numpy_helper.from_array(np.ascontiguousarray(array), name) for name, array in numbers.items()]
    graph = helper.make_graph(nodes, "femsense", arrays(inputs), arrays(outputs), constants)
    opset = helper.make_opsetid("", OPSET)
    model = helper.make_model(graph, producer_name="femsense", ir_version=IR_VERSION, opset_imports=[opset])
    helper.set_model_props(model, dict(text))
    with write_beside(path) as target:
        target.write_bytes(model.SerializeToString())


def read_onnx(path: str | Path) -> tuple[dict[str, npt.NDArray[np.float32]], dict[str, str]]:
    """Return the constants and the metadata of an ONNX file. Raises InputError if it is not one."""
    from google.protobuf.message import DecodeError
    from onnx import load_model_from_string, numpy_helper

    try:
        model = load_model_from_string(Path(path).read_bytes())
    except OSError as error:
        raise InputError("cannot be read", where=path, found=error.strerror) from None
    except DecodeError as error:
        raise InputError("not an ONNX model", where=path, found=error, expected="a file of femsense learn") from None
    numbers = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
    return numbers, {item.key: item.value for item in model.metadata_props}


def network_nodes(name: str, units: Units, source: str) -> tuple[list[NodeProto], list[str]]:
    """Return the operators of one network of `proprioception.network` on the array `source`, and the names of its constants.

    The output is called `name`; its constants are `name.centre`, `name.scale`, `name.B` and so on.
    """
    from onnx.helper import make_node

    steps = list(_steps(units))
    arrays = {"x": source, "y": name}
    nodes = [
        make_node(kind, [arrays.get(key, f"{name}.{key}") for key in of], [arrays.get(to, f"{name}.{to}")])
        for to, kind, *of in steps
    ]
    made = {to for to, *_ in steps} | {"x"}
    return nodes, list(dict.fromkeys(key for _, _, *of in steps for key in of if key not in made))


def _steps(units: Units) -> Iterator[tuple[str, ...]]:
    """Yield the operators of a network with inputs x and outputs y: result, operator, operands."""
    yield "moved", "Sub", "x", "centre"
    yield "z", "Mul", "moved", "scale"
    yield "linear", "MatMul", "z", "C"
    if units == Units.LINEAR:
        yield "y", "Add", "linear", "d"
        return
    yield "straight", "Add", "linear", "d"
    yield "Bz", "MatMul", "z", "B"
    yield "a", "Add", "Bz", "b"
    if units == Units.RADIAL:
        yield "zz", "Mul", "z", "z"
        yield "own", "MatMul", "zz", "half"
        yield "exponent", "Add", "a", "own"
        yield "phi", "Exp", "exponent"
    else:
        yield "phi", "Relu" if units == Units.RELU else "Sigmoid", "a"
    yield "curved", "MatMul", "phi", "A"
    yield "y", "Add", "curved", "straight"
