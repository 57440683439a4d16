"""robot.toml ↔ Robot: the declared robot, checked with errors that say what is wrong where."""

from __future__ import annotations

import copy
import shutil
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, StringConstraints, model_validator

import femsense
from femsense.core.arrays import FloatArray, IntArray, freeze
from femsense.core.errors import InputError
from femsense.core.pose import check_pose, transform_points
from femsense.core.text import did_you_mean, key_path, short
from femsense.fem.body import BodyModel, make_body, tie_cable
from femsense.fem.body_parts import Cable, Chamber
from femsense.fem.cavities import check_chambers, find_chamber
from femsense.fem.mesh import TetMesh, check_mesh, embed_points, to_linear, to_quadratic
from femsense.io.files import plain, write_beside, write_toml
from femsense.io.materials import POISSON_RATIO, silicone
from femsense.io.mesh_files import mesh_companions, read_tets, write_mesh
from femsense.io.regions import RegionTable, regional
from femsense.io.tables import Schema, read_toml, schema_problems, validated
from femsense.model.effects import EFFECT_NAMES
from femsense.model.robot import MarkerLook, Observation, Robot, plain_actuation, spread_features

FORMAT = "femsense-robot-1"
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
PER_METRE = {"m": 1.0, "cm": 100.0, "mm": 1000.0}
"""Dividing by these rounds once: 35 mm become the same number as 0.035."""
SMALLEST_BODY, LARGEST_BODY = 1e-3, 20.0
"""A body that is smaller or larger across than this [m] has another unit than declared."""
FAR_CABLE = 0.25
"""A cable point farther outside than this times the mesh's diagonal is an error."""
FAR_MARKER = 1.0
"""The same for a marker, which may stand on a stalk."""
FAR_PULL_POINT = 20.0
"""The same for a pull point."""
INSIDE = 2
"""A node counts as inside a box up to so many units in the last place of the bound (which is where rounding of units ends)."""

# The tables of robot.toml

Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
Matrix = Annotated[list[Annotated[list[float], Field(min_length=4, max_length=4)]], Field(min_length=4, max_length=4)]
Name = Annotated[str, StringConstraints(pattern=r'^[^\s,;"]([^,;"\r\n\t]*[^\s,;"])?$')]
NAME = "a name without commas, semicolons and quotes"
POINT = "three numbers in metres [x, y, z]"


class MeshTable(Schema):
    file: Annotated[str, Field(min_length=1, description="the mesh file beside robot.toml")]
    unit: Literal["m", "cm", "mm"] = Field(description='unit = "m", "cm" or "mm": the unit of the coordinates in the mesh file')
    element: Literal["tet4", "tet10"] = Field(description='element = "tet4" or "tet10"')
    T_robot_mesh: Matrix | None = Field(None, description="4 rows of 4 numbers: a rotation and a translation in metres")


class MaterialTable(Schema):
    name: str | None = Field(None, description="a silicone of femsense.materials; what the other keys say goes before it")
    young_modulus_pa: float = Field(gt=0, description="Young's modulus in pascal, > 0, such as 150e3 for soft silicone")
    poisson_ratio: float = Field(gt=-1, lt=0.5, description="Poisson's ratio, −1 < ν < 0.5, such as 0.45 or 0.49 for silicone")
    density_kg_m3: float = Field(gt=0, description="density in kg/m³, > 0, such as 1070 for silicone")

    @model_validator(mode="before")
    @classmethod
    def _named(cls, table: Any) -> Any:
        """Take what a named silicone says for the keys that the table leaves out."""
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


Share = Annotated[float, Field(ge=0, le=1)]
Colour = Annotated[list[Share], Field(min_length=3, max_length=3)]


class MarkerTable(Schema):
    name: Name = Field(description=NAME)
    position_m: Vector = Field(description=POINT)
    aruco_id: int | None = Field(
        None,
        ge=0,
        description="number of the ArUco tag whose middle the marker is; read from colour images with registered depth",
    )
    color_rgb: Colour | None = Field(
        None,
        description="colour of the dot whose middle the marker is: [red, green, blue] from 0 to 1; several markers may share one",
    )


class FeaturesTable(Schema):
    count: int = Field(51, ge=1, description="number of feature points, ≥ 1")


