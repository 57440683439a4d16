"""The folder `truth/` of a recording: truth.json, contacts.csv, markers.csv and states.npz (robot frame, without noise)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.errors import InputError
from femsense.fem.mesh import embed_points, to_linear
from femsense.io.checkpoint import UNFINISHED
from femsense.io.files import check_own, check_target, followed, write_csv, write_json
from femsense.io.recording_folder import OWN_FILES
from femsense.io.result_folder import read_document
from femsense.rig.experiment import DIGITS, Experiment
from femsense.rig.recorded import chosen_markers

TRUTH_FORMAT = "femsense-truth-1"
CONTACT_COLUMNS = (
    *("frame", "time_s", "contact", "x_m", "y_m", "z_m", "nx", "ny", "nz", "fx_n", "fy_n", "fz_n", "force_n"),
    *("rest_x_m", "rest_y_m", "rest_z_m", "radius_m", "object"),
)


def check_place(folder: str | Path) -> None:
    """Raise InputError unless a folder is new or contains a simulated recording."""
    check_target(folder, folder=True)
    final = followed(folder)
    if not final.is_dir() or not {path.name for path in final.iterdir()} - {UNFINISHED}:
        return
    what = "a recording of femsense simulate"
    check_own(final, OWN_FILES, what)
    try:
        read_document(final / "truth" / "truth.json", TRUTH_FORMAT)
    except InputError:
        raise InputError(
            "the recording there is not a simulated one and would be deleted",
            where=final,
            found="no truth/truth.json of the virtual rig",
            expected=f"a new folder, or {what}",
            hint="another -o",
        ) from None


def write_truth(experiment: Experiment, folder: Path) -> None:
    """Write the folder `truth/`."""
    folder.mkdir()
    write_json(folder / "truth.json", truth_document(experiment))
    write_csv(folder / "contacts.csv", CONTACT_COLUMNS, _contact_rows(experiment))
    write_csv(folder / "markers.csv", ("frame", "marker", "x_m", "y_m", "z_m"), _marker_rows(experiment))
    corners = to_linear(experiment.declared.body.mesh)
    ties = embed_points(experiment.robot.body.mesh, corners.nodes)
    nodes = np.array([ties.positions(frame.state.positions) for frame in experiment.frames])
    np.savez_compressed(
        folder / "states.npz", time_s=experiment.plan.time_s, nodes_m=np.round(nodes, 6).astype(np.float32), tets=corners.tets
    )


def truth_document(experiment: Experiment) -> dict[str, Any]:
    """Return the plain tables of truth.json."""
    script, robot, plan = experiment.script, experiment.robot, experiment.plan
    names = robot.body.cable_names
    unit = "cable_tension_n" if script.actuation == "tension" else "cable_displacement_m"
    offsets = robot.marker_points - experiment.declared.marker_points
    poses = {view.name: np.round(view.T_robot_camera, 12) for view in experiment.views}
    return {
        "format": TRUTH_FORMAT,
        "robot": experiment.declared.name,
        "seed": script.seed,
        **({"T_robot_camera": poses[""]} if "" in poses else {"cameras": poses}),
        unit: dict(zip(names, plan.initial.tolist())),
        "effects": script.effects,
        "model": script.truth.model_dump(exclude_none=True),
        "nodes": len(robot.body.mesh.nodes),
        "tetrahedra": len(robot.body.mesh.tets),
        "marker_offset_m": {name: np.round(offset, DIGITS) for name, offset in zip(robot.marker_names, offsets)},
        "marker_noise": script.markers.model_dump(include={"std_m", "frame_std_m", "placement_std_m"}),
        "motor": [dict(zip(names, np.round(frame.motor, DIGITS).tolist())) for frame in experiment.frames],
        "contact_frames": [int(k) for k, frame in zip(experiment.numbers, experiment.frames) if frame.contacts],
        "skipped": [{"frame": k, "why": why} for k, why in experiment.skipped],
    }


def _contact_rows(experiment: Experiment) -> list[list[object]]:
    rows: list[list[object]] = []
    for number, time_s, frame in zip(experiment.numbers, experiment.plan.time_s, experiment.frames):
        for contact in frame.contacts:
            planned = experiment.plan.contacts[contact.contact]
            rest = contact.rest if planned.table.point_m is None or contact.rest is None else planned.table.point_m
            numbers = np.concatenate([contact.place, contact.normal, contact.force, [np.linalg.norm(contact.force)], rest])
            rounded = np.round([*numbers, contact.radius], DIGITS).tolist()
            rows.append([int(number), round(float(time_s), DIGITS), contact.contact, *rounded, planned.table.object or ""])
    return rows


def _marker_rows(experiment: Experiment) -> list[list[object]]:
    chosen = chosen_markers(experiment.robot, experiment.script)
    return [
        [int(number), name, *np.round(place, DIGITS).tolist()]
        for number, places in zip(experiment.numbers, experiment.marker_positions)
        for name, place, keep in zip(experiment.robot.marker_names, places, chosen)
        if keep
    ]
