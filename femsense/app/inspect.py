"""What a file or a folder is, what is in it and what is wrong with it: a plain report for people and programs."""

from __future__ import annotations

import json
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from femsense.app.input_checks import cloud_problems
from femsense.core.arrays import FloatArray
from femsense.core.errors import FemsenseError, InputError
from femsense.core.pose import check_pose
from femsense.core.text import did_you_mean
from femsense.fem.body_parts import Cable, Chamber
from femsense.fem.chambers import chamber_volume
from femsense.fem.mesh import TetMesh, check_mesh, element_volumes, surface_triangles, triangle_normals
from femsense.io.checkpoint import UNFINISHED
from femsense.io.clouds.frame_clouds import FOLDERS, numbered_files, read_frame_cloud
from femsense.io.clouds.images import read_color, read_png
from femsense.io.files import plain
from femsense.io.mesh_files import (
    SURFACE_ENDINGS,
    closed_surface,
    ordered_tets,
    radius_ratio,
    read_tets,
    read_triangles,
)
from femsense.io.meshes.reading import file_format, read_content
from femsense.io.meshing.robot_from_line import line_report
from femsense.io.recording_folder import TOO_FAR, load_recording
from femsense.io.recording_toml import recording_problems
from femsense.io.robot_toml import RobotTable, load_robot, read_declared_mesh, robot_names, robot_problems
from femsense.io.tables import read_toml
from femsense.model.recording import Recording, check_against, warn_of_values
from femsense.model.robot import Robot
from femsense.model.tie_spacing import warn_of_tie_spacing
from femsense.rig.script import read_script

Report = dict[str, Any]
MESH_ENDINGS = (
    ".vtu",
    ".pvtu",
    ".vtk",
    ".msh",
    ".mesh",
    ".meshb",
    ".inp",
    ".bdf",
    ".nas",
    ".ele",
    ".node",
    ".xdmf",
    ".xmf",
    ".med",
    ".vol",
)
CAPTURE_ENDINGS = (".bag", ".db3", ".mcap", ".c3d", ".xyz", ".gz")
CLOUDS_READ = 8
"""So many clouds of a recording are read whole; of the others only the name and the size are checked."""
POOR_QUALITY = 0.05
"""A radius ratio below this is worth a warning."""


def inspect_path(path: str | Path, *, robot: str | Path | None = None) -> Report:
    """Return what a file or folder is and holds, and what is wrong with it.

    Arguments:
        path: a file, a folder, or the name of a robot.
        robot: a recording is compared with this robot.

    Returns:
        plain tables: `path`, `kind` (robot, recording, script, mesh, surface, cloud, image, calibration, run, loop, capture, table or
        unknown), what is in it with units in the names, and at the end `problems` and `warnings`, lists of texts.

    Raises:
        InputError: where there is nothing at this path; nothing else, whatever the content is.
    """
    target = _existing(path)
    report: Report = {"path": str(target), "kind": "unknown"}
    problems: list[str] = []
    notes: list[str] = []
    with _collected(problems, notes):
        kind, inspect = _kind(target)
        report["kind"] = kind
        inspect(target, report, problems)
        if robot is not None:
            _compare(target, report, robot)
    report["problems"] = problems
    report["warnings"] = [note for note in dict.fromkeys(notes) if note not in problems]
    checked: Report = plain(report)
    return checked


def _compare(target: Path, report: Report, robot: str | Path) -> None:
    """Compare a recording with a robot. Raises InputError where it does not fit."""
    from femsense.app.input_checks import warn_of_clouds

    if report["kind"] != "recording":
        raise InputError("--robot is about recordings", where=target, found=report["kind"], expected="a recording")
    loaded, body = load_recording(target), load_robot(robot)
    check_against(body, loaded)
    warn_of_clouds(body, loaded)
    report["robot"] = body.name


