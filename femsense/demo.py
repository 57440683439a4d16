"""The whole chain on a recording that comes along, measured against the truth beside it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from femsense import results
from femsense.arrays import FloatArray
from femsense.errors import FemsenseError, InputError
from femsense.files import write_json
from femsense.robot import robot_names
from femsense.steps import estimate_into, improve_into
from femsense.summary import columns, effect_text, run_document
from femsense.tables import read_csv

if TYPE_CHECKING:
    from femsense.sensing import ContactForce, Run

ROBOT = "four-leg"
SAME_PLACE = 0.1
"""A contact is the true one if it is closer than this times the robot's size."""


@dataclass(frozen=True, eq=False, slots=True)
class TrueContact:
    """A contact as it was."""

    frame: int
    position_m: FloatArray
    force_n_xyz: FloatArray


def run_demo(folder: str | Path, *, say: Callable[[str], None], progress: Callable[..., None] | None = None) -> dict[str, Any]:
    """Estimate with the declared robot, improve it, estimate again; export the result and measure both against the truth.

    Steps that the folder holds already are not done again.

    Arguments:
        folder: gets `declared/`, `loop/`, `run/`, robot.glb, picture.png, report.html and demo.json.
        say: told in one line what happens.
        progress: called with what is done and how much there is.

    Returns:
        the content of demo.json.

    Raises:
        FemsenseError: the demo's recording is not there, or a step failed.
    """
    from femsense.picture import draw_demo
    from femsense.xr.export import export_glb

    out, recording = Path(folder), demo_recording()
    say(f"1/4  forces with the robot as it is declared → {out / 'declared'}")
    before = estimate_into(out / "declared", ROBOT, recording, say=say, progress=progress)
    say(f"2/4  what does its model lack? → {out / 'loop'}")
    loop = improve_into(out / "loop", ROBOT, [recording], say=say, progress=progress)
    say(f"3/4  forces with the improved robot → {out / 'run'}")
    after = estimate_into(out / "run", out / "loop", recording, say=say, progress=progress)
    say(f"4/4  mesh, picture and report → {out}")
    truth = read_truth(recording)
    document = demo_document(out, before, loop, after, truth, true_effects(recording))
    export_glb(after, out / "robot.glb")
    draw_demo(before, after, truth, document, out / "picture.png")
    document["report"] = _report(out / "loop", say)
    write_json(out / "demo.json", document)
    return document


def demo_recording() -> Path:
    """Return the folder of the recording that comes along. Raises InputError."""
    folder = robot_names().get(ROBOT)
    recording = None if folder is None else folder / "recordings" / "demo"
    if recording is None or not (recording / "recording.toml").is_file():
        raise InputError("the demo's recording is not in this installation", where=recording or ROBOT, expected="meshes/four-leg/recordings/demo", hint="reinstall femsense")  # fmt: skip
    return recording


def read_truth(recording: Path) -> tuple[TrueContact, ...]:
    """Return the true contacts of a recording of the virtual rig; none where it has no truth beside it."""
    file = recording / "truth" / "contacts.csv"
    if not file.is_file():
        return ()
    columns_used = ("x_m", "y_m", "z_m", "fx_n", "fy_n", "fz_n")
    table = read_csv(
        file, required=("frame", *columns_used), optional=("time_s", "contact", "nx", "ny", "nz", "force_n"), prefixes=("rest_",)
    )
    frames, values = table.integers("frame"), table.numbers(columns_used)
    return tuple(TrueContact(int(frame), row[:3], row[3:]) for frame, row in zip(frames, values))


