"""What the commands leave behind: calibration.json, the files of a run, loop.json with the improved robot.

Everything is written beside and renamed. run.json and loop.json are the last of their folder to appear and the first to go,
so that a folder that has them is complete; they hold what it was made from, so that a second run sees that nothing is to be done.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as version_of
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

import femsense
from femsense.arrays import FloatArray, freeze
from femsense.calib.calibration import Calibration
from femsense.effects.own import find_own_file
from femsense.errors import InputError
from femsense.files import PART_PREFIX, file_hash, json_text, plain, write_beside, write_csv, write_json
from femsense.pose import check_pose
from femsense.tables import read_csv

if TYPE_CHECKING:
    from femsense.loop import LoopResult
    from femsense.model import Robot
    from femsense.recording import Recording
    from femsense.sensing import ContactForce, FrameReport, Run, States

CALIBRATION_FORMAT = "femsense-calibration-1"
RUN_FORMAT = "femsense-run-1"
LOOP_FORMAT = "femsense-loop-1"
RUN_FILES = ("contacts.csv", "frames.csv", "states.npz", "run.json")
CONTACT_COLUMNS = (
    "frame", "time_s", "contact", "x_m", "y_m", "z_m", "nx", "ny", "nz", "fx_n", "fy_n", "fz_n", "force_n", "std_n", "source",
)  # fmt: skip
FRAME_COLUMNS = ("frame", "time_s", "status", "contacts", "matched", "rms_before_m", "rms_after_m", "ms")
RECORDING_PARTS = ("recording.toml", "frames.csv", "markers.csv", "rest.csv", "loads.csv", "clouds", "depth", "color")
"""What results depend on; other files of a recording, such as the truth beside it, do not count."""


# Calibration


def calibration_document(calibration: Calibration) -> dict[str, Any]:
    """Return the content of calibration.json."""
    c = calibration
    document: dict[str, Any] = {
        "format": CALIBRATION_FORMAT,
        "status": c.status,
        "T_robot_camera": c.T_robot_camera,
        "cable_tension_n": c.cable_tension_n,
        "cable_displacement_m": c.cable_displacement_m,
        "rms_m": c.rms_m,
        "marker_rms_m": c.marker_rms_m,
        "history": c.history,
        "std": {"T_robot_camera": c.pose_std, "cable_tension_n": c.tension_std_n, "cable_displacement_m": c.displacement_std_m},
        "pose_covariance": c.pose_covariance,
        "seats_m": c.seats_m,
        "frames": c.frames,
        "cameras": [{"name": name, "T_robot_camera": T} for name, T in zip(c.camera_names, c.poses)],
    }
    checked: dict[str, Any] = plain(document)
    return checked


def write_calibration(calibration: Calibration, path: str | Path) -> Path:
    """Write calibration.json and return its path. Raises InputError where the path is a folder."""
    target = Path(path)
    if target.is_dir():
        raise InputError(
            "a folder stands where the file should be written", where=target, hint=f"-o {target / 'calibration.json'}"
        )
    write_json(target, calibration_document(calibration))
    return target


def read_calibration(path: str | Path) -> Calibration:
    """Read calibration.json (or the one of a folder).

    Raises:
        InputError: another kind of file, or one that is broken; with the key, what was found and what was expected.
    """
    file = Path(path).expanduser()
    file = file / "calibration.json" if file.is_dir() else file
    document = _read_document(file, CALIBRATION_FORMAT)
    std = _table(document, "std", file)
    T = check_pose(_of(document, "T_robot_camera", file), f"{file}: T_robot_camera")
    cameras = document.get("cameras") or [{"name": "", "T_robot_camera": T}]
    try:
        return Calibration(
            T_robot_camera=freeze(T),
            poses=tuple(freeze(check_pose(camera["T_robot_camera"], f"{file}: cameras")) for camera in cameras),
            camera_names=tuple(str(camera["name"]) for camera in cameras),
            cable_tension_n=_numbers(document, "cable_tension_n", file),
            cable_displacement_m=_numbers(document, "cable_displacement_m", file),
            rms_m=_number(document.get("rms_m")),
            marker_rms_m=_numbers(document, "marker_rms_m", file),
            history=tuple(dict(entry) for entry in document.get("history", [])),
            pose_std=_matrix(std.get("T_robot_camera"), 4),
            pose_covariance=_matrix(document.get("pose_covariance"), 6),
            tension_std_n=dict(std.get("cable_tension_n", {})),
            displacement_std_m=dict(std.get("cable_displacement_m", {})),
            status=str(document.get("status", "")),
            seats_m={name: [float(x) for x in point] for name, point in document.get("seats_m", {}).items()},
            frames=tuple(int(frame) for frame in document.get("frames", [])),
        )
    except (TypeError, ValueError, KeyError, AttributeError) as error:
        raise InputError("a broken calibration", where=file, found=f"{type(error).__name__}: {error}", expected="what femsense calibrate wrote", hint="calibrate again") from None  # fmt: skip


# What results were made from


def run_inputs(
    robot: Robot, recording: Recording, calibration: Calibration | None, *, at: npt.ArrayLike | None = None
) -> dict[str, Any]:
    """Return what a run is made from: name or place and SHA-256 of each input, and the options.

    Arguments:
        robot, recording: as loaded.
        calibration: None where the run calibrates by itself.
        at: declared places of contact [m], shape (k, 3).
    """
    own = None if calibration is None else {"sha256": _text_hash(json_text(calibration_document(calibration)))}
    options = {"at": None if at is None else np.asarray(at, dtype=np.float64).reshape(-1, 3).tolist()}
    return {"robot": robot_input(robot), "recording": recording_input(recording), "calibration": own, "options": options}


def loop_inputs(robot: Robot, recordings: Sequence[Recording], validation: Sequence[Recording], **options: Any) -> dict[str, Any]:
    """Return what a closed loop is made from; see `run_inputs`."""
    return {
        "robot": robot_input(robot),
        "recordings": [recording_input(recording) for recording in recordings],
        "validation": [recording_input(recording) for recording in validation],
        "options": plain(options),
    }


def robot_input(robot: Robot) -> dict[str, Any]:
    """Return name, folder and SHA-256 of a robot: of its declaration with effects, and of its mesh."""
    mesh = robot.body.mesh
    digest = hashlib.sha256(json_text(robot.document).encode())
    digest.update(np.ascontiguousarray(mesh.nodes).tobytes() + np.ascontiguousarray(mesh.tets).tobytes())
    for entry in (robot.document or {}).get("effects", []):
        if "file" in entry:
            digest.update(file_hash(find_own_file(entry, robot)).encode())
    return {"name": robot.name, "path": None if robot.folder is None else str(robot.folder), "sha256": digest.hexdigest()}


def recording_input(recording: Recording) -> dict[str, Any]:
    """Return folder and SHA-256 of a recording: of its frames' numbers and the files that results depend on."""
    if recording.folder is None:
        return {"path": None, "sha256": None}
    digest = hashlib.sha256(np.ascontiguousarray(recording.frame_numbers).tobytes())
    for part in RECORDING_PARTS:
        place = recording.folder / part
        for file in sorted(place.rglob("*")) if place.is_dir() else [place]:
            if file.is_file():
                digest.update(f"{file.relative_to(recording.folder).as_posix()}\0{file_hash(file)}\n".encode())
    return {"path": str(recording.folder), "sha256": digest.hexdigest()}


