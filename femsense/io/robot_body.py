"""From the tables of robot.toml to a robot: its mesh in metres, clamp, cables, chambers, markers,
each checked against the mesh."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray, IntArray, diagonal, freeze
from femsense.core.errors import InputError
from femsense.core.pose import check_pose, transform_points
from femsense.core.units import PER_METRE
from femsense.fem.body import make_body, tie_cable
from femsense.fem.body_parts import Cable, Chamber
from femsense.fem.cavities import check_chambers, find_chamber
from femsense.fem.mesh import TetMesh, embed_points, to_linear, to_quadratic
from femsense.fem.mesh_checks import check_mesh
from femsense.io.mesh_files import read_tets
from femsense.io.regions import regional
from femsense.io.robot_tables import (
    CableTable,
    ChamberTable,
    FixedTable,
    MarkerTable,
    MeshTable,
    RobotTable,
    plain_dictionary,
)
from femsense.io.tables import at_key, beside
from femsense.model.body_doubts import doubts_of_body
from femsense.model.plausibility import gravity_doubt, warn_of
from femsense.model.remeshing import within
from femsense.model.robot import MarkerLook, Observation, Robot, plain_actuation, spread_features

SMALLEST_BODY, LARGEST_BODY = 1e-3, 20.0
"""A body that is smaller or larger across than this [m] has another unit than declared."""
FAR_CABLE = 0.25
"""A cable point farther outside than this times the mesh's diagonal is an error."""
FAR_MARKER = 1.0
"""The same for a marker, which may be on a stalk."""
FAR_PULL_POINT = 20.0
"""The same for a pull point."""


def build_robot(table: RobotTable, document: dict[str, Any], path: Path) -> Robot:
    """Return the plain robot (no effects) of a checked robot.toml at `path`. Raises InputError."""
    declared = read_declared_mesh(table.mesh, path)
    mesh = with_element(declared, table.mesh.element)
    clamped = clamped_nodes(mesh, table.fixed, path)
    file, material = beside(path, table.mesh.file), table.material
    moduli, ratios = regional(mesh, table.regions, file, path, material.young_modulus_pa, material.poisson_ratio)
    body = make_body(
        mesh,
        young_modulus=moduli,
        poisson_ratio=ratios,
        density=table.material.density_kg_m3,
        clamped=clamped,
        cables=tuple(_make_cable(mesh, cable, i, path) for i, cable in enumerate(table.cables)),
        chambers=_make_chambers(mesh, table.chambers, path),
        gravity=table.gravity.vector_m_s2 if table.gravity else (0.0, 0.0, 0.0),
    ).with_clamp_nodes(clamped[clamped < len(declared.nodes)])
    if (body.stencil.volumes <= 0).any():
        raise InputError(
            "curved elements that fold over",
            where=path.parent / table.mesh.file,
            expected="a positive Jacobian",
            hint='straight edges: element = "tet4", or a linear mesh',
        )
    _check_gravity(table, path)
    warn_of((f"{path}: {doubt}" for doubt in doubts_of_body(body)), stacklevel=4)
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
        aruco_dictionary=plain_dictionary(table.appearance.aruco_dictionary),
    )


def read_declared_mesh(table: MeshTable, path: Path) -> TetMesh:
    """Return the mesh of the file in metres, in the robot frame, checked. Raises InputError."""
    file = beside(path, table.file)
    where = f"{path}: mesh.file {table.file}"
    raw = read_tets(file, where=where)
    nodes = raw.nodes / PER_METRE[table.unit]
    _check_size(nodes, table.unit, path)
    if table.T_robot_mesh is not None:
        nodes = transform_points(check_pose(table.T_robot_mesh, at_key(path, "mesh", "T_robot_mesh")), nodes)
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
        hits = within(mesh.nodes, np.array([[low, high]]))
        if not hits.any():
            raise _empty_box(mesh, low, high, at_key(path, "fixed", i, "box_m"))
        inside |= hits
    if inside.all():
        raise InputError(
            "the boxes hold every node",
            where=at_key(path, "fixed"),
            found=f"{len(inside)} nodes clamped",
            expected="some that can move",
            hint="boxes are in metres",
        )
    return np.flatnonzero(inside)


def boxes_around(nodes: FloatArray, held: IntArray, *, slack: float = 0.0) -> list[FloatArray]:
    """Return boxes [m], each of shape (2, 3), that hold the nodes `held` and no other: one where that works, else one a node.

    Arguments:
        nodes: shape (n, 3) [m].
        held: their indices.
        slack: the boxes reach this far beyond them [m].
    """
    low, high = nodes[held].min(axis=0) - slack, nodes[held].max(axis=0) + slack
    if within(nodes, np.array([[low, high]])).sum() == len(held):
        return [np.array([low, high])]
    return [np.array([point - slack, point + slack]) for point in nodes[held]]


def likely_unit(size: float) -> str | None:
    """Return the unit that makes a body of this size, in the unit of its file, most like a robot; None where none does."""
    fits = [name for name, count in PER_METRE.items() if SMALLEST_BODY <= size / count <= LARGEST_BODY]
    return min(fits, key=lambda name: abs(np.log(size / PER_METRE[name] / 0.2)), default=None)


