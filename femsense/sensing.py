"""Contacts and forces of a recording, frame by frame.

cloud ─ pose ─ filter ─ segment ─► robot points, surroundings ─ detect ─► places
equilibrium under the inputs ─ match along normals (or markers) ─► rows ─ compliance ─ QP ─► forces ─┐ repeat until still
                               ▲─────────────────────────────────────────────────────────────────────┘
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from femsense.arrays import FloatArray, as_points, freeze
from femsense.calib.calibration import Calibration
from femsense.calib.forward import in_robot_frame
from femsense.errors import DataError, FemsenseError, InputError
from femsense.fem.assembly import internal
from femsense.fem.compliance import Tangent, tangent_at
from femsense.fem.equilibrium import Equilibrium
from femsense.fem.mesh import vertex_normals
from femsense.keep import Keeper
from femsense.march import Walk, drive_of, has_history, solve_frame
from femsense.model import Robot, spread_features
from femsense.parallel import one_blas_thread
from femsense.patch import Patch, Surface, flat_nodes, make_surface, patch_at
from femsense.pointcloud.cloud import PointCloud
from femsense.pointcloud.contact import detect_contacts
from femsense.pointcloud.filters import pass_through, remove_radius_outliers, voxel_grid
from femsense.pointcloud.matching import Matches, match_along_normals
from femsense.pointcloud.normals import estimate_normals
from femsense.pointcloud.segmentation import segment_by_model, segment_robot
from femsense.qp.forces import ForceEstimate, estimate_forces
from femsense.qp.problem import FrictionCone
from femsense.recording import Recording, check_against, read_frame_cloud

ROUGH = 1e-6
"""Unbalanced force, relative to all loads, of the states on the way to the forces; the last one is exact."""
KEEP_S = 10.0
"""Seconds of work that a killed estimate may lose."""
PLACE_STD = 0.5
"""How well the place of a contact is known, in search radii."""


@dataclass(frozen=True, slots=True)
class SensingOptions:
    """Thresholds; those left None follow from the size of the robot."""

    voxel_m: float | None = None
    """Edge of the voxel grid [m]; None: 1 % of the robot's diagonal."""
    match_line_m: float | None = None
    """d_m: largest distance of a match from the normal line [m]; None: 3 voxels."""
    match_reach_m: float | None = None
    """d_l: largest distance along the normal [m]; None: 20 % of the diagonal."""
    contact_radius_m: float | None = None
    """Search radius of Algorithm 2 [m]; None: 3 voxels."""
    contact_neighbors: int = 3
    """Robot points that make a contact."""
    friction: float | None = None
    """Coulomb coefficient of a contact that was found: its force lies within that cone about the inward normal, with 0 along it. None: the
    data say where the force points; beside an edge the normal that the camera sees may be that of another side than the one that is touched."""
    match_points: int = 200
    """Points of the surface that are matched, spread evenly off sharp edges; at least as many as the robot has features."""
    modulus_std: float = 0.03
    """What is not known of the modulus, relative; it enters the standard deviation of every force."""
    model_std: float = 0.015
    """What is not known of the modelled motion of a point, relative to its way from rest (mesh, law, boundary)."""
    cloud_force_std: float = 0.15
    """Relative error of a force from clouds beside noise, pose, modulus and place: occlusion, edges, one view (see docs/forces.md)."""
    correlation_m: float | None = None
    """Length over which errors of model and depth go together [m]; None: 12 % of the diagonal. Matches within it count once."""
    cloud_std_m: float = 5e-4
    """What averaging cannot remove from a cloud [m]."""
    marker_std_m: float | None = None
    """Noise of a marker along each axis [m]; None: from the residual of the calibration."""
    iterations: int = 6
    """Linearisations a frame at most."""


@dataclass(frozen=True, eq=False, slots=True)
class ContactForce:
    """One contact in one frame, robot frame."""

    frame: int
    """Number of the frame as in frames.csv."""
    time_s: float
    contact: int
    """Number of the contact in its frame, from 0."""
    position_m: FloatArray
    """Place on the deformed body, shape (3,)."""
    normal: FloatArray
    """Outward unit normal there, shape (3,)."""
    force_n_xyz: FloatArray
    """Force on the body [N], shape (3,)."""
    force_n: float
    """Its size [N]."""
    std_n: float
    """One standard deviation of the force along its direction [N]."""
    source: str
    """"cloud" or "given"."""


@dataclass(frozen=True, eq=False, slots=True)
class FrameReport:
    """What became of one frame."""

    frame: int
    time_s: float
    status: str
    """"ok", or why there is no result."""
    contacts: int
    matched: int
    """Features or markers that were found."""
    rms_before_m: float
    """Residual of the model without contact forces: normal distance for clouds, 3-D for markers."""
    rms_after_m: float
    ms: float
    tension_n: dict[str, float]
    pressure_pa: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, slots=True)
class States:
    """The deformed body over the frames."""

    time_s: FloatArray
    """shape (F,)."""
    nodes_m: npt.NDArray[np.float32]
    """shape (F, n, 3)."""
    tets: npt.NDArray[np.int64]
    rest_nodes_m: FloatArray
    """shape (n, 3)."""


