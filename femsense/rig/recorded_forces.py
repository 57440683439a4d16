"""Which forces the camera of a recording can resolve at a few places of a robot: the bound of `force_map` with the points
that were measured in place of points that would be.

The rows are those of one frame: of its clouds, or of its markers without a cloud. The standard deviation of a depth
is the one that the recording declares, or else the scatter of the clouds of contact-free frames.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp

from femsense.calib.calibration import Calibration
from femsense.calib.from_clouds import measured_noises
from femsense.calib.inputs import calibrated_inputs
from femsense.calib.pressure_zeros import with_initial_pressures
from femsense.calib.scan import REACH, ray_rows, read_scan
from femsense.core.arrays import BoolArray, IntArray, diagonal, freeze
from femsense.core.errors import DataError
from femsense.fem.equilibrium import Equilibrium
from femsense.fem.mesh import vertex_normals
from femsense.model.camera import CameraNoise
from femsense.model.contact_patch import body_surface, flat_nodes
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.quasi_static_path import free_path
from femsense.model.recording import Recording
from femsense.model.recording_checks import check_against
from femsense.model.robot import Robot, spread_features
from femsense.pointcloud.rays import Surface
from femsense.rig.camera_tables import NoiseTable
from femsense.rig.force_map import CLEAR, ForceMap, Measured, Unknowns, force_bound, measured_rows, neighbours

SEEN, HIDDEN = 4, 2
"""Number of places for which a recording's resolution is stated: visible ones, and hidden ones."""
CANDIDATES = 120
"""Number of evenly spread candidates for them."""
FACING = 0.2
"""Smallest cosine between normal and ray to the camera of a place that is measured."""


@dataclass(frozen=True, eq=False, slots=True)
class RecordedForces:
    """The forces that one frame of a recording resolves."""

    found: ForceMap
    frame: int
    """Its number in frames.csv."""
    from_clouds: bool
    """Whether it is from clouds; else from markers."""
    noise_m: float
    """Median standard deviation of a depth along its ray, or of a marker's coordinate [m]."""
    declared: bool
    """Whether the recording declares that noise; else it is estimated."""


