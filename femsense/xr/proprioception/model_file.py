"""A model as one ONNX file: its networks as a graph for any runtime, and the rest as metadata.

Inputs of the graph: `readings` (rows, c) and, if the model has a memory, `filtered` (rows, k c). Outputs: `markers` (rows,
3 m) and, for an end-to-end network, `bones` (rows, 9 b). Metadata: the key `femsense` contains JSON.
"""

from __future__ import annotations

import base64
import json
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import InputError
from femsense.io.files import check_target, json_text, write_beside
from femsense.io.own_files import MODEL
from femsense.xr.armature import Armature
from femsense.xr.proprioception.curves import Curve
from femsense.xr.proprioception.domain import Domain
from femsense.xr.proprioception.labelled import AS_MEASURED
from femsense.xr.proprioception.model import ProprioceptiveModel
from femsense.xr.proprioception.network import Network, Units
from femsense.xr.proprioception.spread import Spread

if TYPE_CHECKING:
    from onnx import ModelProto, NodeProto, ValueInfoProto

FORMAT = "femsense-proprioception-1"
KEY = "femsense"
IR_VERSION, OPSET = 8, 13
"""Of 2021: read by every runtime since."""
FILTERS = "lines between rows"
"""Description of the input `filtered`: see `memory`."""
NUMBERS = ("centre", "scale", "B", "b", "A", "C", "d")
TURNED = ("B", "A", "C")
"""Stored so that rows of inputs are multiplied from the left."""
LINE = """
    moved = Sub (x, centre)
    z = Mul (moved, scale)
    linear = MatMul (z, C)
    straight = Add (linear, d)
"""
HIDDEN = """
    Bz = MatMul (z, B)
    a = Add (Bz, b)
"""
DISTANCE = """
    zz = Mul (z, z)
    own = MatMul (zz, half)
    exponent = Add (a, own)
"""
CURVE = """
    curved = MatMul (phi, A)
    y = Add (curved, straight)
"""
GRAPHS = {
    Units.LINEAR: LINE + "y = Identity (straight)",
    Units.SIGMOID: LINE + HIDDEN + "phi = Sigmoid (a)" + CURVE,
    Units.RELU: LINE + HIDDEN + "phi = Relu (a)" + CURVE,
    Units.RADIAL: LINE + HIDDEN + DISTANCE + "phi = Exp (exponent)" + CURVE,
}
"""Operators of a network with inputs x and outputs y; the other names that nothing makes are its constants."""


def save_model(model: ProprioceptiveModel, path: str | Path) -> Path:
    """Write a proprioceptive model as an ONNX file.

    Arguments:
        model: result of `learn`, `adapt` or `load_model`.
        path: the file, with the suffix .onnx. An earlier model there is replaced.

    Returns:
        the path.

    Raises:
        InputError: a file of another kind exists at that path.
    """
    check_target(path, folder=False, kind=MODEL)
    content = _onnx_model(model).SerializeToString()
    with write_beside(path) as target:
        target.write_bytes(content)
    return Path(path)


def load_model(path: str | Path) -> ProprioceptiveModel:
    """Load a proprioceptive model: a network that predicts markers and bones from sensors in the body.

    Prediction needs no onnxruntime.

    Arguments:
        path: an ONNX file that `save_model` or `femsense learn` wrote.

    Returns:
        the model: `model.markers(readings)` for marker positions [m], `model.armature(readings)` for bone poses.

    Raises:
        InputError: the file is missing or of another kind.
    """
    from google.protobuf.message import DecodeError
    from onnx import load_model_from_string, numpy_helper

    try:
        found = load_model_from_string(Path(path).read_bytes())
    except OSError as error:
        raise InputError("cannot be read", where=path, found=error.strerror) from None
    except DecodeError as error:
        raise InputError("not an ONNX model", where=path, found=error, expected="a file of femsense learn") from None
    numbers = {tensor.name: numpy_helper.to_array(tensor) for tensor in found.graph.initializer}
    document = json.loads({item.key: item.value for item in found.metadata_props}.get(KEY, "{}"))
    if document.get("format") != FORMAT:
        raise InputError("not a model of femsense learn", where=path, found=document.get("format"), expected=FORMAT)
    if document["memory_s"] and document.get("filters") != FILTERS:
        raise InputError(
            "a model of an older version, whose filters stepped from row to row",
            where=path,
            hint="learn it again: femsense learn",
        )
    networks = {name: _network(name, kind, numbers) for name, kind in document["networks"].items()}
    curves = (_curve(row) for row in document["domain"].get("curves", ()))  # files of older versions have none
    chain, spread = document["chain"], document.get("spread")
    return ProprioceptiveModel(
        tuple(document["channels"]),
        tuple(document["markers"]),
        networks["markers"],
        tuple(document["memory_s"]),
        Domain(**_read(Domain, document["domain"]) | {"curves": tuple(curves)}),
        None if chain is None else Armature(**_read(Armature, chain)),
        networks.get("bones"),
        document["report"],
        document.get("frame", AS_MEASURED),
        None if spread is None else _spread(spread),
    )


# The graph


