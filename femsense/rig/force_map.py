"""The forces that a camera can resolve on a robot, before it is built: a Cramér–Rao bound over the surface.

Each measured point is a row: the displacement of the surface along its normal, with the noise of the depth along the ray
times the cosine of incidence. A force f at a place moves the rows by A f (compliance times rows); the nuisance parameters,
camera poses and modulus, move them by N times their prior standard deviations. The covariance of f is

    (Aᵀ Q A + P)⁻¹,   Q = I − N (Nᵀ N + I)⁻¹ Nᵀ,   rows whitened, P the prior of the force.

The map shows the standard deviation of a small force along the normal [N].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.sparse as sp

from femsense.calib.scan import REACH, RayRows, Scan, ray_rows
from femsense.core.arrays import BoolArray, FloatArray, IntArray, diagonal, freeze
from femsense.core.errors import DataError
from femsense.fem.assembly import internal
from femsense.fem.compliance import Tangent, tangent_at
from femsense.fem.equilibrium import Equilibrium, solve_equilibrium
from femsense.fem.mesh import vertex_normals
from femsense.model.camera import CameraNoise
from femsense.model.contact_patch import body_surface, patch_at
from femsense.model.robot import Robot, spread_features
from femsense.pointcloud.rays import Surface
from femsense.rig.camera import Shape, render, visible_points
from femsense.rig.camera_tables import NoiseTable
from femsense.rig.experiment import View, noise_of, rng_of, views_of
from femsense.rig.lens import pixel_rays
from femsense.rig.plan import plan_script
from femsense.rig.scene import body_shape, floor_shape
from femsense.rig.script import ScriptTable

BATCH = 20
"""Number of places whose compliance is solved for at once."""
RADIUS = 0.02
"""Radius of the patch of a force, relative to the diagonal of the body."""

CLEAR = 1e-4
"""Distance outside of the surface at which the visibility of a place is tested [m]."""


@dataclass(frozen=True, slots=True)
class Unknowns:
    """Prior standard deviations of the nuisance parameters and of the force."""

    places: int = 150
    """Number of places of the surface at which the bound is computed; it is interpolated between them."""
    turn_rad: float = 1e-3
    """Of each camera pose, about each axis [rad]."""
    shift_m: float = 2e-4
    """Of each camera pose, along each axis [m]."""
    modulus: float = 0.03
    """Of the modulus, relative."""
    force_n: float = 2.0
    """Of each component of a force [N]."""


@dataclass(frozen=True, eq=False, slots=True)
class Measured:
    """The rows that cameras measure in a state, to first order; r rows, n nodes, v cameras."""

    operator: sp.csr_array
    """Maps displacements of the nodes to the rows, shape (r, 3 n)."""
    by_pose: FloatArray
    """Derivative of the rows by (rotation about the body's centre [rad], translation [m]) of each camera, shape (r, 6 v)."""
    std: FloatArray
    """Standard deviation of each row, enlarged for the correlation between neighbours [m], shape (r,)."""


@dataclass(frozen=True, eq=False, slots=True)
class ForceMap:
    """Standard deviations of small forces over the surface of a body in one state."""

    positions: FloatArray
    """Nodes in that state [m], shape (n, 3)."""
    triangles: IntArray
    """Of the surface, shape (t, 3)."""
    nodes: IntArray
    """Nodes at which the bound is computed, shape (p,)."""
    rest: FloatArray
    """Their positions at rest [m], shape (p, 3)."""
    normal_std: FloatArray
    """Of a force along the normal [N], shape (p,)."""
    tangent_std: FloatArray
    """Of a force along the surface, in the less favourable direction [N], shape (p,)."""
    visible: BoolArray
    """Whether a camera sees the place, shape (p,)."""
    points: int
    """Number of points of the robot that the cameras measure per frame."""

    def over_nodes(self) -> FloatArray:
        """Return the standard deviation along the normal at every node [N], interpolated in its logarithm, shape (n,)."""
        from scipy.spatial import cKDTree

        distance, near = cKDTree(self.positions[self.nodes]).query(self.positions, k=min(3, len(self.nodes)))
        distance, near = (np.asarray(a).reshape(len(self.positions), -1) for a in (distance, near))
        weight = 1.0 / (distance + 1e-9)
        return np.asarray(np.exp((weight * np.log(self.normal_std[near])).sum(axis=1) / weight.sum(axis=1)))


def force_map(
    robot: Robot, script: ScriptTable, where: Path = Path("script"), *, frame: int = 0, unknowns: Unknowns | None = None
) -> ForceMap:
    """Return the forces that the cameras of a script resolve on the declared robot.

    Arguments:
        robot: the declared robot; effects, mesh and law of the script's truth are ignored.
        script: its inputs and cameras are used.
        where: for error messages.
        frame: the frame whose inputs are used.
        unknowns: prior standard deviations.

    Raises:
        InputError: the script does not fit. DataError: no equilibrium, or no camera sees the robot.
    """
    how, views = unknowns or Unknowns(), views_of(script, robot)
    state = _state(robot, script, where, frame)
    measured = _rows(robot, script, views, state)
    nodes = spread_features(robot.body, how.places)
    surface = body_surface(robot.body.mesh)
    normals = vertex_normals(state.positions, surface.triangles)[nodes]
    return force_bound(
        robot,
        state,
        measured,
        nodes,
        _seen(views, state, surface.triangles, nodes, normals),
        unknowns=how,
    )


def force_bound(
    robot: Robot, state: Equilibrium, measured: Measured, nodes: IntArray, visible: BoolArray, *, unknowns: Unknowns
) -> ForceMap:
    """Return the bound (equation in the module docstring) for forces at some nodes of a state.

    Arguments:
        robot: whose body it is.
        state: the linearisation point.
        measured: the rows.
        nodes: surface nodes of the forces, shape (p,).
        visible: whether a camera sees each of them, shape (p,).
        unknowns: prior standard deviations of the parameters estimated with the force.
    """
    surface, count = body_surface(robot.body.mesh), len(state.positions)
    normals = vertex_normals(state.positions, surface.triangles)[nodes]
    tangent, std = tangent_at(robot.body, state), measured.std
    N = _nuisance(robot, measured, tangent, state, unknowns) / std[:, None]
    inner = np.linalg.inv(N.T @ N + np.eye(N.shape[1]))
    size = diagonal(robot.body.mesh.nodes)
    normal_std, tangent_std = [], []
    for start in range(0, len(nodes), BATCH):
        here = nodes[start : start + BATCH]
        patches = [patch_at(surface, state.positions, state.positions[i], RADIUS * size, robot.body.clamped) for i in here]
        loads = np.array([patch.spread(axis, count) for patch in patches for axis in np.eye(3)])
        A = np.asarray(measured.operator @ tangent.respond(loads).reshape(len(loads), -1).T) / std[:, None]
        NA = N.T @ A
        for i, normal in enumerate(normals[start : start + BATCH]):
            own = slice(3 * i, 3 * i + 3)
            information = A[:, own].T @ A[:, own] - NA[:, own].T @ inner @ NA[:, own] + np.eye(3) / unknowns.force_n**2
            covariance = np.linalg.inv(information)
            across = np.linalg.svd(normal[None])[2][1:]
            normal_std.append(float(np.sqrt(normal @ covariance @ normal)))
            tangent_std.append(float(np.sqrt(np.linalg.eigvalsh(across @ covariance @ across.T).max())))
    return ForceMap(
        state.positions,
        surface.triangles,
        nodes,
        freeze(robot.body.mesh.nodes[nodes]),
        freeze(normal_std),
        freeze(tangent_std),
        visible,
        len(std),
    )


def neighbours(noise: NoiseTable | None) -> float:
    """Return the number of pixels that count as one because their errors are correlated: the sum of their correlations.

    The correlated part of a stereo camera is white noise smoothed with a Gaussian of width w; its correlation at a distance r is
    exp(−r²/4w²), which sums to 4πw².
    """
    if noise is None or noise.kind != "stereo":
        return 1.0
    share = noise.correlated_share
    return float(1.0 - share + share * max(1.0, 4.0 * np.pi * noise.correlation_px**2))


def _state(robot: Robot, script: ScriptTable, where: Path, frame: int) -> Equilibrium:
    plan = plan_script(script, robot, where)
    if not 0 <= frame < len(plan.time_s):
        raise DataError(f"{where} has the frames 0 … {len(plan.time_s) - 1}, not {frame}")
    inputs = dict(zip(robot.body.cable_names, (plan.commanded + plan.initial)[frame].tolist()))
    pressure = dict(zip(robot.body.chamber_names, plan.pressures[frame].tolist()))
    held = plan.control == "displacement"
    state = solve_equilibrium(
        robot.body, tension=None if held else inputs, shortening=inputs if held else None, pressure=pressure
    )
    if not state.converged:
        raise DataError(f"no equilibrium in frame {frame}: {state.status}: {state.advice}")
    return state


def _rows(robot: Robot, script: ScriptTable, views: tuple[View, ...], state: Equilibrium) -> Measured:
    """Return the rows of the points that the cameras measure."""
    shapes = [body_shape(robot, state.positions, script.scene)]
    if script.scene.floor_z_m is not None:
        shapes.append(floor_shape(script.scene.floor_z_m, np.array(script.scene.floor_rgb), script.scene.floor_albedo))
    points, view_of, noises = [], [], []
    for v, view in enumerate(views):
        image = render(view.camera, view.T_robot_camera, shapes, noise=view.table.noise, rng=rng_of(script, "clouds", 0, v))
        true = render(view.camera, view.T_robot_camera, shapes)
        mine = (image.depth > 0) & (true.shape == 0)
        points.append((pixel_rays(view.camera) * true.depth[..., None])[mine])
        view_of.append(np.full(int(mine.sum()), v))
        noises.append(_noise_of(view, robot))
    if not sum(len(p) for p in points):
        raise DataError("no camera sees the robot: check eye_m and target_m")
    scan = Scan(np.vstack(points), np.concatenate(view_of), np.zeros((0, 3)), np.zeros(0, np.int64))
    size = diagonal(robot.body.mesh.nodes)
    surface = Surface(state.positions, body_surface(robot.body.mesh).triangles)
    rows = ray_rows(scan, surface, [view.T_robot_camera for view in views], noises, reach=REACH * size)
    return measured_rows(robot, rows, [neighbours(view.table.noise) for view in views])


def measured_rows(robot: Robot, rows: RayRows, together: Sequence[float]) -> Measured:
    """Return rows of points; together: number of points of each camera that count as one (see `neighbours`), shape (v,)."""
    std = np.asarray(rows.std * np.sqrt(np.asarray(together)[rows.view]))
    nodes = robot.body.mesh.nodes
    return Measured(rows.operator(len(nodes)), rows.by_pose(nodes.mean(axis=0), len(together)), std)


def _noise_of(view: View, robot: Robot) -> CameraNoise:
    """Return the noise of a depth; for a perfect camera that of its quantisation."""
    known = noise_of(view.table, view.T_robot_camera, robot)
    return CameraNoise("tof", floor=view.camera.depth_unit / np.sqrt(12.0)) if known is None else known


def _nuisance(robot: Robot, measured: Measured, tangent: Tangent, state: Equilibrium, how: Unknowns) -> FloatArray:
    """Return the displacement of the rows by one standard deviation of each pose and of the modulus [m], shape (r, 6 v + 1)."""
    views = measured.by_pose.shape[1] // 6
    pose = measured.by_pose * np.tile(np.repeat([how.turn_rad, how.shift_m], 3), views)
    sag = tangent.respond(internal(robot.body, state.positions, tangent=False).forces[None])
    stiffer = measured.operator @ sag.reshape(1, -1).T
    return np.hstack([pose, how.modulus * np.asarray(stiffer)])


def _seen(views: tuple[View, ...], state: Equilibrium, triangles: IntArray, nodes: IntArray, normals: FloatArray) -> BoolArray:
    """Return which places a camera sees, shape (p,)."""
    body = Shape(state.positions, triangles, np.full(3, 0.5))
    places, seen = state.positions[nodes] + CLEAR * normals, np.zeros(len(nodes), dtype=bool)
    for view in views:
        towards = np.einsum("pc,pc->p", view.T_robot_camera[:3, 3] - places, normals) > 0
        seen |= towards & visible_points(view.camera, view.T_robot_camera, [body], places)
    return np.asarray(seen)