def inspect_accuracy(path: str | Path, *, progress: Callable[..., None] | None = None) -> Report:
    """Return a report of a robot with its discretisation error, under `accuracy` (see `assess_accuracy`); without where it has problems.

    Raises:
        InputError: where the path is no robot. DataError: where its model has no equilibrium.
    """
    from femsense.app.mesh_accuracy import assess_accuracy

    report = inspect_path(path)
    if report["kind"] != "robot":
        raise InputError(
            "--accuracy is about robots",
            where=path,
            found=TITLES.get(report["kind"], report["kind"]),
            expected="a folder with robot.toml, or the name of a robot",
        )
    if not report["problems"]:
        report["accuracy"] = plain(assess_accuracy(load_robot(_existing(path)), progress=progress))
    return report


def describe(report: Mapping[str, Any]) -> str:
    """Return a report of `inspect_path` as aligned plain text."""
    lines = [f"{report['path']}: {TITLES.get(report['kind'], report['kind'])}", ""]
    if "accuracy" in report:
        from femsense.app.mesh_accuracy import accuracy_text

        return "\n".join([*lines, accuracy_text(report["accuracy"])])
    lines += _section({key: value for key, value in report.items() if key not in ("path", "kind", "problems", "warnings")}, 2)
    for title in ("problems", "warnings"):
        texts = report.get(title, [])
        if texts:
            lines += ["", f"{len(texts)} {title if len(texts) > 1 else title[:-1]}:"]
            lines += [_bullet(text) for text in texts]
    if report["kind"] in ("capture", "table") and not report.get("problems"):
        lines += ["", "this much was read; femsense import reads the rest"]
    elif not report.get("problems"):
        lines += ["", "nothing is wrong with it" if not report.get("warnings") else "no problems"]
    return "\n".join(lines)


TITLES = {
    "line": "a body along a line (docs/bodies.md)",
    "robot": "a robot",
    "recording": "a recording",
    "mesh": "a mesh of tetrahedra",
    "surface": "a surface",
    "cloud": "a point cloud",
    "scene": "a glTF scene",
    "image": "an image",
    "calibration": "a calibration",
    "run": "the results of an estimate",
    "loop": "the result of a closed loop",
    "script": "a script of the virtual rig",
    "unfinished": "results that are not finished",
    "capture": "a capture of another program",
    "table": "a table",
    "unknown": "not a kind of file that femsense knows",
}


# What it is


def _existing(path: str | Path) -> Path:
    target = Path(path).expanduser()
    if target.exists():
        return target
    known = robot_names()
    if str(path) in known:
        return known[str(path)]
    around = [item.name for item in target.parent.iterdir()] if target.parent.is_dir() else []
    raise InputError(
        "nothing there",
        where=path,
        expected="a file, a folder or the name of a robot",
        hint=did_you_mean(target.name, [*around, *known]),
    )


Inspector = Callable[[Path, Report, list[str]], None]


def _kind(path: Path) -> tuple[str, Inspector]:
    return _kind_of_folder(path) if path.is_dir() else _kind_of_file(path)


def _kind_of_folder(folder: Path) -> tuple[str, Inspector]:
    signs: tuple[tuple[str, str, Inspector], ...] = (
        ("loop.json", "loop", _loop),
        ("robot.toml", "robot", _robot),
        ("recording.toml", "recording", _recording),
        ("run.json", "run", _run),
        ("contacts.csv", "run", _run),
        ("frames.csv", "recording", _recording),
        (UNFINISHED, "unfinished", _unfinished),
    )
    return next(((kind, inspect) for name, kind, inspect in signs if (folder / name).is_file()), ("unknown", _folder))


def _kind_of_file(file: Path) -> tuple[str, Inspector]:
    ending = file.suffix.lower()
    if ending == ".toml":
        return _kind_of_toml(file)
    if ending == ".json":
        return _kind_of_json(file)
    if ending in (".pcd", ".xyz") or (ending == ".ply" and not _has_faces(file)):
        return "cloud", _cloud
    if ending in SURFACE_ENDINGS:
        return "surface", _surface
    if ending in (".glb", ".gltf") or _starts_with(file, b"glTF"):
        return "scene", _scene
    if ending in MESH_ENDINGS or file_format(file):
        return "mesh", _mesh
    if ending in CAPTURE_ENDINGS:
        return "capture", _capture
    others: dict[str, tuple[str, Inspector]] = {
        ".jpg": ("image", _jpeg),
        ".jpeg": ("image", _jpeg),
        ".png": ("image", _image),
        ".csv": ("table", _table_file),
    }
    return others.get(ending, ("unknown", _unknown))