def finished(folder: str | Path, inputs: Mapping[str, Any]) -> bool:
    """Return whether a folder holds the complete results of these inputs, made by this version of femsense."""
    root = Path(folder)
    marker = root / "run.json" if (root / "run.json").is_file() else root / "loop.json"
    try:
        known = json.loads(marker.read_text(encoding="utf-8"))
        made_from, versions = known["inputs"], known["versions"]
    except (OSError, ValueError, KeyError, TypeError):
        return False
    complete = all((root / name).is_file() for name in (RUN_FILES if marker.name == "run.json" else ("robot.toml",)))
    same_version = isinstance(versions, dict) and versions.get("femsense") == femsense.__version__
    return complete and same_version and _without_paths(made_from) == _without_paths(plain(inputs)) and not _without_hash(inputs)


def versions() -> dict[str, str]:
    """Return the versions of femsense and of the packages that its numbers depend on."""
    found = {"femsense": femsense.__version__}
    for package, names in (("numpy", ("numpy",)), ("scipy", ("scipy",)), ("open3d", ("open3d-cpu", "open3d"))):
        found[package] = next((v for v in map(_installed, names) if v), "not installed")
    return found


# Runs


def write_run(
    run: Run,
    folder: str | Path,
    *,
    inputs: Mapping[str, Any],
    seconds: float | None = None,
    calibration: Calibration | None = None,
) -> Path:
    """Write contacts.csv, frames.csv, states.npz, the calibration and at last run.json.

    Arguments:
        run: of `estimate`.
        folder: made where it is missing; its other files stay.
        inputs: of `run_inputs`.
        seconds: how long the estimate took [s].
        calibration: what it was made with; stands beside it as calibration.json.

    Returns:
        the folder.

    Raises:
        InputError: see `check_run_folder`.
    """
    check_run_folder(folder)
    with _results_folder(folder, "run.json") as part:
        if calibration is not None:
            write_calibration(calibration, part / "calibration.json")
        write_csv(part / "contacts.csv", CONTACT_COLUMNS, [_contact_row(contact) for contact in run.contacts])
        cables, chambers = run.robot.body.cable_names, run.robot.body.chamber_names
        columns = [*FRAME_COLUMNS, *(f"tension_{name}_n" for name in cables), *(f"pressure_{name}_pa" for name in chambers)]
        write_csv(part / "frames.csv", columns, [_frame_row(frame, cables, chambers) for frame in run.frames])
        _write_states(run.states, part / "states.npz")
        write_json(part / "run.json", _run_document(run, inputs, seconds))
    return Path(folder)


