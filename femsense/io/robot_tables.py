"""The tables of robot.toml, and their checks before the mesh is read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, StringConstraints, model_validator

from femsense.core.errors import InputError
from femsense.core.text import did_you_mean, short
from femsense.io.materials import POISSON_RATIO, silicone
from femsense.io.regions import RegionTable
from femsense.io.tables import Color, LengthUnit, Matrix, Schema, Vector, at_key, doubles, pose_problems, schema_problems
from femsense.model.effects import EFFECT_NAMES

FORMAT = "femsense-robot-1"
Name = Annotated[str, StringConstraints(pattern=r'^[^\s,;"]([^,;"\r\n\t]*[^\s,;"])?$')]
NAME = "a name without commas, semicolons and quotes"
POINT = "three numbers in metres [x, y, z]"


class MeshTable(Schema):
    file: Annotated[str, Field(min_length=1, description="the mesh file next to robot.toml")]
    unit: LengthUnit = Field(description='unit = "m", "cm" or "mm": the unit of the coordinates in the mesh file')
    element: Literal["tet4", "tet10"] = Field(description='element = "tet4" or "tet10"')
    T_robot_mesh: Matrix | None = Field(None, description="4 rows of 4 numbers: a rotation and a translation in metres")


class MaterialTable(Schema):
    name: str | None = Field(None, description="a silicone of femsense.io.materials; other keys override its values")
    young_modulus_pa: float = Field(gt=0, description="Young's modulus in pascal, > 0, such as 150e3 for soft silicone")
    poisson_ratio: float = Field(gt=-1, lt=0.5, description="Poisson's ratio, −1 < ν < 0.5, such as 0.45 or 0.49 for silicone")
    density_kg_m3: float = Field(gt=0, description="density in kg/m³, > 0, such as 1070 for silicone")

    @model_validator(mode="before")
    @classmethod
    def _named(cls, table: Any) -> Any:
        """Fill the missing keys of the table with the values of a named silicone."""
        if not isinstance(table, dict) or not isinstance(table.get("name"), str):
            return table
        try:
            material = silicone(table["name"])
        except InputError as error:
            raise ValueError(f"unknown material {table['name']!r}; known are {error.expected}") from None
        known = {
            "young_modulus_pa": material.young_modulus_pa,
            "poisson_ratio": POISSON_RATIO,
            "density_kg_m3": material.density_kg_m3,
        }
        return {**{key: value for key, value in known.items() if value is not None}, **table}


class GravityTable(Schema):
    vector_m_s2: Vector = Field(description="three numbers in m/s², such as [0, 0, -9.81]")


class FixedTable(Schema):
    box_m: Annotated[list[Vector], Field(min_length=2, max_length=2)] = Field(
        description="two corners in metres: [[x, y, z], [x, y, z]]"
    )


class CableTable(Schema):
    name: Name = Field(description=NAME)
    path_m: Annotated[list[Vector], Field(min_length=1)] = Field(
        description="points of the body in metres, far end first: [[x, y, z], …]"
    )
    pull_point_m: Vector = Field(description=POINT)
    exit_direction: Vector | None = Field(None, description="a direction [x, y, z] that is not zero")
    min_tension_n: float = Field(0.0, description="least tension in newton, not above max_tension_n")
    max_tension_n: Annotated[float, Field(allow_inf_nan=True)] = Field(np.inf, description="largest tension in newton")


class ChamberTable(Schema):
    name: Name = Field(description=NAME)
    seed_m: Vector = Field(description=POINT)
    max_pressure_pa: float = Field(gt=0, description="largest pressure in pascal, > 0")


class MarkerTable(Schema):
    name: Name = Field(description=NAME)
    position_m: Vector = Field(description=POINT)
    aruco_id: int | None = Field(
        None,
        ge=0,
        description="number of the ArUco tag whose middle the marker is; read from colour images with registered depth",
    )
    color_rgb: Color | None = Field(
        None,
        description="colour of the dot whose middle the marker is: [red, green, blue] from 0 to 1; several markers may share one",
    )


class FeaturesTable(Schema):
    count: int = Field(51, ge=1, description="number of feature points, ≥ 1")


class AppearanceTable(Schema):
    color_rgb: Color | None = Field(None, description="three numbers from 0 to 1: [red, green, blue]")
    aruco_dictionary: str = Field("4X4_50", description="dictionary of the ArUco tags, as OpenCV names it without DICT_")


class CorrectionTable(Schema):
    file: Annotated[str, Field(min_length=1, description="the file of the correction next to robot.toml")]


class RobotTable(Schema):
    """robot.toml, version femsense-robot-1."""

    format: Literal["femsense-robot-1"] = Field(description=f'format = "{FORMAT}"')
    name: Annotated[str, Field(min_length=1)] = Field(description="the robot's name")
    mesh: MeshTable = Field(description="a table [mesh] with file, unit and element")
    material: MaterialTable = Field(description="a table [material] with young_modulus_pa, poisson_ratio and density_kg_m3")
    gravity: GravityTable | None = Field(None, description="a table [gravity] with vector_m_s2")
    fixed: Annotated[list[FixedTable], Field(min_length=1)] = Field(
        description="at least one [[fixed]] with box_m: a body without a clamp has no equilibrium that could be computed"
    )
    cables: list[CableTable] = Field([], description="tables [[cables]]")
    chambers: list[ChamberTable] = Field([], description="tables [[chambers]]")
    regions: list[RegionTable] = Field([], description="tables [[regions]] with a place and young_modulus_pa or poisson_ratio")
    markers: list[MarkerTable] = Field([], description="tables [[markers]]")
    features: FeaturesTable = Field(default_factory=lambda: FeaturesTable(count=51), description="a table [features] with count")
    appearance: AppearanceTable = Field(
        default_factory=lambda: AppearanceTable(color_rgb=None, aruco_dictionary="4X4_50"),
        description="a table [appearance] with color_rgb and aruco_dictionary",
    )
    effects: list[dict[str, Any]] = Field([], description="tables [[effects]] with a name")
    correction: CorrectionTable | None = Field(None, description="a table [correction] with file, of femsense improve --correct")


def robot_problems(document: dict[str, Any], path: Path) -> list[InputError]:
    """Return everything that is wrong with the tables of a robot.toml, before the mesh is read."""
    problems = schema_problems(RobotTable, document, path)
    return problems or list(table_problems(RobotTable.model_validate(document), path))


def table_problems(table: RobotTable, path: Path) -> Iterator[InputError]:
    """Yield the problems that single keys do not show: double names, reversed limits, no rotation, unknown effects."""
    yield from doubles([cable.name for cable in table.cables], "name", path, "cables", "name")
    yield from doubles([chamber.name for chamber in table.chambers], "name", path, "chambers", "name")
    yield from doubles([marker.name for marker in table.markers], "name", path, "markers", "name")
    for i, box in enumerate(table.fixed):
        low, high = np.asarray(box.box_m)
        if (low > high).any():
            yield InputError(
                "the corners of the box are not in order",
                where=at_key(path, "fixed", i, "box_m"),
                found=box.box_m,
                expected="[smallest x, y, z], then [largest x, y, z]",
            )
    yield from doubles([marker.aruco_id for marker in table.markers], "tag", path, "markers", "aruco_id")
    for i, cable in enumerate(table.cables):
        yield from _cable_problems(cable, i, path)
    for i, entry in enumerate(table.effects):
        yield from _effect_problems(entry, i, path)
    yield from _dictionary_problems(table.appearance.aruco_dictionary, path)
    yield from pose_problems(table.mesh.T_robot_mesh, at_key(path, "mesh", "T_robot_mesh"))


DICTIONARIES = (
    *(f"{n}X{n}_{count}" for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)),
    "ARUCO_ORIGINAL",
    "ARUCO_MIP_36h12",
    "APRILTAG_16h5",
    "APRILTAG_25h9",
    "APRILTAG_36h10",
    "APRILTAG_36h11",
)
"""Dictionaries of tags, as OpenCV names them without DICT_."""


def plain_dictionary(name: str) -> str:
    """Return the name of a dictionary of tags without OpenCV's DICT_, its letters as OpenCV has them."""
    bare = name.strip().upper().removeprefix("DICT_")
    return next((known for known in DICTIONARIES if known.upper() == bare), name)


