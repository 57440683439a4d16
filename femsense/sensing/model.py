"""Types of the estimator: the model of a recording, a frame, and a fitted hypothesis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from femsense.calib.condensed_scan import block_side, in_blocks
from femsense.calib.scan import Scan, pixel_angles, read_scan
from femsense.core.arrays import BoolArray, FloatArray
from femsense.core.errors import FemsenseError
from femsense.fem.assembly import internal
from femsense.fem.compliance import Tangent, drive_rows, tangent_at
from femsense.fem.equilibrium import Equilibrium
from femsense.inference.mixture import Others
from femsense.inference.nuisance import Nuisance
from femsense.inference.pixels import Pixels, Skin, pixel_rows
from femsense.inference.rows import Rows, stacked
from femsense.model.camera import CameraNoise
from femsense.pointcloud.primitives import Shape
from femsense.sensing.marker_rows import marker_rows
from femsense.sensing.prepare import scan_of
from femsense.sensing.states import loaded_state
from femsense.sensing.types import Case, Refuted, Sensor, Touch

STRAY, UNTOLD = 0.01, 1.0
"""Prior ω of a pixel: that it mixes both sides of a depth edge; and that it shows an object in front, without colour that separates it."""
STALE = 0.03
"""The compliance at the candidates is reused until a node has moved by more than this share of the diagonal. It only ranks candidates."""
LIKELY = 0.5
"""A pixel counts as the robot's if it is with a larger probability."""
PIXELS = 6000
"""Neighbouring pixels are averaged so that about this many pixels of the robot remain in the first frame."""