def _kind_of_toml(file: Path) -> tuple[str, Inspector]:
    own = _format(file)
    if file.name == "recording.toml" or own.startswith("femsense-recording"):
        return "recording", _recording
    if own.startswith("femsense-line"):
        return "line", _line
    return ("script", _script) if own.startswith("femsense-script") else ("robot", _robot)


def _kind_of_json(file: Path) -> tuple[str, Inspector]:
    text = file.read_text(encoding="utf-8-sig", errors="replace")[:100_000]
    if file.name == "loop.json" or "femsense-loop" in text:
        return "loop", _loop
    if file.name == "calibration.json" or "femsense-calibration" in text:
        return "calibration", _calibration
    return ("run", _run) if file.name == "run.json" else ("unknown", _unknown)


def _format(file: Path) -> str:
    try:
        return str(read_toml(file).get("format", ""))
    except InputError:
        return ""


def _starts_with(file: Path, magic: bytes) -> bool:
    with file.open("rb") as stream:
        return stream.read(len(magic)) == magic


def _has_faces(file: Path) -> bool:
    with file.open("rb") as stream:
        header = stream.read(4096).split(b"end_header")[0].splitlines()
    return any(line.split()[:2] == [b"element", b"face"] and line.split()[2:] != [b"0"] for line in header)


