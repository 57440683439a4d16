"""`femsense learn`: from CSV files to a model, to a verdict on another day, and to a corrected model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from femsense.app.command_line.parameters import three_numbers
from femsense.app.learn_options import LearnTask, Pair
from femsense.core.errors import InputError
from femsense.io.files import check_target
from femsense.io.own_files import MODEL

if TYPE_CHECKING:
    from femsense.xr.proprioception.labelled import Labelled
    from femsense.xr.proprioception.model import ProprioceptiveModel

HELD = 0.9
"""The 95 % intervals hold on another recording if at least this share of its positions lies within them."""
POOR = 0.5
"""If the held-out error exceeds this share of the rms motion of the markers, the sensors carry little information about them."""


def pairs_of(files: Sequence[Path]) -> tuple[Pair, ...]:
    """Return SENSORS MARKERS SENSORS MARKERS … in pairs. Raises InputError where a file has no partner."""
    if not files or len(files) % 2:
        raise InputError(
            "files of a recording come in pairs",
            where="SENSORS.csv MARKERS.csv …",
            found=f"{len(files)} files",
            expected="SENSORS.csv and MARKERS.csv of each recording",
        )
    return tuple(zip(files[::2], files[1::2]))


def learn_into(
    task: LearnTask, output: Path, *, progress: Callable[[int, int], None] | None = None
) -> tuple[dict[str, Any], str]:
    """Learn from SENSORS.csv and MARKERS.csv, or correct a model by them; write it and return plain tables and text.

    Arguments:
        task: files and bones.
        output: the ONNX file.
        progress: called with (items done, items in all).

    Raises:
        InputError, DataError: files that do not fit, too few rows.
    """
    from femsense.xr.proprioception.model_file import save_model

    if task.adapt is not None and (task.end_to_end or task.plane is not None):
        text = "a corrected model keeps its bones"
        raise InputError(text, where="--adapt", found="--end-to-end or --plane", expected="neither")
    check_target(output, folder=False, kind=MODEL, inputs=task.all)
    data, other = task.read()
    made = _learnt(task, data, other, progress) if task.adapt is None else _corrected(task, task.adapt, data, other)
    model, document, text = made
    save_model(model, output)
    document = {"path": str(output), "frame": model.frame, **document, **model.report}
    return document, f"{text}\n\n{frame_text(model.frame)}\n\nwritten: {output}"


Made = tuple["ProprioceptiveModel", dict[str, Any], str]
"""A model, its figures, and its text."""


def _learnt(task: LearnTask, data: Labelled, other: Labelled | None, progress: Callable[[int, int], None] | None) -> Made:
    """Learn a model; `other` are the recordings of the test."""
    from femsense.xr.armature import ArmatureOptions
    from femsense.xr.proprioception.learn import LearnOptions, learn

    bones = ArmatureOptions(bones=task.bones, plane_normal=_normal(task.plane))
    model = learn(data, test=other, options=LearnOptions(end_to_end=task.end_to_end, bones=bones), progress=progress)
    text = report_text(model.report)
    if model.chain is not None:
        text += f"\n\n  {len(model.bone_names)} bones along {', '.join(model.marker_names)}, in this order"
        if len(model.marker_names) == 2:
            text += "\n  two markers say nothing of how the body bends between them: its bones lie on a straight line for lack of data"
    if other is not None and task.test is not None:
        text += f"\n\n{test_text(model, other, task.test[0])}"
    return model, {}, text


def _corrected(task: LearnTask, file: Path, data: Labelled, other: Labelled | None) -> Made:
    """Correct the model of a file by data of another day; `other` are the recordings of the test."""
    from femsense.xr.proprioception.drift import adapt, drift
    from femsense.xr.proprioception.learn import errors_on
    from femsense.xr.proprioception.model_file import load_model

    before = load_model(file)
    found, model = drift(before, data), adapt(before, data)
    text = f"{found.text}\n\n{_adapted_text(model.report['adapted'])}"
    if before.bones is not None:
        text += (
            "\nthe end-to-end network is left out, as frames of markers do not correct it: bones come from the corrected markers"
        )
    document: dict[str, Any] = {"verdict": found.verdict, "rigid_mm": found.rigid_mm, "outside": found.channels}
    document["shifts"] = found.shifts
    text += "\n" + "\n".join(interval_text(model.report))
    if other is not None and task.test is not None:
        model = replace(model, report={**model.report, "test": errors_on(model, other, model.report["error_mm"])})
        text += f"\n\n{test_text(model, other, task.test[0])}"
    return model, document, text


def report_text(report: dict[str, Any]) -> str:
    """Return the report of a model in words."""
    low, high = report["error_ci_mm"]
    lines = [
        f"{report['kind']}: {report['error_mm']:.2f} mm on {report['test_rows']} rows that were held out"
        f" (95 % interval {low:.2f} … {high:.2f}); learnt from {report['rows']}",
        f"  of the markers: {_each_text(report['marker_error_mm'])}",
        "",
        "  map        error    held-out blocks   memory",
    ]
    for name, row in report["compared"].items():
        memory = ", ".join(f"{tau:g} s" for tau in row["memory_s"]) or "none"
        lines.append(f"  {name:<8} {row['error_mm']:6.2f} mm        {row['blocks_mm']:6.2f} mm   {memory}")
    lines += ["", "  the error grows by, when a channel is taken from another time:"]
    ranked = sorted(report["importance_mm"].items(), key=lambda item: -item[1])
    lines += [f"  {name:<12} {grown:6.2f} mm" for name, grown in ranked]
    for key, words in (("dead", "never changes"), ("saturated", "is at the end of its range"), ("unused", "not used")):
        if report[key]:
            lines.append(f"  {words}: {', '.join(report[key])}")
    if report.get("bones_mm") is not None:
        lines.append(f"  bones straight from the readings: {report['bones_mm']:.2f} mm")
    lines += interval_text(report)
    if report["error_mm"] > POOR * report["motion_mm"]:
        lines.append(
            f"  the markers themselves move by {report['motion_mm']:.2f} mm (rms): these sensors contain little information on them"
        )
    if report["test_outside"] > 0.02:
        lines.append(f"  {100 * report['test_outside']:.0f} % of the held-out rows are outside the training domain")
    return "\n".join(lines)


def interval_text(report: dict[str, Any]) -> list[str]:
    """Return the intervals of a model and their coverage, as lines."""
    interval, sessions, adapted = report["interval"], report["sessions"], "adapted" in report
    radii = ", ".join(f"{name} {radius:.2f} mm" for name, radius in interval["radius_mm"].items())
    coverage = f"{100 * interval['coverage']:.0f} % of the held-out positions lie within it"
    if adapted:
        validity = (
            "drifts: interval holds within a session only. From the session that was learnt to this one the error had grown "
            f"{interval['growth']:.1f} times before the correction"
        )
    elif sessions > 1:
        validity = f"it holds what differs between the {sessions} recordings: each was predicted from the others"
    else:
        validity = (
            "drifts: interval holds within a session only. Predicted from what came before, the end of this one is off by "
            f"{interval['growth']:.2f} times as much as its middle; further recordings, or --test, measure other sessions"
        )
    return [f"  95 % interval: {radii} (median radius); {coverage}", f"  {validity}"]


def test_text(model: ProprioceptiveModel, data: Labelled, name: Path) -> str:
    """Return the error of a model on another recording, the coverage of its intervals there, and the likely cause of a large error."""
    from femsense.xr.proprioception.drift import drift

    found = model.report["test"]
    low, high = found["error_ci_mm"]
    within = f"{100 * found['coverage']:.0f} % of the positions lie within it"
    lines = [
        f"on {name}: {found['error_mm']:.2f} mm on {found['rows']} rows (95 % interval {low:.2f} … {high:.2f}), "
        f"{found['growth']:.1f} times the held-out error",
        f"  of the markers: {_each_text(found['marker_error_mm'])}",
    ]
    if found["coverage"] >= HELD:
        lines.append(f"  the interval holds there: {within}")
    else:
        grown = f"the error has grown {found['growth']:.1f} times"
        lines.append(f"  drifts: interval holds within a session only. Here {within}, and {grown}")
    why = drift(model, data)
    if why.verdict != "holds":
        lines += [f"  {line}" for line in why.text.splitlines()]
    return "\n".join(lines)


def frame_text(frame: str) -> str:
    """Return in which frame of reference a model's markers and bones are, in words."""
    if frame == "robot":
        return "  markers and bones are in the robot's frame"
    return (
        "  markers and bones are in the frame in which they were measured, not the robot's:"
        " -c CALIBRATION takes them there, --robot-frame says that they are there"
    )


def _each_text(errors_mm: dict[str, float]) -> str:
    return ", ".join(f"{name} {error:.2f} mm" for name, error in errors_mm.items())


def _adapted_text(found: dict[str, Any]) -> str:
    if found["by"] == "none":
        return f"no correction helps: {found['before_mm']:.2f} mm on {found['rows']} rows"
    return (
        f"corrected by {_correction_text(found['by'])}: {found['before_mm']:.2f} → {found['error_mm']:.2f} mm on blocks of the {found['rows']} rows"
        " that the correction did not see"
    )


def _correction_text(by: str) -> str:
    words = {
        "base": "a rigid motion",
        "channel": "another zero of one channel",
        "zeros": "other zeros of the sensors",
        "line": "a linear map",
        "afresh": "learning afresh: a linear map of these frames alone predicts better than any correction",
    }
    return " and ".join(words[part.split()[0]] for part in by.split(","))


def _normal(text: str | None) -> tuple[float, float, float] | None:
    normal = None if text is None else three_numbers(text)
    if text is not None and normal is None:
        raise InputError("not a direction", where="--plane", found=text, expected="X,Y,Z")
    return normal