def true_effects(recording: Path) -> list[dict[str, Any]]:
    """Return the effects that the truth has, as entries of `[[effects]]`; none where nothing is known of it."""
    try:
        known = json.loads((recording / "truth" / "truth.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return []
    return list(known.get("effects", []))


def demo_document(
    out: Path,
    before: Run,
    loop: Mapping[str, Any],
    after: Run,
    truth: Sequence[TrueContact],
    effects: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """Return the figures of the demo: both runs, the loop, and the errors against the truth."""
    return {
        "folder": str(out),
        "declared": {**run_document(before), **force_errors(before, truth)},
        "improved": {**run_document(after), **force_errors(after, truth)},
        "loop": {key: loop.get(key) for key in ("verdict", "noise_m", "before", "after", "effects")},
        "truth": {"contacts": len(truth), "effects": list(effects)},
        "versions": results.versions(),
    }


def force_errors(run: Run, truth: Sequence[TrueContact]) -> dict[str, Any]:
    """Return how a run compares with the truth: contacts found, median errors of place and force."""
    size = float(np.linalg.norm(np.ptp(run.states.rest_nodes_m, axis=0)))
    pairs = [(true, found) for true in truth if (found := _nearest(run.contacts, true, SAME_PLACE * size)) is not None]
    force = [float(np.linalg.norm(found.force_n_xyz - true.force_n_xyz)) for true, found in pairs]
    share = [error / float(np.linalg.norm(true.force_n_xyz)) for error, (true, _) in zip(force, pairs)]
    place = [float(np.linalg.norm(found.position_m - true.position_m)) for true, found in pairs]
    return {
        "contacts_true": len(truth),
        "contacts_found": len(pairs),
        "contacts_false": len(run.contacts) - len({id(found) for _, found in pairs}),
        "force_error_n": _median(force),
        "force_error_share": _median(share),
        "place_error_m": _median(place),
    }


def demo_text(document: Mapping[str, Any]) -> str:
    """Return the closing table of the demo."""
    a, b, loop = document["declared"], document["improved"], document["loop"]
    out = Path(document["folder"])
    rows = [["", "declared robot", "improved robot"]]
    for title, key, scale, unit in (
        ("error of force (median)", "force_error_n", 1.0, "N"),
        ("  in percent", "force_error_share", 100.0, "%"),
        ("error of place (median)", "place_error_m", 1e3, "mm"),
    ):
        rows.append([title, _figure(a[key], scale, unit), _figure(b[key], scale, unit)])
    rows.append(["true contacts found", *(f"{run['contacts_found']} of {run['contacts_true']}" for run in (a, b))])
    rows.append(["contacts that are none", *(str(run["contacts_false"]) for run in (a, b))])
    for title, key in (("residual of the markers", "train_rms_m"), ("  on held-out sweeps", "validation_rms_m")):
        rows.append([title, *(_figure((loop.get(when) or {}).get(key), 1e3, "mm") for when in ("before", "after"))])
    rows.append(["time a frame", *(_figure(run["ms_per_frame"], 1.0, "ms") for run in (a, b))])
    lines = [columns(rows, indent=0), "", f"the model lacked (verdict: {loop['verdict']}):"]
    lines += ["  " + line for effect in loop.get("effects") or [] for line in effect_text(effect).splitlines()] or [
        "  nothing that these data show"
    ]
    true = [
        ", ".join(f"{key} {value}" for key, value in effect.items() if key != "name") for effect in document["truth"]["effects"]
    ]
    lines += [f"  truth: {effect['name']} {text}" for effect, text in zip(document["truth"]["effects"], true)]
    places = [["see it", f"femsense view {out / 'run'}"], ["mesh", str(out / "robot.glb")], ["picture", str(out / "picture.png")]]
    if document.get("report"):
        places.append(["report", str(document["report"])])
    return "\n".join([*lines, "", columns(places, indent=0)])


def _nearest(contacts: Sequence[ContactForce], true: TrueContact, reach: float) -> ContactForce | None:
    near = [contact for contact in contacts if contact.frame == true.frame]
    best = min(near, key=lambda contact: float(np.linalg.norm(contact.position_m - true.position_m)), default=None)
    return best if best is not None and np.linalg.norm(best.position_m - true.position_m) < reach else None


def _report(folder: Path, say: Callable[[str], None]) -> str | None:
    """Write the report where this installation can."""
    try:
        from femsense.report import write_report

        return str(write_report(folder))
    except (ImportError, FemsenseError) as error:
        say(f"no report: {' '.join(str(error).split())}")
        return None


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def _figure(value: float | None, scale: float, unit: str) -> str:
    return "–" if value is None else f"{scale * value:.3g} {unit}"


__all__ = [
    "ROBOT",
    "TrueContact",
    "demo_document",
    "demo_recording",
    "demo_text",
    "force_errors",
    "read_truth",
    "run_demo",
    "true_effects",
]
