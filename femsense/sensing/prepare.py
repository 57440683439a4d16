"""What stays the same from frame to frame, and what the free frames teach before the first frame is sensed."""

from __future__ import annotations

import warnings
from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from femsense.calib.calibration import Calibration
from femsense.calib.condensed_scan import condensed
from femsense.calib.declared_poses import DECLARED_STD
from femsense.calib.from_clouds import free_clouds, measured_noises, pose_pivot
from femsense.calib.pressure_zeros import with_initial_pressures
from femsense.calib.scan import REACH, Scan, parted, read_scan
from femsense.core.arrays import BoolArray, FloatArray, as_points, freeze
from femsense.core.errors import FemsenseError, InputError
from femsense.core.pose import moved_poses
from femsense.fem.compliance import tangent_at
from femsense.fem.equilibrium import Equilibrium
from femsense.model.contact_patch import body_surface, flat_nodes
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.marker_correction import corrected
from femsense.model.on_body import check_on_body
from femsense.model.quasi_static_path import free_path
from femsense.model.recording import Recording
from femsense.model.recording_checks import check_against
from femsense.model.robot import Robot, spread_features
from femsense.pointcloud.rays import Surface
from femsense.sensing.background import background_of
from femsense.sensing.measurement_rows import facing_of, rows_at, seen_through
from femsense.sensing.nuisance import first_knowledge, learn, sag_at
from femsense.sensing.places import near_places, object_touches, objects_near
from femsense.sensing.pose_beside_field import commons_beside_field
from femsense.sensing.types import Answers, Knowledge, Rows, SensingOptions, Sensor

MODULUS_STD = 0.01
"""Where lengths of cables are given, the shape says little of the modulus: beyond this, errors of the model pass for it (relative)."""
POSE_STD = 0.3 * DECLARED_STD
"""How well a declared pose is known beforehand beside clouds: 0.15° and 0.3 mm along each axis. What the model sags too much or too little looks like
a turn beside another modulus, and takes up what it is allowed; poses that are 0.8° and 1 mm off are still told (`benchmarks/declared_pose.py`)."""
CANDIDATES = 120
"""Places at which hidden contacts are searched (METHODS section 3)."""


def make_sensor(
    robot: Robot,
    recording: Recording,
    calibration: Calibration,
    *,
    at: npt.ArrayLike | None = None,
    options: SensingOptions | None = None,
) -> Sensor:
    """Prepare what stays the same from frame to frame, free frames included.

    Raises:
        InputError: nothing says where to look for forces.
    """
    return prepare(robot, recording, calibration, at=at, options=options).sensor


@dataclass(frozen=True, eq=False, slots=True)
class FreeFrame:
    """What a free frame shows."""

    state: Equilibrium
    """Without its factor."""
    rows: Rows
    """Of every point."""
    means: Rows
    """Of the means of points, by which frames are judged."""
    markers: tuple[Rows, ...]
    """Of its markers, where pulls are to be told beside the pose."""
    moves: FloatArray
    """As `sag_at` has it [m], shape (1 + a + c, n, 3)."""


@dataclass(frozen=True, eq=False, slots=True)
class Prepared:
    """A sensor, and what taught it."""

    sensor: Sensor
    first: Knowledge
    """What was known before the free frames."""
    free: dict[int, FreeFrame]
    """Free frames by their number in the recording."""

    def without(self, frames: Collection[int]) -> Sensor:
        """Return the sensor as it were if some free frames taught nothing."""
        taught = [one for k, one in self.free.items() if k not in frames]
        return replace(self.sensor, knowledge=_taught(self.first, taught))


