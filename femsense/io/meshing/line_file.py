"""The text that describes a body along a line: its tables, and the body that they mean (docs/guides/bodies.md)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import InputError
from femsense.io.meshing.channels import Channel
from femsense.io.meshing.line_body import Cavity, Fold, LineBody
from femsense.io.meshing.line_sections import Section, equal_section
from femsense.io.robot_tables import GravityTable, MaterialTable, Name
from femsense.io.tables import NotNegative, Positive, Schema, Vector, at_key, read_toml, validated

FORMAT = "femsense-line-1"
PER_METRE = 1000.0
Pair = Annotated[list[float], Field(min_length=2, max_length=2)]
Sections = Annotated[list["SectionTable"], Field(min_length=2)]


class SectionTable(Schema):
    at_mm: Vector = Field(description="a point of the centre line in millimetres: [x, y, z]")
    radius_mm: Positive | None = Field(None, description="outer radius in millimetres, > 0")
    bore_mm: NotNegative = Field(0.0, description="radius of a hole around the axis in millimetres")
    width_mm: Positive | None = Field(None, description="of a rectangle, along angle 0, in millimetres, with height_mm")
    height_mm: Positive | None = Field(None, description="of a rectangle, along 90°, in millimetres, with width_mm")
    area_mm2: Positive | None = Field(None, description="area of the true section, with second_moment_mm4")
    second_moment_mm4: Positive | Annotated[list[Positive], Field(min_length=2, max_length=2)] | None = Field(
        None, description="∫x² dA of the true section in mm⁴, or [∫x² dA, ∫y² dA] with x along angle 0"
    )

    @model_validator(mode="after")
    def _is_one_shape(self) -> SectionTable:
        pairs: dict[str, tuple[object, object]] = {"width_mm and height_mm": (self.width_mm, self.height_mm)}
        pairs["area_mm2 and second_moment_mm4"] = (self.area_mm2, self.second_moment_mm4)
        for names, values in pairs.items():
            if (values[0] is None) != (values[1] is None):
                raise ValueError(f"{names} belong together")
        if sum([self.radius_mm is not None, self.width_mm is not None, self.area_mm2 is not None]) != 1:
            raise ValueError("a section has radius_mm, or width_mm and height_mm, or area_mm2 and second_moment_mm4")
        least = min(0.5 * (self.width_mm or np.inf), 0.5 * (self.height_mm or np.inf), self.radius_mm or np.inf)
        if self.bore_mm and (self.area_mm2 is not None or self.bore_mm >= least):
            raise ValueError("a bore is smaller than radius_mm, or half of width_mm and height_mm")
        return self


class TendonTable(Schema):
    name: Name = Field(description="a name without commas, semicolons and quotes")
    distance_mm: float | Pair = Field(description="distance from the axis in millimetres, or [at start_mm, at end_mm]")
    angle_deg: float | Pair = Field(0.0, description="angle about the axis in degrees, or [at start_mm, at end_mm]")
    start_mm: float = Field(0.0, description="length along the line where the channel begins, in millimetres")
    end_mm: Positive | None = Field(None, description="length along the line where the tendon is fixed; by default the end")
    pull_mm: Vector | None = Field(None, description="where it leaves to its motor, fixed in space: [x, y, z] in millimetres")
    points: Annotated[int, Field(ge=1)] | None = Field(None, description="points of the path; by default as many as it needs")
    max_tension_n: Positive | None = Field(None, description="largest tension in newton")


class ChamberTable(Schema):
    name: Name = Field(description="a name without commas, semicolons and quotes")
    from_mm: float = Field(ge=0, description="length along the line where it begins, in millimetres")
    to_mm: Positive = Field(description="length along the line where it ends, in millimetres")
    radius_mm: Positive | None = Field(None, description="radius of a round chamber in millimetres")
    wall_mm: Positive | None = Field(None, description="around the axis: thickness of the wall outside, in millimetres")
    distance_mm: NotNegative = Field(0.0, description="of its middle from the axis in millimetres; 0: around it")
    angle_deg: float = Field(0.0, description="angle of its middle about the axis in degrees")
    inner_mm: Positive | None = Field(None, description="a sector of a ring: its least distance from the axis, in millimetres")
    outer_mm: Positive | None = Field(None, description="a sector of a ring: its largest distance from the axis")
    span_deg: Annotated[float, Field(gt=0, lt=360)] | None = Field(None, description="a sector of a ring: how wide it is")
    max_pressure_pa: float = Field(40e3, gt=0, description="largest pressure in pascal, > 0")

    @model_validator(mode="after")
    def _is_one_shape(self) -> ChamberTable:
        if not self.from_mm < self.to_mm:
            raise ValueError("from_mm is not below to_mm")
        sector = [self.inner_mm is not None, self.outer_mm is not None, self.span_deg is not None]
        if any(sector) and not all(sector):
            raise ValueError("a sector of a ring has inner_mm, outer_mm and span_deg")
        if sum([self.radius_mm is not None, self.wall_mm is not None, all(sector)]) != 1:
            raise ValueError("a chamber has radius_mm, or wall_mm, or inner_mm, outer_mm and span_deg")
        if self.wall_mm is not None and self.distance_mm:
            raise ValueError("wall_mm is for a chamber around the axis, with distance_mm = 0")
        return self


class BellowsTable(Schema):
    from_mm: float = Field(ge=0, description="length along the line where they begin, in millimetres")
    to_mm: Positive = Field(description="length along the line where they end, in millimetres")
    count: int = Field(ge=1, le=100, description="number of folds")
    depth_mm: Positive = Field(description="how much smaller the radius is at the bottom of a fold, in millimetres")


class MarkerTable(Schema):
    name: Name = Field(description="a name without commas, semicolons and quotes")
    along_mm: float = Field(description="length along the line in millimetres")
    distance_mm: float = Field(0.0, description="distance from the axis in millimetres")
    angle_deg: float = Field(0.0, description="angle about the axis in degrees")


class ClampTable(Schema):
    ends: Literal["first", "last", "both"] = Field("first", description='ends = "first", "last" or "both"')
    length_mm: NotNegative = Field(0.0, description="how much of the line is clamped, in millimetres")


class LineTable(Schema):
    """A body along a line, version femsense-line-1."""

    format: Literal["femsense-line-1"] = Field(description=f'format = "{FORMAT}"')
    name: Annotated[str, Field(min_length=1)] = Field(description="the robot's name")
    element: Literal["tet4", "tet10"] = Field("tet10", description='element = "tet4" or "tet10"')
    rings: int = Field(2, ge=1, le=6, description="elements from the axis to the outline, 1 to 6")
    angle_zero: Vector | None = Field(None, description="direction of angle 0 at the first point; by default x, or z along x")
    sections: Sections = Field(description="two tables [[sections]] or more, with at_mm and a shape")
    material: MaterialTable = Field(description="a table [material] with young_modulus_pa, poisson_ratio and density_kg_m3")
    gravity: GravityTable | None = Field(None, description="a table [gravity] with vector_m_s2")
    clamp: ClampTable = Field(default_factory=lambda: ClampTable(ends="first", length_mm=0.0), description="a table [clamp]")
    tendons: list[TendonTable] = Field([], description="tables [[tendons]]")
    chambers: list[ChamberTable] = Field([], description="tables [[chambers]]")
    bellows: list[BellowsTable] = Field([], description="tables [[bellows]]")
    markers: list[MarkerTable] = Field([], description="tables [[markers]]")


def read_line(path: Path) -> LineTable:
    """Return the checked tables of a description. Raises InputError with file, key, found and expected value."""
    return validated(LineTable, read_toml(path), path)


def line_of(table: LineTable, path: Path) -> LineBody:
    """Return the body that tables describe. Raises InputError."""
    points = np.array([section.at_mm for section in table.sections]) / PER_METRE
    sections = tuple(_section(section, i, path) for i, section in enumerate(table.sections))
    _check_steps(points, sections, path)
    line = LineBody(
        points=freeze(points),
        sections=sections,
        zero=_zero(table, points, path),
        folds=tuple(Fold(b.from_mm / PER_METRE, b.to_mm / PER_METRE, b.count, b.depth_mm / PER_METRE) for b in table.bellows),
        cavities=tuple(cavity_of(chamber) for chamber in table.chambers),
        rings=table.rings,
    )
    ends = {"chambers": [c.to_mm for c in table.chambers], "bellows": [b.to_mm for b in table.bellows]}
    for kind, places in ends.items():
        for i, end in enumerate(places):
            _require_on_line(end, line, at_key(path, kind, i, "to_mm"))
    return line


def channels_of(table: LineTable, line: LineBody, path: Path) -> tuple[Channel, ...]:
    """Return the channels of the tendons. Raises InputError for one that leaves the line."""
    channels = []
    for i, tendon in enumerate(table.tendons):
        end = line.length if tendon.end_mm is None else tendon.end_mm / PER_METRE
        _require_on_line(end * PER_METRE, line, at_key(path, "tendons", i, "end_mm"))
        start = tendon.start_mm / PER_METRE
        if not 0.0 <= start < end:
            raise InputError(
                "a channel begins behind its end",
                where=at_key(path, "tendons", i, "start_mm"),
                found=tendon.start_mm,
                expected=f"0 to {end * PER_METRE:g}",
            )
        distances, angles = _both(tendon.distance_mm), _both(tendon.angle_deg)
        channels.append(
            Channel(
                name=tendon.name,
                start=start,
                end=end,
                distances=(distances[0] / PER_METRE, distances[1] / PER_METRE),
                angles=(float(np.radians(angles[0])), float(np.radians(angles[1]))),
                pull_point=None if tendon.pull_mm is None else freeze(np.array(tendon.pull_mm) / PER_METRE),
                max_tension=np.inf if tendon.max_tension_n is None else tendon.max_tension_n,
                points=tendon.points,
            )
        )
    return tuple(channels)


def cavity_of(chamber: ChamberTable) -> Cavity:
    """Return the cavity of a chamber; a round one next to the axis becomes a sector of a ring of the same area,
    as thick as it is wide."""
    inner, outer, half = 0.0, (chamber.radius_mm or 0.0), 0.0
    if chamber.inner_mm is not None and chamber.outer_mm is not None and chamber.span_deg is not None:
        inner, outer, half = chamber.inner_mm, chamber.outer_mm, 0.5 * np.radians(chamber.span_deg)
    elif chamber.distance_mm and chamber.radius_mm:
        reach = 0.5 * np.sqrt(np.pi) * chamber.radius_mm
        inner, outer, half = chamber.distance_mm - reach, chamber.distance_mm + reach, reach / chamber.distance_mm
    if inner < 0.0:
        raise InputError(
            "a chamber off the axis crosses it",
            where=f"chamber {chamber.name}",
            found=f"distance_mm = {chamber.distance_mm:g}, radius_mm = {chamber.radius_mm:g}",
            expected="a smaller radius_mm, or distance_mm = 0 for a chamber around the axis",
        )
    middle = float(np.radians(chamber.angle_deg))
    return Cavity(
        name=chamber.name,
        start=chamber.from_mm / PER_METRE,
        end=chamber.to_mm / PER_METRE,
        inner=inner / PER_METRE,
        outer=outer / PER_METRE,
        angles=(middle - float(half), middle + float(half)),
        wall=(chamber.wall_mm or 0.0) / PER_METRE,
        max_pressure=chamber.max_pressure_pa,
    )


def _both(value: float | list[float]) -> tuple[float, float]:
    return (value[0], value[1]) if isinstance(value, list) else (value, value)


def _section(table: SectionTable, i: int, path: Path) -> Section:
    bore = table.bore_mm / PER_METRE
    if table.radius_mm is not None:
        radius = table.radius_mm / PER_METRE
        return Section(radius, radius, bore, bore)
    if table.width_mm is not None and table.height_mm is not None:
        return Section(0.5 * table.width_mm / PER_METRE, 0.5 * table.height_mm / PER_METRE, bore, bore, squareness=1.0)
    assert table.area_mm2 is not None and table.second_moment_mm4 is not None
    moments = _both(table.second_moment_mm4)
    try:
        return equal_section(1e-6 * table.area_mm2, (1e-12 * moments[0], 1e-12 * moments[1]))
    except InputError as error:
        where = at_key(path, "sections", i)
        raise InputError(error.what, where=where, found=error.found, expected=error.expected) from None


def _check_steps(points: FloatArray, sections: tuple[Section, ...], path: Path) -> None:
    """Refuse steps of the outline, and holes that end in a point."""
    legs = np.linalg.norm(np.diff(points, axis=0), axis=1)
    for i, leg in enumerate(legs):
        a, b = sections[i], sections[i + 1]
        where = at_key(path, "sections", i + 1)
        if leg == 0 and (a.half_width, a.half_height) != (b.half_width, b.half_height):
            raise InputError(
                "a step of the outline",
                where=where,
                expected="another at_mm",
                hint="leave a millimetre between the two: a short cone",
            )
        if leg > 0 and (a.hole_width > 0) != (b.hole_width > 0):
            raise InputError(
                "a hole that ends in a point",
                where=where,
                expected="a bore at both ends of a part, or at none",
                hint="two sections at the same at_mm, one with a bore: there it ends",
            )
    if not legs.any():
        raise InputError("a line without length", where=f"{path}: sections", expected="two points")


def _zero(table: LineTable, points: FloatArray, path: Path) -> FloatArray:
    """Return the direction of angle 0, across the line."""
    legs = np.diff(points, axis=0)
    first = legs[np.linalg.norm(legs, axis=1) > 0][0]
    tangent = first / np.linalg.norm(first)
    wanted = np.array(
        table.angle_zero if table.angle_zero is not None else [1.0, 0.0, 0.0] if abs(tangent[0]) < 0.9 else [0, 0, 1.0]
    )
    across = wanted - (wanted @ tangent) * tangent
    if np.linalg.norm(across) < 1e-6 * max(float(np.linalg.norm(wanted)), 1e-300):
        raise InputError(
            "points along the line", where=f"{path}: angle_zero", found=table.angle_zero, expected="a direction across the line"
        )
    return freeze(across / np.linalg.norm(across))


def _require_on_line(along_mm: float, line: LineBody, where: str) -> None:
    if along_mm > PER_METRE * line.length * (1.0 + 1e-9):
        raise InputError(
            "is beyond the end of the line", where=where, found=along_mm, expected=f"at most {PER_METRE * line.length:g} mm"
        )
