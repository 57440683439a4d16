"""From a line with radii to a robot: its tetrahedra, its tendons in channels, its chambers, and a robot.toml that loads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import femsense
from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import InputError
from femsense.fem.body import BodyModel, make_body
from femsense.fem.mesh import TetMesh, element_volumes, to_quadratic
from femsense.fem.mesh_checks import check_mesh
from femsense.io.files import check_target, file_hash, followed, plain, write_json, write_toml
from femsense.io.mesh_files import write_mesh
from femsense.io.meshing.channels import Channel, Subdivision, channel_path, pull_point, subdivided
from femsense.io.meshing.line_body import Cavity, LineBody, mesh_line, place
from femsense.io.meshing.line_file import LineTable, channels_of, line_of, read_line
from femsense.io.meshing.quality import quality_report, quality_text
from femsense.io.robot_toml import load_robot
from femsense.io.tables import read_toml

MESH_FILE, REPORT_FILE = "mesh.vtu", "mesh.json"
ROUND = 1e-6
"""Boxes of clamped nodes reach so far beyond them [m]."""


def line_into(
    folder: str | Path,
    source: str | Path,
    *,
    most_tets: int = 2000,
    along_mm: float | None = None,
    say: Callable[[str], None] = lambda text: None,
    again: bool = False,
    progress: Callable[..., None] | None = None,
) -> dict[str, Any]:
    """Make a robot's folder of a body along a line; return the report that mesh.json holds.

    Arguments:
        folder: of the robot; a robot.toml in it is replaced if it was made from such a description.
        source: the description (docs/guides/bodies.md).
        most_tets: not more tetrahedra than about so many; along_mm: thickness of a layer instead [mm].
        say: told in one line what happens beside.
        again: make it even where the folder holds this result.
        progress: told what is being done.

    Raises:
        InputError: a description that makes no body, or a folder that holds something else.
    """
    path, target = Path(source).expanduser(), Path(folder).expanduser()
    inputs = {"line": path.name, "sha256": file_hash(path), "most_tets": most_tets, "along_mm": along_mm}
    known = _known(target)
    if known and not again and known["inputs"] == inputs and known["femsense"] == femsense.__version__:
        say(f"{target} holds this robot already (--again makes it anew)")
        return known
    table = read_line(path)
    line = line_of(table, path)
    tell = progress or (lambda text: None)
    tell("tetrahedra")
    mesh, along = mesh_line(line, most_tets=most_tets, along=None if along_mm is None else 1e-3 * along_mm)
    check_mesh(mesh, str(path))
    boxes = clamp_boxes(table, line, mesh, along)
    channels = channels_of(table, line, path)
    paths = subdivisions(table, line, mesh, boxes, channels, tell=tell)
    document = robot_document(table, line, boxes, channels, paths, read_toml(path))
    followed(target).mkdir(parents=True, exist_ok=True)
    write_mesh(mesh, target / MESH_FILE)
    write_toml(target / "robot.toml", document)
    load_robot(target)
    report = {
        "inputs": inputs,
        "femsense": femsense.__version__,
        "length_mm": 1e3 * line.length,
        "volume_mm3": 1e9 * float(element_volumes(mesh).sum()),
        "quality": quality_report(mesh),
        "tendons": [plain({name: getattr(p, name) for name in Subdivision.__slots__}, nonfinite=True) for p in paths],
        "chambers": [c.name for c in line.cavities],
        "robot": {"folder": str(target), "mesh_file": MESH_FILE, "unit": "m", "robot_toml": "written"},
    }
    write_json(target / REPORT_FILE, report)
    return report


def _known(target: Path) -> dict[str, Any] | None:
    """Return the report of a folder that was made from a line; None where it is new.

    Raises InputError where something else stands there.
    """
    import json

    check_target(target, folder=True)
    if not target.is_dir() or not any(target.iterdir()):
        return None
    try:
        report: dict[str, Any] = json.loads((target / REPORT_FILE).read_text(encoding="utf-8"))
        if "line" in report["inputs"]:
            return report
    except (OSError, ValueError, KeyError, TypeError):
        pass
    raise InputError(
        "something else than a robot from such a description stands there",
        where=target,
        expected="a new folder",
        hint="another -o: robot.toml would be replaced",
    )


def clamp_boxes(table: LineTable, line: LineBody, mesh: TetMesh, along: FloatArray) -> list[list[list[float]]]:
    """Return boxes [m] that hold the clamped nodes and no others: one an end where that works, else one a node."""
    reach = table.clamp.length_mm / 1e3 + ROUND
    boxes = []
    for end, low, high in (("first", -1.0, reach), ("last", line.length - reach, np.inf)):
        if table.clamp.ends in (end, "both"):
            boxes += _boxes_around(mesh, np.flatnonzero((along >= low) & (along <= high)))
    return boxes


def _boxes_around(mesh: TetMesh, held: IntArray) -> list[list[list[float]]]:
    nodes = to_quadratic(mesh).nodes
    low, high = mesh.nodes[held].min(axis=0) - ROUND, mesh.nodes[held].max(axis=0) + ROUND
    inside = np.flatnonzero(((nodes >= low) & (nodes <= high)).all(axis=1))
    if set(inside[inside < len(mesh.nodes)]) == set(held):
        return [np.round([low, high], 9).tolist()]
    return [np.round([point - ROUND, point + ROUND], 9).tolist() for point in mesh.nodes[held]]


def subdivisions(
    table: LineTable,
    line: LineBody,
    mesh: TetMesh,
    boxes: list[list[list[float]]],
    channels: Sequence[Channel],
    *,
    tell: Callable[[str], None],
) -> tuple[Subdivision, ...]:
    """Return how many points the path of each tendon needs (see `subdivided`)."""
    if not channels:
        return ()
    body = _bare_body(table, mesh, boxes)
    known = dict[tuple[object, ...], Subdivision]()
    for channel in channels:  # tendons that differ in their angle alone need as many
        if channel.need not in known:
            known[channel.need] = subdivided(body, line, channel, tell=tell)
    return tuple(replace(known[channel.need], name=channel.name) for channel in channels)


def _bare_body(table: LineTable, mesh: TetMesh, boxes: list[list[list[float]]]) -> BodyModel:
    """Return the body with its weight, clamped, without what drives it."""
    whole = to_quadratic(mesh) if table.element == "tet10" else mesh
    held = np.zeros(len(whole.nodes), dtype=bool)
    for low, high in np.asarray(boxes):
        held |= ((whole.nodes >= low) & (whole.nodes <= high)).all(axis=1)
    return make_body(
        whole,
        young_modulus=table.material.young_modulus_pa,
        poisson_ratio=table.material.poisson_ratio,
        density=table.material.density_kg_m3,
        clamped=held,
        gravity=table.gravity.vector_m_s2 if table.gravity else (0.0, 0.0, 0.0),
    )


def robot_document(
    table: LineTable,
    line: LineBody,
    boxes: list[list[list[float]]],
    channels: Sequence[Channel],
    paths: Sequence[Subdivision],
    raw: dict[str, Any],
) -> dict[str, Any]:
    """Return the tables of robot.toml; `raw` holds material and gravity as they were written."""
    document: dict[str, Any] = {
        "format": "femsense-robot-1",
        "name": table.name,
        "mesh": {"file": MESH_FILE, "unit": "m", "element": table.element},
        "material": raw["material"],
    }
    document |= {"gravity": raw["gravity"]} if "gravity" in raw else {}
    document["fixed"] = [{"box_m": box} for box in boxes]
    document["cables"] = [_cable(line, channel, path.points) for channel, path in zip(channels, paths)]
    document["chambers"] = [_chamber(line, cavity) for cavity in line.cavities]
    document["markers"] = [
        {"name": m.name, "position_m": _point(place(line, m.along_mm / 1e3, m.distance_mm / 1e3, float(np.radians(m.angle_deg))))}
        for m in table.markers
    ]
    return {key: value for key, value in document.items() if value != []}


def _cable(line: LineBody, channel: Channel, count: int) -> dict[str, Any]:
    cable: dict[str, Any] = {
        "name": channel.name,
        "path_m": [_point(point) for point in channel_path(line, channel, count)],
        "pull_point_m": _point(pull_point(line, channel)),
    }
    return cable | ({"max_tension_n": channel.max_tension} if np.isfinite(channel.max_tension) else {})


def _chamber(line: LineBody, cavity: Cavity) -> dict[str, Any]:
    return {"name": cavity.name, "seed_m": _point(place(line, *cavity.middle)), "max_pressure_pa": cavity.max_pressure}


def _point(point: FloatArray) -> list[float]:
    return [round(float(value), 8) + 0.0 for value in point]


def line_report(path: Path) -> dict[str, Any]:
    """Return what a description holds, as plain values. Raises InputError where it makes no body."""
    table = read_line(path)
    line = line_of(table, path)
    channels = channels_of(table, line, path)
    return {
        "name": table.name,
        "length_mm": 1e3 * line.length,
        "sections": len(table.sections),
        "tendons": [{"name": c.name, "channel_mm": 1e3 * (c.end - c.start), "max_tension_n": c.max_tension} for c in channels],
        "chambers": [{"name": c.name, "length_mm": 1e3 * (c.end - c.start)} for c in line.cavities],
        "markers": [marker.name for marker in table.markers],
        "next": f"femsense mesh {path.name} -o ROBOT",
    }


def line_text(report: dict[str, Any]) -> str:
    """Return a report as a table."""
    lines = [
        quality_text(report["quality"]),
        f"  {'volume':<19}{1e-3 * report['volume_mm3']:.4g} cm³ along {report['length_mm']:.4g} mm",
    ]
    for tendon in report["tendons"]:
        text = f"{tendon['points']} points in its channel"
        if tendon["tension"] is not None and tendon["moved"]:
            text += (
                f" (twice as many move the body by {100 * (tendon['change'] or np.nan):.2g} % of {1e3 * tendon['moved']:.3g} mm"
                f" at {tendon['tension']:.3g} N)"
            )
        lines.append(f"  {tendon['name']:<19}{text}")
    return "\n".join(lines)