def first_sensor(
    robot: Robot,
    recording: Recording,
    calibration: Calibration,
    *,
    at: npt.ArrayLike | None = None,
    options: SensingOptions | None = None,
) -> Sensor:
    """Return a sensor before any free frame is seen. Arguments and errors as for `make_sensor`."""
    options = options or SensingOptions()
    recording, correction_std = _corrected(robot, check_against(robot, recording), calibration, options)
    robot = robot.in_recording(recording.label)
    places = as_points(at if at is not None else np.zeros((0, 3)), "at")
    size = float(np.linalg.norm(np.ptp(robot.body.mesh.nodes, axis=0)))
    surface = body_surface(robot.body.mesh)
    check_on_body(robot.body.mesh, places, where="at")
    if not recording.has_clouds and not len(places):
        raise InputError(
            "no clouds, and no place of contact is given",
            where=recording.folder,
            expected="clouds/, depth/, or --at X,Y,Z",
            hint="name the place at rest in metres, robot frame: --at 0.1,0,0.015",
        )
    robot = with_initial_pressures(_with_placements(robot, calibration), calibration.chamber_pressure_pa)
    noises = measured_noises(robot, recording, calibration)
    pulls_are_modelled = recording.has_clouds and recording.actuation == "displacement"
    knowledge = first_knowledge(
        noises,
        robot.body.mesh.nodes[surface.triangles].mean(axis=1),
        facing_of(robot.body.mesh.nodes[surface.triangles]),
        size,
        min(options.modulus_std, MODULUS_STD) if pulls_are_modelled else options.modulus_std,
        pose_covariance(recording, calibration),
        drives=len(robot.body.cables) + len(robot.body.chambers) if pulls_are_modelled else 0,
    )
    sensor = Sensor(
        robot,
        recording,
        calibration,
        _driven(robot, recording, calibration, places, size),
        surface,
        options,
        places,
        spread_features(robot.body, CANDIDATES, among=flat_nodes(surface, robot.body.mesh.nodes)),
        pose_pivot(robot),
        size,
        knowledge,
        Answers(),
        correction_std,
    )
    return _with_scenery(sensor)


def prepare(
    robot: Robot,
    recording: Recording,
    calibration: Calibration,
    *,
    at: npt.ArrayLike | None = None,
    options: SensingOptions | None = None,
) -> Prepared:
    """Return a sensor with the free frames that taught it. Arguments and errors as for `make_sensor`."""
    sensor = first_sensor(robot, recording, calibration, at=at, options=options)
    recording, knowledge = sensor.recording, sensor.knowledge
    pulls_are_modelled = recording.has_clouds and recording.actuation == "displacement"
    free = _free_frames(sensor)
    learned = _taught(knowledge, free.values())
    if free and (pulls_are_modelled or _declared(calibration).any()):
        beside = commons_beside_field(knowledge, learned, _rows_of(free.values()), 6 * len(calibration.poses))
        sensor = _better_posed(sensor, beside if pulls_are_modelled else learned.mean)
        knowledge, free = sensor.knowledge, _free_frames(sensor)
        learned = _taught(knowledge, free.values())
    background = background_of(sensor, min(free)) if free else None
    return Prepared(replace(sensor, knowledge=learned, background=background), knowledge, free)


def pose_covariance(recording: Recording, calibration: Calibration) -> FloatArray:
    """Return how well poses are known before a free frame is seen, shape (6 v, 6 v): beside clouds, those that nobody fitted as declared ones are.

    By markers alone it is the pose under the robot's own law: the same law explains the frames that are sensed.
    A pose that was 0.1° and 0.07 mm off, taken for exact, made five of seven touches of `bar-gray` be taken for parts of the scene.
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
    """Return which cameras have a pose that nobody fitted, shape (v,)."""
    return np.asarray(~calibration.joint_covariance.reshape(len(calibration.poses), -1).any(axis=1))


def _corrected(
    robot: Robot, recording: Recording, calibration: Calibration, options: SensingOptions
) -> tuple[Recording, FloatArray]:
    """Return the recording with its markers moved by the robot's correction where that is asked for, and the correction's standard deviation [m], (K,).

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


def _better_posed(sensor: Sensor, shown: FloatArray) -> Sensor:
    """Return the sensor with poses and modulus as the free frames show them, shape (≥ 6 v + 1,): rays and states near the true ones."""
    v = 6 * len(sensor.calibration.poses)
    if not shown[: v + 1].any():
        return sensor
    poses = tuple(freeze(T) for T in moved_poses(sensor.calibration.poses, -shown[:v], sensor.pivot))
    robot = replace(sensor.robot, body=sensor.robot.body.with_stiffness_scale(1.0 / (1.0 + shown[v])))
    expected = sensor.knowledge.mean.copy()  # what was known beforehand, as it looks from there
    expected[:v], expected[v] = -shown[:v], 1.0 / (1.0 + shown[v]) - 1.0
    return replace(
        sensor,
        robot=robot,
        driven=replace(sensor.driven, robot=robot),
        calibration=replace(sensor.calibration, poses=poses, T_robot_camera=poses[0]),
        knowledge=replace(sensor.knowledge, mean=freeze(expected)),
    )


