"""A trial: the markers or the clouds of one recording, as the fit uses them, with the grouping of their rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray, IntArray
from femsense.core.pose import moved_poses
from femsense.fem.equilibrium import Equilibrium
from femsense.fem.mesh import TetMesh
from femsense.model.observation import Scene

if TYPE_CHECKING:
    from femsense.loop.data.sampled_states import Sampled
    from femsense.loop.data.surface_rows import MeasuredSurface


COMPONENTS = ("white", "state", "marker", "frame", "sweep")


@dataclass(frozen=True, eq=False, slots=True)
class Groups:
    """Groups of correlated rows of a recording: one group number per row, shape (k,)."""

    marker: IntArray
    frame: IntArray
    sweep: IntArray
    state: IntArray
    """Marker and state (same inputs and loads)."""
    surface: SurfaceRows | None = None
    """Position of the rows on the body if they are points of a surface; None: markers, with three axes each."""
    turns: FloatArray | None = None
    """∂(marker position)/∂(its place on the body at rest), shape (k, 3, 3), axes of the place last; None: the identity."""

    @property
    def placements(self) -> FloatArray | None:
        """The displacements of markers per unit of misplacement, shape (k, 3, 3 markers); None: unknown."""
        if self.turns is None:
            return None
        count = int(self.marker.max(initial=-1)) + 1
        fields = np.zeros((len(self.marker), 3, count, 3))
        fields[np.arange(len(self.marker)), :, self.marker] = self.turns
        return fields.reshape(len(self.marker), 3, 3 * count)

    def shared(self, name: str) -> FloatArray:
        """Return the correlation of a noise component between every two rows, shape (k, k)."""
        if name == "white":
            return np.eye(len(self.marker))
        labels = getattr(self, name)
        if self.surface is None:
            return np.asarray(labels[:, None] == labels[None, :], dtype=float)
        return self.surface.shared(name, labels)

    def of_rows(self, rows: BoolArray | IntArray) -> Groups:
        """Return the groups of a selection of rows."""
        marker, frame, sweep, state = (
            np.unique(labels[rows], return_inverse=True)[1] for labels in (self.marker, self.frame, self.sweep, self.state)
        )
        surface = None if self.surface is None else self.surface.of_rows(rows)
        return Groups(marker, frame, sweep, state, surface, None if self.turns is None else self.turns[rows])

    @property
    def observations(self) -> int:
        """Number of independent observations, as BIC counts them: marker coordinates, or cells of the surface, in distinct states."""
        if self.surface is None:
            return 3 * (int(self.state.max(initial=-1)) + 1)
        return self.surface.cells()

    def members(self) -> dict[str, IntArray]:
        """Return the groupings that can be estimated: those with several groups, of which some have several rows."""
        result: dict[str, IntArray] = {}
        for name in COMPONENTS[1:]:
            labels = getattr(self, name)
            count = np.bincount(labels)
            always = name == "state" and self.surface is not None  # errors of neighbouring points are correlated within a state
            if always or ((count > 1).any() and len(count) > 1):
                result[name] = labels
        return result


@dataclass(frozen=True, eq=False, slots=True)
class SurfaceRows:
    """Position and normals of the rows of a cloud."""

    points: FloatArray
    """Position on the body at rest [m], shape (k, 3)."""
    normals: FloatArray
    """Measured, shape (k, 3)."""
    rest_normals: FloatArray
    """Of the body at rest, shape (k, 3)."""
    states: IntArray
    """Which state (same inputs and loads) each row was measured in, shape (k,)."""
    length: float
    """ℓ, correlation length of errors of the model, the shape and the camera [m]."""

    def shared(self, name: str, labels: IntArray) -> FloatArray:
        """Return the correlation of a noise component between every two rows, shape (k, k)."""
        of_body = name in ("state", "marker")
        normals = self.rest_normals if of_body else self.normals
        alike = normals @ normals.T
        if of_body:
            square = (self.points**2).sum(axis=1)
            apart = np.maximum(square[:, None] + square[None, :] - 2.0 * self.points @ self.points.T, 0.0)
            alike *= np.exp(-0.5 * apart / self.length**2)
        if name == "marker":
            return alike
        groups = self.states if name == "state" else labels
        return np.asarray(alike * (groups[:, None] == groups[None, :]))

    def of_rows(self, rows: BoolArray | IntArray) -> SurfaceRows:
        """Return a selection of the rows."""
        return SurfaceRows(self.points[rows], self.normals[rows], self.rest_normals[rows], self.states[rows], self.length)

    def cells(self) -> int:
        """Return the number of observed cells of edge ℓ, summed over states."""
        cells = np.floor(self.points / self.length).astype(np.int64)
        return len(np.unique(np.column_stack([cells, self.states]), axis=0))


States = dict[int, Equilibrium]
"""Frame → its last solved state."""


@dataclass(frozen=True, eq=False, slots=True)
class Trial:
    """The markers, or the clouds, of one recording, as the fit uses them."""

    scene: Scene
    groups: Groups
    poses: tuple[FloatArray, ...]
    """Starting values; pose increments are relative to them."""
    initial: FloatArray | None
    """Starting values of the initial inputs; None if these are known."""
    input_low: FloatArray
    input_high: FloatArray
    starts: dict[int, tuple[TetMesh, States]]
    """States of earlier evaluations by frame, for each mesh; they serve as warm starts."""
    mesh_error: FloatArray | None = None
    """Fields of the discretisation error of the markers [m], shape (k, c, b), each scaled to one standard deviation (`loop.fit.discretisation_error`)."""
    mesh_moves: Sampled | None = None
    """Displacement of the robot's markers by a finer mesh in the states in which it was computed [m], each (m, 3)."""
    together: bool = False
    """Whether these are the clouds of the recording whose markers are the previous trial: pose and initial inputs are shared."""
    seen: MeasuredSurface | None = None
    """The measured surface of the robot; None for markers."""
    frames: IntArray | None = None
    """All fitted (or held-out) frames of the recording, markers and clouds together; None: those of the scene."""

    @property
    def size(self) -> int:
        """Number of the parameters that belong to the recording."""
        return 6 * len(self.poses) + (0 if self.initial is None else len(self.initial))

    @property
    def error_by_sweep(self) -> FloatArray | None:
        """The fields of the discretisation error that get a degree of freedom when the noise is estimated: common to all sweeps, and one per sweep. The
        rotated fields are small and are left out."""
        return None if self.mesh_error is None else self.mesh_error[:, :, : 1 + len(np.unique(self.groups.sweep))]

    def part(self, frames: IntArray) -> Trial:
        """Return the trial restricted to some frames."""
        rows = np.isin(self.scene.frame, frames)
        return replace(self, scene=self.scene.pick(frames), groups=self.groups.of_rows(rows), mesh_error=None)

    def starts_on(self, mesh: TetMesh) -> States:
        """Return the warm starts on a mesh; bodies of another size share its elements."""
        return self.starts.setdefault(id(mesh.tets), (mesh, {}))[1]

    def place(self, own: FloatArray, pivot: FloatArray) -> tuple[list[FloatArray], FloatArray | None]:
        """Return poses and initial inputs from the trial's own parameters."""
        at = 6 * len(self.poses)
        return moved_poses(self.poses, own[:at], pivot), None if self.initial is None else own[at:]