class AppearanceTable(Schema):
    color_rgb: Colour | None = Field(None, description="three numbers from 0 to 1: [red, green, blue]")
    aruco_dictionary: str = Field("4X4_50", description="dictionary of the ArUco tags, as OpenCV names it without DICT_")


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


# Loading


def load_robot(path_or_name: str | Path, *, effects: bool = True) -> Robot:
    """Load a robot.

    Arguments:
        path_or_name: a folder with robot.toml, that file, or a NAME of the project's `meshes/`.
        effects: apply the `[[effects]]` that the file lists; False gives the plain model.

    Returns:
        the robot; its mesh in metres in the robot frame.

    Raises:
        InputError: with file, key, what was found and what was expected.
    """
    path = find_robot(path_or_name)
    document = read_toml(path)
    table = validated(RobotTable, document, path)
    for problem in table_problems(table, path):
        raise problem
    robot = build_robot(table, document, path)
    entries = [dict(entry) for entry in table.effects]
    return _with_effects(robot, entries, path) if entries and effects else robot


def find_robot(path_or_name: str | Path) -> Path:
    """Return the robot.toml of a folder, a file or a NAME. Raises InputError that lists the known names."""
    path = Path(path_or_name).expanduser()
    known = robot_names()
    if path.is_file():
        return path
    if (path / "robot.toml").is_file():
        if str(path_or_name) in known and known[str(path_or_name)].resolve() != path.resolve():
            warnings.warn(
                f"{path_or_name}: the folder {path.absolute()} is used; the robot of that name that comes along is {known[str(path_or_name)]}",
                stacklevel=3,
            )
        return path / "robot.toml"
    if str(path_or_name) in known:
        if path.exists():
            warnings.warn(
                f"{path_or_name}: the robot that comes along is used; the folder {path.absolute()} has no robot.toml",
                stacklevel=3,
            )
        return known[str(path_or_name)] / "robot.toml"
    if path.is_dir():
        raise InputError("not a robot: the folder has no robot.toml", where=path, found=_listing(path), expected="robot.toml")
    names = ", ".join(sorted(known)) or "none"
    raise InputError(
        "no such robot",
        where=path_or_name,
        found="neither a folder, nor a file, nor a known name",
        expected=f"a folder with robot.toml, or one of: {names}",
        hint=did_you_mean(str(path_or_name), known),
    )


def robot_names() -> dict[str, Path]:
    """Return the robots that come with the project: name → folder."""
    package = Path(femsense.__file__).parent
    folders: dict[str, Path] = {}
    for root in (package.parent / "meshes", package / "meshes"):
        found = sorted(root.iterdir()) if root.is_dir() else []
        folders.update({folder.name: folder for folder in found if (folder / "robot.toml").is_file()})
    return folders


def robot_problems(document: dict[str, Any], path: Path) -> list[InputError]:
    """Return everything that is wrong with the tables of a robot.toml, before the mesh is read."""
    problems = schema_problems(RobotTable, document, path)
    return problems or table_problems(RobotTable.model_validate(document), path)


def table_problems(table: RobotTable, path: Path) -> list[InputError]:
    """Return what single keys cannot show: double names, limits the wrong way round, no rotation, unknown effects."""
    problems: list[InputError] = []
    named: list[tuple[str, Sequence[CableTable | ChamberTable | MarkerTable]]]
    named = [("cables", table.cables), ("chambers", table.chambers), ("markers", table.markers)]
    for kind, items in named:
        problems += _double_names(kind, [item.name for item in items], path)
    for i, box in enumerate(table.fixed):
        low, high = np.asarray(box.box_m)
        if (low > high).any():
            problems.append(
                InputError(
                    "the corners of the box are not in order",
                    where=_at(path, "fixed", i, "box_m"),
                    found=box.box_m,
                    expected="[smallest x, y, z], then [largest x, y, z]",
                )
            )
    tags = [marker.aruco_id for marker in table.markers]
    for i, tag in enumerate(tags):
        if tag is not None and tag in tags[:i]:
            problems.append(
                InputError(
                    "a tag stands twice",
                    where=_at(path, "markers", i, "aruco_id"),
                    found=tag,
                    expected="each tag once",
                    hint=f"markers[{tags.index(tag)}] has it too",
                )
            )
    for i, cable in enumerate(table.cables):
        problems += _cable_problems(cable, i, path)
    for i, entry in enumerate(table.effects):
        problems += _effect_problems(entry, i, path)
    if table.mesh.T_robot_mesh is not None:
        try:
            check_pose(table.mesh.T_robot_mesh, _at(path, "mesh", "T_robot_mesh"))
        except InputError as problem:
            problems.append(problem)
    return problems