@dataclass(frozen=True, eq=False, slots=True)
class Model:
    """Everything that stays the same from frame to frame."""

    sensor: Sensor
    skin: Skin
    nuisance: Nuisance
    noises: tuple[CameraNoise, ...]
    """Noise of each camera as declared or measured."""
    scale: float = 1.0
    """Factor on that noise, estimated from contact-free frames."""
    overdispersion: float = 1.0
    """T: variance of sums of whitened residuals over neighbouring pixels, relative to independent ones."""
    inferred_odds: float = 0.0
    """L of an inferred contact: −2 log of its prior odds, raised by the gain of false contacts in contact-free frames."""
    modulus_shift: float = 0.0
    """Relative softness estimated from contact-free frames, and already applied to the body."""
    limits: Limits | None = None
    """Limits of the posterior check; None without contact-free frames."""
    stray: tuple[float, float] = (1.0, 1.0)
    """Density of mixed pixels in contact-free frames relative to STRAY, in front and behind."""
    block: int = 1
    """Side of the blocks of averaged pixels. It is the same in all frames, so that their noise is the same."""
    candidates: Candidates = field(default_factory=lambda: Candidates())

    @property
    def upward(self) -> FloatArray:
        """Unit vector against gravity, shape (3,); 0 for a weightless model."""
        gravity = self.sensor.robot.body.gravity
        return np.asarray(-gravity / max(float(np.linalg.norm(gravity)), 1e-12))

    @property
    def views(self) -> int:
        return len(self.sensor.calibration.poses)

    @property
    def compliance_std(self) -> float:
        """Relative standard deviation of the compliance at a contact [1].

        Contact-free frames need another modulus, or other pulls, than declared because of errors of law, mesh and cable ties. The same
        error is assumed at a contact: the root mean square of the estimated relative pulls, and the estimated shift of the modulus. The
        uncertainty of the modulus itself is part of A.
        """
        softness, pulls = 6 * self.views, np.arange(6 * self.views + 1, self.nuisance.common)
        asked = self.nuisance.mean[pulls] ** 2 + (self.nuisance.root[pulls] ** 2).sum(axis=1)
        return float(np.sqrt(self.modulus_shift**2 + self.nuisance.mean[softness] ** 2 + (asked.mean() if len(pulls) else 0.0)))

    @property
    def drives(self) -> int:
        """Number of cables and chambers whose pulls are nuisance parameters."""
        return self.nuisance.common - 6 * self.views - 1

    def pixels(self, scan: Scan) -> Pixels:
        """Return the pixels of a scan with their noise."""
        poses = self.sensor.calibration.poses
        front, behind = self.stray
        others = Others(STRAY * front if scan.segmented else UNTOLD, STRAY * behind)
        std = self.scale * scan.ray_std(self.noises) / np.sqrt(scan.measured)
        return Pixels(scan.points(poses), scan.origins(poses), scan.view, std, others, 1.0 / self.overdispersion, scan.segmented)

    def rows(self, frame: Frame, state: Equilibrium) -> Rows:
        """Return the rows of a frame at a state: its pixels, or its markers if it has no pixels. Raises DataError."""
        if frame.pixels is None:
            return marker_rows(self.sensor, frame.index, state, len(self.skin.field))
        rows = pixel_rows(frame.pixels, self.skin, state.positions, self.views)
        more = [] if frame.background is None else [frame.background]
        if frame.with_markers:
            more.append(marker_rows(self.sensor, frame.index, state, len(self.skin.field)))
        return stacked([rows, *more])

    def solve(self, frame: Frame, contacts: Sequence[Touch], forces: FloatArray, start: Equilibrium) -> Equilibrium | None:
        """Return the equilibrium under the inputs and contact forces (m, 3) [N]; None if none is found from the start."""
        return loaded_state(self.sensor, frame.index, contacts, forces, start, frame.previous_tensions)

    def answers_near(self, state: Equilibrium) -> FloatArray:
        """Return the displacements under unit forces along x, y, z at each candidate [m/N], shape (n, 3, 3c), at this state or a near
        one."""
        kept, nodes = self.candidates, self.sensor.candidates
        if kept.state is None or np.abs(kept.state.positions - state.positions).max() > STALE * self.sensor.size:
            kept.state, kept.answers = replace(state, factor=None), None
        if kept.answers is None:
            n = len(kept.state.positions)
            loads = np.zeros((len(nodes), 3, n, 3))
            loads[np.arange(len(nodes)), :, nodes] = np.eye(3)
            moves = tangent_at(self.sensor.robot.body, kept.state).respond(loads.reshape(-1, n, 3))
            kept.answers = np.ascontiguousarray(np.moveaxis(moves, 0, 2))
        return kept.answers

    def linearised(self, state: Equilibrium) -> Linearised:
        """Return the body linearised about a state: with respect to forces, softness and pulls."""
        body = self.sensor.robot.body
        tangent = tangent_at(body, state)
        loads = [internal(body, state.positions, tangent=False).forces]
        if not self.drives:
            return Linearised(state.positions, tangent, tangent.respond(np.array(loads)))
        pulls = np.array([*state.tension.values(), *state.pressure.values()])
        shares = [t / T if T > 0 else np.ones_like(t) for t, T in zip(state.segment_tensions, state.tension.values())]
        unit = drive_rows(body, state.positions, shares).reshape(len(pulls), -1, 3)
        moves = tangent.respond(np.concatenate([loads, pulls[:, None, None] * unit]))
        held = np.flatnonzero(state.held)
        if len(held):
            moves[1 + held] = (pulls[held] * np.diag(tangent.held_compliance))[:, None, None] * tangent.respond_to_held()
        return Linearised(state.positions, tangent, moves)


def pixels_of(model: Model, k: int, state: Equilibrium) -> Scan | None:
    """Return the scan of frame k near a state, with the robot's pixels averaged in blocks; None for a recording without clouds. Raises
    FemsenseError."""
    scan, recording = scan_of(model.sensor, k, state), model.sensor.recording
    return None if scan is None else in_blocks(scan, model.noises, pixel_angles(recording, k, scan), model.block)


def block_of(sensor: Sensor) -> int:
    """Return the side of the blocks for which about PIXELS pixels of the robot remain in the first readable frame; 1 without clouds."""
    nodes = sensor.robot.body.mesh.nodes
    for k in range(len(sensor.recording.time_s)):
        try:
            scan = read_scan(sensor.robot, sensor.recording, k, sensor.calibration.poses, nodes)
        except FemsenseError:
            continue
        if scan is not None:
            return block_side(len(scan.view), PIXELS)
    return 1


@dataclass(frozen=True, eq=False, slots=True)
class Linearised:
    """The body, linearised about a state."""

    positions: FloatArray
    """Nodes of the state [m], shape (n, 3)."""
    tangent: Tangent
    softening: FloatArray
    """∂x/∂(softness, pulls) [m], shape (1 + a, n, 3)."""