@dataclass(frozen=True, eq=False, slots=True)
class Run:
    """The result of `estimate`."""

    contacts: tuple[ContactForce, ...]
    frames: tuple[FrameReport, ...]
    states: States
    robot: Robot
    recording_folder: Path | None
    known_loads: tuple[dict[str, float], ...] = ()
    """Declared loads at the given places next to what was sensed: {frame, declared_n, sensed_n, error_percent}."""


@dataclass(frozen=True, eq=False, slots=True)
class SensedFrame:
    """One frame, sensed."""

    state: Equilibrium
    """With the forces found."""
    free_state: Equilibrium
    """Under the inputs alone."""
    forces: FloatArray
    """Components of all contact forces [N], shape (3k,)."""
    report: FrameReport
    contacts: tuple[ContactForce, ...]


@dataclass(eq=False, slots=True)
class Done:
    """The frames of a recording that are sensed so far."""

    reports: list[FrameReport] = field(default_factory=list)
    contacts: list[ContactForce] = field(default_factory=list)
    states: list[FloatArray] = field(default_factory=list)
    """Node positions [m], shape (n, 3), one array a frame."""
    last: SensedFrame | None = None
    """The last frame that gave a result."""


@dataclass(frozen=True, eq=False, slots=True)
class Seen:
    """What the cameras see in one frame, robot frame."""

    robot: FloatArray
    """Points of the robot [m], shape (r, 3)."""
    normals: FloatArray | None
    """Their normals towards the camera, shape (r, 3); None with several cameras."""
    others: FloatArray
    """Points of everything else [m], shape (o, 3)."""


@dataclass(frozen=True, eq=False, slots=True)
class Rows:
    """Linearised measurements: `functional` maps node displacements to them."""

    functional: Callable[[FloatArray], FloatArray]
    """Node displacements (k, n, 3) → rows (r, k)."""
    residual: FloatArray
    """Measured minus modelled [m], shape (r,)."""
    std: FloatArray
    """[m], shape (r,)."""
    by_pose: FloatArray
    """d residual / d (pose in units of its standard deviation), shape (r, ≤ 6)."""
    count: int
    """Features or markers."""
    rms: float
    """[m]."""
    sharp: FloatArray
    """The same before residuals that stand out got more [m], shape (r,)."""
    crowding: float = 1.0
    """By how much errors that neighbours share widen standard deviations [1]."""


@dataclass(frozen=True, eq=False, slots=True)
class Sensor:
    """Everything that stays the same from frame to frame."""

    robot: Robot
    recording: Recording
    calibration: Calibration
    walk: Walk
    surface: Surface
    options: SensingOptions
    places: FloatArray
    """Given places of contact at rest [m], shape (g, 3)."""
    probes: npt.NDArray[np.int64]
    """Surface nodes that are matched with clouds, shape (e,)."""
    pose_root: FloatArray
    """Square root of the pose covariance (rotation about the pivot, shift), shape (6, ≤ 6)."""
    size: float = field(default=0.0)
    """Diagonal of the body at rest [m]."""


@one_blas_thread()
def estimate(
    robot: Robot,
    recording: Recording,
    calibration: Calibration,
    *,
    at: npt.ArrayLike | None = None,
    options: SensingOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
    keep: tuple[str | Path, Mapping[str, Any]] | None = None,
) -> Run:
    """Find contacts and forces in every frame: from clouds, or from markers where there are none.

    Known loads (loads.csv) act on the model, except those within a fifth of the body's size of a given place: these are what
    is to be sensed, and `known_loads` compares.

    Arguments:
        robot: the robot.
        recording: clouds or markers, and inputs.
        calibration: pose and initial inputs.
        at: places of contact at rest [m], shape (g, 3); needed where there are only markers.
        options: thresholds and assumptions.
        progress: called with (frames done, frames in all).
        keep: a file that holds the frames that are done, so that an estimate that is killed goes on there, and what it is made from: a file that
            says something else is not used. It is removed at the end.

    Raises:
        InputError: no clouds and no places; DataError: not one frame gave a result.
    """
    sensor = make_sensor(robot, recording, calibration, at=at, options=options)
    count = len(recording.time_s)
    with Keeper(keep) as keeper:
        done = keeper.kept(Done) or Done()
        for k in range(len(done.reports), count):
            try:
                done.last = sense_frame(sensor, k, done.last)
                done.reports.append(done.last.report)
                done.contacts.extend(done.last.contacts)
            except FemsenseError as error:
                done.reports.append(_failed(sensor, k, error))
            done.states.append(robot.body.mesh.nodes if done.last is None else done.last.state.positions)
            if progress is not None:
                progress(k + 1, count)
            keeper.keep(done, every=KEEP_S)
    if done.last is None:
        raise DataError(f"not one of {count} frames gave a result; the first: {done.reports[0].status}")
    mesh = robot.body.mesh
    return Run(
        contacts=tuple(done.contacts),
        frames=tuple(done.reports),
        states=States(recording.time_s, np.asarray(done.states, dtype=np.float32), mesh.tets, mesh.nodes),
        robot=robot,
        recording_folder=recording.folder,
        known_loads=_compare_loads(recording, sensor.places, done.contacts, sensor.size),
    )