def _dictionary_problems(name: str, path: Path) -> Iterator[InputError]:
    if plain_dictionary(name) not in DICTIONARIES:
        yield InputError(
            "unknown dictionary of tags",
            where=at_key(path, "appearance", "aruco_dictionary"),
            found=repr(name),
            expected=" | ".join(DICTIONARIES),
            hint=did_you_mean(name, DICTIONARIES),
        )


def _cable_problems(cable: CableTable, i: int, path: Path) -> Iterator[InputError]:
    if not cable.min_tension_n <= cable.max_tension_n:
        yield InputError(
            "the least tension is above the largest",
            where=at_key(path, "cables", i, "min_tension_n"),
            found=f"min {cable.min_tension_n} N, max {cable.max_tension_n} N",
            expected="min_tension_n ≤ max_tension_n",
        )
    if cable.exit_direction is not None and not np.any(cable.exit_direction):
        yield InputError(
            "has no length",
            where=at_key(path, "cables", i, "exit_direction"),
            found=cable.exit_direction,
            expected="a direction [x, y, z] that is not zero",
        )


def _effect_problems(entry: Mapping[str, Any], i: int, path: Path) -> Iterator[InputError]:
    where, expected = at_key(path, "effects", i, "name"), " | ".join(EFFECT_NAMES)
    if "name" not in entry:
        yield InputError("a required key is missing", where=where, found="nothing", expected=expected)
    elif entry["name"] not in EFFECT_NAMES and "file" not in entry:
        hint = did_you_mean(str(entry["name"]), EFFECT_NAMES)
        yield InputError("unknown effect", where=where, found=short(entry["name"]), expected=expected, hint=hint)
