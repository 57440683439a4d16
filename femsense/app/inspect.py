"""The kind, content and problems of a file or a folder: a plain report for people and programs."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from femsense.app.inspection.recordings import JPEG, inspect_cloud, inspect_image, inspect_recording
from femsense.app.inspection.reports import Problems, Report, collected
from femsense.app.inspection.results import (
    inspect_cad,
    inspect_calibration,
    inspect_capture,
    inspect_line,
    inspect_loop,
    inspect_many,
    inspect_run,
    inspect_script,
    inspect_table,
    inspect_unfinished,
    inspect_unknown,
)
from femsense.app.inspection.robots import inspect_mesh, inspect_robot, inspect_scene, inspect_surface
from femsense.app.inspection.text import bullet, section_lines
from femsense.core.errors import FemsenseError, InputError
from femsense.core.text import did_you_mean, one_line
from femsense.io.checkpoint import UNFINISHED
from femsense.io.files import check_no_pipe, plain
from femsense.io.importers.formats import CAPTURE_ENDINGS
from femsense.io.importers.ros.bag import content_ending
from femsense.io.mesh_files import SURFACE_ENDINGS
from femsense.io.meshes.reading import file_format
from femsense.io.meshing.cad import CAD_READ
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot, robot_names
from femsense.io.tables import read_toml
from femsense.model.recording import Recording
from femsense.model.recording_checks import check_against
from femsense.model.robot import Robot

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


def inspect_path(path: str | Path, *, robot: str | Path | None = None) -> Report:
    """Return kind, content and problems of a file or folder.

    Arguments:
        path: a file, a folder, or the name of a robot.
        robot: a recording is compared with this robot.

    Returns:
        plain tables: `path`, `kind` (robot, recording, script, mesh, surface, cad, cloud, image, calibration, run, loop,
        capture, table or unknown), its contents with units in the keys, and at the end `problems` and `warnings`,
        lists of texts.

    Raises:
        InputError: nothing exists at this path, or a pipe. Any content is reported, not raised.
    """
    target = _existing(path)
    check_no_pipe([target])
    report: Report = {"path": str(target), "kind": "unknown"}
    problems: Problems = []
    notes: list[str] = []
    with collected(problems, notes):
        kind = _kind(target)
        report["kind"] = kind
        KINDS[kind][1](target, report, problems)
        if robot is not None:
            _compare(target, report, robot)
    report["problems"] = [str(problem) for problem in problems]
    report["warnings"] = [note for note in dict.fromkeys(notes) if note not in report["problems"]]
    checked: Report = plain(report)
    return checked


def _compare(target: Path, report: Report, robot: str | Path) -> None:
    """Compare a recording with a robot. Raises InputError where it does not fit."""
    from femsense.app.input_checks import warn_of_markers, warn_of_pictures

    if report["kind"] != "recording":
        raise InputError("--robot is about recordings", where=target, found=report["kind"], expected="a recording")
    loaded, body = load_recording(target), load_robot(robot)
    check_against(body, loaded)
    warn_of_pictures(body, loaded)
    warn_of_markers(body, loaded)
    report["robot"] = body.name
    report["force_resolution"] = _resolution(body, loaded)


def _resolution(robot: Robot, recording: Recording) -> Report:
    """Return the forces that the recording resolves; the camera's pose is found first."""
    from femsense.app.force_resolution import force_resolution, unknown_resolution
    from femsense.calib.calibrate import calibrate

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # calibrate prints them itself
        try:
            document, text = force_resolution(robot, recording, calibrate(robot, recording))
        except FemsenseError as error:
            document, text = unknown_resolution(f"the camera's pose was not found: {one_line(error)}")
    return document | {"text": text}


def inspect_accuracy(path: str | Path, *, progress: Callable[..., None] | None = None) -> Report:
    """Return a report of a robot with its discretisation error, under `accuracy` (see `assess_accuracy`);
    without where it has problems.

    Raises:
        InputError: where the path is no robot. DataError: where its model has no equilibrium.
    """
    from femsense.app.accuracy.assess import assess_accuracy

    report = inspect_path(path)
    if report["kind"] != "robot":
        raise InputError(
            "--accuracy is about robots",
            where=path,
            found=KINDS[report["kind"]][0],
            expected="a folder with robot.toml, or the name of a robot",
        )
    if not report["problems"]:
        report["accuracy"] = plain(assess_accuracy(load_robot(_existing(path)), progress=progress))
    return report


