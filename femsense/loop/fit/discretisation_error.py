"""Discretisation error: the displacement of the markers by a mesh of half the size, in every state; for linear elements, by
quadratic ones of the same size.

A residual of this shape is not evidence for an effect. The amplitude is uncertain (a cable tied to points indents the body
more, the finer the mesh), but nearly the same in all sweeps. The error therefore enters the noise as random fields: one common to
all sweeps (`mesh_share` of `Thresholds`), one per sweep (`mesh_varies`) and its rotations (`mesh_turns`). It is computed by a few
Newton steps on the finer mesh, starting from the state on the declared mesh, which the finer one represents exactly
(a hierarchical estimate: Bank & Smith 1993).
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import DataError, FemsenseError
from femsense.core.parallel import each
from femsense.core.work import count
from femsense.fem.body import BodyModel
from femsense.fem.mesh import Embedding, TetMesh, embed_points
from femsense.loop.data.dataset import MESH, Data
from femsense.loop.data.representative_states import representatives, state_vectors
from femsense.loop.data.sampled_states import Sampled, drive_table, ranges
from femsense.loop.data.trial import Trial, normals_of, rms_of
from femsense.loop.fit.fitted_model import FittedModel, poses_and_inputs, some_terms
from femsense.loop.fit.noise_components import Noise, whiten
from femsense.loop.thresholds import Thresholds
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.finer_mesh import finer_state, share_on_finer
from femsense.model.linear_elements import MOST_TETS
from femsense.model.observation import SceneJet, placements
from femsense.model.quasi_static_path import solve_path
from femsense.model.recording import Recording
from femsense.model.remeshing import finer_mesh, robot_on_mesh
from femsense.model.robot import Robot

MOST_WORK = 100_000
"""Maximum number of tetrahedra × states; beyond it the error is interpolated between computed states."""
PULLING = "cables", "cable_slots"
"""Fields of a body that only affect the cable forces."""


@dataclass(frozen=True, eq=False, slots=True)
class _Part:
    """The trials of one recording."""

    trials: list[Trial]
    poses: Sequence[FloatArray]
    initial: FloatArray | None

    @property
    def recording(self) -> Recording:
        return self.trials[0].scene.recording

    @property
    def frames(self) -> IntArray:
        """The frames of all trials, ascending."""
        return np.unique(np.concatenate([t.scene.frames for t in self.trials]))

    @property
    def drives(self) -> FloatArray:
        return drive_table(self.recording, self.frames)

    @property
    def kind(self) -> int:
        """A number that is equal for recordings whose states can be interpolated jointly: known inputs, and the same number of drives."""
        apart = self.initial is not None or any(t.scene.crossings is not None for t in self.trials)
        return -id(self) if apart else self.drives.shape[1]


def with_mesh_errors(data: Data, fitted: FittedModel, tried: Sequence[str]) -> Data:
    """Return the data with the discretisation error at a fitted model. `mesh_note` states why it is unknown: the mesh is too large, linear elements are
    tested by the effect `discretisation`, no state converges on the finer mesh, or a reference cancels it."""
    if data.relative:
        return replace(data, mesh_note="it cancels against the reference")
    robot = fitted.fit.hypothesis.robot_at(fitted.fit.coordinates)
    alike: dict[int, list[_Part]] = {}
    for part in _parts(data, fitted):
        alike.setdefault(part.kind, []).append(part)
    try:
        finer = _finer(robot.body.mesh, tried)
        if finer is None:
            return replace(data, mesh_note=_why_not(robot.body.mesh, tried))
        fine = on_its_clamp(robot, robot_on_mesh(_on_firm_clamp(robot), finer))
        sampled = [(part, moves) for parts in alike.values() for moves in [_moves(robot, fine, parts)] for part in parts]
    except FemsenseError as error:
        known_before = bool(mesh_errors(data))
        return data if known_before else replace(data, mesh_note=f"no state converges on a finer mesh ({error})")
    moves_of = {id(trial): moves for part, moves in sampled for trial in part.trials}
    return _by_moves(replace(data.with_trials(lambda t: replace(t, mesh_moves=moves_of[id(t)])), mesh_note=""), fitted)


def with_mesh_errors_of(data: Data, some: Data, fitted: FittedModel) -> Data:
    """Return the data with the discretisation error interpolated from that computed in some of their states."""
    train, held = (
        [replace(t, mesh_moves=s.mesh_moves) for t, s in zip(trials, known)]
        for trials, known in ((data.train, some.train), (data.held, some.held))
    )
    return _by_moves(replace(data, train=train, held=held, mesh_note=some.mesh_note), fitted)


def as_shown(data: Data, fitted: FittedModel) -> Data:
    """Return the data with the discretisation error scaled to the share in the residual of a fitted model, if `Data.mesh_as_shown`: the default amplitudes
    are too large if calibration has shown that the mesh error is small. The scale is at most 1."""
    errors = mesh_errors(data)
    if not data.mesh_as_shown or not errors:
        return data
    shares = np.concatenate([_shares(t, jet, error) for t, jet, error in zip(data.train, fitted.fit.jets, errors)])
    thresholds = data.thresholds
    size = max(float(abs(shares.mean())) / thresholds.mesh_share, float(shares.std()) / thresholds.mesh_varies)
    return data.with_trials(lambda t: t if t.mesh_error is None else replace(t, mesh_error=min(size, 1.0) * t.mesh_error))


def _shares(trial: Trial, jet: SceneJet, error: FloatArray) -> FloatArray:
    """Return the amplitude of the discretisation error (k, c) in the residual of each sweep, fitted jointly with the nuisance parameters, shape (s,)."""
    moves = np.concatenate([jet.by_pose, jet.by_initial, jet.by_effect], axis=2).reshape(error.size, -1)
    number = np.unique(trial.groups.sweep, return_inverse=True)[1]
    own = np.zeros((*error.shape, int(number.max()) + 1))
    own[np.arange(len(error)), :, number] = error
    columns = np.hstack([moves, own.reshape(error.size, -1)])
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    answer = np.linalg.lstsq(columns / size, jet.residual.ravel(), rcond=1e-9)[0] / size
    return np.asarray(answer[moves.shape[1] :])


def _parts(data: Data, fitted: FittedModel) -> list[_Part]:
    """Return the trials by recording, each fitted one with its held-out ones."""
    parts = [
        _Part([trial, *(h for h, of in zip(data.held, data.held_of) if of == i)], poses, initial)
        for i, (trial, (poses, initial)) in enumerate(zip(data.train, poses_and_inputs(data, fitted.fit)))
    ]
    return parts + [_Part([h], h.poses, h.initial) for h, of in zip(data.held, data.held_of) if of is None]


def _by_moves(data: Data, fitted: FittedModel) -> Data:
    """Return the data with the fields of the discretisation error, interpolated from `mesh_moves`."""
    errors = {
        id(trial): None
        if trial.mesh_moves is None
        else _by_sweep(trial, trial.mesh_moves.at(part.drives), part.frames, part.poses, data.thresholds)
        for part in _parts(data, fitted)
        for trial in part.trials
    }
    return data.with_trials(lambda t: replace(t, mesh_error=errors[id(t)]))


def same_mesh_error(before: FittedModel, after: FittedModel) -> bool:
    """Return whether the discretisation error after an added effect equals that before: the effect changes only cable forces, or the camera."""
    old = before.fit.hypothesis
    added, _, mask = some_terms(after, [name for name in after.fit.hypothesis.names if name not in old.names])
    robot = added.robot_at(after.fit.coordinates[mask])
    kept = (f.name for f in fields(BodyModel) if f.name not in PULLING)
    return all(getattr(robot.body, name) is getattr(old.robot.body, name) for name in kept)


def _on_firm_clamp(robot: Robot) -> Robot:
    """Return the robot with a rigid clamp: on the finer mesh a compliant clamp keeps its position from the declared mesh, because its compliance is
    fitted."""
    body = robot.body
    return robot if body.clamp_is_rigid else robot.with_body(body.with_clamp_stiffness())


def on_its_clamp(robot: Robot, fine: Robot) -> Robot:
    """Return the robot on the finer mesh with its clamp springs, if it has them, distributed over all clamped nodes so that their rotational stiffness is
    equal: between few springs the surface would bulge, unlike that of a body held by a face."""
    body, finer = robot.body, fine.body
    if np.isinf(body.clamp_stiffness):
        return fine
    second = [
        float(((b.mesh.nodes[n] - body.clamp_center) ** 2).sum()) for b, n in ((body, body.clamp_nodes), (finer, finer.clamped))
    ]
    shared = replace(finer, clamp_nodes=finer.clamped)
    return fine.with_body(
        shared.with_clamp_stiffness(body.clamp_stiffness * second[0] / second[1], turn=body.clamp_turn_stiffness)
    )


def _finer(mesh: TetMesh, tried: Sequence[str]) -> TetMesh | None:
    """Return the mesh for the estimate: of half the size, or quadratic elements for a linear mesh. None if it would be too large, or if the order of a linear
    mesh is tested as an effect."""
    if mesh.is_quadratic:
        return finer_mesh(mesh, None, 1) if 8 * len(mesh.tets) <= MOST_TETS else None
    return finer_mesh(mesh, "tet10", 0) if MESH.name not in tried and len(mesh.tets) <= MOST_TETS else None


def _why_not(mesh: TetMesh, tried: Sequence[str]) -> str:
    """Return in words why there is no finer mesh."""
    if not mesh.is_quadratic and MESH.name in tried:
        return f"linear elements were compared with quadratic ones ({MESH.name})"
    return f"a mesh of half the size has more than {MOST_TETS} elements"


def make_finer(robot: Robot, tried: Sequence[str]) -> None:
    """Compute the parts of the finer mesh that do not depend on the material, concurrently with other work; the results are cached.

    Errors are ignored here and raised where the mesh is needed.
    """
    with contextlib.suppress(FemsenseError):
        finer = _finer(robot.body.mesh, tried)
        if finer is not None:
            share_on_finer(robot_on_mesh(robot, finer).body)
            _ties(robot.body.mesh, finer)


@functools.lru_cache(maxsize=2)
def _ties(mesh: TetMesh, fine: TetMesh) -> Embedding:
    """Return the embedding of the nodes of a finer mesh in a mesh."""
    return embed_points(mesh, fine.nodes)


def _by_sweep(
    trial: Trial, moves: FloatArray, frames: IntArray, poses: Sequence[FloatArray], thresholds: Thresholds
) -> FloatArray:
    """Return the fields of the error [m], shape (k, c, 1 + sweeps + 9), each scaled to one standard deviation; moves (f, m, 3) belong to the frames (f,).

    In order: the error of all sweeps, of each sweep, and each of its components along each axis (rotation and stretch).
    """
    error = moves[np.searchsorted(frames, trial.scene.frame), trial.scene.marker]
    along = np.broadcast_to(np.eye(3), (len(error), 3, 3))  # (k, c, axis)
    if trial.scene.crossings is not None:
        along = normals_of(trial.scene, poses)[:, None, :]
    turned = thresholds.mesh_turns * (along[:, :, :, None] * error[:, None, None, :]).reshape(len(error), -1, 9)
    error = np.einsum("kca,ka->kc", along, error)
    number = np.unique(trial.groups.sweep, return_inverse=True)[1]
    by_sweep = np.zeros((*error.shape, int(number.max()) + 1))
    by_sweep[np.arange(len(error)), :, number] = thresholds.mesh_varies * error
    return np.concatenate([thresholds.mesh_share * error[:, :, None], by_sweep, turned], axis=2)


def mesh_errors(data: Data) -> list[FloatArray]:
    """Return the discretisation error of the rows of each fitted trial [m], (k, c); empty if one is unknown."""
    known = [t.mesh_error[:, :, 0] / data.thresholds.mesh_share for t in data.train if t.mesh_error is not None]
    return known if len(known) == len(data.train) else []


def representative_frames(trial: Trial, tets: int) -> IntArray:
    """Return the frames of a trial in which the error of a mesh with `tets` elements would be computed, ascending."""
    frames = trial.scene.frames
    return np.asarray(frames[np.sort(_chosen(state_vectors(trial.scene.recording, frames), 8 * tets))])


def _moves(robot: Robot, fine: Robot, parts: Sequence[_Part]) -> Sampled:
    """Return the displacement of the markers by the finer mesh [m], (m, 3), in some states of recordings. Raises DataError."""
    share_on_finer(fine.body)
    table = np.vstack([part.drives for part in parts])
    vectors, owner = (table - table[0]) / ranges(table), np.repeat(np.arange(len(parts)), [len(part.frames) for part in parts])
    chosen = np.zeros(len(table), dtype=bool)
    chosen[_chosen(vectors, len(fine.body.mesh.tets))] = True
    found = [_moves_in(robot, fine, part, part.frames[chosen[owner == i]]) for i, part in enumerate(parts)]
    drives = np.vstack([drive_table(part.recording, frames) for part, (frames, _) in zip(parts, found)])
    if not len(drives):
        raise DataError("no state converges on the finer mesh")
    return Sampled(drives, np.concatenate([moves for _, moves in found]), ranges(table))


def _moves_in(robot: Robot, fine: Robot, part: _Part, frames: IntArray) -> tuple[IntArray, FloatArray]:
    """Return those of the frames that converge on the finer mesh, and the displacement of the markers in each [m], (n, m, 3)."""
    recording, starts = part.recording, part.trials[0].starts_on(robot.body.mesh)
    places = placements(robot, part.trials[0].scene, part.poses)
    coarse_driven = DrivenRobot(robot, drive_of(robot, recording, initial=part.initial))
    fine_driven = DrivenRobot(fine, drive_of(fine, recording, initial=part.initial))
    ties, here, there = _ties(robot.body.mesh, fine.body.mesh), robot.tie_markers(places), fine.tie_markers(places)
    states = {k: state for k, state, _, _ in solve_path(coarse_driven, frames.tolist(), lambda r: r.markers[:0], starts=starts)}

    def finer_at(k: int) -> FloatArray | None:
        try:
            return finer_state(coarse_driven, fine_driven, k, states[k], ties)
        except FemsenseError:  # no equilibrium on the finer mesh
            return None

    moves: dict[int, FloatArray] = {}
    for k, finer in zip(frames.tolist(), each(finer_at, frames.tolist())):
        count(refined=1)
        if finer is not None:
            moves[k] = there.positions(finer) - here.positions(states[k].positions)
    return np.array(list(moves), dtype=np.int64), np.array(list(moves.values())).reshape(len(moves), len(here), 3)


def _chosen(vectors: FloatArray, tets: int) -> IntArray:
    """Return indices of distinct states for the estimate, given the number of elements of the finer mesh."""
    return representatives(vectors, max(8, MOST_WORK // tets))


def without_mesh_error(trial: Trial, residual: FloatArray, noise: Noise, *, nor_placements: bool = False) -> FloatArray:
    """Return the residual [m], (k, c), minus the most likely discretisation error; `nor_placements`: and minus that of rotating marker placements."""
    placements = noise.placements(trial.groups)
    mesh = np.zeros((*residual.shape, 0)) if trial.mesh_error is None else trial.mesh_error
    fields = np.concatenate([mesh, placements], axis=2)
    plain = noise.plain_whitener(trial.groups)
    G, r = whiten(plain, fields), whiten(plain, residual)
    share = np.linalg.solve(np.eye(G.shape[1]) + G.T @ G, G.T @ r)
    count = fields.shape[2] if nor_placements else mesh.shape[2]
    return np.asarray(residual - fields[:, :, :count] @ share[:count])


def beyond_mesh(trials: list[Trial], residuals: list[FloatArray], noise: Noise) -> float:
    """Return the root mean square [m] of residuals minus the most likely discretisation error."""
    return rms_of([without_mesh_error(t, r, noise) for t, r in zip(trials, residuals)])


def mesh_error_rms(data: Data) -> float | None:
    """Return the rms displacement of the markers by a finer mesh [m]; None if it was not computed."""
    errors = mesh_errors(data)
    return rms_of(errors) if errors else None