def scan_of(sensor: Sensor, k: int, state: Equilibrium) -> Scan | None:
    """Return what cameras see in frame k near a state; None where the recording has no clouds at all."""
    if not sensor.recording.has_clouds:
        return None
    return read_scan(sensor.robot, sensor.recording, k, sensor.calibration.poses, state.positions)


def condensed_at(sensor: Sensor, scan: Scan, state: Equilibrium) -> Scan:
    """Return a scan whose neighbouring points on a state are averaged (see `condensed`)."""
    surface = Surface(state.positions, sensor.surface.triangles)
    return condensed(scan, surface, sensor.calibration.poses, sensor.knowledge.noises, reach=REACH * sensor.size)


def _with_placements(robot: Robot, calibration: Calibration) -> Robot:
    if not calibration.placements_m:
        return robot
    points = robot.marker_points.copy()
    for name, placement in calibration.placements_m.items():
        if name in robot.marker_names:
            points[robot.marker_names.index(name)] = placement
    return robot.with_marker_points(points)


def _driven(robot: Robot, recording: Recording, calibration: Calibration, places: FloatArray, size: float) -> DrivenRobot:
    """Return what drives the robot, without the known loads that are to be sensed."""
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


def _marked(sensor: Sensor, k: int, state: Equilibrium) -> list[Rows]:
    """Return the rows of the markers of a frame, if it has some and pulls are to be told beside the pose."""
    if sensor.recording.actuation != "displacement" or not (sensor.recording.marker_frame == k).any():
        return []
    try:
        return [rows_at(sensor, k, None, state)]
    except FemsenseError:
        return []


def _with_scenery(sensor: Sensor) -> Sensor:
    """Return the sensor with what seems to touch or overlap the body in the first free frame with a cloud."""
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
        inside = [one for one in shapes if one.kind != "points" and one.towards(corners).distance(corners).min() < 0.0]
        touching = np.array([touch.place for touch in object_touches(sensor, shapes, state)]).reshape(-1, 3)
        return replace(sensor, scenery=touching, overlapping=tuple(inside))
    return sensor


def _taught(knowledge: Knowledge, frames: Collection[FreeFrame]) -> Knowledge:
    """Return what free frames teach (see `learn`)."""
    return learn(knowledge, _rows_of(frames), [(one.means, one.moves) for one in frames])


def _rows_of(frames: Collection[FreeFrame]) -> list[tuple[Rows, FloatArray]]:
    """Return the rows of the clouds and markers of free frames, each with the moves of its frame."""
    return [(rows, one.moves) for one in frames for rows in (one.rows, *one.markers)]


def _free_frames(sensor: Sensor) -> dict[int, FreeFrame]:
    """Return what the free frames with clouds show; a frame that gives nothing is left out."""
    result = {}
    for k, state in free_path(sensor.driven, free_clouds(sensor.recording)):
        try:
            scan = scan_of(sensor, k, state)
            if scan is None:
                continue
            if not scan.segmented:
                shape = Surface(state.positions, sensor.surface.triangles)
                scan = parted(scan, shape, sensor.calibration.poses, sensor.knowledge.noises, reach=REACH * sensor.size)
            through = 0.0 if scan.segmented else seen_through(sensor, scan, state)
            rows, few = (rows_at(sensor, k, one, state) for one in (scan, condensed_at(sensor, scan, state)))
        except FemsenseError:
            continue
        moves = sag_at(sensor, state, tangent_at(sensor.robot.body, state))
        own = tuple(_marked(sensor, k, state))
        few, rows = (replace(one, through=through) for one in (few, rows))
        result[k] = FreeFrame(replace(state, factor=None), rows, few, own, moves)
    return result
