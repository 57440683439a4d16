"""What estimating contacts takes and returns: the model of a recording, a frame, and a fitted hypothesis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from femsense.calib.condensed_scan import block_side, in_blocks
from femsense.calib.scan import Scan, pixel_angles, read_scan
from femsense.core.arrays import FloatArray
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
from femsense.sensing.types import Case, Sensor, Touch

STRAY, UNTOLD = 0.01, 1.0
"""ω of a pixel before contact-free frames are seen: a depth mixed of both sides of an edge, or of something in front where colour does not tell it."""
STALE = 0.03
"""Answers at the candidates serve while no node has moved farther than this share of the diagonal: they rank, and do not estimate."""
PIXELS = 6000
"""Neighbouring pixels of the robot are averaged beyond about so many in the first frame."""


@dataclass(frozen=True, eq=False, slots=True)
class Model:
    """Everything that stays the same from frame to frame."""

    sensor: Sensor
    skin: Skin
    nuisance: Nuisance
    noises: tuple[CameraNoise, ...]
    """Noise of each camera as declared or measured."""
    scale: float = 1.0
    """Factor on that noise: what contact-free frames scatter."""
    overdispersion: float = 1.0
    """T: variance of sums of whitened residuals over neighbouring pixels, relative to independent ones."""
    inferred_odds: float = 0.0
    """L of an inferred contact: −2 log of its prior odds, raised by what the search gains in contact-free frames."""
    modulus_shift: float = 0.0
    """Relative softness that contact-free frames asked for and that the body has been given."""
    limits: Limits | None = None
    """What the posterior check compares with; None before contact-free frames are seen."""
    stray: tuple[float, float] = (1.0, 1.0)
    """How many times more than STRAY pixels of contact-free frames are mixed ones, in front and behind."""
    block: int = 1
    """Side of the blocks of pixels that are averaged, the same in all frames: their noise is one."""
    candidates: Candidates = field(default_factory=lambda: Candidates())

    @property
    def upward(self) -> FloatArray:
        """Unit vector against gravity, shape (3,); 0 where the model has no weight."""
        gravity = self.sensor.robot.body.gravity
        return np.asarray(-gravity / max(float(np.linalg.norm(gravity)), 1e-12))

    @property
    def views(self) -> int:
        return len(self.sensor.calibration.poses)

    @property
    def compliance_std(self) -> float:
        """Relative standard deviation of the compliance at a contact [1].

        Gravity and cables pull as declared, and yet the model needs another modulus or other pulls to move as the body does (law, mesh, ties): what it
        needs there, it needs at a contact. The root mean square of the pulls that contact-free frames ask for, and that of the modulus; how well the
        modulus is known is part of A.
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
        """Return the rows of a frame at a state: its pixels, or its markers where it has none. Raises DataError."""
        if frame.pixels is None:
            return marker_rows(self.sensor, frame.index, state, len(self.skin.field))
        rows = pixel_rows(frame.pixels, self.skin, state.positions, self.views)
        more = [] if frame.background is None else [frame.background]
        if frame.with_markers:
            more.append(marker_rows(self.sensor, frame.index, state, len(self.skin.field)))
        return stacked([rows, *more])

    def solve(self, frame: Frame, contacts: Sequence[Touch], forces: FloatArray, start: Equilibrium) -> Equilibrium | None:
        """Return the equilibrium under the inputs and contact forces (m, 3) [N]; None where there is none near the start."""
        return loaded_state(self.sensor, frame.index, contacts, forces, start, frame.previous_tensions)

    def answers_near(self, state: Equilibrium) -> FloatArray:
        """Return the displacements by unit forces along x, y, z at each candidate [m/N], shape (n, 3, 3c), at this state or one near by."""
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
        """Return how the body answers to small forces, softness and pulls near a state."""
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
    """Return what the cameras see in frame k near a state, the robot's pixels in blocks; None where the recording has no clouds. Raises FemsenseError."""
    scan, recording = scan_of(model.sensor, k, state), model.sensor.recording
    return None if scan is None else in_blocks(scan, model.noises, pixel_angles(recording, k, scan), model.block)


def block_of(sensor: Sensor) -> int:
    """Return the side of blocks that leaves about PIXELS pixels of the robot in the first frame that can be read; 1 without clouds."""
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
    """The body near a state."""

    positions: FloatArray
    """Nodes of the state [m], shape (n, 3)."""
    tangent: Tangent
    softening: FloatArray
    """∂x/∂(softness, pulls) [m], shape (1 + a, n, 3)."""


@dataclass(eq=False, slots=True)
class Candidates:
    """Answers of the body to unit forces at the candidate nodes near one state, kept while the body stays near it."""

    state: Equilibrium | None = None
    answers: FloatArray | None = None
    """[m/N], shape (n, 3, 3c); None: not computed yet for the state."""


@dataclass(frozen=True, eq=False, slots=True)
class Frame:
    """One frame: what was measured and what is known of it beforehand."""

    index: int
    case: Case
    pixels: Pixels | None
    scan: Scan | None
    predicted: Equilibrium
    """Under the inputs without contact forces."""
    previous_tensions: tuple[FloatArray, ...] | None
    """Tensions along the cables before this frame (friction)."""
    background: Rows | None = None
    """Rows of what stands around the robot, where it is asked whether a camera has moved."""
    with_markers: bool = False
    """Whether its markers are rows next to its pixels: of contact-free frames, where they identify pulls and pose."""
    objects: tuple[Shape, ...] = ()
    """Rigid objects seen or declared near the body, completed."""
    objects_at: FloatArray | None = None
    """Nodes of the body where these were told from what a camera adds around its silhouette [m], shape (n, 3)."""
    seen_before: tuple[Shape, ...] = ()
    """Objects of the frame before."""
    latent: tuple[Touch, ...] = ()
    """Objects in touch that are no contact of the best hypothesis: each may carry a small force along its normal, which left out would bias those of its
    neighbours and make their intervals too narrow. Empty while hypotheses are compared."""

    @property
    def coloured(self) -> bool:
        """Whether colour separates the robot from the rest."""
        return self.pixels is None or self.pixels.coloured


@dataclass(frozen=True, eq=False, slots=True)
class Fit:
    """A hypothesis at the minimum of Φ, with its Laplace approximation."""

    frame: Frame
    contacts: tuple[Touch, ...]
    forces: FloatArray
    """[N], shape (m, 3)."""
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
    """Of all force components [N²], shape (3m, 3m)."""
    place_covariance: FloatArray
    """Of each contact point [m²], shape (m, 3, 3)."""
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

    def left(self, nuisance: Nuisance) -> FloatArray:
        """Return the whitened residual with η fitted, shape (r,)."""
        return np.asarray((self.rows.residual - self.C @ nuisance.mean - self.N @ self.eta) / self.rows.std)


@dataclass(frozen=True, slots=True)
class Limits:
    """Largest values of the posterior check that contact-free frames let expect."""

    misfit: float
    nuisance: float
    behind: float