def _double_names(kind: str, names: Sequence[str], path: Path) -> list[InputError]:
    problems = []
    for i, name in enumerate(names):
        if name in names[:i]:
            hint = f"{kind}[{names.index(name)}] has it too"
            problems.append(
                InputError(
                    "a name stands twice",
                    where=_at(path, kind, i, "name"),
                    found=repr(name),
                    expected="each name once",
                    hint=hint,
                )
            )
    return problems


def _cable_problems(cable: CableTable, i: int, path: Path) -> list[InputError]:
    problems = []
    if not cable.min_tension_n <= cable.max_tension_n:
        problems.append(
            InputError(
                "the least tension is above the largest",
                where=_at(path, "cables", i, "min_tension_n"),
                found=f"min {cable.min_tension_n} N, max {cable.max_tension_n} N",
                expected="min_tension_n ≤ max_tension_n",
            )
        )
    if cable.exit_direction is not None and not np.any(cable.exit_direction):
        problems.append(
            InputError(
                "has no length",
                where=_at(path, "cables", i, "exit_direction"),
                found=cable.exit_direction,
                expected="a direction [x, y, z] that is not zero",
            )
        )
    return problems


def _effect_problems(entry: Mapping[str, Any], i: int, path: Path) -> list[InputError]:
    where = _at(path, "effects", i, "name")
    expected = " | ".join(EFFECT_NAMES)
    if "name" not in entry:
        return [InputError("a required key is missing", where=where, found="nothing", expected=expected)]
    if entry["name"] not in EFFECT_NAMES and "file" not in entry:
        return [
            InputError(
                "unknown effect",
                where=where,
                found=short(entry["name"]),
                expected=expected,
                hint=did_you_mean(str(entry["name"]), EFFECT_NAMES),
            )
        ]
    return []


# Building


def build_robot(table: RobotTable, document: dict[str, Any], path: Path) -> Robot:
    """Return the plain robot (no effects) of a checked robot.toml at `path`. Raises InputError."""
    declared = read_declared_mesh(table.mesh, path)
    mesh = with_element(declared, table.mesh.element)
    clamped = clamped_nodes(mesh, table.fixed, path)
    file, material = path.parent / table.mesh.file, table.material
    moduli, ratios = regional(mesh, table.regions, file, path, material.young_modulus_pa, material.poisson_ratio)
    body = make_body(
        mesh,
        young_modulus=moduli,
        poisson_ratio=ratios,
        density=table.material.density_kg_m3,
        clamped=clamped,
        clamp_nodes=clamped[clamped < len(declared.nodes)],
        cables=tuple(_make_cable(mesh, cable, i, path) for i, cable in enumerate(table.cables)),
        chambers=_make_chambers(mesh, table.chambers, path),
        gravity=table.gravity.vector_m_s2 if table.gravity else (0.0, 0.0, 0.0),
    )
    if (body.stencil.volumes <= 0).any():
        raise InputError(
            "curved elements that fold over",
            where=path.parent / table.mesh.file,
            expected="a positive Jacobian",
            hint='straight edges: element = "tet4", or a linear mesh',
        )
    _warn_of_units(table, path)
    points = _marker_points(mesh, table.markers, path)
    color = table.appearance.color_rgb
    return Robot(
        name=table.name,
        body=body,
        marker_names=tuple(marker.name for marker in table.markers),
        marker_points=points,
        markers=embed_points(mesh, points),
        features=spread_features(body, table.features.count),
        color_rgb=None if color is None else freeze(color),
        actuation=plain_actuation(len(table.cables)),
        observation=Observation(),
        document=copy.deepcopy(document),
        folder=path.parent.absolute(),
        marker_looks=_marker_looks(table.markers),
        aruco_dictionary=table.appearance.aruco_dictionary,
    )


