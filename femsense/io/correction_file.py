"""correction.json: the empirical correction of a robot, written and read."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import InputError
from femsense.io.files import write_json
from femsense.io.result_folder import read_document
from femsense.io.tables import Schema, validated
from femsense.model.marker_correction import Correction

FORMAT = "femsense-correction-1"
FILE = "correction.json"
Rows = list[list[float]]


class CorrectionTable(Schema):
    """correction.json, version femsense-correction-1."""

    format: Literal["femsense-correction-1"] = Field(description=f'format = "{FORMAT}"')
    kernel: Literal["each input by itself", "all inputs together"] = Field(description="of which inputs a term is a function")
    length: float = Field(gt=0, description="of the kernel, in ranges of an input")
    control: Literal["tension", "displacement"] = Field(description="the quantity of the cable inputs")
    inputs: list[str] = Field(description="names of cables, then of chambers")
    ranges: list[float] = Field(description="of the inputs [N], [m] or [Pa]")
    markers: list[str] = Field(description="names of the markers")
    states: Rows = Field(description="inputs that it was learned from, in their ranges: a row a state")
    basis: Rows = Field(description="from the kernel to the terms: a row a state")
    weights_m: list[Rows] = Field(description="for each term a row of three numbers a marker")
    covariance_m2: Rows = Field(description="of the weights of one axis")
    noise_m: float = Field(ge=0, description="what it leaves of a marker along each axis")


def write_correction(correction: Correction, folder: Path) -> str:
    """Write correction.json into a folder and return its name."""
    c = correction
    document = {"format": FORMAT, "kernel": c.kernel, "length": c.length, "control": c.control, "inputs": c.input_names}
    document |= {"ranges": c.ranges, "markers": c.marker_names, "states": c.states, "basis": c.basis}
    document |= {"weights_m": c.weights, "covariance_m2": c.covariance, "noise_m": c.noise}
    write_json(folder / FILE, document)
    return FILE


def read_correction(path: Path) -> Correction:
    """Read correction.json. Raises InputError."""
    t = validated(CorrectionTable, read_document(path, FORMAT), path)
    n, a, q, m = len(t.states), len(t.inputs), len(t.weights_m), len(t.markers)
    return Correction(
        kernel=t.kernel,
        length=t.length,
        control=t.control,
        input_names=tuple(t.inputs),
        ranges=_shaped(t.ranges, (a,), path, "ranges"),
        marker_names=tuple(t.markers),
        states=_shaped(t.states, (n, a), path, "states"),
        basis=_shaped(t.basis, (n, q), path, "basis"),
        weights=_shaped(t.weights_m, (q, m, 3), path, "weights_m"),
        covariance=_shaped(t.covariance_m2, (q, q), path, "covariance_m2"),
        noise=t.noise_m,
    )


def _shaped(values: object, shape: tuple[int, ...], path: Path, key: str) -> FloatArray:
    try:
        array = np.array(values, dtype=np.float64)
    except ValueError:
        array = np.zeros(0)
    if array.shape != shape:
        raise InputError(
            "numbers of another shape",
            where=f"{path}: {key}",
            found=f"{array.shape}" if array.size else "rows of different lengths, or none",
            expected=f"{shape}",
            hint="the file is written whole by femsense improve --correct",
        )
    return freeze(array)