@contextmanager
def _collected(problems: list[str], notes: list[str]) -> Iterator[None]:
    """Turn what the block raises into a problem, and its warnings into notes."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            yield
        except FemsenseError as error:
            problems.append(str(error))
        except Exception as error:  # whatever a broken file makes of a reader
            problems.append(f"cannot be read: {type(error).__name__}: {error}")
    notes += [str(item.message) for item in caught if issubclass(item.category, UserWarning)]


# Robots and meshes


def _robot(path: Path, report: Report, problems: list[str]) -> None:
    file = path / "robot.toml" if path.is_dir() else path
    document = read_toml(file)
    report["name"] = str(document.get("name", ""))
    found = robot_problems(document, file)
    problems += [str(problem) for problem in found]
    if found:
        return
    loaded = _attempt(lambda: load_robot(path, effects=False), problems)
    if loaded is None:
        table = RobotTable.model_validate(document).mesh
        mesh = _attempt(lambda: read_declared_mesh(table, file), [])
        report.update({"mesh": _mesh_report(mesh, 1e3)} if mesh is not None else {})
        return
    report.update(_robot_report(loaded, document))
    if document.get("effects"):
        _attempt(lambda: load_robot(file), problems)


def _attempt(action: Callable[[], Any], problems: list[str]) -> Any:
    """Return what the action returns; None where it raises, with the text among the problems."""
    notes: list[str] = []
    result = None
    with _collected(problems, notes):
        result = action()
    for note in notes:
        warnings.warn(note, stacklevel=2)
    return result


def _robot_report(loaded: Robot, document: Mapping[str, Any]) -> Report:
    body = loaded.body
    volume = float(element_volumes(body.mesh).sum())
    mesh = {"file": document["mesh"]["file"], "unit": document["mesh"]["unit"]} | _mesh_report(body.mesh, 1e3)
    _warn_of_quality(mesh["radius_ratio_min"], document["mesh"]["file"])
    warn_of_tie_spacing(body)
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
    points = np.vstack([cable.path.positions(mesh.nodes), cable.pull_point])
    legs = np.diff(points, axis=0)
    length = np.linalg.norm(legs, axis=1)
    units = legs[length > 0] / length[length > 0, None]
    if cable.exit_direction is not None:
        units = np.vstack([units, cable.exit_direction])
    angles = np.arccos(np.clip(np.einsum("ic,ic->i", units[:-1], units[1:]), -1.0, 1.0))
    return {
        "name": cable.name,
        "points": len(cable.path),
        "length_mm": 1e3 * float(length.sum()),
        "bends_deg": float(np.degrees(angles.sum())),
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
        warnings.warn(
            f"{name}: the worst element has a radius ratio of {worst:.3g} (1 is regular): a sliver makes the model stiff and the solver slow",
            stacklevel=2,
        )


def _mesh(file: Path, report: Report, problems: list[str]) -> None:
    content = read_content(file, str(file))
    points, cells = content.points, content.cells
    report["cells"] = {kind: len(data) for kind, data in cells.items()}
    kinds = [kind for kind in ("tetra", "tetra10") if kind in cells]
    if not kinds and "triangle" in cells:
        report["kind"] = "surface"
        _surface_report(points, cells["triangle"], report)
        _attempt(lambda: closed_surface(points, cells["triangle"], str(file)), problems)
        return
    mesh = ordered_tets(points, cells[kinds[0]], str(file)) if len(kinds) == 1 else read_tets(file)
    report.update(_without_unit(_mesh_report(mesh, 1.0)))
    _attempt(lambda: check_mesh(mesh, str(file)), problems)
    _warn_of_quality(report["radius_ratio_min"], file.name)


def _without_unit(report: Report) -> Report:
    """Rename lengths of a file whose unit is not known."""
    names = {"low_mm": "low", "high_mm": "high", "size_mm": "size"}
    return {"lengths": "in the unit of the file"} | {
        names.get(key, key): value for key, value in report.items() if key != "volume_cm3"
    }


def _scene(file: Path, report: Report, problems: list[str]) -> None:
    """A .glb is what `femsense export` writes; its header is checked, its content is for viewers."""
    with file.open("rb") as stream:
        head = stream.read(12)
    report["bytes"] = file.stat().st_size
    report["next"] = "viewers and engines show it; femsense writes it and does not read it"
    if file.suffix.lower() == ".gltf":
        report["version"] = str(_json(file).get("asset", {}).get("version", "not said"))
        return
    announced = int.from_bytes(head[8:12], "little")
    if head[:4] != b"glTF" or announced != report["bytes"]:
        found = f"{announced} bytes announced, {report['bytes']} there" if head[:4] == b"glTF" else repr(head[:4])
        problems.append(str(InputError("not a whole .glb file", where=file, found=found, expected="glTF and its length")))


def _surface(file: Path, report: Report, problems: list[str]) -> None:
    points, triangles = read_triangles(file)
    _surface_report(points, triangles, report)
    _attempt(lambda: closed_surface(points, triangles, str(file)), problems)


def _surface_report(points: FloatArray, triangles: Any, report: Report) -> None:
    low, high = points.min(axis=0), points.max(axis=0)
    report.update(
        {
            "lengths": "in the unit of the file",
            "points": len(points),
            "triangles": len(triangles),
            "low": low,
            "high": high,
            "size": high - low,
        }
    )


# Recordings, clouds, images


def _recording(path: Path, report: Report, problems: list[str]) -> None:
    folder = path if path.is_dir() else path.parent
    toml = folder / "recording.toml"
    if toml.is_file():
        found = recording_problems(read_toml(toml), toml)
        problems += [str(problem) for problem in found]
        if found:
            return
    loaded = load_recording(folder)
    report.update(_recording_report(loaded))
    warn_of_values(loaded)
    if not loaded.has_clouds and not loaded.has_markers and not len(loaded.unnamed_frame):
        problems.append(f"{folder}: neither markers nor clouds: nothing was measured")
    _check_clouds(loaded, report, problems)
    problems += cloud_problems(loaded)
    _warn_of_unmatched(loaded, folder)


def _recording_report(r: Recording) -> Report:
    steps = np.diff(r.time_s)
    _warn_of_gaps(r, steps)
    return {
        "frames": r.frame_count,
        "duration_s": float(r.time_s[-1] - r.time_s[0]),
        "rate_hz": 1.0 / float(np.median(steps)) if len(steps) else None,
        "actuation": r.actuation,
        "actuation_zero": r.actuation_zero,
        "cables": _input_report(r.cable_names, r.inputs, "n" if r.actuation == "tension" else "m"),
        "chambers": _input_report(r.chamber_names, r.pressures, "pa"),
        "free_frames": None if r.free is None else int(r.free.sum()),
        "sweeps": None if r.sweep is None else dict(Counter(r.sweep)),
        "gravity": "as the robot declares" if r.gravity is None else "given for each frame",
        "cameras": [_camera_report(r, v) for v in range(len(r.camera_names))],
        "markers": _marker_report(r),
        "markers_without_names": len(r.unnamed_frame) or None,
        "tools": [{"name": tool.name, "kind": tool.kind} for tool in r.tools],
        "session": r.session,
        "rest_markers": None if r.rest is None else len(r.rest.names),
        "loads": _load_report(r),
    }


def _input_report(names: Sequence[str], values: FloatArray, unit: str) -> list[Report]:
    return [
        {"name": name, f"min_{unit}": float(column.min()), f"max_{unit}": float(column.max())}
        for name, column in zip(names, values.T)
    ]


def _camera_report(r: Recording, v: int) -> Report:
    camera = r.cameras[v]
    files = [files[v] for files in r.cloud_files if files[v] is not None]
    images = sum(file is not None and file.suffix.lower() == ".png" for file in files)
    return {
        "name": r.camera_names[v] or "(the camera)",
        "pixels": f"{camera.width} × {camera.height}" if camera else "lens not given",
        "depth_unit_m": camera.depth_unit if camera and images else None,
        "pose": "not known" if r.T_robot_camera[v] is None else "known",
        "clouds": len(files) - images,
        "depth_images": images,
        "color_images": sum(files[v] is not None for files in r.color_files),
        "marker_rows": int((r.marker_view == v).sum()),
    }


def _marker_report(r: Recording) -> Report | None:
    if not r.has_markers:
        return None
    seen = np.zeros((r.frame_count, len(r.marker_names)), dtype=bool)
    seen[r.marker_frame, r.marker_index] = True
    visible = seen.sum(axis=1)
    return {
        "visible_per_frame_min": int(visible.min()),
        "visible_per_frame_median": float(np.median(visible)),
        "visible_per_frame_max": int(visible.max()),
        "hidden_share": 1.0 - float(seen.mean()),
        "each": [{"name": name, "frames": int(count)} for name, count in zip(r.marker_names, seen.sum(axis=0))],
    }


def _load_report(r: Recording) -> Report | None:
    if not len(r.load_frame):
        return None
    total = np.zeros((r.frame_count, 3))
    np.add.at(total, r.load_frame, r.load_forces)
    return {
        "rows": len(r.load_frame),
        "frames": len(np.unique(r.load_frame)),
        "largest_total_n": float(np.linalg.norm(total, axis=1).max()),
    }


def _check_clouds(r: Recording, report: Report, problems: list[str]) -> None:
    """Read some clouds whole; say which files are empty and what extent the read ones have."""
    frames = [(k, v) for k in range(r.frame_count) for v in range(len(r.camera_names)) if r.cloud_files[k][v] is not None]
    if not frames:
        return
    chosen = {frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, CLOUDS_READ).astype(int))}
    counts: list[int] = []
    for k, v in frames:
        file = r.cloud_files[k][v]
        if (k, v) in chosen:
            cloud = _attempt(partial(read_frame_cloud, r, k, view=v), problems)
            counts += [len(cloud)] if cloud is not None else []
        elif file is not None and file.stat().st_size == 0:
            problems.append(f"{file}: the file is empty")
    report["clouds"] = {
        "frames_with_cloud": len({k for k, _ in frames}),
        "frames_without_cloud": r.frame_count - len({k for k, _ in frames}),
        "read": len(counts),
        "points_median": float(np.median(counts)) if counts else None,
    }


def _warn_of_gaps(r: Recording, steps: FloatArray) -> None:
    if len(steps) < 3:
        return
    gaps = np.flatnonzero(steps > 5.0 * np.median(steps))
    if len(gaps):
        k = int(gaps[0])
        warnings.warn(
            f"{len(gaps)} gaps in time of more than five frames, the first of {steps[k]:.3g} s before frame {r.frame_numbers[k + 1]}",
            stacklevel=2,
        )


def _warn_of_unmatched(r: Recording, folder: Path) -> None:
    """Warn of clouds and images whose number is no frame."""
    numbers = set(r.frame_numbers.tolist())
    for kind, endings in FOLDERS.items():
        for name in r.camera_names:
            outliers = sorted(set(numbered_files(folder / kind / name, endings)) - numbers)
            if outliers:
                warnings.warn(
                    f"{folder / kind / name}: {len(outliers)} files whose number is not in frames.csv, the first is {outliers[0]}",
                    stacklevel=2,
                )
    if any((folder / "clouds").glob("*/*.p[lc][yd]")) and r.camera_names == ("",):
        warnings.warn(
            f"{folder / 'clouds'}: folders of clouds, but recording.toml has no [cameras.NAME]: they are not used", stacklevel=2
        )


def _cloud(file: Path, report: Report, problems: list[str]) -> None:
    from femsense.io.clouds.cloud_files import read_cloud

    cloud = read_cloud(file)
    report.update({"points": len(cloud), "colors": cloud.colors is not None})
    if not len(cloud):
        problems.append(f"{file}: the cloud has no points")
        return
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    report.update(
        {
            "low_mm": 1e3 * low,
            "high_mm": 1e3 * high,
            "median_distance_mm": 1e3 * float(np.median(np.linalg.norm(cloud.points, axis=1))),
        }
    )
    if np.abs(cloud.points).max() > TOO_FAR:
        problems.append(
            f"{file}: coordinates of this size look like millimetres\n  found:    up to {np.abs(cloud.points).max():.4g}\n  expected: metres"
        )


def _image(file: Path, report: Report, problems: list[str]) -> None:
    image = read_png(file)
    depth = image.ndim == 2 and image.dtype == np.uint16
    channels = 1 if image.ndim == 2 else image.shape[2]
    report.update({"width": image.shape[1], "height": image.shape[0], "channels": channels, "bits": 8 * image.dtype.itemsize})
    report["content"] = "depth" if depth else "colour" if channels >= 3 else "grey"
    if depth:
        valid = image[image > 0]
        report.update(
            {
                "valid_share": float((image > 0).mean()),
                "depth_min": int(valid.min()) if valid.size else None,
                "depth_median": float(np.median(valid)) if valid.size else None,
                "depth_max": int(valid.max()) if valid.size else None,
            }
        )
        if not valid.size:
            problems.append(f"{file}: no pixel has a depth")


def _jpeg(file: Path, report: Report, problems: list[str]) -> None:
    image = read_color(file)
    report.update({"width": image.shape[1], "height": image.shape[0], "channels": 3, "bits": 8, "content": "colour"})


# Results


def _json(file: Path) -> dict[str, Any]:
    try:
        data = json.loads(file.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError) as error:
        raise InputError("not valid JSON", where=file, found=str(error), expected="one JSON object") from None
    if not isinstance(data, dict):
        raise InputError("not a JSON object", where=file, found=type(data).__name__, expected="one JSON object")
    return data


def _expect(data: Mapping[str, Any], name: str, keys: Sequence[str], file: Path) -> list[str]:
    """Return the texts of a wrong format and of missing keys."""
    texts = []
    if data.get("format") != name:
        texts.append(
            str(InputError("another format", where=f"{file}: format", found=repr(data.get("format")), expected=repr(name)))
        )
    missing = [key for key in keys if key not in data]
    if missing:
        texts.append(str(InputError("keys are missing", where=file, found=", ".join(data), expected=", ".join(missing))))
    return texts


def _script(file: Path, report: Report, problems: list[str]) -> None:
    script = read_script(file)
    report["actuation"] = script.actuation
    report["sweeps"] = [
        {"label": s.label, "frames": len(s.profile()), "drives": ", ".join([*s.cables, *s.chambers])} for s in script.sweeps
    ]
    report["frames"] = sum(len(s.profile()) for s in script.sweeps)
    report["effects"] = [str(entry.get("name", "")) for entry in script.effects]
    report["contacts"], report["loads"] = len(script.contacts), len(script.loads)
    report["camera"] = f"{script.camera.width} × {script.camera.height}"
    report["clouds"] = script.clouds.kind


def _line(file: Path, report: Report, problems: list[str]) -> None:
    report.update(line_report(file))


def _unfinished(folder: Path, report: Report, problems: list[str]) -> None:
    report["holds"] = f"{(folder / UNFINISHED).stat().st_size / 1e6:.0f} MB of work that is done"
    problems.append(
        str(
            InputError("a command was stopped here", where=folder, hint="run the same command again: it goes on where it stopped")
        )
    )


def _calibration(file: Path, report: Report, problems: list[str]) -> None:
    data = _json(file)
    problems += _expect(data, "femsense-calibration-1", ("T_robot_camera", "rms_m", "status"), file)
    for key in ("status", "rms_m", "T_robot_camera", "cable_tension_n", "cable_displacement_m", "marker_rms_m"):
        if key in data:
            report[key] = data[key]
    report["iterations"] = len(data.get("history") or [])
    pose = data.get("T_robot_camera")
    if isinstance(pose, list):
        _attempt(lambda: check_pose(pose, f"{file}: T_robot_camera"), problems)


def _loop(path: Path, report: Report, problems: list[str]) -> None:
    file = path / "loop.json" if path.is_dir() else path
    data = _json(file)
    problems += _expect(data, "femsense-loop-1", ("verdict", "before", "after", "effects"), file)
    for key in ("verdict", "noise_m", "before", "after", "left", "next_experiment"):
        if key in data:
            report[key] = data[key]
    effects = data.get("effects")
    names = [entry.get("name", "?") if isinstance(entry, dict) else str(entry) for entry in effects or []]
    report["effects"] = names
    report["candidates"] = len(data.get("candidates") or [])
    improved = file.parent / "robot.toml"
    if path.is_dir() and improved.is_file():
        inner: Report = {}
        _robot(improved, inner, problems)
        report["robot"] = inner


def _run(path: Path, report: Report, problems: list[str]) -> None:
    folder = path if path.is_dir() else path.parent
    expected = ("contacts.csv", "frames.csv", "states.npz", "run.json")
    missing = [name for name in expected if not (folder / name).is_file()]
    if missing:
        problems.append(
            str(
                InputError(
                    "files are missing",
                    where=folder,
                    found=", ".join(sorted(p.name for p in folder.iterdir())),
                    expected=", ".join(missing),
                    hint="run femsense estimate again: it goes on where it stopped",
                )
            )
        )
    if (folder / "run.json").is_file():
        data = _attempt(lambda: _json(folder / "run.json"), problems) or {}
        report["run"] = {key: value for key, value in data.items() if isinstance(value, str | int | float | bool)}
    for name in ("frames.csv", "contacts.csv"):
        if (folder / name).is_file():
            report[name.removesuffix(".csv")] = _attempt(partial(_csv_report, folder / name), problems)
    if (folder / "states.npz").is_file():
        report["states"] = _attempt(lambda: _npz_report(folder / "states.npz"), problems)


def _csv_report(file: Path) -> Report:
    import csv

    with file.open(encoding="utf-8-sig", newline="") as stream:
        reader = csv.reader(stream)
        columns = next(reader, [])
        rows = [row for row in reader if any(row)]
    report: Report = {"rows": len(rows), "columns": len(columns)}
    if "status" in columns:
        report["status"] = dict(Counter(row[columns.index("status")] for row in rows if len(row) == len(columns)))
    if "force_n" in columns and rows:
        report["largest_force_n"] = max(float(row[columns.index("force_n")] or 0.0) for row in rows)
    return report


def _npz_report(file: Path) -> Report:
    with np.load(file) as data:
        return {name: " × ".join(str(n) for n in data[name].shape) for name in data.files}


def _table_file(file: Path, report: Report, problems: list[str]) -> None:
    from femsense.io.importers.guess import guess_format

    if guess_format(file) in ("optitrack", "vicon"):
        report["kind"] = "capture"
        _capture(file, report, problems)
        return
    report.update(_csv_report(file))


def _capture(path: Path, report: Report, problems: list[str]) -> None:
    """Ask the importer what is in it; frames are not read here."""
    from femsense.io.importers.guess import contents

    report["bytes"] = path.stat().st_size if path.is_file() else None
    found = _attempt(lambda: contents(path), problems)
    if found is not None:
        report.update({**found, "next": "femsense import reads its frames and makes a recording of it"})


def _folder(folder: Path, report: Report, problems: list[str]) -> None:
    from femsense.io.importers.guess import guess_format

    if guess_format(folder) is not None:
        report["kind"] = "capture"
        _capture(folder, report, problems)
        return
    endings = Counter(item.suffix.lower() or "(none)" for item in folder.iterdir() if item.is_file())
    report.update({"files": dict(endings), "folders": sorted(item.name for item in folder.iterdir() if item.is_dir())})
    problems.append(
        str(
            InputError(
                "nothing that femsense knows",
                where=folder,
                found=", ".join(f"{n} {e}" for e, n in endings.items()) or "no files",
                expected="robot.toml, recording.toml, run.json or loop.json",
                hint="femsense import makes a recording of folders of clouds or images",
            )
        )
    )


def _unknown(file: Path, report: Report, problems: list[str]) -> None:
    report["bytes"] = file.stat().st_size
    problems.append(
        str(
            InputError(
                "not a kind of file that femsense knows",
                where=file,
                found=file.suffix or "no ending",
                expected="a robot, a recording, a mesh, a surface, a cloud, an image or a result",
            )
        )
    )


# Text


def section_text(items: Mapping[str, Any]) -> list[str]:
    """Return lines of aligned labels and values."""
    return _section(items, 2)


UNITS = {
    "kg_m3": "kg/m³",
    "m_s2": "m/s²",
    "cm3": "cm³",
    "mm": "mm",
    "hz": "1/s",
    "deg": "°",
    "pa": "Pa",
    "n": "N",
    "g": "g",
    "s": "s",
    "m": "m",
}


def _section(items: Mapping[str, Any], indent: int) -> list[str]:
    """Return lines of aligned labels and values; tables and nested sections below their label."""
    shown = {key: value for key, value in items.items() if value is not None and value != [] and value != {}}
    width = max((len(_label(key)) for key, value in shown.items() if not _nested(value)), default=0)
    lines: list[str] = []
    for key, value in shown.items():
        if isinstance(value, Mapping):
            lines += [" " * indent + _label(key), *_section(value, indent + 2)]
        elif _nested(value):
            lines += [" " * indent + _label(key), *_grid(value, indent + 2)]
        else:
            lines.append(" " * indent + f"{_label(key):<{width}}  {_value(key, value)}")
    return lines


def _nested(value: Any) -> bool:
    return isinstance(value, Mapping) or (isinstance(value, list) and bool(value) and isinstance(value[0], Mapping | list))


def _grid(rows: Sequence[Any], indent: int) -> list[str]:
    """Return a table of mappings, or the rows of a matrix, as aligned lines."""
    if not isinstance(rows[0], Mapping):
        return [" " * indent + _value("", row) for row in rows]
    keys = [key for key in rows[0] if any(row.get(key) is not None for row in rows)]
    cells = [[_label(key) for key in keys]] + [[_value(key, row.get(key)) for key in keys] for row in rows]
    widths = [max(len(row[j]) for row in cells) for j in range(len(keys))]
    return [(" " * indent + "  ".join(cell.ljust(width) for cell, width in zip(row, widths))).rstrip() for row in cells]


def _label(key: str) -> str:
    for ending, unit in UNITS.items():
        if key.endswith("_" + ending):
            return f"{key.removesuffix('_' + ending).replace('_', ' ')} [{unit}]"
    return key.replace("_", " ")


def _value(key: str, value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if key.endswith("share"):
        return f"{100.0 * value:.1f} %"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return ", ".join(_value("", item) for item in value)
    return str(value)


def _bullet(text: str) -> str:
    first, *rest = text.splitlines()
    return "\n".join([f"  - {first}", *(f"  {line}" for line in rest)])
