"""Reports on robots, meshes, surfaces and scenes."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from femsense.app.inspection.reports import Problems, Report, attempt
from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.fem.body_parts import Cable, Chamber
from femsense.fem.cables import bend_angles, cable_length
from femsense.fem.chambers import chamber_volume
from femsense.fem.mesh import TetMesh, element_volumes, surface_triangles, triangle_normals
from femsense.fem.mesh_checks import check_mesh
from femsense.io.mesh_files import closed_surface, ordered_tets, radius_ratio, read_tets, read_triangles
from femsense.io.meshes.reading import read_content
from femsense.io.result_folder import read_object
from femsense.io.robot_body import read_declared_mesh
from femsense.io.robot_tables import RobotTable, robot_problems
from femsense.io.robot_toml import load_robot
from femsense.io.tables import read_toml
from femsense.model.linear_elements import warn_of_linear_elements
from femsense.model.robot import Robot
from femsense.model.tie_spacing import warn_of_tie_spacing

POOR_QUALITY = 0.05
"""A radius ratio below this is worth a warning."""


def inspect_robot(path: Path, report: Report, problems: Problems) -> None:
    """Report what robot.toml declares."""
    file = path / "robot.toml" if path.is_dir() else path
    document = read_toml(file)
    report["name"] = str(document.get("name", ""))
    found = robot_problems(document, file)
    problems += found
    if found:
        return
    loaded = attempt(lambda: load_robot(path, effects=False), problems)
    if loaded is None:
        table = RobotTable.model_validate(document).mesh
        mesh = attempt(lambda: read_declared_mesh(table, file), [])
        report.update({"mesh": _mesh_report(mesh, 1e3)} if mesh is not None else {})
        return
    report.update(_robot_report(loaded, document))
    _warn_of_gaps(loaded, file)
    if document.get("effects"):
        attempt(lambda: load_robot(file), problems)


def _warn_of_gaps(robot: Robot, file: Path) -> None:
    """Warn of missing tables without which a robot cannot be calibrated, and of guesses of `femsense mesh` that nobody has confirmed."""
    texts = []
    guessed = guessed_tables(file.read_text(encoding="utf-8-sig"))
    if guessed:
        texts.append(f"still marked GUESSED: {', '.join(guessed)}. Compare each with the real robot, then delete the word")
    if not robot.body.cables and not robot.body.chambers:
        texts.append(
            "neither [[cables]] nor [[chambers]]: no recorded input moves this robot. calibrate then uses the rest state only, "
            "and improve cannot compare inputs"
        )
    if not robot.marker_names:
        texts.append(
            "no [[markers]]: the camera pose must come from clouds of contact-free frames (femsense docs calibrate), "
            "and frames without a cloud give no forces"
        )
    for text in texts:
        warnings.warn(f"{file.name}: {text}", stacklevel=3)


def guessed_tables(text: str) -> list[str]:
    """Return the tables of a robot.toml whose comment still says GUESSED, in their order."""
    found, pending = [], False
    for line in text.splitlines():
        pending = pending or line.startswith("# GUESSED")
        name = line.strip().strip("[]")
        if pending and line.startswith("["):
            found.append(name)
            pending = False
    return found


def inspect_mesh(file: Path, report: Report, problems: Problems) -> None:
    """Report cells, size and quality of a mesh."""
    content = read_content(file, str(file))
    points, cells = content.points, content.cells
    report["cells"] = {kind: len(data) for kind, data in cells.items()}
    kinds = [kind for kind in ("tetra", "tetra10") if kind in cells]
    if not kinds and "triangle" in cells:
        report["kind"] = "surface"
        _surface_report(points, cells["triangle"], report)
        attempt(lambda: closed_surface(points, cells["triangle"], str(file)), problems)
        return
    mesh = ordered_tets(points, cells[kinds[0]], str(file)) if len(kinds) == 1 else read_tets(file)
    report.update(_without_unit(_mesh_report(mesh, 1.0)))
    attempt(lambda: check_mesh(mesh, str(file)), problems)
    _warn_of_quality(report["radius_ratio_min"], file.name)


def inspect_surface(file: Path, report: Report, problems: Problems) -> None:
    """Report size and gaps of a surface."""
    points, triangles = read_triangles(file)
    _surface_report(points, triangles, report)
    attempt(lambda: closed_surface(points, triangles, str(file)), problems)


def inspect_scene(file: Path, report: Report, problems: Problems) -> None:
    """A .glb is what `femsense export` writes; its header is checked, its content is for viewers."""
    with file.open("rb") as stream:
        head = stream.read(12)
    report["bytes"] = file.stat().st_size
    report["next"] = "viewers and engines show it; femsense writes it and does not read it"
    if file.suffix.lower() == ".gltf":
        report["version"] = str(read_object(file).get("asset", {}).get("version", "not said"))
        return
    announced = int.from_bytes(head[8:12], "little")
    if head[:4] != b"glTF" or announced != report["bytes"]:
        found = f"{announced} bytes announced, {report['bytes']} there" if head[:4] == b"glTF" else repr(head[:4])
        problems.append(InputError("not a whole .glb file", where=file, found=found, expected="glTF and its length"))


def _robot_report(loaded: Robot, document: Mapping[str, Any]) -> Report:
    body = loaded.body
    volume = float(element_volumes(body.mesh).sum())
    mesh = {"file": document["mesh"]["file"], "unit": document["mesh"]["unit"]} | _mesh_report(body.mesh, 1e3)
    _warn_of_quality(mesh["radius_ratio_min"], document["mesh"]["file"])
    warn_of_tie_spacing(body)
    warn_of_linear_elements(body, where=document["mesh"]["file"])
    return {
        "mesh": mesh,
        "material": document["material"],
        "mass_g": 1e3 * volume * body.material.density,
        "gravity_m_s2": body.gravity,
        "clamped_nodes": len(body.clamped),
        "cables": [_cable_report(cable, body.mesh) for cable in body.cables],
        "chambers": [_chamber_report(chamber, body.mesh) for chamber in body.chambers],
        "markers": [
            {"name": name, "position_mm": 1e3 * point, "outside_mm": 1e3 * float(outside)}
            for name, point, outside in zip(loaded.marker_names, loaded.marker_points, loaded.markers.outside)
        ],
        "features": len(loaded.features),
        "color_rgb": loaded.color_rgb,
        "effects": [entry.get("name", "") for entry in document.get("effects", [])],
    }


def _cable_report(cable: Cable, mesh: TetMesh) -> Report:
    return {
        "name": cable.name,
        "points": len(cable.path),
        "length_mm": 1e3 * cable_length(cable, mesh.nodes),
        "bends_deg": float(np.degrees(bend_angles(cable, mesh.nodes).sum())),
        "outside_mm": 1e3 * float(cable.path.outside.max()),
        "max_tension_n": cable.max_tension,
    }


def _chamber_report(chamber: Chamber, mesh: TetMesh) -> Report:
    area = np.linalg.norm(triangle_normals(mesh.nodes, chamber.faces[:, :3]), axis=1)
    return {
        "name": chamber.name,
        "volume_cm3": 1e6 * chamber_volume(chamber, mesh.nodes),
        "area_cm2": 1e4 * float(area.sum()),
        "max_pressure_kpa": 1e-3 * chamber.max_pressure,
    }


def _mesh_report(mesh: TetMesh, to_mm: float) -> Report:
    """Return counts, extent and quality; `to_mm` millimetres make one unit of the nodes."""
    low, high = to_mm * mesh.nodes.min(axis=0), to_mm * mesh.nodes.max(axis=0)
    quality = radius_ratio(mesh)
    return {
        "element": "tet10" if mesh.is_quadratic else "tet4",
        "nodes": len(mesh.nodes),
        "tetrahedra": len(mesh.tets),
        "surface_triangles": len(surface_triangles(mesh)),
        "low_mm": low,
        "high_mm": high,
        "size_mm": high - low,
        "volume_cm3": float(element_volumes(mesh).sum()) * to_mm**3 / 1e3,
        "radius_ratio_min": float(quality.min()),
        "radius_ratio_median": float(np.median(quality)),
    }


def _warn_of_quality(worst: float, name: str) -> None:
    if worst < POOR_QUALITY:
        text = "a sliver makes the model stiff and the solver slow"
        warnings.warn(f"{name}: the worst element has a radius ratio of {worst:.3g} (1 is regular): {text}", stacklevel=2)


def _without_unit(report: Report) -> Report:
    """Rename lengths of a file whose unit is not known."""
    own = {key.removesuffix("_mm"): value for key, value in report.items() if key != "volume_cm3"}
    return {"lengths": "in the unit of the file"} | own


def _surface_report(points: FloatArray, triangles: Any, report: Report) -> None:
    low, high = points.min(axis=0), points.max(axis=0)
    report |= {"lengths": "in the unit of the file", "points": len(points), "triangles": len(triangles)}
    report |= {"low": low, "high": high, "size": high - low}