def check_run_folder(folder: str | Path) -> None:
    """Raise InputError where a run cannot be written: in a robot, a recording or a loop, or where a file stands."""
    _check_folder(Path(folder).expanduser(), ("robot.toml", "recording.toml", "loop.json"))


def read_run(folder: str | Path, *, robot: Robot | None = None) -> Run:
    """Read a run back.

    Arguments:
        folder: of `write_run`.
        robot: by default loaded from where run.json says it was.

    Raises:
        InputError: files are missing or broken, or the robot is no longer there.
    """
    from femsense.sensing import Run

    root = Path(folder).expanduser()
    missing = [name for name in RUN_FILES if not (root / name).is_file()]
    if missing:
        raise InputError("not a complete run", where=root, found=f"no {', '.join(missing)}", expected="a folder that femsense estimate wrote", hint="femsense estimate … -o RUN")  # fmt: skip
    document = _read_document(root / "run.json", RUN_FORMAT)
    known = robot or _robot_of_run(document, root)
    recording = _table(_table(document, "inputs", root / "run.json"), "recording", root / "run.json").get("path")
    return Run(
        contacts=_read_contacts(root / "contacts.csv"),
        frames=_read_frames(root / "frames.csv"),
        states=read_states(root / "states.npz"),
        robot=known,
        recording_folder=None if recording is None else Path(recording),
        known_loads=tuple(document.get("known_loads", [])),
    )


def read_states(path: str | Path) -> States:
    """Read states.npz. Raises InputError."""
    from femsense.sensing import States

    file = Path(path)
    try:
        with np.load(file, allow_pickle=False) as data:
            arrays = {name: data[name] for name in ("time_s", "nodes_m", "tets", "rest_nodes_m")}
    except Exception as error:  # whatever the archive reader meets in a broken file
        raise InputError("not readable", where=file, found=error, expected="arrays time_s, nodes_m, tets, rest_nodes_m") from None
    return States(
        time_s=freeze(arrays["time_s"]), nodes_m=freeze(arrays["nodes_m"], np.float32), tets=freeze(arrays["tets"], np.int64), rest_nodes_m=freeze(arrays["rest_nodes_m"])
    )  # fmt: skip


def _contact_row(contact: ContactForce) -> list[object]:
    c = contact
    return [c.frame, c.time_s, c.contact, *c.position_m, *c.normal, *c.force_n_xyz, c.force_n, c.std_n, c.source]


def _frame_row(frame: FrameReport, cables: Sequence[str], chambers: Sequence[str]) -> list[object]:
    drives = [*(frame.tension_n.get(name) for name in cables), *(frame.pressure_pa.get(name) for name in chambers)]
    return [*(getattr(frame, name) for name in FRAME_COLUMNS), *drives]


