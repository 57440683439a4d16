"""From a line with radii to a robot: its tetrahedra, its tendons in channels, its chambers, and a robot.toml that loads."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import femsense
from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.fem.mesh import TetMesh, element_volumes
from femsense.fem.mesh_checks import check_mesh
from femsense.io.files import check_target, file_hash, followed, plain, write_json, write_toml
from femsense.io.mesh_files import write_mesh
from femsense.io.meshing.channels import Channel, Subdivision, channel_path, pull_point, subdivided
from femsense.io.meshing.line_body import Cavity, LineBody, mesh_line, place
from femsense.io.meshing.line_file import LineTable, channels_of, line_of, read_line
from femsense.io.meshing.quality import quality_report, quality_text
from femsense.io.meshing.robot_from_surface import MESH_FILE, REPORT_FILE, finished, report_in
from femsense.io.robot_body import boxes_around
from femsense.io.robot_toml import load_robot
from femsense.io.tables import read_toml

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
        most_tets: approximate largest number of tetrahedra; along_mm: thickness of a layer instead [mm].
        say: called with one-line notes.
        again: repeat it even if the folder contains this result.
        progress: called with a description of each step.

    Raises:
        InputError: a description that makes no body, or a folder that holds something else.
    """
    path, target = Path(source).expanduser(), Path(folder).expanduser()
    inputs = {"line": path.name, "sha256": file_hash(path), "most_tets": most_tets, "along_mm": along_mm}
    _check_target(target)
    if not again and (known := finished(target, inputs)):
        say(f"{target} contains this robot already (--again repeats it)")
        return known
    table = read_line(path)
    line = line_of(table, path)
    tell = progress or (lambda text: None)
    tell("tetrahedra")
    mesh, along = mesh_line(line, most_tets=most_tets, along=None if along_mm is None else 1e-3 * along_mm)
    check_mesh(mesh, str(path))
    document = robot_document(table, line, clamp_boxes(table, line, mesh, along), read_toml(path))
    channels = channels_of(table, line, path)
    paths = subdivisions(document, mesh, line, channels, tell=tell)
    document |= {"cables": [_cable(line, channel, path.points) for channel, path in zip(channels, paths)]} if channels else {}
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
        "mesh_sha256": file_hash(target / MESH_FILE),
    }
    write_json(target / REPORT_FILE, report)
    return report


def _check_target(target: Path) -> None:
    check_target(target, folder=True)
    made_of = report_in(target).get("inputs")
    if target.is_dir() and any(target.iterdir()) and not (isinstance(made_of, dict) and "line" in made_of):
        raise InputError(
            "the folder contains something else than a robot from such a description",
            where=target,
            expected="a new folder",
            hint="another -o: robot.toml would be replaced",
        )


def clamp_boxes(table: LineTable, line: LineBody, mesh: TetMesh, along: FloatArray) -> list[FloatArray]:
    """Return boxes [m] that hold the clamped nodes and no others (see `boxes_around`)."""
    reach = table.clamp.length_mm / 1e3 + ROUND
    boxes = []
    for end, low, high in (("first", -1.0, reach), ("last", line.length - reach, np.inf)):
        if table.clamp.ends in (end, "both"):
            boxes += boxes_around(mesh.nodes, np.flatnonzero((along >= low) & (along <= high)), slack=ROUND)
    return boxes


def subdivisions(
    document: Mapping[str, Any], mesh: TetMesh, line: LineBody, channels: Sequence[Channel], *, tell: Callable[[str], None]
) -> tuple[Subdivision, ...]:
    """Return the number of points that the path of each tendon needs (see `subdivided`).

    Arguments:
        document: the tables of robot.toml without cables.
        mesh, line, channels: of the body.
        tell: called with a description of each trial.
    """
    if not channels:
        return ()
    with tempfile.TemporaryDirectory(prefix="femsense-") as trial, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # reported with the finished robot
        write_mesh(mesh, Path(trial, MESH_FILE))
        write_toml(Path(trial, "robot.toml"), document)
        body = load_robot(trial).body
    known = dict[tuple[object, ...], Subdivision]()
    for channel in channels:  # tendons that differ only in their angle need the same number
        if channel.need not in known:
            known[channel.need] = subdivided(body, line, channel, tell=tell)
    return tuple(replace(known[channel.need], name=channel.name) for channel in channels)


def robot_document(table: LineTable, line: LineBody, boxes: Sequence[FloatArray], raw: dict[str, Any]) -> dict[str, Any]:
    """Return the tables of robot.toml without cables; `raw` holds material and gravity as they were written."""
    document: dict[str, Any] = {
        "format": "femsense-robot-1",
        "name": table.name,
        "mesh": {"file": MESH_FILE, "unit": "m", "element": table.element},
        "material": raw["material"],
    }
    document |= {"gravity": raw["gravity"]} if "gravity" in raw else {}
    document["fixed"] = [{"box_m": np.round(box, 9).tolist()} for box in boxes]
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
    """Return the contents of a description as plain values. Raises InputError if it does not describe a body."""
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