def _onnx_model(model: ProprioceptiveModel) -> ModelProto:
    """Return the graph of a model with its constants and metadata."""
    from onnx import TensorProto, helper, numpy_helper

    def rows(name: str, width: int) -> ValueInfoProto:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["rows", width])

    inputs = [rows("readings", len(model.channels))]
    nodes, source, constants = list["NodeProto"](), "readings", []
    if model.memory_s:
        inputs.append(rows("filtered", len(model.channels) * len(model.memory_s)))
        nodes, source = [helper.make_node("Concat", ["readings", "filtered"], ["inputs"], axis=1)], "inputs"
    networks = {"markers": model.network} | ({"bones": model.bones} if model.bones is not None else {})
    for name, network in networks.items():
        own = _nodes(name, network.units, source)
        used = {edge for node in own for edge in node.input}
        stored = {f"{name}.{key}": array for key, array in _stored(network).items()}
        nodes += own
        constants += [numpy_helper.from_array(array, key) for key, array in stored.items() if key in used]
    outputs = [rows(name, len(network.d)) for name, network in networks.items()]
    graph = helper.make_graph(nodes, "femsense", inputs, outputs, constants)
    opset = helper.make_opsetid("", OPSET)
    made = helper.make_model(graph, producer_name="femsense", ir_version=IR_VERSION, opset_imports=[opset])
    helper.set_model_props(made, {KEY: json_text(_document(model, networks), indent=None)})
    return made


def _nodes(name: str, units: Units, source: str) -> list[NodeProto]:
    """Return the operators of one network on the array `source`, with the output `name`; all other names begin with it."""
    from onnx.parser import parse_graph

    graph = parse_graph(f"network (float[n, d] x) => (float[n, o] y) {{ {GRAPHS[units]} }}")
    known = {"x": source, "y": name}
    for node in graph.node:
        node.input[:] = [known.get(edge, f"{name}.{edge}") for edge in node.input]
        node.output[:] = [known.get(edge, f"{name}.{edge}") for edge in node.output]
    return list(graph.node)


def _stored(network: Network) -> dict[str, npt.NDArray[np.float32]]:
    """Return the constants of a graph. Of radial units: −½ |z − B|² = z·B − ½ |B|² − ½ |z|²."""
    numbers = {key: getattr(network, key) for key in NUMBERS}
    if network.units == Units.RADIAL:
        numbers |= {"b": -0.5 * (network.B**2).sum(axis=1), "half": np.full((len(network.centre), 1), -0.5)}
    turned = {key: array.T if key in TURNED else array for key, array in numbers.items()}
    return {key: np.ascontiguousarray(array, dtype=np.float32) for key, array in turned.items()}


def _network(name: str, kind: str, numbers: dict[str, npt.NDArray[np.float32]]) -> Network:
    if kind not in list(Units):
        raise InputError("unknown kind of network", where=name, found=kind, expected=" | ".join(Units))
    wide, high = len(numbers[f"{name}.centre"]), len(numbers[f"{name}.d"])
    none = {"B": np.zeros((wide, 0)), "b": np.zeros(0), "A": np.zeros((0, high))}

    def array(key: str) -> FloatArray:
        stored = numbers.get(f"{name}.{key}", none.get(key))
        if stored is None:
            raise InputError("a constant is missing", where=f"{name}.{key}")
        return freeze(stored.T if key in TURNED else stored)

    return Network(Units(kind), *(array(key) for key in NUMBERS))


# The metadata


def _document(model: ProprioceptiveModel, networks: dict[str, Network]) -> dict[str, Any]:
    curves = [
        {"channel": one.channel, "half": one.half} | {key: getattr(one.network, key) for key in NUMBERS}
        for one in model.domain.curves
    ]
    return {
        "format": FORMAT,
        "channels": model.channels,
        "markers": model.marker_names,
        "frame": model.frame,
        "memory_s": model.memory_s,
        "filters": FILTERS,
        "networks": {name: network.units for name, network in networks.items()},
        "domain": _written(model.domain) | {"curves": curves},
        "chain": None if model.chain is None else _written(model.chain),
        "report": model.report,
        "spread": None if model.spread is None else _spread_table(model.spread),
    }


def _written(thing: Domain | Armature) -> dict[str, Any]:
    return {one.name: getattr(thing, one.name) for one in fields(thing)}


def _read(kind: type[Domain | Armature], table: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a dataclass in a table, lists of numbers as arrays."""
    known = {one.name for one in fields(kind)} - {"curves"}
    return {key: freeze(value) if isinstance(value, list) else value for key, value in table.items() if key in known}


def _curve(row: dict[str, Any]) -> Curve:
    return Curve(row["channel"], Network(Units.RADIAL, *(freeze(row[key]) for key in NUMBERS)), row["half"])


def _spread_table(spread: Spread) -> dict[str, Any]:
    """Return a spread as plain tables; its matrix as float32 in base64, which JSON's digits would make four times as long."""
    root = base64.b64encode(spread.root.astype("<f4").tobytes()).decode("ascii")
    return {"root": root, "kappa": spread.kappa, "quantile_m": spread.quantile}


def _spread(table: dict[str, Any]) -> Spread:
    root = np.frombuffer(base64.b64decode(table["root"]), dtype="<f4").astype(np.float64)
    side = round(len(root) ** 0.5)
    return Spread(freeze(root.reshape(side, side)), float(table["kappa"]), freeze(table["quantile_m"]))