def _write_states(states: States, path: Path) -> None:
    with write_beside(path) as part, part.open("wb") as stream:
        np.savez_compressed(
            stream,
            time_s=np.asarray(states.time_s, dtype=np.float64),
            nodes_m=np.asarray(states.nodes_m, dtype=np.float32),
            tets=np.asarray(states.tets, dtype=np.int32),
            rest_nodes_m=np.asarray(states.rest_nodes_m, dtype=np.float64),
        )


def _run_document(run: Run, inputs: Mapping[str, Any], seconds: float | None) -> dict[str, Any]:
    times = np.array([frame.ms for frame in run.frames if frame.status == "ok"], dtype=np.float64)
    good = [frame.status for frame in run.frames].count("ok")
    return {
        "format": RUN_FORMAT,
        "robot": run.robot.name,
        "frames": len(run.frames),
        "frames_ok": good,
        "contacts": len(run.contacts),
        "known_loads": run.known_loads,
        "inputs": inputs,
        "versions": versions(),
        "timing": {"seconds": seconds, "ms_per_frame_median": float(np.median(times)) if len(times) else None},
    }


def _robot_of_run(document: Mapping[str, Any], root: Path) -> Robot:
    from femsense.robot import load_robot

    path = _table(_table(document, "inputs", root / "run.json"), "robot", root / "run.json").get("path")
    if path is None or not Path(path).is_dir():
        raise InputError("the robot of this run is not there", where=root / "run.json", found=path or "a robot made in Python", expected="its folder", hint="read_run(folder, robot=…)")  # fmt: skip
    return load_robot(path)


def _read_contacts(file: Path) -> tuple[ContactForce, ...]:
    from femsense.sensing import ContactForce

    table = read_csv(file, required=CONTACT_COLUMNS)
    frames, contacts = table.integers("frame"), table.integers("contact")
    values, sources = table.numbers(("time_s", *CONTACT_COLUMNS[3:14]), empty_is_nan=True), table.text("source")
    return tuple(
        ContactForce(
            frame=int(frames[i]), time_s=float(row[0]), contact=int(contacts[i]), position_m=freeze(row[1:4]), normal=freeze(row[4:7]),
            force_n_xyz=freeze(row[7:10]), force_n=float(row[10]), std_n=float(row[11]), source=sources[i],
        )
        for i, row in enumerate(values)
    )  # fmt: skip


def _read_frames(file: Path) -> tuple[FrameReport, ...]:
    from femsense.sensing import FrameReport

    table = read_csv(file, required=FRAME_COLUMNS, prefixes=("tension_", "pressure_"))
    tensions = [c for c in table.columns if c.startswith("tension_") and c.endswith("_n")]
    pressures = [c for c in table.columns if c.startswith("pressure_") and c.endswith("_pa")]
    cables = [c.removeprefix("tension_").removesuffix("_n") for c in tensions]
    chambers = [c.removeprefix("pressure_").removesuffix("_pa") for c in pressures]
    counts = {name: table.integers(name) for name in ("frame", "contacts", "matched")}
    values = table.numbers(("time_s", "rms_before_m", "rms_after_m", "ms", *tensions, *pressures), empty_is_nan=True)
    status = table.text("status")
    return tuple(
        FrameReport(
            frame=int(counts["frame"][i]), time_s=float(row[0]), status=status[i], contacts=int(counts["contacts"][i]),
            matched=int(counts["matched"][i]), rms_before_m=float(row[1]), rms_after_m=float(row[2]), ms=float(row[3]),
            tension_n={name: float(value) for name, value in zip(cables, row[4:])},
            pressure_pa={name: float(value) for name, value in zip(chambers, row[4 + len(cables) :])},
        )
        for i, row in enumerate(values)
    )  # fmt: skip


# Loops


def write_loop(loop: LoopResult, folder: str | Path, *, inputs: Mapping[str, Any] | None = None) -> Path:
    """Write the improved robot and at last loop.json; return the folder.

    Raises:
        InputError: see `check_loop_folder`.
    """
    from femsense.robot import save_robot

    check_loop_folder(folder)
    with _results_folder(folder, "loop.json") as part:
        declared = (loop.declared.document or {}).get("effects", [])
        save_robot(loop.declared, part, effects=[*declared, *loop.entries])
        write_json(part / "loop.json", {**loop.document(), "inputs": inputs or {}, "versions": versions()})
    return Path(folder)


