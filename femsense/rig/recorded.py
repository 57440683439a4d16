"""The recording of an experiment without its clouds: inputs, markers with noise, known loads, tools."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray, IntArray, freeze
from femsense.model.recording import Recording, make_recording
from femsense.model.recording_parts import About, Drives, LoadRows, MarkerRows, RestMarkers, Timeline, Views
from femsense.model.robot import Robot
from femsense.rig.camera import measured_points
from femsense.rig.experiment import DIGITS, Experiment, rng_of
from femsense.rig.objects import tool_of
from femsense.rig.script import ScriptTable


def recording_of(experiment: Experiment) -> Recording:
    """Return the recording without its clouds: inputs, markers with noise, known loads, tools."""
    script, plan, views = experiment.script, experiment.plan, experiment.views
    recorded = plan.commanded + (plan.initial if script.actuation_zero == "absolute" else 0.0)
    recorded = recorded + script.input_std * rng_of(script, "inputs").standard_normal(recorded.shape)
    view, frame, index = _seen_markers(experiment)
    measured = _measured_markers(experiment)[view, frame, index]
    tools = [tool_of(item, experiment.folder) for item in script.objects if item.declared]
    return make_recording(
        Timeline(
            np.round(plan.time_s, DIGITS),
            frame_numbers=experiment.numbers,
            free=plan.free,
            sweep=plan.sweep,
            gravity=plan.gravity,
        ),
        drives=Drives(
            actuation=script.actuation,
            actuation_zero=script.actuation_zero,
            cable_names=experiment.declared.body.cable_names,
            inputs=np.round(recorded, DIGITS),
            chamber_names=experiment.declared.body.chamber_names,
            pressures=plan.pressures,
        ),
        markers=MarkerRows(experiment.robot.marker_names, frame, index, np.round(measured, DIGITS), view),
        loads=LoadRows(plan.load_frame, plan.load_points, plan.load_forces),
        views=Views(
            names=[v.name for v in views],
            cameras=[v.camera for v in views],
            T_robot_camera=[v.T_robot_camera if v.table.declare_pose else None for v in views],
        ),
        about=About(rest=_measured_rest(experiment) if script.markers.rest_file else None, tools=tools),
    )


def with_placement(robot: Robot, script: ScriptTable) -> Robot:
    """Return the robot with its markers at their true places."""
    std = script.markers.placement_std_m
    if not std:
        return robot
    error = std * rng_of(script, "placement").standard_normal(robot.marker_points.shape)
    return robot.with_marker_points(robot.marker_points + error)


def chosen_markers(robot: Robot, script: ScriptTable) -> BoolArray:
    """Return the mask of the existing markers, shape (k,)."""
    names = script.markers.names
    return np.array([names is None or name in names for name in robot.marker_names], dtype=bool)


def _seen_markers(experiment: Experiment) -> tuple[IntArray, IntArray, IntArray]:
    """Return camera, frame and marker of each row of markers.csv: in a frame as the script names them, else as the robot does."""
    view, frame, index = np.nonzero(experiment.visible)
    known = experiment.robot.marker_names
    names = experiment.script.markers.names or known
    rank = np.array([names.index(name) if name in names else len(names) for name in known], dtype=np.int64)
    order = np.lexsort((rank[index], view, frame))
    return view[order], frame[order], index[order]


def _measured_markers(experiment: Experiment) -> FloatArray:
    """Return the markers as the cameras measure them [m], each in its own frame, shape (V, F, k, 3)."""
    script, seen = experiment.script, experiment.robot.observation
    result = []
    for v, view in enumerate(experiment.views):
        true = np.array([measured_points(view.T_robot_camera, x, seen) for x in experiment.marker_positions])
        rng = rng_of(script, "markers", *([v] if v else []))
        own, common = rng.standard_normal(true.shape), rng.standard_normal((len(true), 1, 3))
        result.append(true + script.markers.std_m * own + script.markers.frame_std_m * common)
    return np.array(result)


def _measured_rest(experiment: Experiment) -> RestMarkers:
    """Return the markers of the unloaded body as the first camera measures them."""
    script, robot = experiment.script, experiment.robot
    chosen = np.flatnonzero(chosen_markers(robot, script))
    places = measured_points(experiment.views[0].T_robot_camera, robot.marker_points[chosen], robot.observation)
    places = places + script.markers.std_m * rng_of(script, "rest").standard_normal(places.shape)
    std = np.full(len(chosen), script.markers.std_m if script.markers.std_m else np.nan)
    names = tuple(robot.marker_names[i] for i in chosen)
    return RestMarkers(names, freeze(np.round(places, DIGITS)), freeze(std), freeze(np.zeros(len(chosen)), np.int64))
