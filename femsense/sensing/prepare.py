"""Constants of a recording: what is the same in every frame."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from femsense.calib.calibration import Calibration
from femsense.calib.declared_poses import DECLARED_STD
from femsense.calib.from_clouds import free_clouds, measured_noises, pose_pivot
from femsense.calib.pressure_zeros import with_initial_pressures
from femsense.calib.scan import REACH, Scan, parted, read_scan
from femsense.core.arrays import BoolArray, FloatArray, as_points, freeze
from femsense.core.errors import FemsenseError, InputError
from femsense.fem.equilibrium import Equilibrium
from femsense.inference.error_field import facing_of, spread_field
from femsense.inference.nuisance import EXPECTED
from femsense.model.contact_patch import body_surface, flat_nodes
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.marker_correction import corrected
from femsense.model.on_body import check_on_body
from femsense.model.quasi_static_path import free_path
from femsense.model.recording import Recording
from femsense.model.recording_checks import check_against
from femsense.model.robot import Robot, spread_features
from femsense.pointcloud.rays import Surface
from femsense.sensing.options import SensingOptions
from femsense.sensing.places import near_places, object_touches, objects_near
from femsense.sensing.types import Knowledge, Sensor

POSE_STD = 0.3 * DECLARED_STD
"""Prior σ of a declared pose in recordings with clouds: 0.15° and 0.3 mm along each axis. An error of the sag resembles a rotation and a
change of the modulus, so that a wider prior would absorb it; poses that are wrong by 0.8° and 1 mm are still corrected
(`benchmarks/declared_pose.py`)."""
CANDIDATES = 120
"""Number of surface points at which inferred contacts are searched."""


def make_sensor(
    robot: Robot,
    recording: Recording,
    calibration: Calibration,
    *,
    at: npt.ArrayLike | None = None,
    options: SensingOptions | None = None,
) -> Sensor:
    """Return the constants of a recording, before contact-free frames are used.

    Arguments:
        robot, recording, calibration: as for `estimate`.
        at: known contact points at rest [m], shape (g, 3).
        options: assumptions.

    Raises:
        InputError: neither clouds nor known contact points.
    """
    options = options or SensingOptions()
    recording, correction_std = _corrected(robot, check_against(robot, recording), calibration, options)
    robot = robot.in_recording(recording.label)
    places = as_points(at if at is not None else np.zeros((0, 3)), "at")
    size = float(np.linalg.norm(np.ptp(robot.body.mesh.nodes, axis=0)))
    surface = body_surface(robot.body.mesh, robot.body.chambers)
    check_on_body(robot.body.mesh, places, where="at")
    recording = _without_sensed_frames(recording, places, size)
    if not recording.has_clouds and not len(places):
        raise InputError(
            "no clouds, and no place of contact is given",
            where=recording.folder,
            expected="clouds/, depth/, or --at X,Y,Z",
            hint="name the place at rest in metres, robot frame: --at 0.1,0,0.015",
        )
    robot = with_initial_pressures(_with_placements(robot, calibration), calibration.chamber_pressure_pa)
    noises = measured_noises(robot, recording, calibration)
    corners = robot.body.mesh.nodes[surface.triangles]
    sensor = Sensor(
        robot,
        recording,
        calibration,
        _driven(robot, recording, calibration, places, size),
        surface,
        options,
        places,
        np.flatnonzero(~np.isin(surface.triangles, robot.body.clamped).any(axis=1)),
        spread_features(robot.body, CANDIDATES, among=flat_nodes(surface, robot.body.mesh.nodes)),
        pose_pivot(robot),
        size,
        spread_field(corners.mean(axis=1), facing_of(corners), size),
        Knowledge(noises, *EXPECTED),
        correction_std,
    )
    return _with_scenery(sensor)


def pose_covariance(recording: Recording, calibration: Calibration) -> FloatArray:
    """Return the prior covariance of the poses, shape (6 v, 6 v). In recordings with clouds, poses that were not fitted have that of
    declared ones.

    With markers only it is the covariance under the declared law, since the same law is used for the estimate. A pose that was wrong by
    0.1° and 0.07 mm and assumed exact made five of seven contacts of `bar-gray` look like parts of the scene.
    """
    covariance = calibration.joint_covariance.copy()
    for view in np.flatnonzero(_declared(calibration) & recording.has_clouds):
        own = slice(6 * view, 6 * view + 6)
        covariance[own, own] = np.diag(POSE_STD**2)
    step = calibration.law_step[: len(covariance)]
    if len(step) and not recording.has_clouds:
        covariance -= np.outer(step, step)
    return covariance


def _declared(calibration: Calibration) -> BoolArray:
    """Return which cameras have a declared pose that was not fitted, shape (v,)."""
    return np.asarray(~calibration.joint_covariance.reshape(len(calibration.poses), -1).any(axis=1))


def _corrected(
    robot: Robot, recording: Recording, calibration: Calibration, options: SensingOptions
) -> tuple[Recording, FloatArray]:
    """Return the recording with the robot's correction subtracted from its markers, if requested, and the standard deviation of the
    correction [m], shape (K,).

    Raises:
        InputError: no correction, one for other inputs, or no markers.
    """
    if calibration.is_corrected != options.correct and recording.has_markers:
        warnings.warn(
            f"calibrated {'with' if calibration.is_corrected else 'without'} the correction, estimated"
            f" {'with' if options.correct else 'without'} it: poses do not belong together",
            stacklevel=4,
        )
    if not options.correct:
        return recording, np.zeros(len(recording.marker_frame))
    if recording.has_clouds or not recording.has_markers:
        raise InputError(
            "the correction speaks of markers; where there are clouds, forces come from these",
            where=recording.folder,
            expected="a recording with markers and without clouds",
            hint="leave --correct out",
        )
    correction = robot.require_correction()
    return corrected(recording, correction, calibration.poses), correction.of_rows(recording)[1]


def scan_of(sensor: Sensor, k: int, state: Equilibrium) -> Scan | None:
    """Return the scan of frame k near a state; None for a recording without clouds."""
    if not sensor.recording.has_clouds:
        return None
    return read_scan(sensor.robot, sensor.recording, k, sensor.calibration.poses, state.positions)


def _with_placements(robot: Robot, calibration: Calibration) -> Robot:
    if not calibration.placements_m:
        return robot
    points = robot.marker_points.copy()
    for name, placement in calibration.placements_m.items():
        if name in robot.marker_names:
            points[robot.marker_names.index(name)] = placement
    return robot.with_marker_points(points)


def _without_sensed_frames(recording: Recording, places: FloatArray, size: float) -> Recording:
    """Return the recording without the contact-free mark of frames whose known load acts near a given contact point: that load is to be
    estimated."""
    sensed_here = near_places(recording.load_points, places, size)
    if recording.free is None or not sensed_here.any():
        return recording
    free = recording.free.copy()
    free[recording.load_frame[sensed_here]] = False
    return replace(recording, free=freeze(free))


def _driven(robot: Robot, recording: Recording, calibration: Calibration, places: FloatArray, size: float) -> DrivenRobot:
    """Return the inputs and known loads, without the loads that are to be estimated."""
    initial = None
    if recording.actuation_zero == "unknown":
        table = calibration.cable_tension_n if recording.actuation == "tension" else calibration.cable_displacement_m
        initial = np.array([table[name] for name in robot.body.cable_names])
    drive = drive_of(robot, recording, initial=initial)
    sensed_here = near_places(drive.load_points, places, size)
    drive = replace(
        drive,
        load_frame=drive.load_frame[~sensed_here],
        load_points=drive.load_points[~sensed_here],
        load_forces=drive.load_forces[~sensed_here],
        load_ties=drive.load_ties[~sensed_here],
    )
    return DrivenRobot(robot, drive)


def _with_scenery(sensor: Sensor) -> Sensor:
    """Return the sensor with the objects that touch or overlap the body in the first contact-free frame with a cloud."""
    for k, state in free_path(sensor.driven, free_clouds(sensor.recording)[:1]):
        try:
            scan = scan_of(sensor, k, state)
            if scan is not None and not scan.segmented:
                shape = Surface(state.positions, sensor.surface.triangles)
                scan = parted(scan, shape, sensor.calibration.poses, sensor.knowledge.noises, reach=REACH * sensor.size)
            shapes = [] if scan is None else objects_near(sensor, scan, state)
        except FemsenseError:
            continue
        corners = state.positions[sensor.surface.nodes]
        deep = [0.0 if one.kind == "points" else float(one.towards(corners).distance(corners).min()) for one in shapes]
        inside = tuple(one for one, gap in zip(shapes, deep) if gap < 0.0)
        passing = tuple(one for one, gap in zip(shapes, deep) if one.kind == "plate" and gap < -sensor.surface.edge)
        touching = np.array([touch.place for touch in object_touches(sensor, shapes, state)]).reshape(-1, 3)
        return replace(sensor, scenery=touching, overlapping=inside, passing=passing)
    return sensor