def make_sensor(
    robot: Robot, recording: Recording, calibration: Calibration, *, at: npt.ArrayLike | None = None, options: SensingOptions | None = None,
) -> Sensor:  # fmt: skip
    """Prepare what stays the same from frame to frame. Raises InputError where nothing says where to look for forces."""
    recording = check_against(robot, recording)
    places = as_points(at if at is not None else np.zeros((0, 3)), "at")
    size = float(np.linalg.norm(np.ptp(robot.body.mesh.nodes, axis=0)))
    surface = make_surface(robot.body.mesh)
    _check_places(places, surface, robot, size)
    if not _has_clouds(recording) and not len(places):
        raise InputError("no clouds, and no place of contact is given", where=recording.folder, expected="clouds/, depth/, or --at X,Y,Z",
                         hint="name the place at rest in metres, robot frame: --at 0.1,0,0.015")  # fmt: skip
    if calibration.seats_m:
        points = robot.marker_points.copy()
        for name, seat in calibration.seats_m.items():
            if name in robot.marker_names:
                points[robot.marker_names.index(name)] = seat
        robot = robot.with_marker_points(points)
    initial = None
    if recording.actuation_zero == "unknown":
        table = calibration.cable_tension_n if recording.actuation == "tension" else calibration.cable_displacement_m
        initial = np.array([table[name] for name in robot.body.cable_names])
    drive = drive_of(robot, recording, initial=initial)
    sensed_here = _near_places(drive.load_points, places, size)
    drive = replace(drive, load_frame=drive.load_frame[~sensed_here], load_points=drive.load_points[~sensed_here], load_forces=drive.load_forces[~sensed_here],
                    load_ties=drive.load_ties[~sensed_here])  # fmt: skip
    return Sensor(
        robot,
        recording,
        calibration,
        Walk(robot, drive),
        surface,
        options or SensingOptions(),
        places,
        _probes(robot, surface, options or SensingOptions()),
        _root(calibration.pose_covariance),
        size,
    )


def _probes(robot: Robot, surface: Surface, options: SensingOptions) -> npt.NDArray[np.int64]:
    """Return the surface nodes that are matched with clouds: as many as the robot's features at least, off sharp edges where it has enough others."""
    count = max(len(robot.features), options.match_points)
    flat = spread_features(robot.body, count, among=flat_nodes(surface, robot.body.mesh.nodes))
    return flat if len(flat) >= min(50, count) else spread_features(robot.body, count)


def sense_frame(sensor: Sensor, k: int, previous: SensedFrame | None) -> SensedFrame:
    """Return contacts and forces of frame k, starting from the frame before.

    Raises:
        FemsenseError: a broken file, nothing of the robot in view, or no equilibrium.
    """
    began = time.perf_counter()
    before = previous.state.segment_tensions if previous is not None and has_history(sensor.robot) else None
    free_state = _solve(sensor, k, None, None if previous is None else previous.free_state, before)
    expected = free_state if previous is None else previous.state
    clouds = _robot_and_surroundings(sensor, k, expected) if _has_clouds(sensor.recording) else None
    patches, source = _find_contacts(sensor, k, clouds, expected)
    rows = _measure(sensor, k, clouds, free_state)
    rows = rows if clouds is None else _measure(sensor, k, clouds, free_state, _reach(sensor, rows))
    state, forces, at_end = free_state, np.zeros(0), rows
    contacts: tuple[ContactForce, ...] = ()
    if patches:
        same = previous is not None and (source == "given" or _same_places(previous, patches, expected))
        start = (previous.state, previous.forces) if previous is not None and same else None
        state, estimate, at_end = _fit_forces(sensor, k, clouds, patches, source, free_state, start, before)
        if source == "cloud":  # where it touches is clearer once the model has come near
            again, _ = _find_contacts(sensor, k, clouds, state)
            if len(again) == len(patches) and _wandered(patches, again, state) > 0.5 * sensor.surface.edge:
                patches = again
                near = (state, estimate.forces)
                state, estimate, at_end = _fit_forces(sensor, k, clouds, patches, source, free_state, near, before)
        forces = estimate.forces
        contacts = _contacts(sensor, k, patches, estimate, state, source)
    number, stamp = int(sensor.recording.frame_numbers[k]), float(sensor.recording.time_s[k])
    report = FrameReport(
        number,
        stamp,
        "ok",
        len(contacts),
        at_end.count,
        rows.rms,
        at_end.rms,
        1e3 * (time.perf_counter() - began),
        dict(state.tension),
        dict(state.pressure),
    )
    return SensedFrame(state, free_state, forces, report, contacts)


def _wandered(patches: Sequence[Patch], again: Sequence[Patch], state: Equilibrium) -> float:
    """Return how far the farthest patch has moved [m]."""
    return max(float(np.linalg.norm(a.mean(state.positions) - b.mean(state.positions))) for a, b in zip(patches, again))


