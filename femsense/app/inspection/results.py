"""Reports on scripts, results of commands, captures of other programs, and files of no known kind."""

from __future__ import annotations

from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np

from femsense.app.inspection.reports import Problems, Report, attempt
from femsense.app.inspection.robots import inspect_robot
from femsense.calib.files import CALIBRATION_FORMAT, read_calibration
from femsense.core.errors import InputError
from femsense.io.checkpoint import UNFINISHED
from femsense.io.importers.foreign import export_hint
from femsense.io.meshing.robot_from_line import line_report
from femsense.io.result_folder import read_document, read_object, value_of
from femsense.loop.files import read_loop, saved_loop
from femsense.many.summary import MANY_FORMAT
from femsense.rig.script import read_script


def inspect_script(file: Path, report: Report, problems: Problems) -> None:
    """Report sweeps and frames of a script of the rig."""
    script = read_script(file)
    report["actuation"] = script.actuation
    report["sweeps"] = [
        {"label": s.label, "frames": len(s.profile()), "drives": ", ".join([*s.cables, *s.chambers])} for s in script.sweeps
    ]
    report["frames"] = sum(len(s.profile()) for s in script.sweeps)
    report["effects"] = [str(entry.get("name", "")) for entry in script.effects]
    report["contacts"], report["loads"] = len(script.contacts), len(script.loads)
    report["camera"] = ", ".join(f"{name} {view.width} × {view.height}".strip() for name, view in script.views.items())
    report["clouds"] = script.clouds.kind


def inspect_line(file: Path, report: Report, problems: Problems) -> None:
    """Report the contents of a description of a body along a line."""
    report.update(line_report(file))


def inspect_unfinished(folder: Path, report: Report, problems: Problems) -> None:
    """Report the unfinished work of a stopped command."""
    report["holds"] = f"{(folder / UNFINISHED).stat().st_size / 1e6:.0f} MB of work that is done"
    problems.append(
        InputError("a command was stopped here", where=folder, hint="run the same command again: it goes on where it stopped")
    )


def inspect_many(folder: Path, report: Report, problems: Problems) -> None:
    """Report the results of many recordings."""
    file = folder / "many.json"
    data = read_document(file, MANY_FORMAT)
    report |= {key: value_of(data, key, file) for key in ("command", "jobs", "counts")}
    report["table"], report["page"] = str(folder / "summary.csv"), str(folder / "summary.html")


def inspect_calibration(file: Path, report: Report, problems: Problems) -> None:
    """Report poses, inputs and residuals of calibration.json."""
    data = read_document(file, CALIBRATION_FORMAT)
    keys = ("status", "rms_m", "T_robot_camera", "cable_tension_n", "cable_displacement_m", "marker_rms_m")
    report |= {key: data[key] for key in keys if key in data}
    report["iterations"] = len(data.get("history") or [])
    attempt(lambda: read_calibration(file), problems)


def inspect_loop(path: Path, report: Report, problems: Problems) -> None:
    """Report verdict, effects and errors of loop.json."""
    file = path / "loop.json" if path.is_dir() else path
    data = read_loop(file)
    keys = ("verdict", "noise_m", "before", "after", "left", "next_experiment")
    report |= {key: data[key] for key in keys if key in data}
    attempt(lambda: [value_of(data, key, file) for key in ("verdict", "before", "after", "effects")], problems)
    loop = attempt(lambda: saved_loop(data, file), problems)
    if loop is not None:
        report |= {"effects": [effect.name for effect in loop.effects], "candidates": len(loop.candidates)}
    improved = file.parent / "robot.toml"
    if path.is_dir() and improved.is_file():
        inner: Report = {}
        inspect_robot(improved, inner, problems)
        report["robot"] = inner


def inspect_run(path: Path, report: Report, problems: Problems) -> None:
    """Report frames, contacts and files of a run."""
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
        data = attempt(lambda: read_object(folder / "run.json"), problems) or {}
        report["run"] = {key: value for key, value in data.items() if isinstance(value, str | int | float | bool)}
    for name in ("frames.csv", "contacts.csv"):
        if (folder / name).is_file():
            report[name.removesuffix(".csv")] = attempt(partial(_csv_report, folder / name), problems)
    if (folder / "states.npz").is_file():
        report["states"] = attempt(lambda: _npz_report(folder / "states.npz"), problems)


def inspect_table(file: Path, report: Report, problems: Problems) -> None:
    """Report a table by its columns, or as a capture."""
    from femsense.io.importers.guess import guess_format

    if guess_format(file) != "csv":
        report["kind"] = "capture"
        inspect_capture(file, report, problems)
        return
    report.update(_csv_report(file))


def inspect_capture(path: Path, report: Report, problems: Problems) -> None:
    """Report the contents that the importer identifies; frames are not read."""
    from femsense.io.importers.guess import contents

    report["bytes"] = path.stat().st_size if path.is_file() else None
    found = attempt(lambda: contents(path), problems)
    if found is not None:
        report.update({**found, "next": "femsense import reads its frames and makes a recording of it"})


def inspect_cad(file: Path, report: Report, problems: Problems) -> None:
    """Report the header of a CAD file; its shapes are not read."""
    data = file.read_bytes()
    report["bytes"] = len(data)
    if file.suffix.lower() not in (".step", ".stp"):
        return
    report["solids"] = data.count(b"MANIFOLD_SOLID_BREP(") + data.count(b"BREP_WITH_VOIDS(")
    if b"ISO-10303-21" not in data[:1000]:
        problems.append(InputError("no STEP file", where=file, found=f"begins {data[:12]!r}", expected="ISO-10303-21"))


def inspect_unknown(path: Path, report: Report, problems: Problems) -> None:
    """Report a file of an unknown kind, or the contents of a folder."""
    if path.is_dir():
        _inspect_folder(path, report, problems)
        return
    report["bytes"] = path.stat().st_size
    problems.append(
        InputError(
            "not a kind of file that femsense knows",
            where=path,
            found=path.suffix or "no ending",
            expected="a robot, a recording, a mesh, a surface, a cloud, an image or a result",
            hint=export_hint(path),
        )
    )


def _inspect_folder(folder: Path, report: Report, problems: Problems) -> None:
    from femsense.io.importers.guess import guess_format

    if guess_format(folder) is not None:
        report["kind"] = "capture"
        inspect_capture(folder, report, problems)
        return
    endings = Counter(item.suffix.lower() or "(none)" for item in folder.iterdir() if item.is_file())
    report.update({"files": dict(endings), "folders": sorted(item.name for item in folder.iterdir() if item.is_dir())})
    problems.append(
        InputError(
            "nothing that femsense knows",
            where=folder,
            found=", ".join(f"{n} {e}" for e, n in endings.items()) or "no files",
            expected="robot.toml, recording.toml, run.json or loop.json",
            hint="femsense import makes a recording of folders of clouds or images",
        )
    )


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