@dataclass(eq=False, slots=True)
class Candidates:
    """Compliance at the candidate nodes, cached while the body stays close to one state."""

    state: Equilibrium | None = None
    answers: FloatArray | None = None
    """[m/N], shape (n, 3, 3c); None: not computed yet for the state."""


@dataclass(frozen=True, eq=False, slots=True)
class Frame:
    """One frame: its measurements and its priors."""

    index: int
    case: Case
    pixels: Pixels | None
    scan: Scan | None
    predicted: Equilibrium
    """Equilibrium under the inputs without contact forces."""
    previous_tensions: tuple[FloatArray, ...] | None
    """Tensions along the cables before this frame (friction)."""
    background: Rows | None = None
    """Rows of the static background, for the hypothesis of a moved camera."""
    with_markers: bool = False
    """Whether its markers are rows in addition to its pixels. True in contact-free frames if pulls are nuisance parameters, which markers
    help to identify."""
    objects: tuple[Shape, ...] = ()
    """Observed or declared rigid objects near the body, with completed shapes."""
    objects_at: FloatArray | None = None
    """Nodes of the state in which these objects were separated from depth bleeding at the silhouette [m], shape (n, 3)."""
    seen_before: tuple[Shape, ...] = ()
    """Objects of the previous frame."""
    refuted: tuple[Refuted, ...] = ()
    """Proposals that did not lower J, here or in the frames before."""
    latent: tuple[Touch, ...] = ()
    """Touching objects that are not contacts of the best hypothesis. Each can carry a small normal force; neglecting it would bias the
    forces of its neighbours and make their intervals too narrow. Empty while hypotheses are compared."""

    @property
    def coloured(self) -> bool:
        """Whether colour separates the robot from other objects."""
        return self.pixels is None or self.pixels.coloured


@dataclass(frozen=True, eq=False, slots=True)
class Fit:
    """A hypothesis at the minimum of Φ, with its Laplace approximation."""

    frame: Frame
    contacts: tuple[Touch, ...]
    forces: FloatArray
    """Force of each contact [N], shape (m, 3)."""
    tau: FloatArray
    """Prior scale of each force [N], shape (m,)."""
    axes: FloatArray
    """Axes of each force: outward normal and two tangents, shape (m, 3, 3)."""
    state: Equilibrium
    rows: Rows
    linearised: Linearised
    C: FloatArray
    """Derivatives of the rows with η, shape (r, p)."""
    N: FloatArray
    """C R, shape (r, q)."""
    D: FloatArray
    """Derivatives of the modelled rows with (force along its axes [N], contact point [m]) of each contact, shape (r, 5m)."""
    eta: FloatArray
    """Whitened nuisance η̃, shape (q,)."""
    weight: FloatArray
    """W [1/m²], shape (r,)."""
    evidence: float
    """E = Φ + log det A."""
    odds: FloatArray
    """L of each contact, shape (m,)."""
    covariance: FloatArray
    """Covariance of all force components [N²], shape (3m, 3m)."""
    place_covariance: FloatArray
    """Covariance of each contact point [m²], shape (m, 3, 3)."""
    latent_force: FloatArray
    """Force at each object of `Frame.latent` and its standard deviation [N], shape (l, 2)."""
    drop_gain: FloatArray
    """−2 log evidence ratio of each contact against its absence (Savage–Dickey), shape (m,)."""
    converged: bool = True

    @property
    def criterion(self) -> float:
        """J = E + Σ L."""
        return self.evidence + float(self.odds.sum())

    @property
    def responsibility(self) -> FloatArray:
        """Probability that each row is the robot's, shape (r,)."""
        return np.asarray(self.weight * self.rows.std**2 / self.rows.share)

    @property
    def of_robot(self) -> BoolArray:
        """Which pixels, or markers where there are no pixels, show the robot with a probability above LIKELY, shape (r,)."""
        return np.asarray((self.responsibility > LIKELY) & (self.rows.pixel if self.rows.pixel.any() else True))

    def left(self, nuisance: Nuisance) -> FloatArray:
        """Return the whitened residual at the fitted η, shape (r,)."""
        return np.asarray((self.rows.residual - self.C @ nuisance.mean - self.N @ self.eta) / self.rows.std)


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of the posterior check, from contact-free frames."""

    misfit: float
    nuisance: float
    behind: float