def check_loop_folder(folder: str | Path) -> None:
    """Raise InputError where a loop cannot be written: in a recording, a run or a robot that no loop wrote, or at a file."""
    root = Path(folder).expanduser()
    own = (root / "loop.json").is_file()
    _check_folder(root, ("recording.toml", "run.json") if own else ("recording.toml", "run.json", "robot.toml"))


def read_loop(path: str | Path) -> dict[str, Any]:
    """Return the content of loop.json (or of the one in a folder). Raises InputError."""
    file = Path(path).expanduser()
    return _read_document(file / "loop.json" if file.is_dir() else file, LOOP_FORMAT)


# Parts


@contextmanager
def _results_folder(folder: str | Path, marker: str) -> Iterator[Path]:
    """Yield an empty folder; what the block writes there moves into `folder` at its end, `marker` last.

    A new folder appears in one step. In one that is there, the old marker goes first, so that a folder with a marker is always
    complete; its other files stay.
    """
    root = Path(folder).expanduser().absolute()
    if not root.exists():
        with write_beside(root) as part:
            part.mkdir(parents=True)
            yield part
        return
    with tempfile.TemporaryDirectory(prefix=PART_PREFIX, dir=root) as scratch:
        yield Path(scratch)
        (root / marker).unlink(missing_ok=True)
        for file in sorted(Path(scratch).iterdir(), key=lambda file: file.name == marker):
            os.replace(file, root / file.name)


def _check_folder(root: Path, not_beside: Sequence[str]) -> None:
    foreign = next((name for name in not_beside if (root / name).is_file()), None)
    if foreign is not None:
        raise InputError("the results would mix with what stands there", where=root, found=foreign, expected="a folder of their own", hint="another -o")  # fmt: skip
    if root.exists() and not root.is_dir():
        raise InputError("a file stands where the folder should be written", where=root, expected="a folder", hint="another -o")


def _read_document(file: Path, expected: str) -> dict[str, Any]:
    """Return a JSON object of a format. Raises InputError."""
    try:
        document = json.loads(file.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError("cannot be read", where=file, found=error.strerror, expected=f"a file of format {expected}") from None
    except ValueError as error:
        raise InputError("not valid JSON", where=file, found=error, expected=f"a file of format {expected}") from None
    found = document.get("format") if isinstance(document, dict) else type(document).__name__
    if found != expected:
        raise InputError("another kind of file", where=f"{file}: format", found=repr(found), expected=repr(expected))
    checked: dict[str, Any] = document
    return checked


def _of(document: Mapping[str, Any], key: str, file: Path) -> Any:
    if key not in document:
        raise InputError("a key is missing", where=file, found=", ".join(document), expected=key)
    return document[key]


def _table(document: Mapping[str, Any], key: str, file: Path) -> dict[str, Any]:
    value = _of(document, key, file)
    if not isinstance(value, dict):
        raise InputError("not a table", where=f"{file}: {key}", found=repr(value)[:80], expected="an object")
    return value


def _numbers(document: Mapping[str, Any], key: str, file: Path) -> dict[str, float]:
    return {str(name): _number(value) for name, value in _table(document, key, file).items()}


def _number(value: Any) -> float:
    """Return a number of JSON, where null stands for one that is not finite."""
    return float("nan") if value is None else float(value)


def _matrix(rows: Any, size: int) -> FloatArray:
    """Return a square matrix, zero where it is not given."""
    return freeze(
        np.zeros((size, size)) if rows is None else np.array([[_number(x) for x in row] for row in rows]).reshape(size, size)
    )


def _text_hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _without_paths(value: Any) -> Any:
    """Return inputs without their places: the same content elsewhere is the same input."""
    if isinstance(value, Mapping):
        return {key: _without_paths(item) for key, item in value.items() if key != "path"}
    return [_without_paths(item) for item in value] if isinstance(value, list | tuple) else value


def _without_hash(value: Any) -> bool:
    """Return whether an input was made in Python, so that nobody can say what it held."""
    if isinstance(value, Mapping):
        return ("sha256" in value and value["sha256"] is None) or any(map(_without_hash, value.values()))
    return any(map(_without_hash, value)) if isinstance(value, list | tuple) else False


def _installed(package: str) -> str | None:
    try:
        return version_of(package)
    except PackageNotFoundError:
        return None
