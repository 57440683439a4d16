"""Results on disk: calibration.json, the files of a run, loop.json with the improved robot.

Files are written next to their final name and then renamed. run.json and loop.json are written last and deleted first, so that a folder
that has them is complete. They contain the inputs, so that a second run can tell that the result is up to date.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from femsense.calib.calibration import Calibration
from femsense.calib.files import calibration_document, write_calibration
from femsense.core.arrays import freeze
from femsense.core.errors import InputError
from femsense.io.files import json_text, write_beside, write_csv, write_json
from femsense.io.own_files import RUN
from femsense.io.provenance import _text_hash, recording_input, robot_input, versions
from femsense.io.result_folder import RUN_FILES, check_folder, read_document, results_folder, table_of
from femsense.io.tables import read_csv
from femsense.sensing.options import SensingOptions
from femsense.sensing.run_arrays import count_of, undetermined, undetermined_text

if TYPE_CHECKING:
    from femsense.model.recording import Recording
    from femsense.model.robot import Robot
    from femsense.sensing.types import ContactForce, FrameReport, LoadComparison, Run, States

RUN_FORMAT = "femsense-run-1"
CONTACT_COLUMNS = (
    "frame",
    "time_s",
    "contact",
    "x_m",
    "y_m",
    "z_m",
    "nx",
    "ny",
    "nz",
    "fx_n",
    "fy_n",
    "fz_n",
    "force_n",
    "std_n",
    "source",
)
"""Columns of contacts.csv in every run."""
MORE_CONTACT_COLUMNS = (
    "track",
    "x_std_m",
    "y_std_m",
    "z_std_m",
    "radius_m",
    "fx_std_n",
    "fy_std_n",
    "fz_std_n",
)
NOTE_COLUMN = "note"
"""Last column of frames.csv if a run has notes: visible contacts whose force has no determined magnitude."""
FRAME_COLUMNS = ("frame", "time_s", "status", "contacts", "matched", "rms_before_m", "rms_after_m", "ms")


# What results were made from


def run_inputs(
    robot: Robot,
    recording: Recording,
    calibration: Calibration | None,
    *,
    at: npt.ArrayLike | None = None,
    options: SensingOptions | None = None,
) -> dict[str, Any]:
    """Describe the inputs of a run, so that its results can be traced to them: path and SHA-256 of each input file, and the options.

    Arguments:
        robot, recording: results of `load_robot` and `load_recording`.
        calibration: the calibration that `estimate` was given, or None if there was none.
        at: known contact points at rest [m], shape (3,) or (g, 3), as for `estimate`.
        options: the `SensingOptions` of the run. Default: `SensingOptions()`.

    Returns:
        a dict for the argument `inputs` of `write_run`.
    """
    own = None if calibration is None else {"sha256": _text_hash(json_text(calibration_document(calibration)))}
    places = None if at is None else np.asarray(at, dtype=np.float64).reshape(-1, 3).tolist()
    usual = asdict(SensingOptions())
    chosen = {name: value for name, value in asdict(options or SensingOptions()).items() if value != usual[name]}
    said = {"at": places, **chosen}
    return {"robot": robot_input(robot), "recording": recording_input(recording), "calibration": own, "options": said}


# Runs


def write_run(
    run: Run,
    folder: str | Path,
    *,
    inputs: Mapping[str, Any],
    seconds: float | None = None,
    calibration: Calibration | None = None,
) -> Path:
    """Write a run as contacts.csv, frames.csv, states.npz, calibration.json and, last, run.json.

    Arguments:
        run: result of `estimate`.
        folder: created if missing; its other files are kept.
        inputs: result of `run_inputs`: the files that the run was computed from.
        seconds: duration of the estimate [s].
        calibration: the calibration that was used.

    Returns:
        the folder.

    Raises:
        InputError: the folder is not writable, or contains another kind of result.

    Example:
        >>> import tempfile
        >>> import femsense as fs
        >>> robot = fs.load_robot("finger")
        >>> recording = fs.load_recording(fs.robot_names()["finger"] / "recordings" / "press")  # installed with femsense
        >>> calibration = fs.calibrate(robot, recording)
        >>> run = fs.estimate(robot, recording, calibration, at=[0.088, 0.0, 0.014])
        >>> inputs = fs.run_inputs(robot, recording, calibration, at=[0.088, 0.0, 0.014])
        >>> folder = fs.write_run(run, tempfile.mkdtemp() + "/run", inputs=inputs, calibration=calibration)
        >>> len(fs.read_run(folder).contacts)
        3
    """
    check_run_folder(folder)
    with results_folder(folder, "run.json") as part:
        if calibration is not None:
            write_calibration(calibration, part / "calibration.json")
        write_csv(
            part / "contacts.csv", CONTACT_COLUMNS + MORE_CONTACT_COLUMNS, [_contact_row(contact) for contact in run.contacts]
        )
        cables, chambers = run.robot.body.cable_names, run.robot.body.chamber_names
        columns = [*FRAME_COLUMNS, *(f"tension_{name}_n" for name in cables), *(f"pressure_{name}_pa" for name in chambers)]
        notes = _notes(run)
        rows = [[*_frame_row(frame, cables, chambers), *([notes.get(frame.frame, "")] if notes else [])] for frame in run.frames]
        write_csv(part / "frames.csv", [*columns, *([NOTE_COLUMN] if notes else [])], rows)
        _write_states(run.states, part / "states.npz")
        write_json(part / "run.json", _run_document(run, inputs, seconds))
    return Path(folder)


def check_run_folder(folder: str | Path) -> None:
    """Raise InputError if a run cannot be written to a folder: it is a robot, a recording or a loop, or a file."""
    check_folder(Path(folder).expanduser(), ("robot.toml", "recording.toml", "loop.json"), RUN)


def read_run(folder: str | Path, *, robot: Robot | None = None) -> Run:
    """Read a run that `write_run` or `femsense estimate` wrote.

    Arguments:
        folder: the folder of the run.
        robot: the robot of the run. Default: loaded from the path in run.json.

    Returns:
        the run, as `estimate` returned it.

    Raises:
        InputError: files are missing or broken, or the robot no longer exists.
    """
    from femsense.sensing.types import Run

    root = Path(folder).expanduser()
    missing = [name for name in RUN_FILES if not (root / name).is_file()]
    if missing:
        raise InputError(
            "not a complete run",
            where=root,
            found=f"no {', '.join(missing)}",
            expected="a folder that femsense estimate wrote",
            hint="femsense estimate … -o RUN",
        )
    document = read_document(root / "run.json", RUN_FORMAT)
    known = robot or _robot_of_run(document, root)
    recording = table_of(table_of(document, "inputs", root / "run.json"), "recording", root / "run.json").get("path")
    return Run(
        contacts=read_contacts(root / "contacts.csv"),
        frames=read_frames(root / "frames.csv"),
        states=read_states(root / "states.npz"),
        robot=known,
        recording_folder=None if recording is None else Path(recording),
        known_loads=_read_known_loads(document, root / "run.json"),
    )


def read_states(path: str | Path) -> States:
    """Read states.npz. Raises InputError."""
    from femsense.sensing.types import States

    file = Path(path)
    try:
        with np.load(file, allow_pickle=False) as data:
            arrays = {name: data[name] for name in ("time_s", "nodes_m", "tets", "rest_nodes_m")}
    except Exception as error:  # any error of the archive reader in a broken file
        raise InputError("not readable", where=file, found=error, expected="arrays time_s, nodes_m, tets, rest_nodes_m") from None
    return States(
        time_s=freeze(arrays["time_s"]),
        nodes_m=freeze(arrays["nodes_m"], np.float32),
        tets=freeze(arrays["tets"], np.int64),
        rest_nodes_m=freeze(arrays["rest_nodes_m"]),
    )


def _contact_row(contact: ContactForce) -> list[object]:
    c = contact
    own = [c.frame, c.time_s, c.contact, *c.position_m, *c.normal, *c.force_n_xyz, c.force_n, c.std_n, c.source]
    return [*own, c.track, *c.position_std_m, c.radius_m, *c.force_std_n_xyz]


def _frame_row(frame: FrameReport, cables: Sequence[str], chambers: Sequence[str]) -> list[object]:
    drives = [*(frame.tension_n.get(name) for name in cables), *(frame.pressure_pa.get(name) for name in chambers)]
    return [*(getattr(frame, name) for name in FRAME_COLUMNS), *drives]


def _notes(run: Run) -> dict[int, str]:
    """Return the notes of frames.csv by frame number."""
    notes: dict[int, list[str]] = {}
    for contact in undetermined(run.contacts):
        notes.setdefault(contact.frame, []).append(undetermined_text(contact.force_n, contact.std_n))
    return {frame: "; ".join(texts) for frame, texts in notes.items()}


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
        "contacts": count_of(run),
        "known_loads": [asdict(load) for load in run.known_loads],
        "inputs": inputs,
        "versions": versions(),
        "timing": {"seconds": seconds, "ms_per_frame_median": float(np.median(times)) if len(times) else None},
    }


def _robot_of_run(document: Mapping[str, Any], root: Path) -> Robot:
    from femsense.io.robot_toml import load_robot

    path = table_of(table_of(document, "inputs", root / "run.json"), "robot", root / "run.json").get("path")
    if path is None or not Path(path).is_dir():
        raise InputError(
            "the robot of this run is not there",
            where=root / "run.json",
            found=path or "a robot made in Python",
            expected="its folder",
            hint="read_run(folder, robot=…)",
        )
    return load_robot(path)


def _read_known_loads(document: Mapping[str, Any], file: Path) -> tuple[LoadComparison, ...]:
    from femsense.sensing.types import LoadComparison

    try:
        return tuple(LoadComparison(**row) for row in document.get("known_loads", ()))
    except TypeError:
        names = ", ".join(LoadComparison.__slots__)
        raise InputError("broken known_loads", where=file, found=document["known_loads"], expected=f"tables of {names}") from None


def read_contacts(file: Path) -> tuple[ContactForce, ...]:
    """Read contacts.csv. Raises InputError."""
    from femsense.sensing.types import ContactForce

    table = read_csv(file, required=CONTACT_COLUMNS, optional=MORE_CONTACT_COLUMNS)
    more = all(name in table.columns for name in MORE_CONTACT_COLUMNS)
    frames, contacts = table.integers("frame"), table.integers("contact")
    tracks = table.integers("track") if more else contacts
    values, sources = table.numbers(("time_s", *CONTACT_COLUMNS[3:14]), empty_is_nan=True), table.text("source")
    spread = table.numbers(MORE_CONTACT_COLUMNS[1:], empty_is_nan=True) if more else np.full((len(values), 7), np.nan)
    return tuple(
        ContactForce(
            frame=int(frames[i]),
            time_s=float(row[0]),
            contact=int(contacts[i]),
            position_m=freeze(row[1:4]),
            normal=freeze(row[4:7]),
            force_n_xyz=freeze(row[7:10]),
            force_n=float(row[10]),
            std_n=float(row[11]),
            source=sources[i],
            track=int(tracks[i]),
            position_std_m=freeze(std[:3]),
            radius_m=float(std[3]),
            force_std_n_xyz=freeze(std[4:]),
        )
        for i, (row, std) in enumerate(zip(values, spread))
    )


def read_frames(file: Path) -> tuple[FrameReport, ...]:
    """Read frames.csv. Raises InputError."""
    from femsense.sensing.types import FrameReport

    table = read_csv(file, required=FRAME_COLUMNS, optional=(NOTE_COLUMN,), prefixes=("tension_", "pressure_"))
    tensions = [c for c in table.columns if c.startswith("tension_") and c.endswith("_n")]
    pressures = [c for c in table.columns if c.startswith("pressure_") and c.endswith("_pa")]
    cables = [c.removeprefix("tension_").removesuffix("_n") for c in tensions]
    chambers = [c.removeprefix("pressure_").removesuffix("_pa") for c in pressures]
    counts = {name: table.integers(name) for name in ("frame", "contacts", "matched")}
    values = table.numbers(("time_s", "rms_before_m", "rms_after_m", "ms", *tensions, *pressures), empty_is_nan=True)
    status = table.text("status")
    return tuple(
        FrameReport(
            frame=int(counts["frame"][i]),
            time_s=float(row[0]),
            status=status[i],
            contacts=int(counts["contacts"][i]),
            matched=int(counts["matched"][i]),
            rms_before_m=float(row[1]),
            rms_after_m=float(row[2]),
            ms=float(row[3]),
            tension_n={name: float(value) for name, value in zip(cables, row[4:])},
            pressure_pa={name: float(value) for name, value in zip(chambers, row[4 + len(cables) :])},
        )
        for i, row in enumerate(values)
    )
