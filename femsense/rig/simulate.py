"""`simulate`: a script becomes a recording as a camera would see it, with the truth beside it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray, IntArray, freeze
from femsense.core.errors import InputError
from femsense.core.pose import transform_points
from femsense.fem.mesh import embed_points, to_linear
from femsense.io.files import write_csv, write_json
from femsense.io.recording_folder import save_recording
from femsense.model.camera import Camera
from femsense.model.recording import Recording, make_recording
from femsense.model.recording_parts import About, Drives, LoadRows, MarkerRows, RestMarkers, Timeline, Views
from femsense.model.robot import Robot
from femsense.rig.camera import (
    DepthImage,
    Shape,
    camera_of,
    cloud_of,
    measured_points,
    pose_of,
    render,
    thinned,
    visible_points,
    write_images,
    write_ply,
)
from femsense.rig.plan import Plan, plan_script
from femsense.rig.scene import frame_shapes
from femsense.rig.script import ScriptTable, check_script, read_script
from femsense.rig.sensors import sensor_readings, write_sensors
from femsense.rig.truth import TrueFrame, true_path, true_robot

TRUTH_FORMAT = "femsense-truth-1"
CONTACT_COLUMNS = ("frame", "time_s", "contact", "x_m", "y_m", "z_m", "nx", "ny", "nz", "fx_n", "fy_n", "fz_n", "force_n")
REST_COLUMNS = ("rest_x_m", "rest_y_m", "rest_z_m")
DIGITS = 9
"""Places are written to the nanometre, so that the last bits of a solver do not change a file."""
STREAMS = {"placement": 1, "markers": 2, "inputs": 3, "rest": 4, "clouds": 5, "sensors": 6}
"""Each kind of noise has its own stream of random numbers, so that switching one off leaves the others alone."""


@dataclass(frozen=True, eq=False, slots=True)
class Experiment:
    """A simulated experiment before it is written."""

    script: ScriptTable
    plan: Plan
    declared: Robot
    """The robot as the estimator knows it."""
    robot: Robot
    """The robot as it is, its markers where they really sit."""
    camera: Camera
    T_robot_camera: FloatArray
    frames: tuple[TrueFrame, ...]
    marker_positions: FloatArray
    """True positions of the markers [m], shape (F, k, 3), robot frame."""
    visible: BoolArray
    """Markers that the camera sees, shape (F, k)."""


def simulate(robot: Robot, script: ScriptTable | Mapping[str, Any] | str | Path, out_folder: str | Path) -> Path:
    """Run a virtual experiment and write its recording, with a folder `truth/` inside.

    Arguments:
        robot: as the estimator knows it; the truth gets the script's mesh, law and effects.
        script: a script, its plain tables, or the path of a TOML file.
        out_folder: the recording; what stood there is replaced as a whole, and only when all is written.

    Returns:
        the folder.

    Raises:
        InputError: where the script does not fit. DataError: where the truth has no equilibrium.
    """
    where = Path(script) if isinstance(script, str | Path) else Path("script")
    experiment = run_experiment(robot, _script(script), where)
    return write_experiment(experiment, out_folder)


def run_experiment(robot: Robot, script: ScriptTable, where: Path = Path("script")) -> Experiment:
    """Return the truth of a script, seen by its camera but not yet written; `where` is what messages name."""
    plan = plan_script(script, robot, where)
    camera, T_robot_camera = camera_of(script.camera), pose_of(script.camera)
    real = _with_placement(true_robot(robot, script.truth, script.effects), script)
    frames = tuple(true_path(real, plan, substeps=script.truth.substeps))
    chosen = _chosen_markers(real, script)
    positions = np.array([real.markers.positions(frame.state.positions) for frame in frames])
    visible = np.zeros(positions.shape[:2], dtype=bool)
    for k, frame in enumerate(frames):
        shapes = frame_shapes(real, frame, plan, script.scene)
        visible[k] = chosen & (visible_points(camera, T_robot_camera, shapes, positions[k]) if script.markers.occlusion else True)
    if not visible.any() and chosen.any() and script.clouds.kind == "none":
        raise InputError(
            "the camera sees no marker in any frame",
            where=f"{where}: camera",
            expected="markers, or [clouds]",
            hint="another eye_m; scene.floor_z_m below the robot; or markers.occlusion = false",
        )
    return Experiment(script, plan, robot, real, camera, T_robot_camera, frames, freeze(positions), freeze(visible, bool))


def write_experiment(experiment: Experiment, out_folder: str | Path) -> Path:
    """Write the recording of an experiment and its truth, and return the folder."""

    def fill(folder: Path) -> None:
        _write_clouds(experiment, folder)
        if experiment.script.sensors:
            _write_sensors(experiment, folder)
        _write_truth(experiment, folder / "truth")

    return save_recording(recording_of(experiment), out_folder, fill=fill)


def recording_of(experiment: Experiment) -> Recording:
    """Return what the recording holds beside its clouds: inputs, markers with noise, known loads."""
    script, plan = experiment.script, experiment.plan
    recorded = plan.commanded + (plan.initial if script.actuation_zero == "absolute" else 0.0)
    recorded = recorded + script.input_std * _rng(script, "inputs").standard_normal(recorded.shape)
    frame, index = _seen_markers(experiment)
    return make_recording(
        Timeline(np.round(plan.time_s, DIGITS), free=plan.free, sweep=plan.sweep, gravity=plan.gravity),
        drives=Drives(
            actuation=script.actuation,
            actuation_zero=script.actuation_zero,
            cable_names=experiment.declared.body.cable_names,
            inputs=np.round(recorded, DIGITS),
            chamber_names=experiment.declared.body.chamber_names,
            pressures=plan.pressures,
        ),
        markers=MarkerRows(
            experiment.robot.marker_names, frame, index, np.round(_measured_markers(experiment)[frame, index], DIGITS)
        ),
        loads=LoadRows(plan.load_frame, plan.load_points, plan.load_forces),
        views=Views(
            cameras=[experiment.camera], T_robot_camera=[experiment.T_robot_camera] if script.camera.declare_pose else None
        ),
        about=About(rest=_measured_rest(experiment) if script.markers.rest_file else None),
    )


def cloud_frames(script: ScriptTable, plan: Plan) -> list[int]:
    """Return the indices of the frames that get a cloud."""
    if script.clouds.kind == "none":
        return []
    if script.clouds.frames == "all":
        return list(range(len(plan.time_s)))
    touched = np.zeros(len(plan.time_s), dtype=bool)
    for contact in plan.contacts:
        touched |= contact.force > 0
    return sorted({*np.flatnonzero(touched).tolist(), *script.clouds.extra_frames})


# Markers


def _script(script: ScriptTable | Mapping[str, Any] | str | Path) -> ScriptTable:
    if isinstance(script, ScriptTable):
        return script
    return read_script(script) if isinstance(script, str | Path) else check_script(dict(script))


def _rng(script: ScriptTable, stream: str, *more: int) -> np.random.Generator:
    return np.random.default_rng([script.seed, STREAMS[stream], *more])


def _with_placement(robot: Robot, script: ScriptTable) -> Robot:
    """Return the robot with its markers where they were glued."""
    std = script.markers.placement_std_m
    if not std:
        return robot
    error = std * _rng(script, "placement").standard_normal(robot.marker_points.shape)
    points = robot.marker_points + error
    return robot.with_marker_points(points)


def _chosen_markers(robot: Robot, script: ScriptTable) -> BoolArray:
    names = script.markers.names
    return np.array([names is None or name in names for name in robot.marker_names], dtype=bool)


def _seen_markers(experiment: Experiment) -> tuple[IntArray, IntArray]:
    """Return frame and marker of each row of markers.csv: in a frame as the script names them, else as the robot does."""
    frame, index = np.nonzero(experiment.visible)
    known = experiment.robot.marker_names
    names = experiment.script.markers.names or known
    rank = np.array([names.index(name) if name in names else len(names) for name in known], dtype=np.int64)
    order = np.lexsort((rank[index], frame))
    return frame[order], index[order]


def _measured_markers(experiment: Experiment) -> FloatArray:
    """Return the markers as the camera measures them [m], camera frame, shape (F, k, 3)."""
    script, seen = experiment.script, experiment.robot.observation
    true = np.array([measured_points(experiment.T_robot_camera, x, seen) for x in experiment.marker_positions])
    rng = _rng(script, "markers")
    own, common = rng.standard_normal(true.shape), rng.standard_normal((len(true), 1, 3))
    return np.asarray(true + script.markers.std_m * own + script.markers.frame_std_m * common)


def _measured_rest(experiment: Experiment) -> RestMarkers:
    """Return the markers of the unloaded body as the camera measures them."""
    script, robot = experiment.script, experiment.robot
    chosen = np.flatnonzero(_chosen_markers(robot, script))
    places = measured_points(experiment.T_robot_camera, robot.marker_points[chosen], robot.observation)
    places = places + script.markers.std_m * _rng(script, "rest").standard_normal(places.shape)
    std = np.full(len(chosen), script.markers.std_m if script.markers.std_m else np.nan)
    names = tuple(robot.marker_names[i] for i in chosen)
    return RestMarkers(names, freeze(np.round(places, DIGITS)), freeze(std), freeze(np.zeros(len(chosen)), np.int64))


# Clouds


def _write_clouds(experiment: Experiment, folder: Path) -> None:
    script = experiment.script
    write = _write_ply if script.clouds.kind == "ply" else _write_images
    for k in cloud_frames(script, experiment.plan):
        shapes = frame_shapes(experiment.robot, experiment.frames[k], experiment.plan, script.scene)
        write(experiment, shapes, k, folder)


def _write_ply(experiment: Experiment, shapes: list[Shape], k: int, folder: Path) -> None:
    clouds = experiment.script.clouds
    image = _image(experiment, shapes, k)
    cloud = cloud_of(image, experiment.camera)
    if clouds.crop_m is not None:
        low, high = np.asarray(clouds.crop_m)
        x = transform_points(experiment.T_robot_camera, cloud.points)
        cloud = cloud.select(((x >= low) & (x <= high)).all(axis=1))
    if clouds.voxel_m:
        cloud = thinned(cloud, clouds.voxel_m)
    (folder / "clouds").mkdir(exist_ok=True)
    write_ply(folder / "clouds" / f"{k:06d}.ply", cloud)


def _write_images(experiment: Experiment, shapes: list[Shape], k: int, folder: Path) -> None:
    for name in ("depth", "color"):
        (folder / name).mkdir(exist_ok=True)
    image = _image(experiment, shapes, k)
    write_images(folder / "depth" / f"{k:06d}.png", folder / "color" / f"{k:06d}.png", image, experiment.camera)


def _image(experiment: Experiment, shapes: list[Shape], k: int) -> DepthImage:
    script = experiment.script
    return render(
        experiment.camera,
        experiment.T_robot_camera,
        shapes,
        noise=script.camera.noise,
        observation=experiment.robot.observation,
        rng=_rng(script, "clouds", k),
    )


def _write_sensors(experiment: Experiment, folder: Path) -> None:
    script, time_s = experiment.script, experiment.plan.time_s
    states = [frame.state.positions for frame in experiment.frames]
    readings = sensor_readings(script.sensors, experiment.robot.body.mesh, states, time_s, rng=_rng(script, "sensors"))
    write_sensors(folder / "sensors.csv", script.sensors, time_s, readings)


# The truth


def _write_truth(experiment: Experiment, folder: Path) -> None:
    """Write truth.json, contacts.csv, markers.csv and states.npz (robot frame, without noise)."""
    folder.mkdir()
    write_json(folder / "truth.json", truth_document(experiment))
    write_csv(folder / "contacts.csv", (*CONTACT_COLUMNS, *REST_COLUMNS), _contact_rows(experiment))
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
    return {
        "format": TRUTH_FORMAT,
        "robot": experiment.declared.name,
        "seed": script.seed,
        "T_robot_camera": np.round(experiment.T_robot_camera, 12),
        unit: dict(zip(names, plan.initial.tolist())),
        "effects": script.effects,
        "model": script.truth.model_dump(exclude_none=True),
        "nodes": len(robot.body.mesh.nodes),
        "tetrahedra": len(robot.body.mesh.tets),
        "marker_offset_m": {name: np.round(offset, DIGITS) for name, offset in zip(robot.marker_names, offsets)},
        "marker_noise": script.markers.model_dump(include={"std_m", "frame_std_m", "placement_std_m"}),
        "motor": [dict(zip(names, np.round(frame.motor, DIGITS).tolist())) for frame in experiment.frames],
        "contact_frames": [k for k, frame in enumerate(experiment.frames) if frame.contacts],
    }


def _contact_rows(experiment: Experiment) -> list[list[object]]:
    rows: list[list[object]] = []
    for k, frame in enumerate(experiment.frames):
        for contact in frame.contacts:
            rest = experiment.plan.contacts[contact.contact].table.point_m
            numbers = np.concatenate([contact.place, contact.normal, contact.force, [np.linalg.norm(contact.force)], rest])
            rows.append(
                [k, round(float(experiment.plan.time_s[k]), DIGITS), contact.contact, *np.round(numbers, DIGITS).tolist()]
            )
    return rows


def _marker_rows(experiment: Experiment) -> list[list[object]]:
    chosen = _chosen_markers(experiment.robot, experiment.script)
    return [
        [k, name, *np.round(place, DIGITS).tolist()]
        for k, places in enumerate(experiment.marker_positions)
        for name, place, keep in zip(experiment.robot.marker_names, places, chosen)
        if keep
    ]