def _same_places(previous: SensedFrame, patches: Sequence[Patch], state: Equilibrium) -> bool:
    """Return whether the contacts are those of the frame before, so that its forces are a start."""
    if len(previous.contacts) != len(patches):
        return False
    moved = [np.linalg.norm(p.mean(state.positions) - c.position_m) for p, c in zip(patches, previous.contacts)]
    return bool(max(moved) < 0.05 * np.linalg.norm(np.ptp(state.positions, axis=0)))


# --- places ------------------------------------------------------------------------------------------------------------


def _find_contacts(sensor: Sensor, k: int, clouds: Seen | None, state: Equilibrium) -> tuple[list[Patch], str]:
    """Return where forces may act: the given places, else where surroundings touch the robot (Algorithm 2)."""
    mesh, clamped, radius = sensor.robot.body.mesh, sensor.robot.body.clamped, 1.5 * sensor.surface.edge
    if len(sensor.places):
        return [patch_at(sensor.surface, mesh.nodes, p, radius, clamped) for p in sensor.places], "given"
    said_free = sensor.recording.free is not None and bool(sensor.recording.free[k])
    if clouds is None or said_free:
        return [], "cloud"
    voxel = _voxel(sensor)
    reach = sensor.options.contact_radius_m or 3.0 * voxel
    found = detect_contacts(clouds.others, clouds.robot, search_radius_m=reach, min_neighbors=sensor.options.contact_neighbors,
                            cluster_distance_m=4.0 * voxel, min_points=3)  # fmt: skip
    near_clamp = _clamp_mask(sensor, found.positions, reach)
    patches = [
        patch_at(sensor.surface, state.positions, p, max(radius, r), clamped, facing=_seen_normal(clouds, p, 2.0 * reach))
        for p, r, skip in zip(found.positions, found.radius, near_clamp)
        if not skip
    ]
    return patches, "cloud"


def _seen_normal(clouds: Seen, place: FloatArray, radius: float) -> FloatArray | None:
    """Return the mean outward normal of the robot as it is seen around a place, shape (3,); None where it is not known."""
    if clouds.normals is None:
        return None
    near = np.linalg.norm(clouds.robot - place, axis=1) < radius
    mean = clouds.normals[near].sum(axis=0)
    length = float(np.linalg.norm(mean))
    return mean / length if length > 0.3 * max(int(near.sum()), 1) else None


def _clamp_mask(sensor: Sensor, places: FloatArray, reach: float) -> npt.NDArray[np.bool_]:
    """Return places that touch the clamp: a force there does not move the body, and a holder always touches it."""
    clamped = sensor.robot.body.mesh.nodes[sensor.robot.body.clamped]
    if not len(clamped) or not len(places):
        return np.zeros(len(places), dtype=bool)
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(clamped).query(places)[0] < reach)


def _check_places(places: FloatArray, surface: Surface, robot: Robot, size: float) -> None:
    from femsense.patch import closest_surface_point

    nodes = robot.body.mesh.nodes
    for i, place in enumerate(places):
        distance = float(np.linalg.norm(closest_surface_point(surface, nodes, place) - place))
        if distance > 0.1 * size:
            raise InputError("far from the surface of the body", where=f"at[{i}]", found=f"{place.tolist()} m, {1e3 * distance:.1f} mm away",
                             expected=f"a point of the surface at rest, within {1e3 * nodes.min(axis=0)} … {1e3 * nodes.max(axis=0)} mm",
                             hint="coordinates are metres in the robot frame")  # fmt: skip


def _near_places(points: FloatArray, places: FloatArray, size: float) -> npt.NDArray[np.bool_]:
    """Return which known loads act near a given place."""
    if not len(places) or not len(points):
        return np.zeros(len(points), dtype=bool)
    distance = np.linalg.norm(points[:, None] - places[None], axis=2).min(axis=1)
    return np.asarray(distance < 0.2 * size)


# --- clouds ------------------------------------------------------------------------------------------------------------


def _has_clouds(recording: Recording) -> bool:
    return any(file is not None for files in recording.cloud_files for file in files)


def _voxel(sensor: Sensor) -> float:
    return sensor.options.voxel_m or 0.01 * sensor.size


def _robot_and_surroundings(sensor: Sensor, k: int, state: Equilibrium) -> Seen | None:
    """Return robot points and surrounding points of all cameras [m], robot frame; None where the frame has no cloud."""
    parts: list[PointCloud] = []
    for view in range(len(sensor.recording.camera_names)):
        cloud = read_frame_cloud(sensor.recording, k, view=view)
        if cloud is not None:
            points = in_robot_frame(
                cloud.points,
                np.zeros(len(cloud.points), dtype=np.int64),
                [sensor.calibration.poses[view]],
                sensor.robot.observation,
            )
            parts.append(PointCloud(points, cloud.colors))
    if not parts:
        return None
    colors = [p.colors for p in parts if p.colors is not None]
    cloud = PointCloud(np.vstack([p.points for p in parts]), np.vstack(colors) if len(colors) == len(parts) else None)
    margin = 0.25 * sensor.size
    box = np.array([state.positions.min(axis=0) - margin, state.positions.max(axis=0) + margin])
    voxel = _voxel(sensor)
    cloud = remove_radius_outliers(voxel_grid(pass_through(cloud, box), voxel), 3.0 * voxel, 4)
    robot, others = _segment(sensor, cloud, state)
    if len(robot.points) < 10:
        raise DataError(
            f"only {len(robot.points)} points of the robot in view: check the pose, appearance.color_rgb, and what the camera sees"
        )
    normals = None
    if len(sensor.calibration.poses) == 1:
        normals = estimate_normals(robot.points, 2.5 * voxel, camera_position=sensor.calibration.poses[0][:3, 3])[0]
    return Seen(robot.points, normals, others.points)