def _marker_looks(markers: Sequence[MarkerTable]) -> tuple[MarkerLook, ...]:
    seen = [marker for marker in markers if marker.aruco_id is not None or marker.color_rgb is not None]
    return tuple(
        MarkerLook(m.name, m.aruco_id, None if m.color_rgb is None else freeze(np.array(m.color_rgb, dtype=float))) for m in seen
    )


def read_declared_mesh(table: MeshTable, path: Path) -> TetMesh:
    """Return the mesh of the file in metres, in the robot frame, checked. Raises InputError."""
    file = path.parent / table.file
    where = f"{path}: mesh.file {table.file}"
    raw = read_tets(file, where=where)
    nodes = raw.nodes / PER_METRE[table.unit]
    _check_size(nodes, table.unit, path)
    if table.T_robot_mesh is not None:
        nodes = transform_points(check_pose(table.T_robot_mesh, _at(path, "mesh", "T_robot_mesh")), nodes)
    mesh = TetMesh(nodes, raw.tets)
    check_mesh(mesh, where)
    return mesh


def with_element(mesh: TetMesh, element: str) -> TetMesh:
    """Return the mesh as "tet4" or "tet10"."""
    return to_quadratic(mesh) if element == "tet10" else to_linear(mesh)


def clamped_nodes(mesh: TetMesh, boxes: Sequence[FixedTable], path: Path) -> IntArray:
    """Return the nodes inside any of the boxes at rest (the boundary counts), shape (k,). Raises InputError."""
    inside = np.zeros(len(mesh.nodes), dtype=bool)
    for i, box in enumerate(boxes):
        low, high = np.asarray(box.box_m)
        hits = _within(mesh.nodes, low, high)
        if not hits.any():
            raise _empty_box(mesh, low, high, _at(path, "fixed", i, "box_m"))
        inside |= hits
    if inside.all():
        raise InputError(
            "the boxes hold every node",
            where=_at(path, "fixed"),
            found=f"{len(inside)} nodes clamped",
            expected="some that can move",
            hint="boxes are in metres",
        )
    return np.flatnonzero(inside)


def _within(nodes: FloatArray, low: FloatArray, high: FloatArray) -> npt.NDArray[np.bool_]:
    slack_low, slack_high = INSIDE * np.spacing(np.abs(low)), INSIDE * np.spacing(np.abs(high))
    return np.asarray(((nodes >= low - slack_low) & (nodes <= high + slack_high)).all(axis=1))


def mesh_diagonal(nodes: FloatArray) -> float:
    """Return the diagonal of the bounding box [m]."""
    return float(np.linalg.norm(np.ptp(nodes, axis=0)))


def _empty_box(mesh: TetMesh, low: FloatArray, high: FloatArray, where: str) -> InputError:
    distance = np.linalg.norm(mesh.nodes - np.clip(mesh.nodes, low, high), axis=1)
    nearest = int(distance.argmin())
    diagonal, size = mesh_diagonal(mesh.nodes), float(np.abs([low, high]).max())
    hint = "does the box lie on another side of the body, or in the frame before T_robot_mesh?"
    if size > 20 * diagonal:
        hint = "box_m looks like millimetres: it is in metres"
    elif size < 0.02 * diagonal:
        hint = "box_m is much smaller than the mesh: is mesh.unit right?"
    return InputError(
        "no node of the mesh is inside the box",
        where=where,
        found=f"the nearest node is number {nearest} at {_metres(mesh.nodes[nearest])}, {1e3 * distance[nearest]:.4g} mm away",
        expected=f"a box that meets the mesh, which reaches from {_metres(mesh.nodes.min(axis=0))} to {_metres(mesh.nodes.max(axis=0))}",
        hint=hint,
    )


def _check_size(nodes: FloatArray, unit: str, path: Path) -> None:
    size = float(np.ptp(nodes, axis=0).max())
    if SMALLEST_BODY <= size <= LARGEST_BODY:
        return
    raw = size / UNITS[unit]
    best = likely_unit(raw)
    raise InputError(
        "the body has an unlikely size",
        where=_at(path, "mesh", "unit"),
        found=f"{size:.3g} m across with unit = {unit!r}",
        expected="between 1 mm and 20 m",
        hint=f"unit = {best!r} gives {raw * UNITS[best]:.3g} m" if best else "scale the mesh file",
    )


