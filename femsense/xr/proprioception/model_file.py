"""A model as one ONNX file: its networks as a graph for any runtime, and the rest as metadata.

Inputs of the graph: `readings` (rows, c) and, if the model has a memory, `filtered` (rows, k c). Outputs: `markers` (rows,
3 m) and, for an end-to-end network, `bones` (rows, 9 b). Metadata: the key `femsense` contains JSON.
"""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import InputError
from femsense.io.files import check_target, json_text
from femsense.io.own_files import MODEL
from femsense.xr.armature import Armature
from femsense.xr.proprioception.curves import Curve
from femsense.xr.proprioception.domain import Domain
from femsense.xr.proprioception.labelled import AS_MEASURED
from femsense.xr.proprioception.model import ProprioceptiveModel
from femsense.xr.proprioception.network import Network, Units
from femsense.xr.proprioception.onnx_file import network_nodes, read_onnx, write_onnx
from femsense.xr.proprioception.spread import Spread

FORMAT = "femsense-proprioception-1"
KEY = "femsense"
FILTERS = "lines between rows"
"""Description of the input `filtered`: see `memory`."""
NUMBERS = ("centre", "scale", "B", "b", "A", "C", "d")
TURNED = ("B", "A", "C")
"""Stored so that rows of inputs are multiplied from the left."""
DOMAIN = ("low", "high", "centre", "scale", "precision", "limit")
CHAIN = ("rest_points", "knots", "at", "normal", "tangent")


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
    from onnx.helper import make_node

    check_target(path, folder=False, kind=MODEL)
    width = len(model.channels)
    inputs = {"readings": width}
    nodes = []
    source = "readings"
    if model.memory_s:
        inputs["filtered"] = width * len(model.memory_s)
        nodes.append(make_node("Concat", ["readings", "filtered"], ["inputs"], axis=1))
        source = "inputs"
    networks = {"markers": model.network} | ({"bones": model.bones} if model.bones is not None else {})
    numbers: dict[str, npt.NDArray[np.float32]] = {}
    for name, network in networks.items():
        found, constants = network_nodes(name, network.units, source)
        nodes += found
        stored = _stored(network)
        numbers |= {f"{name}.{key}": stored[key] for key in constants}
    outputs = {name: len(network.d) for name, network in networks.items()}
    text = {KEY: json_text(_document(model, networks), indent=None)}
    write_onnx(path, nodes, numbers, inputs=inputs, outputs=outputs, text=text)
    return Path(path)


def load_model(path: str | Path) -> ProprioceptiveModel:
    """Load a proprioceptive model: a network that predicts markers and bones from sensors in the body.

    Loading and prediction need neither onnx nor onnxruntime.

    Arguments:
        path: an ONNX file that `save_model` or `femsense learn` wrote.

    Returns:
        the model: `model.markers(readings)` for marker positions [m], `model.armature(readings)` for bone poses.

    Raises:
        InputError: the file is missing or of another kind.
    """
    numbers, text = read_onnx(path)
    document = json.loads(text.get(KEY, "{}"))
    if document.get("format") != FORMAT:
        raise InputError("not a model of femsense learn", where=path, found=document.get("format"), expected=FORMAT)
    if document["memory_s"] and document.get("filters") != FILTERS:
        raise InputError(
            "a model of an older version, whose filters stepped from row to row",
            where=path,
            hint="learn it again: femsense learn",
        )
    chain = document["chain"]
    return ProprioceptiveModel(
        tuple(document["channels"]),
        tuple(document["markers"]),
        _network("markers", document["networks"]["markers"], numbers),
        tuple(document["memory_s"]),
        _domain(document["domain"]),
        None if chain is None else _chain(chain),
        _network("bones", document["networks"]["bones"], numbers) if "bones" in document["networks"] else None,
        document["report"],
        document.get("frame", AS_MEASURED),
        _spread(document.get("spread")),
    )


def _chain(chain: dict[str, Any]) -> Armature:
    points, knots, at, normal, tangent = (freeze(chain[key]) for key in CHAIN)
    return Armature(points, knots, at, normal, tangent, chain["planar"], chain["inextensible"])


def _domain(table: dict[str, Any]) -> Domain:
    """Return a domain; files of older versions hold no curves."""
    curves = (
        Curve(row["channel"], Network(Units.RADIAL, *(freeze(row[key]) for key in NUMBERS)), row["half"])
        for row in table.get("curves", ())
    )
    low, high, centre, scale, precision, limit = (freeze(table[key]) for key in DOMAIN)
    return Domain(low, high, centre, scale, precision, limit, tuple(curves))


def _domain_table(domain: Domain) -> dict[str, Any]:
    curves = [
        {"channel": one.channel, "half": one.half} | {key: getattr(one.network, key) for key in NUMBERS} for one in domain.curves
    ]
    return {key: getattr(domain, key) for key in DOMAIN} | {"curves": curves}


def _document(model: ProprioceptiveModel, networks: dict[str, Network]) -> dict[str, Any]:
    chain = model.chain
    return {
        "format": FORMAT,
        "channels": model.channels,
        "markers": model.marker_names,
        "frame": model.frame,
        "memory_s": model.memory_s,
        "filters": FILTERS,
        "networks": {name: network.units for name, network in networks.items()},
        "domain": _domain_table(model.domain),
        "chain": None
        if chain is None
        else {key: getattr(chain, key) for key in CHAIN} | {"planar": chain.planar, "inextensible": chain.inextensible},
        "report": model.report,
        "spread": None if model.spread is None else _spread_table(model.spread),
    }


def _spread_table(spread: Spread) -> dict[str, Any]:
    """Return a spread as plain tables; its matrix as float32 in base64, which JSON's digits would make four times as long."""
    root = base64.b64encode(spread.root.astype("<f4").tobytes()).decode("ascii")
    return {"root": root, "kappa": spread.kappa, "quantile_m": spread.quantile}


def _spread(table: dict[str, Any] | None) -> Spread | None:
    if table is None:
        return None
    root = np.frombuffer(base64.b64decode(table["root"]), dtype="<f4").astype(np.float64)
    side = round(len(root) ** 0.5)
    return Spread(freeze(root.reshape(side, side)), float(table["kappa"]), freeze(table["quantile_m"]))


def _stored(network: Network) -> dict[str, npt.NDArray[np.float32]]:
    """Return the constants of a graph. Of radial units: −½ |z − B|² = z·B − ½ |B|² − ½ |z|²."""
    numbers = {key: getattr(network, key) for key in NUMBERS}
    if network.units == Units.RADIAL:
        numbers |= {"b": -0.5 * (network.B**2).sum(axis=1), "half": np.full((len(network.centre), 1), -0.5)}
    return {key: np.asarray(array.T if key in TURNED else array, dtype=np.float32) for key, array in numbers.items()}


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
