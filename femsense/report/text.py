"""Results in a few lines of text for people, and in a few numbers for programs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from femsense.calib.calibration import Calibration
from femsense.sensing.run_arrays import count_of, sensed, undetermined, undetermined_text

if TYPE_CHECKING:
    from femsense.sensing.types import ContactForce, FrameReport, Run

OFF = 4.0
"""A frame is reported as not explained where its residual is this many times the lower quartile of all frames …"""
LITTLE = 1e-4
"""… or of this residual, which no camera falls below [m]."""
MODEL_ERRS = 3.0
"""A residual of calibration of this many times the noise of the markers is reported as an error of the model."""
LISTED = 6
"""Number of frames that are listed one by one."""


def columns(rows: Iterable[Sequence[str]], *, indent: int = 2, right: bool = False) -> str:
    """Return rows of text as aligned columns; a row may end early. `right`: all columns but the first are aligned on the right."""
    table = [list(row) for row in rows]
    count = max((len(row) for row in table), default=0)
    ragged = 0 if right else 1  # the last cell of a row takes its own width
    widths = [max((len(row[j]) for row in table if j < len(row) - ragged), default=0) for j in range(count)]
    sides = [str.rjust if right and j else str.ljust for j in range(count)]
    lines = ["  ".join(side(cell, width) for side, cell, width in zip(sides, row, widths)) for row in table]
    return "\n".join((" " * indent + line).rstrip() for line in lines)


def calibration_text(calibration: Calibration) -> str:
    """Return a calibration in a few lines."""
    c = calibration
    rows = [["status", c.status]]
    for name, T in zip(c.camera_names, c.poses):
        std = _pose_std(c) if T is c.poses[0] else ""
        rows.append([f"camera {name}".strip(), f"at {_millimetres(T[:3, 3])} in the robot frame{std}"])
    if np.isfinite(c.rms_m):
        rows.append(["residual", f"{1e3 * c.rms_m:.3f} mm rms over {len(c.marker_rms_m)} markers in {len(c.frames)} frames"])
        worst = max(c.marker_rms_m, key=lambda name: c.marker_rms_m[name], default=None)
        rows += [] if worst is None else [["worst marker", f"{worst}, {1e3 * c.marker_rms_m[worst]:.3f} mm rms"]]
        rows += [["error of the model", text]] if (text := model_error(c)) else []
    for name, tension in c.cable_tension_n.items() if has_unknown_inputs(c) else ():
        newton = f"{tension:.3f} N{_std(c.tension_std_n.get(name), 1.0, 'N')}"
        shortening = f"{1e3 * c.cable_displacement_m.get(name, float('nan')):.2f} mm"
        rows.append([f"cable {name}", f"{newton}, {shortening}{_std(c.displacement_std_m.get(name), 1e3, 'mm')} at the start"])
    for name, pressure in c.chamber_pressure_pa.items():
        rows.append([f"chamber {name}", f"{pressure:.0f} Pa{_std(c.pressure_std_pa.get(name), 1.0, 'Pa')} at the start"])
    return "calibration\n" + columns(rows)


def has_unknown_inputs(c: Calibration) -> bool:
    """Whether initial inputs of cables were estimated: absolute ones are known, and have no deviation."""
    return any(std is None or std > 0 for table in (c.tension_std_n, c.displacement_std_m) for std in table.values())


def model_error(c: Calibration) -> str:
    """Return the part of the residual that is an error of the model, √(rms² − noise²), in words; empty where the residual is less than
    MODEL_ERRS times the noise of the markers."""
    if not c.rms_m > MODEL_ERRS * c.noise_m:
        return ""
    own, noise = 1e3 * float(np.sqrt(c.rms_m**2 - c.noise_m**2)), 1e3 * c.noise_m
    return f"{own:.3f} mm of it: markers repeat to {noise:.3f} mm. The pose is no better than the model (femsense improve)"


def run_document(run: Run) -> dict[str, Any]:
    """Return a run in numbers."""
    good = [frame for frame in run.frames if frame.status == "ok"]
    strongest, felt = strongest_contact(run.contacts, run.frames), sensed(run.contacts)
    feels = {contact.frame for contact in felt}
    touched = [frame for frame in good if frame.frame in feels] or [frame for frame in run.frames if frame.frame in feels] or good
    return {
        "robot": run.robot.name,
        "frames": len(run.frames),
        "frames_ok": len(good),
        "contacts": count_of(run),
        "contacts_in_frames": len(felt),
        "frames_with_contact": len(feels),
        "undetermined": [
            {"frame": c.frame, "contact": c.contact, "force_n": c.force_n, "std_n": c.std_n} for c in undetermined(run.contacts)
        ],
        "largest_force_n": None if strongest is None else strongest.force_n,
        "rms_before_m": _median([frame.rms_before_m for frame in touched]),
        "rms_after_m": _median([frame.rms_after_m for frame in touched]),
        "ms_per_frame": _median([frame.ms for frame in good]),
        "known_loads": [asdict(load) for load in run.known_loads],
        "failed": [{"frame": frame.frame, "status": frame.status} for frame in run.frames if frame.status != "ok"],
        "unexplained": [{"frame": frame.frame, "rms_after_m": frame.rms_after_m} for frame in _unexplained(good)],
    }


def _unexplained(frames: Sequence[FrameReport]) -> list[FrameReport]:
    """Return frames whose residual with the forces that were found is OFF times that of a frame that went well,
    the lower quartile."""
    known = [frame.rms_after_m for frame in frames if np.isfinite(frame.rms_after_m)]
    usual = max(float(np.quantile(known, 0.25)), LITTLE) if known else np.inf
    return [frame for frame in frames if frame.rms_after_m > OFF * usual]


def run_text(run: Run) -> str:
    """Return a run in a few lines."""
    facts = run_document(run)
    rows = [["frames", f"{facts['frames_ok']} of {facts['frames']} ok"], *_contact_rows(run, facts)]
    if facts["rms_after_m"] is not None:
        of = "the frames with contact" if facts["contacts"] else "all frames"
        before, after = 1e3 * facts["rms_before_m"], 1e3 * facts["rms_after_m"]
        rows.append(["residual", f"{before:.3f} → {after:.3f} mm rms with the forces, median of {of}"])
    rows += _strongest_rows(strongest_contact(run.contacts, run.frames))
    if facts["unexplained"]:
        worst = max(facts["unexplained"], key=lambda frame: frame["rms_after_m"])
        count = f"{len(facts['unexplained'])} of {facts['frames_ok']} frames, most frame {worst['frame']}"
        rows.append(["not explained", f"{count}: off by {1e3 * worst['rms_after_m']:.1f} mm with the forces that were found"])
        cause = "something out of sight may touch it there (--at names a place), or the model lacks something (femsense improve)"
        rows.append(["", cause])
    for load in run.known_loads[:LISTED]:
        sizes = f"{load.declared_n:.3f} N declared, {load.sensed_n:.3f} N sensed ({load.error_percent:+.1f} %)"
        rows.append([f"known load, frame {load.frame}", sizes])
    if len(run.known_loads) > LISTED:
        rows.append(["known loads", f"{len(run.known_loads) - LISTED} frames more: see run.json"])
    doubtful = {frame.frame for frame in run.frames if np.isfinite(frame.rms_after_m)}
    for frame in facts["failed"][:LISTED]:
        rows.append([f"{'not ok' if frame['frame'] in doubtful else 'no result'}, frame {frame['frame']}", frame["status"]])
    if len(facts["failed"]) > LISTED:
        rows.append(["not ok", f"in {len(facts['failed']) - LISTED} frames more: see frames.csv"])
    return f"run of {run.robot.name}\n{columns(rows)}"


def _contact_rows(run: Run, facts: dict[str, Any]) -> list[list[str]]:
    """Return how many contacts there are, and those whose size is not determined."""
    found = [f"{facts['contacts']} in {facts['frames_with_contact']} frames"] if facts["contacts"] else []
    weak = undetermined(run.contacts)
    if weak:
        count = len({c.frame for c in weak})
        found.append(f"a contact whose size is not determined in {count} frame{'s' if count > 1 else ''}")
    text = "; ".join(found) or "none"
    doubted = len({c.frame for c in sensed(run.contacts)} - {frame.frame for frame in run.frames if frame.status == "ok"})
    rows = [["contacts", f"{text}; {doubted} of the frames with a force are not ok" if doubted else text]]
    rows += [[f"frame {c.frame}", undetermined_text(c.force_n, c.std_n)] for c in weak[:LISTED]]
    return rows + ([["", f"{len(weak) - LISTED} more: see frames.csv"]] if len(weak) > LISTED else [])


def _strongest_rows(contact: ContactForce | None) -> list[list[str]]:
    if contact is None:
        return []
    size = f"{contact.force_n:.3f} ± {contact.std_n:.3f} N (1 σ) in frame {contact.frame}"
    rows = [["largest force", f"{size}, at {_millimetres(contact.position_m)}"]]
    return rows + ([["of it", part]] if (part := known_part(contact)) else [])


def known_part(contact: ContactForce) -> str:
    """Return in words the part of a force that is determined, where one component makes up most of its variance and is not significant
    (2 σ); else nothing. An undetermined component makes the size too large: a force along a beam hardly moves a marker."""
    force, std = contact.force_n_xyz, contact.force_std_n_xyz
    worst = int(np.argmax(np.nan_to_num(std)))
    if not std[worst] ** 2 > 0.5 * float((std**2).sum()) or abs(force[worst]) > 2.0 * std[worst]:
        return ""
    others = np.delete(np.arange(3), worst)
    size = float(np.linalg.norm(force[others]))
    own = float(np.linalg.norm(force[others] * std[others])) / max(size, 1e-300)
    along = f"{force[worst]:.3f} ± {std[worst]:.3f} N, which is not significant"
    return f"{size:.3f} ± {own:.3f} N across {'xyz'[worst]}; along it {along}"


def strongest_contact(contacts: Sequence[ContactForce], frames: Sequence[FrameReport]) -> ContactForce | None:
    """Return the sensed contact with the largest force, outside the frames that are not ok; None where there is none."""
    bad = {frame.frame for frame in frames if frame.status != "ok"}
    return max((c for c in sensed(contacts) if c.frame not in bad), key=lambda contact: contact.force_n, default=None)


def _median(values: Sequence[float]) -> float | None:
    known = [value for value in values if np.isfinite(value)]
    return float(np.median(known)) if known else None


def _millimetres(point: Any) -> str:
    return "[" + ", ".join(f"{1e3 * value:.1f}" for value in point) + "] mm"


def _std(value: float | None, scale: float, unit: str) -> str:
    if value is None:
        return " (not determined by the data)"
    return f" ± {scale * value:.2g} {unit}" if value > 0 else ""


def _pose_std(calibration: Calibration) -> str:
    largest = float(np.max(calibration.pose_std[:3, 3], initial=0.0))
    return f", ± {1e3 * largest:.2g} mm" if largest > 0 else ""