def likely_unit(size: float) -> str | None:
    """Return the unit that makes a body of this size, in the unit of its file, most like a robot; None where none does."""
    fits = [name for name, scale in UNITS.items() if SMALLEST_BODY <= size * scale <= LARGEST_BODY]
    return min(fits, key=lambda name: abs(np.log(size * UNITS[name] / 0.2)), default=None)


def _make_cable(mesh: TetMesh, table: CableTable, i: int, path: Path) -> Cable:
    cable = tie_cable(
        mesh,
        table.name,
        table.path_m,
        table.pull_point_m,
        exit_direction=table.exit_direction,
        min_tension=table.min_tension_n,
        max_tension=table.max_tension_n,
    )
    diagonal = mesh_diagonal(mesh.nodes)
    worst = int(cable.path.outside.argmax())
    if cable.path.outside[worst] > FAR_CABLE * diagonal:
        raise _far(
            f"point {worst} of cable {table.name!r} is far outside the body",
            _at(path, "cables", i, "path_m"),
            table.path_m[worst],
            float(cable.path.outside[worst]),
            FAR_CABLE,
            mesh,
        )
    away = float(np.linalg.norm(mesh.nodes - np.asarray(table.pull_point_m), axis=1).min())
    if away > FAR_PULL_POINT * diagonal:
        raise _far(
            f"the pull point of cable {table.name!r} is far from the body",
            _at(path, "cables", i, "pull_point_m"),
            table.pull_point_m,
            away,
            FAR_PULL_POINT,
            mesh,
        )
    outside = int((cable.path.outside > 1e-6).sum())
    if outside:
        warnings.warn(
            f"{_at(path, 'cables', i, 'path_m')}: cable {table.name!r} has {outside} of {len(cable.path)} points outside the mesh, "
            f"up to {1e3 * cable.path.outside[worst]:.3g} mm; each is carried by the affine map of the tetrahedron with the nearest centre",
            stacklevel=4,
        )
    return cable


def _make_chambers(mesh: TetMesh, tables: Sequence[ChamberTable], path: Path) -> tuple[Chamber, ...]:
    chambers = tuple(
        find_chamber(mesh, t.name, t.seed_m, max_pressure=t.max_pressure_pa, where=_at(path, "chambers", i, "seed_m"))
        for i, t in enumerate(tables)
    )
    check_chambers(chambers, where=f"{path}: chambers")
    return chambers


def _marker_points(mesh: TetMesh, markers: Sequence[MarkerTable], path: Path) -> FloatArray:
    points = freeze(np.array([marker.position_m for marker in markers], dtype=np.float64).reshape(-1, 3))
    outside = embed_points(mesh, points).outside
    far = np.flatnonzero(outside > FAR_MARKER * mesh_diagonal(mesh.nodes))
    if len(far):
        i = int(far[0])
        raise _far(
            f"marker {markers[i].name!r} is far from the body",
            _at(path, "markers", i, "position_m"),
            markers[i].position_m,
            float(outside[i]),
            FAR_MARKER,
            mesh,
        )
    return points


def _far(what: str, where: str, point: Sequence[float], distance: float, limit: float, mesh: TetMesh) -> InputError:
    diagonal = mesh_diagonal(mesh.nodes)
    millimetres = float(np.abs(point).max()) > 20 * float(np.abs(mesh.nodes).max())
    hint = (
        "this looks like millimetres: positions are in metres"
        if millimetres
        else "positions are in the robot frame, after T_robot_mesh"
    )
    return InputError(
        what,
        where=where,
        found=f"{_metres(point)}, {1e3 * distance:.4g} mm outside",
        expected=f"at most {limit:g} × the mesh's diagonal of {1e3 * diagonal:.4g} mm outside; the mesh reaches from {_metres(mesh.nodes.min(axis=0))} to {_metres(mesh.nodes.max(axis=0))}",
        hint=hint,
    )


def _warn_of_units(table: RobotTable, path: Path) -> None:
    """Warn of what can be computed but is hardly meant."""
    if table.material.young_modulus_pa < 1e3:
        warnings.warn(
            f"{_at(path, 'material', 'young_modulus_pa')}: {table.material.young_modulus_pa:g} Pa is softer than any silicone; is it in kPa or MPa?",
            stacklevel=4,
        )
    if table.material.density_kg_m3 < 20.0:
        warnings.warn(
            f"{_at(path, 'material', 'density_kg_m3')}: {table.material.density_kg_m3:g} kg/m³ is lighter than any foam; is it in g/cm³? Silicone has 1070 kg/m³",
            stacklevel=4,
        )
    if table.gravity and np.linalg.norm(table.gravity.vector_m_s2) > 100.0:
        warnings.warn(
            f"{_at(path, 'gravity', 'vector_m_s2')}: {table.gravity.vector_m_s2} is more than ten times gravity; is it in mm/s²?",
            stacklevel=4,
        )