def _segment(sensor: Sensor, cloud: PointCloud, state: Equilibrium) -> tuple[PointCloud, PointCloud]:
    nodes, triangles = sensor.surface.nodes, sensor.surface.triangles
    normals = vertex_normals(state.positions, triangles)[nodes]
    distance = 0.08 * sensor.size
    color = sensor.robot.color_rgb
    if cloud.colors is None:
        return segment_by_model(cloud, state.positions[nodes], normals, 0.5 * distance, plane_m=1.5 * _voxel(sensor))
    if color is None:
        return segment_by_model(cloud, state.positions[nodes], normals, distance)
    return segment_robot(cloud, color, vote_radius_m=1.5 * _voxel(sensor))


# --- measurements --------------------------------------------------------------------------------------------------------


def _measure(sensor: Sensor, k: int, clouds: Seen | None, state: Equilibrium, reach: float = np.inf) -> Rows:
    if clouds is not None:
        return _cloud_rows(sensor, clouds, state, reach)
    return _marker_rows(sensor, k, state)


def _cloud_rows(sensor: Sensor, seen_now: Seen, state: Equilibrium, reach: float) -> Rows:
    """Feature points matched along their normals (Algorithm 3), no farther than `reach` [m]."""
    options, features = sensor.options, sensor.probes
    normals = vertex_normals(state.positions, sensor.surface.triangles)[features]
    cameras = np.array([T[:3, 3] for T in sensor.calibration.poses])
    matches: Matches = match_along_normals(
        state.positions[features],
        normals,
        seen_now.robot,
        d_m=options.match_line_m or 3.0 * _voxel(sensor),
        d_l=min(options.match_reach_m or 0.2 * sensor.size, reach),
        average=True,
        camera_position=cameras,
        robot_normals=seen_now.normals,
        std_floor_m=options.cloud_std_m,
    )
    use = matches.found & np.isfinite(matches.std)
    if use.sum() < 3:
        raise DataError(
            f"only {int(use.sum())} of {len(features)} feature points were found in the cloud: check the pose and the view"
        )
    at, n = features[use], normals[use]
    seen = matches.positions(state.positions[features], normals)[use]
    by_pose = np.einsum("rc,rcj->rj", n, _pose_columns(sensor, seen))
    distance = matches.distance[use]
    way = np.linalg.norm(state.positions[at] - sensor.robot.body.mesh.nodes[at], axis=1)
    std = np.hypot(matches.std[use], options.model_std * way)
    return Rows(
        lambda u: np.einsum("krc,rc->rk", u[:, at], n),
        distance,
        std,
        by_pose,
        int(use.sum()),
        float(np.sqrt((distance**2).mean())),
        std,
        _crowding(seen, options.correlation_m or 0.12 * sensor.size),
    )


def _crowding(points: FloatArray, length: float) -> float:
    """Return the factor by which neighbours' common errors widen standard deviations: √(points / cells of that length they fill)."""
    cells = len(np.unique(np.floor(points / length).astype(np.int64), axis=0))
    return float(np.sqrt(len(points) / cells))


def _marker_rows(sensor: Sensor, k: int, state: Equilibrium) -> Rows:
    """Markers, three rows each."""
    recording, robot = sensor.recording, sensor.robot
    known = {name: i for i, name in enumerate(robot.marker_names)}
    rows = np.flatnonzero(recording.marker_frame == k)
    marker = np.array([known.get(recording.marker_names[i], -1) for i in recording.marker_index[rows]], dtype=np.int64)
    rows, marker = rows[marker >= 0], marker[marker >= 0]
    if not len(rows):
        raise DataError("no marker is seen in this frame")
    measured = in_robot_frame(
        recording.marker_xyz[rows], recording.marker_view[rows], sensor.calibration.poses, robot.observation
    )
    place = robot.markers[marker]
    residual = measured - place.positions(state.positions)
    way = np.linalg.norm(place.positions(state.positions) - robot.marker_points[marker], axis=1)
    noise = sensor.options.marker_std_m or _marker_std(sensor.calibration)
    std = np.repeat(np.hypot(noise, sensor.options.model_std * way), 3)
    seated = np.array([robot.marker_names[m] in sensor.calibration.seats_m for m in marker])
    # a seat that rest.csv measured moves with the pose: only the marker's motion since then is left to turn
    by_pose = _pose_columns(sensor, measured) - seated[:, None, None] * _pose_columns(sensor, robot.marker_points[marker])
    by_pose = by_pose.reshape(residual.size, -1)

    def functional(u: FloatArray) -> FloatArray:
        return np.array([place.moves(v).ravel() for v in u]).reshape(len(u), -1).T

    return Rows(functional, residual.ravel(), std, by_pose, len(rows), float(np.sqrt((residual**2).sum(axis=1).mean())), std)


