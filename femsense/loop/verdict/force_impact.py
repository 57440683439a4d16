"""Consequence of a model change for estimated forces: at declared loads, or if there are none, by the compliances.

A smaller residual obtained with a wrong effect can make forces worse; these tables show it. The analysis is linear about the state under the
declared load, with one factorisation per frame and model:  δf = argmin |r − C δf|²,  C the response of the markers to unit forces at
the load's place, r the residual with the declared load; estimated force = declared + δf.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import FloatArray, IntArray, spread_evenly
from femsense.core.errors import FemsenseError
from femsense.core.parallel import each
from femsense.fem.compliance import Tangent, compliance, tangent_at
from femsense.fem.mesh import embed_points, surface_triangles, vertex_normals
from femsense.loop.data.covariates import actuation_of
from femsense.loop.data.dataset import Data
from femsense.loop.data.trial import Trial, heads_of, normals_of, numbers_of, vectors_of
from femsense.loop.fit.fitted_model import FittedModel, poses_and_inputs
from femsense.loop.fit.noise_components import Noise
from femsense.loop.result.evidence import Compliance, ForceField, ForceImpact, LoadRow, Softer
from femsense.model.camera_frame import in_robot_frame
from femsense.model.observation import SceneJet, placements
from femsense.model.robot import Robot, spread_features

POINTS = 8
"""Number of places at which compliances are compared, and maximum number of frames with known loads."""
FIELD_POINTS = 48
"""Number of surface points that carry the field of equivalent forces."""
WEAKEST = 0.03
"""Directions of force with a singular value of C below this share of the largest keep their declared value."""


@dataclass(frozen=True, eq=False, slots=True)
class View:
    """One trial evaluated with a model."""

    robot: Robot
    trial: Trial
    jet: SceneJet
    poses: list[FloatArray]
    recording: int
    """Number of the recording; validation recordings come last."""
    held_out: bool

    def rows(self, frame: int) -> IntArray:
        """Return the rows of the residual in a frame."""
        return np.flatnonzero(self.trial.scene.frame == frame)

    def number(self, frame: int) -> int:
        """Return the number of a frame in frames.csv."""
        return int(self.trial.scene.recording.frame_numbers[frame])

    def tangent(self, frame: int) -> Tangent:
        """Return the linearised body in a frame."""
        return tangent_at(self.robot.body, self.jet.states[frame])

    def answers(self, tangent: Tangent, frame: int, places: FloatArray) -> FloatArray:
        """Return C, the response of the markers of a frame to unit forces along x, y, z at places of the body at rest [m/N], (3k, 3p)."""
        mesh, rows = self.robot.body.mesh, self.rows(frame)
        ties = embed_points(mesh, places)
        units = [ties.spread(np.eye(3 * len(places))[j].reshape(-1, 3), len(mesh.nodes)) for j in range(3 * len(places))]
        marks = self.robot.tie_markers(placements(self.robot, self.trial.scene, self.poses))[self.trial.scene.marker[rows]]
        moves = np.array([marks.moves(move) for move in tangent.respond(np.array(units))])
        if self.trial.scene.crossings is not None:
            moves = np.einsum("jkc,kc->jk", moves, normals_of(self.trial.scene, self.poses)[rows])
        return moves.reshape(len(moves), -1).T

    @property
    def vectors(self) -> FloatArray:
        """Residuals as vectors in the robot frame [m], shape (k, 3); those of clouds along the normals."""
        return vectors_of(self.trial, self.jet.residual, self.poses)

    @property
    def measured(self) -> FloatArray:
        """Measured points [m], shape (k, 3), robot frame; for clouds, where the normals cross the measured surface."""
        scene = self.trial.scene
        return in_robot_frame(scene.points, scene.view, self.poses, self.robot.in_recording(scene.recording.label).observation)


def views_of(data: Data, fitted: FittedModel) -> list[View]:
    """Return one trial per recording evaluated with a fitted model: the fitted ones, then the held-out ones; markers before clouds."""
    robot = fitted.fit.hypothesis.robot_at(fitted.fit.coordinates)
    poses, numbers = poses_and_inputs(data, fitted.fit), numbers_of(data.train)
    known = [View(robot, data.train[i], fitted.fit.jets[i], list(poses[i][0]), numbers[i], False) for i in heads_of(data.train)]
    held, extra = [], len(known)
    for i in heads_of(data.held):
        of, own = data.held_of[i], fitted.held[i]
        held.append(View(robot, data.held[i], own.jet, own.poses, extra if of is None else numbers[of], True))
        extra += of is None
    return known + held


def force_consequence(before: list[View], after: list[View], noise: Noise) -> ForceImpact:
    """Return the forces of both models: at declared loads, or if there are none, by compliance; empty if neither can be computed."""
    pairs = list(zip(before, after))
    loaded = [(a, b, k) for a, b in pairs if a.held_out for k in _loaded_frames(a)]
    loaded = loaded or [(a, b, k) for a, b in pairs for k in _loaded_frames(a)]
    try:
        if loaded:
            chosen = spread_evenly(len(loaded), POINTS)
            rows = each(lambda at: _at_loads(at[0], at[1], at[2], noise), [loaded[i] for i in chosen])
            return ForceImpact(loads=tuple(row for row in rows if row is not None))
        return ForceImpact(compliance=_compliances(*pairs[0]))
    except FemsenseError:
        return ForceImpact()


def _loaded_frames(view: View) -> list[int]:
    recording = view.trial.scene.recording
    heavy = np.linalg.norm(recording.load_forces, axis=1) > 0 if len(recording.load_frame) else np.zeros(0, dtype=bool)
    return [int(k) for k in view.trial.scene.frames if k in recording.load_frame[heavy] and k in view.jet.states]


def _at_loads(before: View, after: View, frame: int, noise: Noise) -> LoadRow | None:
    """Return the largest declared load of a frame, and the force that each model estimates there."""
    recording = before.trial.scene.recording
    own = np.flatnonzero(recording.load_frame == frame)
    if any(len(view.rows(frame)) < len(own) for view in (before, after)):
        return None
    size = np.linalg.norm(recording.load_forces[own], axis=1)
    places, main = recording.load_points[own], int(size.argmax())
    direction = recording.load_forces[own][main] / size[main]
    part = slice(3 * main, 3 * main + 3)
    sensed = []
    for view in (before, after):
        C = view.answers(view.tangent(frame), frame, places)
        change, covariance = forces_from(C, view.jet.residual[view.rows(frame)].ravel(), noise.row_std(view.trial.groups))
        sensed += [float(size[main] + change[part] @ direction), float(np.sqrt(direction @ covariance[part, part] @ direction))]
    return LoadRow(before.recording, before.number(frame), before.held_out, float(size[main]), *sensed)


def forces_from(C: FloatArray, residual: FloatArray, std: float) -> tuple[FloatArray, FloatArray]:
    """Return the least-squares forces of a residual and their covariance; poorly determined directions (WEAKEST) stay at zero."""
    U, s, Vt = np.linalg.svd(C, full_matrices=False)
    keep = s > WEAKEST * s[0]
    inverse = Vt[keep].T / s[keep]
    return inverse @ (U[:, keep].T @ residual), std**2 * inverse @ inverse.T


def _compliances(before: View, after: View) -> Compliance:
    """Return the change of an estimated force between models where no load is declared.

    An indentation d along the normal is interpreted as the force d / W, so that forces change by W_before / W_after. `phantom` is the force at
    the free end that the residual of each model would be interpreted as, in a contact-free frame.
    """
    frames = chosen_frames(before)
    declared = before.robot.body.mesh
    nodes = spread_features(before.robot.body, POINTS)
    normals = vertex_normals(declared.nodes, surface_triangles(declared))[nodes]
    rows = []
    for title, k in frames:
        ends = list[tuple[FloatArray, float]]()
        for view in (before, after):
            tangent = view.tangent(k)
            W = compliance(view.robot.body, view.jet.states[k], points=declared.nodes[nodes], directions=normals, tangent=tangent)
            C = view.answers(tangent, k, declared.nodes[nodes[:1]])
            phantom = forces_from(C, view.jet.residual[view.rows(k)].ravel(), 1.0)[0]
            ends.append((np.diag(W)[: len(nodes)], float(np.linalg.norm(phantom))))
        (first, phantom_before), (second, phantom_after) = ends
        rows.append(Softer(title, before.number(k), tuple((first / second).tolist()), phantom_before, phantom_after))
    return Compliance(tuples_of(declared.nodes[nodes]), tuple(rows))


def tuples_of(rows: FloatArray) -> tuple[tuple[float, ...], ...]:
    """Return rows as tuples of numbers."""
    return tuple(tuple(row) for row in rows.tolist())


def chosen_frames(view: View) -> list[tuple[str, int]]:
    """Return three frames of a trial, (title, index): the least driven, one half way and the most driven; by time if the inputs are constant."""
    frames = view.trial.scene.frames
    drive = actuation_of(view.trial.scene.recording)[frames]
    if np.ptp(drive) == 0:
        picked = [("first", 0), ("middle", len(frames) // 2), ("last", len(frames) - 1)]
    else:
        half = 0.5 * (drive.min() + drive.max())
        picked = [("rest", int(drive.argmin())), ("mid", int(np.abs(drive - half).argmin())), ("max", int(drive.argmax()))]
    found: dict[int, str] = {}
    for title, i in picked:
        found.setdefault(int(frames[i]), title)
    return [(title, k) for k, title in found.items()]


def equivalent_forces(views: list[View], noise: Noise) -> ForceField | None:
    """Return surface forces that would fit the frame with the largest residual; an illustration, not evidence.

    Every residual can be written as a field of forces. This is the smallest one (Tikhonov) that leaves the noise, |C f − r|² = 3 k σ².
    None if that frame does not exceed the noise.
    """
    worst = max(((v, int(k)) for v in views for k in v.trial.scene.frames), key=lambda at: _mean_square(*at))
    view, frame = worst
    r = view.jet.residual[view.rows(frame)].ravel()
    goal = len(r) * noise.row_std(view.trial.groups) ** 2
    if float(r @ r) <= goal:
        return None
    body = view.robot.body
    nodes = spread_features(body, FIELD_POINTS)
    places = body.mesh.nodes[nodes]
    try:
        C = view.answers(view.tangent(frame), frame, places)
    except FemsenseError:
        return None
    forces = smallest_field(C, r, goal).reshape(-1, 3)
    left = r - C @ forces.ravel()
    return ForceField(
        recording=view.recording,
        frame=view.number(frame),
        points_m=tuples_of(places),
        forces_n=tuples_of(forces),
        total_n=tuple(forces.sum(axis=0).tolist()),
        explained_share=float(1.0 - left @ left / (r @ r)),
    )


def _mean_square(view: View, frame: int) -> float:
    return float((view.jet.residual[view.rows(frame)] ** 2).sum(axis=1).mean())


def smallest_field(C: FloatArray, r: FloatArray, goal: float) -> FloatArray:
    """Return the smallest f with |C f − r|² ≤ goal; if there is none, the least regularised one that is stable."""
    U, s, Vt = np.linalg.svd(C, full_matrices=False)
    b = U.T @ r
    outside = float(r @ r - b @ b)
    low, high = 1e-4 * s[0], 1e3 * s[0]
    for _ in range(60):
        ridge = float(np.sqrt(low * high))
        left = outside + float(((ridge**2 / (s**2 + ridge**2) * b) ** 2).sum())
        low, high = (ridge, high) if left < goal else (low, ridge)
    return np.asarray(Vt.T @ (s / (s**2 + low**2) * b))