def _with_effects(robot: Robot, entries: list[dict[str, Any]], path: Path) -> Robot:
    from femsense.model.effects import apply_effects

    for i, entry in enumerate(entries):
        try:
            robot = apply_effects(robot, [entry])
        except InputError as error:
            name = entry["name"]
            raise InputError(
                f"effect {name!r}: {error.what}",
                where=_at(path, "effects", i),
                found=error.found,
                expected=error.expected,
                hint=error.hint,
            ) from None
    return robot


# Saving


def save_robot(robot: Robot, folder: str | Path, *, effects: Sequence[Mapping[str, Any]] | None = None) -> Path:
    """Write robot.toml and a copy of the mesh file, so that the folder loads back to the same robot.

    A robot that was loaded is written as it was declared; what was changed in Python since then must be said by `effects`.

    Arguments:
        robot: the robot.
        folder: made where it is missing; its other files stay.
        effects: the `[[effects]]` to write; by default those that the robot declares.

    Returns:
        the path of robot.toml.

    Raises:
        InputError: where the robot was made in Python and holds what robot.toml cannot say without effects.
    """
    target = Path(folder)
    document = robot_document(robot, effects=effects)
    for entry in document.get("effects", []):
        if "file" in entry:
            entry["file"] = _copy_effect(entry, robot, target)
    if robot.document is not None and robot.folder is not None:
        document["mesh"]["file"] = _copy_mesh(robot.folder / document["mesh"]["file"], target)
    else:
        write_mesh(robot.body.mesh, target / document["mesh"]["file"])
    write_toml(target / "robot.toml", document)
    return target / "robot.toml"


def robot_document(robot: Robot, *, effects: Sequence[Mapping[str, Any]] | None = None) -> dict[str, Any]:
    """Return the robot as the plain tables of robot.toml; see `save_robot`."""
    document = copy.deepcopy(robot.document) if robot.document is not None else _declared(robot)
    if effects is not None:
        document["effects"] = [plain(dict(entry), nonfinite=True) for entry in effects]
    if not document.get("effects"):
        document.pop("effects", None)
    problems = robot_problems(document, Path("robot.toml"))
    if problems:
        raise problems[0]
    return document


def _declared(robot: Robot) -> dict[str, Any]:
    """Return the tables of a robot that was made in Python."""
    body = robot.body
    _check_plain(robot)
    document: dict[str, Any] = {
        "format": FORMAT,
        "name": robot.name,
        "mesh": {"file": "mesh.vtu", "unit": "m", "element": "tet10" if body.mesh.is_quadratic else "tet4"},
        "material": {
            "young_modulus_pa": float(body.material.young_modulus[0]),
            "poisson_ratio": float(body.material.poisson_ratio[0]),
            "density_kg_m3": body.material.density,
        },
    }
    if body.gravity.any():
        document["gravity"] = {"vector_m_s2": body.gravity.tolist()}
    document["fixed"] = [{"box_m": box} for box in _clamp_boxes(body)]
    document["cables"] = [_cable_document(cable, body.mesh) for cable in body.cables]
    document["chambers"] = [{"name": c.name, "seed_m": c.seed.tolist(), "max_pressure_pa": c.max_pressure} for c in body.chambers]
    looks = {look.name: look for look in robot.marker_looks}
    document["markers"] = [
        {"name": n, "position_m": p.tolist(), **_look_document(looks.get(n))}
        for n, p in zip(robot.marker_names, robot.marker_points)
    ]
    document["features"] = {"count": max(len(robot.features), 1)}
    if robot.color_rgb is not None:
        document["appearance"] = {"color_rgb": robot.color_rgb.tolist()}
    if any(look.aruco_id is not None for look in robot.marker_looks):
        document.setdefault("appearance", {})["aruco_dictionary"] = robot.aruco_dictionary
    return {key: value for key, value in document.items() if value != []}