def recorded_forces(robot: Robot, recording: Recording, calibration: Calibration) -> RecordedForces:
    """Return the forces that a recording resolves at a few places, in its first measured contact-free frame.

    Arguments:
        robot, recording: as loaded.
        calibration: poses and initial inputs.

    Raises:
        InputError: the recording does not fit the robot. DataError: nothing was measured, or no equilibrium.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # shown when the recording was read
        recording = check_against(robot, recording)
    robot = with_initial_pressures(robot.in_recording(recording.label), calibration.chamber_pressure_pa)
    initial = None if recording.actuation_zero == "absolute" else calibrated_inputs(robot, recording, calibration)
    driven = DrivenRobot(robot, drive_of(robot, recording, initial=initial))
    clouds = np.array([any(file is not None for file in files) for files in recording.cloud_files])
    k = _frame(recording, clouds if clouds.any() else np.isin(np.arange(recording.frame_count), recording.marker_frame))
    state = next((state for _, state in free_path(driven, [k])), None)
    if state is None:
        raise DataError(f"no equilibrium in frame {recording.frame_numbers[k]}")
    if clouds.any():
        noises = measured_noises(robot, recording, calibration)
        declared = all(camera is not None and camera.noise is not None for camera in recording.cameras)
        measured, noise = _cloud_rows(robot, recording, k, calibration, noises, state)
    else:
        declared = recording.marker_noise_m is not None
        measured, noise = _marker_rows(robot, recording, k, calibration)
    nodes, seen = _places(robot, calibration, state)
    bound = force_bound(robot, state, measured, nodes, seen, unknowns=Unknowns())
    return RecordedForces(bound, int(recording.frame_numbers[k]), bool(clouds.any()), noise, declared)


def _frame(recording: Recording, measured: BoolArray) -> int:
    """Return the index of the first measured contact-free frame, or else of the first measured frame."""
    if not measured.any():
        raise DataError("the recording has neither clouds nor markers with names")
    free = measured if recording.free is None else measured & recording.free
    return int(np.flatnonzero(free if free.any() else measured)[0])


def _cloud_rows(
    robot: Robot,
    recording: Recording,
    k: int,
    calibration: Calibration,
    noises: tuple[CameraNoise, ...],
    state: Equilibrium,
) -> tuple[Measured, float]:
    """Return the rows of the clouds of a frame, and the median standard deviation of a depth [m]."""
    scan = read_scan(robot, recording, k, calibration.poses, state.positions)
    surface = Surface(state.positions, body_surface(robot.body.mesh).triangles)
    size = diagonal(robot.body.mesh.nodes)
    rows = None if scan is None else ray_rows(scan, surface, calibration.poses, noises, reach=REACH * size)
    if rows is None or not len(rows.residual):
        raise DataError(f"no point of frame {recording.frame_numbers[k]} lies on the robot at its calibrated pose")
    measured = measured_rows(robot, rows, [_together(noise, recording, view) for view, noise in enumerate(noises)])
    return measured, float(np.median(rows.std / np.maximum(rows.hits.cosine, 1e-3)))


def _together(noise: CameraNoise, recording: Recording, view: int) -> float:
    """Return the number of points of a camera that count as one: errors of neighbouring stereo pixels are correlated (see `neighbours`).

    Points of a cloud file are usually thinned, and count one each.
    """
    images = any(file is not None and file.suffix.lower() == ".png" for file in (files[view] for files in recording.cloud_files))
    return neighbours(NoiseTable.model_validate({"kind": "stereo"})) if noise.kind == "stereo" and images else 1.0


def _marker_rows(robot: Robot, recording: Recording, k: int, calibration: Calibration) -> tuple[Measured, float]:
    """Return three rows for each marker in a frame, and the standard deviation of a coordinate [m]."""
    known = {name: i for i, name in enumerate(robot.marker_names)}
    mine = np.flatnonzero(recording.marker_frame == k)
    markers = np.array([known.get(recording.marker_names[i], -1) for i in recording.marker_index[mine]], dtype=np.int64)
    mine, markers = mine[markers >= 0], markers[markers >= 0]
    if not len(mine):
        raise DataError(f"frame {recording.frame_numbers[k]} has no marker of the robot")
    guesses = (recording.marker_noise_m, calibration.noise_m / np.sqrt(3.0), calibration.rms_m / np.sqrt(3.0))
    noise = next((float(value) for value in guesses if value is not None and np.isfinite(value) and value > 0), 0.0)
    if not noise:
        raise DataError("the noise of the markers is unknown: declare marker_noise_m in recording.toml")
    ties = robot.markers[markers]
    unit = sp.csr_array(ties.matrix(len(robot.body.mesh.nodes)))
    operator = sp.csr_array(sp.kron(unit, sp.eye_array(3)))
    arm = robot.marker_points[markers] - robot.body.mesh.nodes.mean(axis=0)
    by_pose = np.zeros((len(mine), 3, len(calibration.poses), 6))
    rows = np.arange(len(mine))
    by_pose[rows, :, recording.marker_view[mine], :3] = np.cross(np.eye(3)[None], arm[:, None]).transpose(0, 2, 1)
    by_pose[rows, :, recording.marker_view[mine], 3:] = np.eye(3)
    return Measured(operator, by_pose.reshape(3 * len(mine), -1), np.full(3 * len(mine), noise)), noise


def _places(robot: Robot, calibration: Calibration, state: Equilibrium) -> tuple[IntArray, BoolArray]:
    """Return the nodes at which the resolution is stated, and whether a camera sees each, shape (p,)."""
    surface = body_surface(robot.body.mesh)
    flat = np.setdiff1d(flat_nodes(surface, robot.body.mesh.nodes), robot.body.clamped)
    nodes = spread_features(robot.body, CANDIDATES, among=flat if len(flat) else None)
    if not len(nodes):
        raise DataError("every node of the surface is clamped: no force moves this robot")
    seen = _seen(calibration, state, surface.triangles, nodes)
    few = [spread_features(robot.body, count, among=nodes[which]) for count, which in ((SEEN, seen), (HIDDEN, ~seen))]
    return np.concatenate(few), np.repeat([True, False], [len(part) for part in few])


def _seen(calibration: Calibration, state: Equilibrium, triangles: IntArray, nodes: IntArray) -> BoolArray:
    """Return which nodes a camera sees: facing it and not occluded by the body, shape (p,)."""
    normals = vertex_normals(state.positions, triangles)[nodes]
    size = diagonal(state.positions)
    places = state.positions[nodes] + CLEAR * normals
    surface, seen = Surface(state.positions, triangles), np.zeros(len(nodes), dtype=bool)
    for T in calibration.poses:
        rays = T[:3, 3] - places
        facing = np.einsum("pc,pc->p", rays, normals) > FACING * np.linalg.norm(rays, axis=1)
        hits = surface.cast(places, np.tile(T[:3, 3], (len(places), 1)), reach=size)
        clear = np.zeros(len(nodes), dtype=bool)
        clear[hits.index[np.abs(hits.distance) < 2.0 * CLEAR]] = True
        seen |= facing & clear
    return freeze(seen, bool)


# Texts and tables


def resolution_document(recorded: RecordedForces) -> dict[str, Any]:
    """Return the resolution at each place as plain tables."""
    found = recorded.found
    return {
        "frame": recorded.frame,
        "from": "clouds" if recorded.from_clouds else "markers",
        "points": found.points if recorded.from_clouds else found.points // 3,
        "noise_m": recorded.noise_m,
        "noise_declared": recorded.declared,
        "places": [
            {"place_m": place.tolist(), "seen": bool(seen), "normal_std_n": float(normal), "tangent_std_n": float(tangent)}
            for place, seen, normal, tangent in zip(found.rest, found.visible, found.normal_std, found.tangent_std)
        ],
    }


def resolution_text(recorded: RecordedForces) -> str:
    """Return the resolution as text: one line per place, and the smallest force whose size is determined."""
    found, mm = recorded.found, 1e3 * recorded.noise_m
    if recorded.from_clouds:
        source = f"{found.points} points of the robot, noise of a depth {mm:.2g} mm"
    else:
        source = f"{found.points // 3} markers, noise of a coordinate {mm:.2g} mm"
    known = "declared" if recorded.declared else "estimated"
    lines = [
        "forces that this camera resolves (σ of a small force at a known place)",
        f"  frame {recorded.frame}: {source} ({known})",
        f"  {'at rest [mm]':<22}{'':<14}{'into the surface':>18}{'along it':>12}",
    ]
    for place, seen, normal, tangent in zip(found.rest, found.visible, found.normal_std, found.tangent_std):
        at = ", ".join(f"{1e3 * x:.0f}" for x in place)
        lines.append(f"  {f'({at})':<22}{'seen' if seen else 'out of sight':<14}{normal:>16.2g} N{tangent:>10.2g} N")
    low, high = 3.0 * found.normal_std.min(), 3.0 * found.normal_std.max()
    lines.append(
        f"  the size of a force is determined from three σ on: {low:.2g} to {high:.2g} N at these places; "
        "an unknown place or a model error enlarges σ"
    )
    return "\n".join(lines)
