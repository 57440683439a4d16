"""Parts of a body that are made of another material: the tables [[regions]] of robot.toml.

An element belongs to a region if its centroid at rest (of its four corners) is in the box or sphere, or if the mesh file's cell data have
the value. Of overlapping regions the last one counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from femsense.core.arrays import BoolArray, FloatArray
from femsense.core.errors import InputError
from femsense.fem.mesh import TetMesh
from femsense.io.mesh_files import tet_values
from femsense.io.tables import Schema, Vector


class RegionTable(Schema):
    box_m: Annotated[list[Vector], Field(min_length=2, max_length=2)] | None = Field(
        None, description="two corners in metres: [[x, y, z], [x, y, z]]"
    )
    center_m: Vector | None = Field(None, description="centre of a sphere in metres [x, y, z], with radius_m")
    radius_m: float | None = Field(None, gt=0, description="radius of the sphere in metres, > 0, with center_m")
    cells: str | None = Field(None, description="the name of an array of cell data in the mesh file, with value")
    value: int | None = Field(None, description="the cells with this value in that array")
    young_modulus_pa: float | None = Field(None, gt=0, description="Young's modulus of the region in pascal, > 0")
    poisson_ratio: float | None = Field(None, gt=-1, lt=0.5, description="Poisson's ratio of the region, −1 < ν < 0.5")

    @model_validator(mode="after")
    def _says_where_and_what(self) -> RegionTable:
        ways = [self.box_m is not None, self.center_m is not None, self.cells is not None]
        if sum(ways) != 1 or (self.center_m is None) != (self.radius_m is None) or (self.cells is None) != (self.value is None):
            raise ValueError("a region is a box_m, or center_m with radius_m, or cells with value")
        if self.young_modulus_pa is None and self.poisson_ratio is None:
            raise ValueError("a region needs its own young_modulus_pa or poisson_ratio")
        return self


def regional(
    mesh: TetMesh, regions: Sequence[RegionTable], file: Path, path: Path, E: float, nu: float
) -> tuple[FloatArray, FloatArray]:
    """Return Young's modulus [Pa] and Poisson's ratio of each element, shapes (m,).

    Arguments:
        mesh: the mesh at rest, elements in the order of its file.
        regions: the tables.
        file: the mesh file, for its cell data.
        path: robot.toml, for messages.
        E: modulus outside of all regions [Pa].
        nu: Poisson's ratio outside of all regions.

    Raises:
        InputError: a region that holds no element; cell data that are not there.
    """
    moduli, ratios = np.full(len(mesh.tets), E), np.full(len(mesh.tets), nu)
    centroids = mesh.nodes[mesh.tets[:, :4]].mean(axis=1)
    for i, region in enumerate(regions):
        inside = _inside(region, centroids, file, f"{path}: regions[{i}]")
        if not inside.any():
            raise InputError(
                "no element has its centroid in the region",
                where=f"{path}: regions[{i}]",
                expected="a part of the body",
                hint=f"the body spans {centroids.min(axis=0).round(4).tolist()} to {centroids.max(axis=0).round(4).tolist()} m",
            )
        if region.young_modulus_pa is not None:
            moduli[inside] = region.young_modulus_pa
        if region.poisson_ratio is not None:
            ratios[inside] = region.poisson_ratio
    return moduli, ratios


def _inside(region: RegionTable, centroids: FloatArray, file: Path, where: str) -> BoolArray:
    if region.box_m is not None:
        low, high = np.asarray(region.box_m)
        return np.asarray(((centroids >= low) & (centroids <= high)).all(axis=1))
    if region.center_m is not None:
        return np.asarray(np.linalg.norm(centroids - region.center_m, axis=1) <= region.radius_m)
    values = tet_values(file, str(region.cells), where)
    if len(values) != len(centroids):
        raise InputError(
            "the cell data do not fit the elements",
            where=where,
            found=values.shape,
            expected=f"one number for each of {len(centroids)} tetrahedra",
        )
    return np.asarray((values == region.value).any(axis=1))