def _empty_box(mesh: TetMesh, low: FloatArray, high: FloatArray, where: str) -> InputError:
    distance = np.linalg.norm(mesh.nodes - np.clip(mesh.nodes, low, high), axis=1)
    nearest = int(distance.argmin())
    whole, size = diagonal(mesh.nodes), float(np.abs([low, high]).max())
    hint = "does the box lie on another side of the body, or in the frame before T_robot_mesh?"
    if size > 20 * whole:
        hint = "box_m looks like millimetres: it is in metres"
    elif size < 0.02 * whole:
        hint = "box_m is much smaller than the mesh: is mesh.unit right?"
    return InputError(
        "no node of the mesh is inside the box",
        where=where,
        found=f"the nearest node is number {nearest} at {_metres(mesh.nodes[nearest])}, {1e3 * distance[nearest]:.4g} mm away",
        expected=(
            f"a box that meets the mesh, which reaches from {_metres(mesh.nodes.min(axis=0))} to "
            f"{_metres(mesh.nodes.max(axis=0))}"
        ),
        hint=hint,
    )


def _check_size(nodes: FloatArray, unit: str, path: Path) -> None:
    size = float(np.ptp(nodes, axis=0).max())
    if SMALLEST_BODY <= size <= LARGEST_BODY:
        return
    raw = size * PER_METRE[unit]
    best = likely_unit(raw)
    raise InputError(
        "the body has an unlikely size",
        where=at_key(path, "mesh", "unit"),
        found=f"{size:.3g} m across with unit = {unit!r}",
        expected="between 1 mm and 20 m",
        hint=f"unit = {best!r} gives {raw / PER_METRE[best]:.3g} m" if best else "scale the mesh file",
    )


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
    size = diagonal(mesh.nodes)
    worst = int(cable.path.outside.argmax())
    if cable.path.outside[worst] > FAR_CABLE * size:
        raise _far(
            f"point {worst} of cable {table.name!r} is far outside the body",
            at_key(path, "cables", i, "path_m"),
            table.path_m[worst],
            float(cable.path.outside[worst]),
            FAR_CABLE,
            mesh,
        )
    away = float(np.linalg.norm(mesh.nodes - np.asarray(table.pull_point_m), axis=1).min())
    if away > FAR_PULL_POINT * size:
        raise _far(
            f"the pull point of cable {table.name!r} is far from the body",
            at_key(path, "cables", i, "pull_point_m"),
            table.pull_point_m,
            away,
            FAR_PULL_POINT,
            mesh,
        )
    outside = int((cable.path.outside > 1e-6).sum())
    if outside:
        warnings.warn(
            f"{at_key(path, 'cables', i, 'path_m')}: cable {table.name!r} has {outside} of {len(cable.path)} points "
            f"outside the mesh, "
            f"up to {1e3 * cable.path.outside[worst]:.3g} mm; each is carried by the affine map of the tetrahedron with "
            f"the nearest centre",
            stacklevel=4,
        )
    return cable


def _make_chambers(mesh: TetMesh, tables: Sequence[ChamberTable], path: Path) -> tuple[Chamber, ...]:
    chambers = tuple(
        find_chamber(mesh, t.name, t.seed_m, max_pressure=t.max_pressure_pa, where=at_key(path, "chambers", i, "seed_m"))
        for i, t in enumerate(tables)
    )
    check_chambers(chambers, where=f"{path}: chambers")
    return chambers


def _marker_points(mesh: TetMesh, markers: Sequence[MarkerTable], path: Path) -> FloatArray:
    points = freeze(np.array([marker.position_m for marker in markers], dtype=np.float64).reshape(-1, 3))
    outside = embed_points(mesh, points).outside
    far = np.flatnonzero(outside > FAR_MARKER * diagonal(mesh.nodes))
    if len(far):
        i = int(far[0])
        raise _far(
            f"marker {markers[i].name!r} is far from the body",
            at_key(path, "markers", i, "position_m"),
            markers[i].position_m,
            float(outside[i]),
            FAR_MARKER,
            mesh,
        )
    return points


def _marker_looks(markers: Sequence[MarkerTable]) -> tuple[MarkerLook, ...]:
    seen = [marker for marker in markers if marker.aruco_id is not None or marker.color_rgb is not None]
    return tuple(
        MarkerLook(m.name, m.aruco_id, None if m.color_rgb is None else freeze(np.array(m.color_rgb, dtype=float))) for m in seen
    )


def _far(what: str, where: str, point: Sequence[float], distance: float, limit: float, mesh: TetMesh) -> InputError:
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
        expected=(
            f"at most {limit:g} × the mesh's diagonal of {1e3 * diagonal(mesh.nodes):.4g} mm outside; the mesh reaches from "
            f"{_metres(mesh.nodes.min(axis=0))} to {_metres(mesh.nodes.max(axis=0))}"
        ),
        hint=hint,
    )


def _check_gravity(table: RobotTable, path: Path) -> None:
    """Warn of gravity in another unit. Raises InputError for an impossible gravity."""
    if table.gravity and np.linalg.norm(table.gravity.vector_m_s2) > 100.0:
        raise InputError(
            "more than ten times gravity",
            where=at_key(path, "gravity", "vector_m_s2"),
            found=f"{table.gravity.vector_m_s2} m/s²",
            expected="[0.0, 0.0, -9.81], in the robot frame",
            hint="is it in mm/s²?",
        )
    doubt = gravity_doubt(float(np.linalg.norm(table.gravity.vector_m_s2))) if table.gravity else None
    if doubt:
        warnings.warn(f"{at_key(path, 'gravity', 'vector_m_s2')}: {doubt}", stacklevel=4)


def _metres(point: FloatArray | Sequence[float]) -> str:
    return "[" + ", ".join(f"{value:.4g}" for value in point) + "] m"