def spans_of(trials: Sequence[Trial]) -> list[slice]:
    """Return the slice of θ that each trial's recording owns."""
    spans: list[slice] = []
    at = 0
    for trial in trials:
        if not trial.together:
            spans.append(slice(at, at + trial.size))
            at += trial.size
        else:
            spans.append(spans[-1])
    return spans


def numbers_of(trials: Sequence[Trial]) -> list[int]:
    """Return the number of the recording that each trial belongs to."""
    return [int(n) - 1 for n in np.cumsum([not t.together for t in trials])]


def heads_of(trials: Sequence[Trial]) -> list[int]:
    """Return the index of the trial that represents each recording: its markers if it has any, else its clouds."""
    return [i for i, t in enumerate(trials) if not t.together]


def vectors_of(trial: Trial, residual: FloatArray, poses: Sequence[FloatArray] | None = None) -> FloatArray:
    """Return a residual (k, c) [m] as vectors in the robot frame, shape (k, 3); those of clouds point along the measured normals."""
    if trial.scene.crossings is None:
        return residual
    return residual * normals_of(trial.scene, trial.poses if poses is None else poses)


def normals_of(scene: Scene, poses: Sequence[FloatArray]) -> FloatArray:
    """Return the measured outward normals of the rows of a cloud, robot frame, shape (k, 3)."""
    assert scene.crossings is not None
    turn = np.array([T[:3, :3] for T in poses])[scene.view]
    return np.asarray(np.einsum("kij,kj->ki", turn, scene.crossings.normals))


def rms_of(residuals: list[FloatArray]) -> float:
    """Return the root mean square 3-D length of the residuals of markers (k, 3) [m]; if there are none, the rms of those of clouds (k, 1)."""
    kind = max(r.shape[1] for r in residuals)
    return float(np.sqrt(np.mean(np.concatenate([(r**2).sum(axis=1) for r in residuals if r.shape[1] == kind]))))


def normal_rms_of(residuals: list[FloatArray]) -> float | None:
    """Return the root mean square of the residuals of clouds (k, 1) [m]; None without clouds."""
    own = [r.ravel() for r in residuals if r.shape[1] == 1]
    return float(np.sqrt(np.mean(np.concatenate(own) ** 2))) if own else None