def _marker_std(calibration: Calibration) -> float:
    """Return the noise of a marker along each axis [m]: what the calibration left, or half a millimetre where it had none."""
    return max(calibration.rms_m / np.sqrt(3.0), 2e-5) if np.isfinite(calibration.rms_m) else 5e-4


def _pose_columns(sensor: Sensor, points: FloatArray) -> FloatArray:
    """Return how points move with the pose, in units of its standard deviations [m], shape (p, 3, j)."""
    pivot = sensor.robot.marker_points.mean(axis=0) if len(sensor.robot.marker_points) else np.zeros(3)
    arm = points - pivot
    J = np.zeros((len(points), 3, 6))
    J[:, 0, 1], J[:, 0, 2] = arm[:, 2], -arm[:, 1]
    J[:, 1, 0], J[:, 1, 2] = -arm[:, 2], arm[:, 0]
    J[:, 2, 0], J[:, 2, 1] = arm[:, 1], -arm[:, 0]
    J[:, :, 3:] = np.eye(3)
    return J @ sensor.pose_root


def _root(covariance: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh(covariance) if covariance.size else (np.zeros(0), np.zeros((6, 0)))
    keep = values > 0
    return np.asarray(vectors[:, keep] * np.sqrt(values[keep]))


# --- forces --------------------------------------------------------------------------------------------------------------


def _fit_forces(
    sensor: Sensor, k: int, clouds: Seen | None, patches: Sequence[Patch], source: str, free_state: Equilibrium,
    start: tuple[Equilibrium, FloatArray] | None, before: tuple[FloatArray, ...] | None,
) -> tuple[Equilibrium, ForceEstimate, Rows]:  # fmt: skip
    """Equilibrium → compliance → QP, until the forces stop changing or no step makes the fit better.

    `start` is a state near by and the forces in it.
    """
    n = len(sensor.robot.body.mesh.nodes)
    basis = np.array([patch.spread(axis, n) for patch in patches for axis in np.eye(3)])
    state, forces = free_state, np.zeros(len(basis))
    if start is not None and len(start[1]) == len(basis):
        forces = start[1]
        state = _solve(sensor, k, np.tensordot(forces, basis, axes=1), start[0], before, ROUGH)
    rows = _measure(sensor, k, clouds, state)
    estimate: ForceEstimate | None = None
    size = np.inf
    for iteration in range(sensor.options.iterations):
        rows = rows if clouds is None or iteration == 0 else _measure(sensor, k, clouds, state, _reach(sensor, rows))
        outlying = _outlying(rows)
        rows = _robust(rows, outlying)
        directions = _directions(sensor, patches, state, source)
        tangent = tangent_at(sensor.robot.body, state)
        load = internal(sensor.robot.body, state.positions, tangent=False).forces
        moves = tangent.respond(np.concatenate([basis, load[None]]))
        moves, sag = moves[:-1], moves[-1:]
        W = rows.functional(moves) @ directions
        nuisance = _nuisance(sensor, rows, sag)
        estimate, size = _solve_qp(sensor, rows, W, nuisance, directions, forces, state, patches, source, size)
        step = directions @ estimate.forces - forces
        still = np.maximum(
            2e-3 * max(float(np.abs(forces + step).max()), 1e-3), 0.05 * np.linalg.norm(directions * estimate.std, axis=1)
        )
        if (np.abs(step) < still).all():
            break
        cost = _cost(rows, nuisance, forces, size, outlying)
        better = None
        for share in (1.0, 0.4, 0.1):  # large deflections: a full step may lead too far
            try:
                there = _predicted(state, tangent, np.tensordot(share * step, moves, axes=1))
                there = _solve(sensor, k, np.tensordot(forces + share * step, basis, axes=1), there, before, ROUGH)
                seen = _measure(sensor, k, clouds, there, np.inf if iteration == 0 else _reach(sensor, rows))
            except DataError:
                continue
            seen = _robust(seen, outlying)
            gain = cost - _cost(seen, _nuisance(sensor, seen, sag), forces + share * step, size, outlying)
            if gain > 0:
                better = (forces + share * step, there, seen)
                break
        if better is None:
            break
        forces, state, rows = better
        if gain < 1e-3 * cost:
            break
    state = _solve(sensor, k, np.tensordot(forces, basis, axes=1), state, before)
    assert estimate is not None
    covariance = rows.crowding**2 * (directions @ estimate.covariance @ directions.T)
    if source == "cloud":
        covariance = covariance + _place_covariance(sensor, patches, state, tangent, rows, forces)
    return state, replace(estimate, forces=freeze(forces), covariance=freeze(covariance)), rows


def _predicted(state: Equilibrium, tangent: Tangent, move: FloatArray) -> Equilibrium:
    """Return a start near the state that follows when nodes move by `move` [m], shape (n, 3), with the factor that said so."""
    factor = tangent.factor if tangent.factor.negative == 0 else None
    return replace(state, positions=state.positions + move, factor=factor)


def _place_covariance(
    sensor: Sensor, patches: Sequence[Patch], state: Equilibrium, tangent: Tangent, rows: Rows, forces: FloatArray
) -> FloatArray:
    """Return what not knowing the place of contact exactly adds to the covariance of the forces [N²], shape (3k, 3k).

    The camera sees the rim of what touches, not the contact itself. Each force is fitted again at places shifted along the surface
    by PLACE_STD of the search radius, so that it moves the rows as before.
    """
    n, count = len(state.positions), 3 * len(patches)
    covariance = np.zeros((count, count))
    shift = PLACE_STD * (sensor.options.contact_radius_m or 3.0 * _voxel(sensor))
    for i, patch in enumerate(patches):
        force = forces[3 * i : 3 * i + 3]
        size, normal = float(np.linalg.norm(force)), _normal(sensor, patch, state)
        if size == 0:
            continue
        across = np.linalg.svd(normal[None])[2][1:]
        places = [patch.mean(state.positions) + shift * t for t in across]
        moved = [
            patch_at(sensor.surface, state.positions, p, 1.5 * sensor.surface.edge, sensor.robot.body.clamped, facing=normal)
            for p in places
        ]
        moves = (
            rows.functional(tangent.respond(np.array([q.spread(force / size, n) for q in [patch, *moved]]))) / rows.std[:, None]
        )
        again = size * (moves[:, 1:].T @ moves[:, 0]) / np.maximum((moves[:, 1:] ** 2).sum(axis=0), 1e-300)
        spread = float(((again - size) ** 2).sum())
        relative = spread / size**2 + sensor.options.cloud_force_std**2
        covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = relative * np.outer(force, force)
    return covariance


def _reach(sensor: Sensor, rows: Rows) -> float:
    """Return how far along the normal a match may still lie [m]: what lies farther than the rest belongs to something else."""
    return max(6.0 * float(np.median(np.abs(rows.residual))), 1.5 * _voxel(sensor))


def _outlying(rows: Rows) -> float:
    """Return from which size on a whitened residual stands out [1]: 2.5 times the median scale (Huber)."""
    return 2.5 * max(1.483 * float(np.median(np.abs(rows.residual / rows.sharp))), 1.0)


def _robust(rows: Rows, outlying: float) -> Rows:
    """Return the rows with larger standard deviations where residuals stand out."""
    return replace(rows, std=rows.sharp * np.sqrt(np.maximum(np.abs(rows.residual / rows.sharp) / outlying, 1.0)))


def _directions(sensor: Sensor, patches: Sequence[Patch], state: Equilibrium, source: str) -> FloatArray:
    """Return what the unknowns are: all three components, or the inward normal of each patch, shape (3k, unknowns)."""
    if not _along_normals(sensor, source):
        return np.eye(3 * len(patches))
    directions = np.zeros((3 * len(patches), len(patches)))
    for i, patch in enumerate(patches):
        directions[3 * i : 3 * i + 3, i] = -_normal(sensor, patch, state)
    return directions


def _along_normals(sensor: Sensor, source: str) -> bool:
    return source == "cloud" and sensor.options.friction == 0


def _normal(sensor: Sensor, patch: Patch, state: Equilibrium) -> FloatArray:
    mean = patch.mean(vertex_normals(state.positions, sensor.surface.triangles))
    return mean / max(float(np.linalg.norm(mean)), 1e-12)


def _nuisance(sensor: Sensor, rows: Rows, sag: FloatArray) -> FloatArray:
    """Return how the model moves with modulus and pose, in units of their standard deviations [m], shape (r, j).

    `sag` is the response of the nodes to the internal forces [m], shape (1, n, 3): a body so much softer moves on by so much.
    """
    return np.hstack([-sensor.options.modulus_std * rows.functional(sag), -rows.by_pose])


def _cost(rows: Rows, nuisance: FloatArray, forces: FloatArray, size: float, outlying: float) -> float:
    """Return the mean of Huber's function of the whitened residual with nuisance fitted, and of the forces against their prior."""
    A = np.vstack([nuisance / rows.std[:, None], np.eye(nuisance.shape[1])])
    b = np.concatenate([rows.residual / rows.std, np.zeros(nuisance.shape[1])])
    fitted = np.linalg.lstsq(A, b, rcond=None)[0]
    z = np.abs(rows.residual - nuisance @ fitted) / rows.sharp
    loss = np.where(z <= outlying, z**2, outlying * (2.0 * z - outlying)).sum() + fitted @ fitted
    return float((loss + (0.0 if np.isinf(size) else forces @ forces / size**2)) / len(rows.residual))


def _solve_qp(
    sensor: Sensor, rows: Rows, W: FloatArray, nuisance: FloatArray, directions: FloatArray, forces: FloatArray, state: Equilibrium,
    patches: Sequence[Patch], source: str, size: float,
) -> tuple[ForceEstimate, float]:  # fmt: skip
    """The QP in the total forces: modelled = W (f − f₀) at the linearisation f₀; pose and modulus are nuisance with priors.

    Three free components of one force are seldom all determined (a beam hardly yields along its axis). They share a Gaussian
    prior of unknown size, which the data choose (MacKay 1992): what the data do not see shrinks, what they see stays.

    Returns:
        the estimate, and the size of that prior [N] (inf where each force has one component).
    """
    now = np.linalg.lstsq(directions, forces, rcond=None)[0]
    pushing, cone = _along_normals(sensor, source), None
    if source == "cloud" and sensor.options.friction:
        cone = FrictionCone(normals=np.array([_normal(sensor, p, state) for p in patches]), mu=sensor.options.friction)

    def answer(prior: float) -> ForceEstimate:
        extra = 0 if np.isinf(prior) else W.shape[1]  # the prior on the forces as rows: 0 ± prior
        estimate = estimate_forces(
            np.vstack([W, np.eye(W.shape[1])[:extra]]), None, np.concatenate([-W @ now, np.zeros(extra)]),
            np.concatenate([rows.residual, np.zeros(extra)]), std=np.concatenate([rows.std, np.full(extra, prior)]),
            force_lower=np.zeros(W.shape[1]) if pushing else None, friction_cone=cone,
            nuisance=np.vstack([nuisance, np.zeros((extra, nuisance.shape[1]))]), nuisance_std=np.ones(nuisance.shape[1]), inflate=True,
        )  # fmt: skip
        if not np.isfinite(estimate.forces).all():
            raise DataError(f"the force problem has no answer: {estimate.status}")
        return estimate

    estimate = answer(size)
    if pushing:
        return estimate, np.inf
    for _ in range(20):
        square = float(estimate.forces @ estimate.forces)
        blurred = float(np.trace(estimate.covariance)) if np.isfinite(estimate.covariance).all() else 0.0
        new = float(np.sqrt((square + blurred) / len(estimate.forces)))
        if not np.isfinite(new) or new < 1e-9 or abs(new - size) < 1e-3 * new:
            break
        size = new
        estimate = answer(size)
    return estimate, size


def _solve(
    sensor: Sensor, k: int, nodal_forces: FloatArray | None, start: Equilibrium | None, before: tuple[FloatArray, ...] | None,
    tolerance: float = 1e-9,
) -> Equilibrium:  # fmt: skip
    state = solve_frame(
        sensor.walk, k, start=start, before=before, nodal_forces=nodal_forces, reuse_factor=start is not None, relative_tolerance=tolerance
    )  # fmt: skip
    if not state.converged:
        raise DataError(f"no equilibrium: {state.status}: {state.advice}")
    return state


# --- results -------------------------------------------------------------------------------------------------------------


def _contacts(
    sensor: Sensor, k: int, patches: Sequence[Patch], estimate: ForceEstimate | None, state: Equilibrium, source: str
) -> tuple[ContactForce, ...]:
    if estimate is None:
        return ()
    number, stamp = int(sensor.recording.frame_numbers[k]), float(sensor.recording.time_s[k])
    result = []
    for i, patch in enumerate(patches):
        force = estimate.forces[3 * i : 3 * i + 3]
        size = float(np.linalg.norm(force))
        normal = _normal(sensor, patch, state)
        along = force / size if size > 0 else -normal
        std = float(np.sqrt(max(float(along @ estimate.covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] @ along), 0.0)))
        result.append(ContactForce(number, stamp, i, patch.mean(state.positions), normal, force, size, std, source))
    return tuple(result)