def describe(report: Mapping[str, Any]) -> str:
    """Return a report of `inspect_path` as aligned plain text."""
    lines = [f"{report['path']}: {KINDS[report['kind']][0]}", ""]
    if "accuracy" in report:
        from femsense.app.accuracy.report import accuracy_text

        return "\n".join([*lines, accuracy_text(report["accuracy"])])
    lines += section_lines(
        {key: value for key, value in report.items() if key not in ("path", "kind", "force_resolution", "problems", "warnings")},
        2,
    )
    if forces := report.get("force_resolution"):
        lines += ["", forces["text"]]
    for title in ("problems", "warnings"):
        texts = report.get(title, [])
        if texts:
            lines += ["", f"{len(texts)} {title if len(texts) > 1 else title[:-1]}:"]
            lines += [bullet(text) for text in texts]
    if report["kind"] in ("capture", "table", "cad") and not report.get("problems"):
        command = "mesh" if report["kind"] == "cad" else "import"
        lines += ["", f"this much was read; femsense {command} reads the rest"]
    elif not report.get("problems"):
        lines += ["", "nothing is wrong with it" if not report.get("warnings") else "no problems"]
    return "\n".join(lines)


Inspector = Callable[[Path, Report, Problems], None]
KINDS: dict[str, tuple[str, Inspector]] = {
    "line": ("a body along a line (femsense docs bodies)", inspect_line),
    "robot": ("a robot", inspect_robot),
    "recording": ("a recording", inspect_recording),
    "mesh": ("a mesh of tetrahedra", inspect_mesh),
    "surface": ("a surface", inspect_surface),
    "cad": ("a CAD file", inspect_cad),
    "cloud": ("a point cloud", inspect_cloud),
    "scene": ("a glTF scene", inspect_scene),
    "image": ("an image", inspect_image),
    "calibration": ("a calibration", inspect_calibration),
    "run": ("the results of an estimate", inspect_run),
    "loop": ("the result of a closed loop", inspect_loop),
    "many": ("the results of many recordings", inspect_many),
    "script": ("a script of the virtual rig", inspect_script),
    "unfinished": ("results that are not finished", inspect_unfinished),
    "capture": ("a capture of another program", inspect_capture),
    "table": ("a table", inspect_table),
    "unknown": ("not a kind of file that femsense knows", inspect_unknown),
}
"""Kind → its title, and the function that reports the contents of such a file or folder. A report may refine its kind."""


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


def _kind(path: Path) -> str:
    return _kind_of_folder(path) if path.is_dir() else _kind_of_file(path)


def _kind_of_folder(folder: Path) -> str:
    signs = (
        ("loop.json", "loop"),
        ("robot.toml", "robot"),
        ("recording.toml", "recording"),
        ("run.json", "run"),
        ("contacts.csv", "run"),
        ("frames.csv", "recording"),
        (UNFINISHED, "unfinished"),
        ("many.json", "many"),
    )
    return next((kind for name, kind in signs if (folder / name).is_file()), "unknown")


def _kind_of_file(file: Path) -> str:
    ending = file.suffix.lower()
    if ending == ".toml":
        return _kind_of_toml(file)
    if ending == ".json":
        return _kind_of_json(file)
    if ending in (".pcd", ".xyz") or (ending == ".ply" and not _has_faces(file)):
        return "cloud"
    if ending in SURFACE_ENDINGS:
        return "surface"
    if ending in (".glb", ".gltf") or _starts_with(file, b"glTF"):
        return "scene"
    if ending in MESH_ENDINGS or file_format(file):
        return "mesh"
    if ending in CAD_READ:
        return "cad"
    if ending in CAPTURE_ENDINGS or content_ending(file):
        return "capture"
    images, tables = dict.fromkeys((*JPEG, ".png"), "image"), dict.fromkeys((".csv", ".tsv", ".txt"), "table")
    return (images | tables).get(ending, "unknown")


def _kind_of_toml(file: Path) -> str:
    own = _format(file)
    if file.name == "recording.toml" or own.startswith("femsense-recording"):
        return "recording"
    if own.startswith("femsense-line"):
        return "line"
    return "script" if own.startswith("femsense-script") else "robot"


def _kind_of_json(file: Path) -> str:
    text = file.read_text(encoding="utf-8-sig", errors="replace")[:100_000]
    if file.name == "loop.json" or "femsense-loop" in text:
        return "loop"
    if file.name == "calibration.json" or "femsense-calibration" in text:
        return "calibration"
    return "run" if file.name == "run.json" else "unknown"


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