def _look_document(look: MarkerLook | None) -> dict[str, Any]:
    if look is None:
        return {}
    tag = {} if look.aruco_id is None else {"aruco_id": look.aruco_id}
    return tag if look.color_rgb is None else {**tag, "color_rgb": look.color_rgb.tolist()}


def _check_plain(robot: Robot) -> None:
    """Refuse to write a robot made in Python whose model is not the plain one."""
    body, material = robot.body, robot.body.material
    plain_inputs = plain_actuation(len(body.cables))
    same_inputs = not robot.by_recording and all(
        np.array_equal(getattr(robot.actuation, name), getattr(plain_inputs, name)) for name in plain_inputs.__slots__
    )
    beyond = {
        "a material that varies": np.ptp(material.young_modulus) > 0 or np.ptp(material.poisson_ratio) > 0,
        f"the law {material.law}": material.law != "corotational",
        "a clamp that gives": np.isfinite(body.clamp_stiffness),
        "dead forces": body.dead_forces.any(),
        "masses that it carries": body.carried_mass is not None,
        "cable friction": any(cable.friction for cable in body.cables),
        "actuation that is not plain": not same_inputs,
        "observation that is not plain": (robot.observation.depth_scale, robot.observation.depth_offset) != (1.0, 0.0),
        "creep": robot.creep,
        "softness of what was loaded": robot.softening,
    }
    found = [name for name, holds in beyond.items() if holds]
    if found:
        raise InputError(
            "robot.toml cannot say this without effects",
            where=robot.name,
            found=", ".join(found),
            expected="the plain model",
            hint="save the plain robot and pass effects=[…]",
        )


def _clamp_boxes(body: BodyModel) -> list[list[list[float]]]:
    """Return boxes that hold the clamped nodes and no other: one where that works, else one a node."""
    nodes = body.mesh.nodes
    clamped = nodes[body.clamped]
    if not len(clamped):
        raise InputError("the body has no clamp", where="robot", expected="clamped nodes")
    low, high = clamped.min(axis=0), clamped.max(axis=0)
    hits = _within(nodes, low, high)
    if hits.sum() == len(clamped):
        return [[low.tolist(), high.tolist()]]
    return [[point.tolist(), point.tolist()] for point in clamped]


def _cable_document(cable: Cable, mesh: TetMesh) -> dict[str, Any]:
    table: dict[str, Any] = {
        "name": cable.name,
        "path_m": cable.path.positions(mesh.nodes).tolist(),
        "pull_point_m": cable.pull_point.tolist(),
        "min_tension_n": cable.min_tension,
    }
    if cable.exit_direction is not None:
        table["exit_direction"] = cable.exit_direction.tolist()
    if np.isfinite(cable.max_tension):
        table["max_tension_n"] = cable.max_tension
    return table


def _copy_effect(entry: Mapping[str, Any], robot: Robot, folder: Path) -> str:
    """Copy the Python file of a user's effect and return its name."""
    from femsense.model.effects.user_defined import find_own_file

    source = find_own_file(entry, robot)
    if not source.is_file():
        raise InputError("the file of an effect is gone", where=source, expected=f"the Python file of {entry.get('name')}")
    target = folder / source.name
    if not (target.exists() and target.samefile(source)):
        with write_beside(target) as part:
            shutil.copyfile(source, part)
    return source.name


def _copy_mesh(source: Path, folder: Path) -> str:
    """Copy a mesh file (with the files that belong to it) and return its name."""
    if not source.is_file():
        raise InputError("the robot's mesh file is gone", where=source, expected="the file that it was loaded from")
    for file in mesh_companions(source):
        target = folder / file.name
        if not (target.exists() and target.samefile(file)):
            with write_beside(target) as part:
                shutil.copyfile(file, part)
    return source.name


def _at(path: Path, *location: int | str) -> str:
    return f"{path}: {key_path(location)}"


def _metres(point: FloatArray | Sequence[float]) -> str:
    return "[" + ", ".join(f"{value:.4g}" for value in point) + "] m"


def _listing(folder: Path) -> str:
    names = sorted(file.name for file in folder.iterdir())
    return ", ".join(names[:6]) + (", …" if len(names) > 6 else "") or "an empty folder"