def _failed(sensor: Sensor, k: int, error: FemsenseError) -> FrameReport:
    number, stamp = int(sensor.recording.frame_numbers[k]), float(sensor.recording.time_s[k])
    nan = float("nan")
    body = sensor.robot.body
    return FrameReport(
        number, stamp, " ".join(str(error).split()), 0, 0, nan, nan, nan,
        dict.fromkeys(body.cable_names, nan), dict.fromkeys(body.chamber_names, nan),
    )  # fmt: skip


def _compare_loads(
    recording: Recording, places: FloatArray, contacts: Sequence[ContactForce], size: float
) -> tuple[dict[str, float], ...]:
    """Return declared next to sensed resultants of the frames whose loads act at the given places."""
    near = _near_places(recording.load_points, places, size)
    result = []
    for k, number in enumerate(recording.frame_numbers):
        rows = near & (recording.load_frame == k)
        sensed = [c.force_n_xyz for c in contacts if c.frame == number]
        if rows.any() and sensed:
            declared = np.linalg.norm(recording.load_forces[rows].sum(axis=0))
            found = np.linalg.norm(np.sum(sensed, axis=0))
            result.append(
                {
                    "frame": int(number),
                    "declared_n": float(declared),
                    "sensed_n": float(found),
                    "error_percent": float(100 * (found / declared - 1)),
                }
            )
    return tuple(result)


__all__ = [
    "ContactForce",
    "FrameReport",
    "Run",
    "SensedFrame",
    "SensingOptions",
    "States",
    "estimate",
    "make_sensor",
    "sense_frame",
]
