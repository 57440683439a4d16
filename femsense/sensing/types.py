"""What sensing takes and returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

import femsense
from femsense.calib.calibration import Calibration
from femsense.core.arrays import FloatArray, IntArray
from femsense.fem.compliance import Tangent
from femsense.fem.equilibrium import Equilibrium
from femsense.model.camera import CameraNoise
from femsense.model.contact_patch import BodySurface, ContactPatch
from femsense.model.drive import DrivenRobot
from femsense.model.recording import Recording
from femsense.model.robot import Robot
from femsense.pointcloud.local_planes import LocalPlanes
from femsense.pointcloud.primitives import Shape
from femsense.sensing import run_arrays

MEDIAN = 1.0 - 1.483 ** (-2.0 / 3.0)
"""The median of the mean of n squares of normal numbers is about (1 − this / n)³, exact for n = 1 (Wilson & Hilferty 1931)."""


@dataclass(frozen=True, slots=True)
class SensingOptions:
    """What the data cannot say."""

    method: str = "rays"
    """"rays": every point a measurement; "evidence": the same under one objective (docs/estimator.md); "paper": feature points, Algorithms 2 and 3,
    normals only, one linear step."""
    friction: float | None = 1.0
    """Coulomb coefficient of a contact: its force lies within that cone about the inward normal. None: the data alone say where it points."""
    push: bool = False  # what acts at a given place keeps to its cone, too
    smooth_s: float = 0.0
    """Time constant over which the forces of one track are averaged [s]; they lag by so much. 0: each frame speaks for itself."""
    modulus_std: float = 0.03
    """What is not known of the modulus before the free frames are seen, relative."""
    force_std_n: float = 2.0
    """Size of forces that is expected, along each axis [N]: a weak prior that keeps what the data do not see near zero."""
    marker_std_m: float | None = None
    """Noise of a marker along each axis [m]; None: from the residual of the calibration."""
    marker_model_std: float = 0.015
    """Where there are only markers: error of the modelled motion of a point, relative to its way from rest."""
    iterations: int = 10  # Gauss–Newton steps a frame at most
    correct: bool = False
    """Use the robot's empirical correction of its markers, with its standard deviation."""


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
    """By how much its size may be off, one standard deviation; what is not known across the force counts to second order [N]."""
    source: str
    """"cloud", "shape" or "given"."""
    track: int = 0
    """Its identity over the frames."""
    position_std_m: FloatArray = field(default_factory=lambda: np.zeros(3))
    """One standard deviation of its place along each axis [m], shape (3,)."""
    radius_m: float = 0.0
    """Radius of its patch [m]."""
    force_std_n_xyz: FloatArray = field(default_factory=lambda: np.zeros(3))
    """One standard deviation of each component of the force [N], shape (3,)."""


@dataclass(frozen=True, eq=False, slots=True)
class FrameReport:
    """What became of one frame."""

    frame: int
    time_s: float
    status: str
    """"ok", or what is wrong with the result or why there is none."""
    contacts: int  # whose force is more than noise may make
    matched: int
    """Points or markers that were used."""
    rms_before_m: float
    """Residual of the model without contact forces: normal distance for clouds, 3-D for markers."""
    rms_after_m: float
    ms: float
    tension_n: dict[str, float]
    pressure_pa: dict[str, float] = field(default_factory=dict)
    stages_ms: dict[str, float] = field(default_factory=dict)
    """Time of each stage [ms]."""


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


@dataclass(frozen=True, slots=True)
class LoadComparison:
    """A declared load beside the force that was sensed at its place."""

    frame: int
    """Its number."""
    declared_n: float
    """Size of the sum of what acts there [N]."""
    sensed_n: float
    """Size of the sum of the forces that were sensed [N]."""
    error_percent: float
    """By how much the sensed one is larger [%]."""


@dataclass(frozen=True, eq=False, slots=True)
class Run:
    """The result of `estimate`."""

    contacts: tuple[ContactForce, ...]
    frames: tuple[FrameReport, ...]
    states: States
    robot: Robot
    recording_folder: Path | None
    known_loads: tuple[LoadComparison, ...] = ()
    """Declared loads at the given places beside what was sensed."""

    def __repr__(self) -> str:
        return run_arrays.describe_run(self)

    @property
    def forces(self) -> FloatArray:
        """Forces [N], shape (frames, contacts, 3); nan where a contact is not there."""
        return run_arrays.forces_of(self)

    @property
    def positions(self) -> FloatArray:
        """Their places on the deformed body [m], shape (frames, contacts, 3); nan where a contact is not there."""
        return run_arrays.positions_of(self)

    def to_dataframe(self) -> Any:
        """Return the contacts as a pandas DataFrame with the columns of contacts.csv. Raises MissingDependency."""
        return run_arrays.data_frame_of(self)

    def plot(self) -> Any:
        """Return a matplotlib figure of the forces over time."""
        return femsense.plot_run(self)

    def show(self, *, height: int = 480) -> Any:
        """Return the viewer's page in a frame of so many pixels, for a notebook. Raises MissingDependency."""
        return femsense.show_run(self, height=height)


@dataclass(frozen=True, eq=False, slots=True)
class Touch:
    """A place where a force may act, and what is known of it before the shape is asked."""

    place: FloatArray
    """On the surface at rest [m], shape (3,)."""
    normal: FloatArray
    """Outward unit normal of the surface at rest there, shape (3,)."""
    patch: ContactPatch
    """What carries the force."""
    expected: FloatArray
    """Where it is expected, on the surface at rest [m], shape (3,)."""
    std_m: float
    """How well that is known along the surface [m]; 0: exactly."""
    source: str  # "cloud", "shape" or "given"
    object_radius_m: float = np.inf  # of curvature [m]; inf: flat or not known
    spread_m: float = 0.0  # radius of the zone where it touches, if that is wider than what the mesh can tell from a point [m]
    line: FloatArray = field(default_factory=lambda: np.zeros(3))
    """Unit vector at rest along which alone it is known no better than that, as along a rod; zero: all ways alike."""
    across_m: float = 0.0  # how well it is known across the line [m]
    pulls: bool = False  # whether a weight hangs there, as on a thread: along gravity, not about the normal
    undetermined: bool = False  # an object in touch whose force the data do not determine
    shape: Shape | None = None  # the rigid object that touches there, where one is seen or declared


@dataclass(frozen=True, eq=False, slots=True)
class Response:
    """How a body answers near a state (see `response_at`)."""

    tangent: Tangent
    sag: FloatArray
    """How the nodes move with the modulus and the pulls, as `sag_at` has it [m], shape (1 + a + c, n, 3)."""
    positions: FloatArray
    """Nodes of the state where it was made [m], shape (n, 3)."""


@dataclass(frozen=True, eq=False, slots=True)
class Start:
    """Where a fit may begin: a state, and forces for its touches."""

    state: Equilibrium
    forces: FloatArray  # [N], shape (m, 3)
    response: Response | None = None  # near the state, where it is known
    firm: bool = False
    """Whether it is so near the answer that outliers are known from the first step on (see `robust_std`)."""


@dataclass(frozen=True, eq=False, slots=True)
class Fit:
    """Forces at some places that explain a frame."""

    touches: tuple[Touch, ...]
    state: Equilibrium
    """With the forces."""
    forces: FloatArray
    """[N], shape (m, 3)."""
    covariance: FloatArray
    """Of all components [N²], shape (3m, 3m)."""
    place_covariance: FloatArray
    """Of each place [m²], shape (m, 3, 3)."""
    rows: Rows
    cost: float
    """Misfit: Huber's function of the whitened residual with nuisance fitted, and the priors."""
    still: bool = True
    """Whether the forces had stopped changing."""
    response: Response | None = None
    """At the state or near it, where it was made."""


@dataclass(frozen=True, eq=False, slots=True)
class SensedFrame:
    """One frame, sensed, as the next one starts from it."""

    touches: tuple[Touch, ...]
    state: Equilibrium
    """With the forces."""
    forces: FloatArray
    """[N], shape (m, 3)."""
    free_state: Equilibrium
    """Under the inputs alone."""
    report: FrameReport
    contacts: tuple[ContactForce, ...]
    sure: tuple[bool, ...] = ()
    """Whether each force was more than noise."""
    response: Response | None = None  # near the state
    free_response: Response | None = None  # near the state under the inputs alone
    tau: FloatArray = field(default_factory=lambda: np.zeros(0))
    """Prior scale of each force [N], shape (m,); of the objective alone."""
    trusted: bool = True
    """Whether the next frame may start from this one."""
    objects: tuple[Shape, ...] = ()
    """What was seen near the body: a ball keeps its radius."""


@dataclass(eq=False, slots=True)
class Done:
    """The frames of a recording that are sensed so far."""

    reports: list[FrameReport] = field(default_factory=list)
    contacts: list[ContactForce] = field(default_factory=list)
    states: list[FloatArray] = field(default_factory=list)
    """Node positions [m], shape (n, 3), one array a frame."""
    last: SensedFrame | None = None
    """The last frame that gave a result to start from."""
    tracks: int = 0
    """Contacts distinguished so far."""
    answered_at: Equilibrium | None = None
    """The state of `Answers`."""


@dataclass(frozen=True, eq=False, slots=True)
class Rows:
    """Linearised measurements of one frame at one state: `functional` maps node displacements to them."""

    functional: Callable[[FloatArray], FloatArray]
    """Node displacements (k, n, 3) → rows (r, k)."""
    residual: FloatArray
    """Measured minus modelled [m], shape (r,)."""
    std: FloatArray  # [m], shape (r,)
    by_pose: FloatArray
    """How the measured side moves with (rotation about the pivot [rad], shift [m]) of each camera, shape (r, 6 v)."""
    place: FloatArray  # where on the body at rest each row is taken [m], shape (r, 3)
    way: FloatArray
    """How far that place has moved from rest [m], shape (r,)."""
    count: int  # points or markers
    rms: float  # [m]
    missed: FloatArray = field(default_factory=lambda: np.zeros(0))
    """How far points of the scan whose rays meet nothing, or graze it, lie from the surface, in standard deviations, shape (q,)."""
    of_clouds: bool = False
    """Whether the rows are points of clouds, and not markers."""
    together: float = 1.0
    """How many rows count as one, since neighbours err together."""
    through: float = 0.0
    """Share of the points that lie behind the body on their ray (see `seen_through`)."""
    operator: sp.csr_array | None = None
    """What `functional` does, as a matrix, shape (r, 3n); None for markers."""
    number: FloatArray | None = None
    """How many points each row is the mean of, shape (r,); `std` is that of one of them. None: each row is one."""
    scatter: FloatArray | None = None
    """Mean square of the residuals of these about their mean [m²], shape (r,)."""
    facing: FloatArray = field(default_factory=lambda: np.zeros((1, 3)))
    """Outward unit normal of the body at rest there, shape (r, 3); zero for markers."""
    cosine: FloatArray = field(default_factory=lambda: np.ones(1))  # between ray and face, shape (r,); of clouds
    missed_number: FloatArray | None = None  # how many points each of `missed` is, shape (q,); None: each is one

    @property
    def weight(self) -> FloatArray:
        """How many points each row stands for, shape (r,)."""
        return np.ones(len(self.std)) if self.number is None else self.number

    def sizes(self, residual: FloatArray) -> FloatArray:
        """Return the root mean square of the points of each row that has this residual [m], in standard deviations of a point, shape (r,)."""
        square = residual**2 if self.scatter is None else residual**2 + self.scatter
        return np.asarray(np.sqrt(square) / self.std)

    def spread(self, residual: FloatArray) -> float:
        """Return how widely points scatter, in their standard deviations (1 for noise alone): by the median, which outliers hardly move."""
        return float(np.median(self.sizes(residual) * (1.0 - MEDIAN / self.weight) ** -1.5))

    def some(self, which: IntArray, columns: FloatArray) -> FloatArray:
        """Return the rows `which` (t,) of node displacements that stand in columns (3n, k), shape (t, k)."""
        if self.operator is None:
            return self.functional(columns.T.reshape(columns.shape[1], -1, 3))[which]
        return np.asarray(self.operator[which] @ columns)


@dataclass(frozen=True, eq=False, slots=True)
class Knowledge:
    """What free frames teach: noise of the cameras, pose and modulus, and the errors that neighbouring rows share."""

    noises: tuple[CameraNoise, ...]
    """One a camera."""
    centres: FloatArray
    """Centres of the field of shared errors on the body at rest [m], shape (p, 3)."""
    facing: FloatArray
    """Outward unit normal of the surface at each, shape (p, 3)."""
    length: float
    """Over which errors go together [m]."""
    bias_m: float
    """Size of the shared error that does not depend on motion (camera) [m]."""
    model_share: float
    """Size of the shared error relative to the way from rest (model) [1]."""
    mean: FloatArray
    """What free frames show of pose steps (6 v), modulus (1), pulls of cables and chambers (a + c), and of both shared errors at the
    centres (2 p) [m], [1]: what all frames have alike; shape (6 v + 1 + a + c + 2 p,)."""
    root: FloatArray
    """Square root of their covariance in a new frame, shape (6 v + 1 + a + c + 2 p, j)."""
    gain_limit: float
    """Gain in log evidence from which on a contact that only the shape shows is believed: one false in 1000 free frames."""
    misfit_limit: float
    """Misfit per row above which a frame is not explained."""
    nuisance_limit: float = np.inf
    """χ² of the fitted nuisance over what is expected of it, above which a frame is not explained: a smooth error swallows what touches."""
    through_limit: float = 1.0
    """Share of the points that may lie behind the body on their ray, where colour does not tell the robot's from others."""
    together: float = 1.0  # how many points of a cloud count as one, since neighbours err together
    slant: float = 0.0  # power of one over the cosine of incidence with which noise grows beyond what is stated
    alike: float = 0.0
    """Share of the variance of the shared errors that all frames have alike [1]."""
    rough: float = 1.0
    """How many times the noise of the camera the rows scatter: errors of the model that neighbours do not share (facets, small waves)."""


@dataclass(eq=False, slots=True)
class Answers:
    """How the body answers to unit forces at the candidates near one state; made anew when the body has moved far from it."""

    state: Equilibrium | None = None  # with which an estimate that was stopped goes on
    columns: FloatArray | None = None
    """Moves of the nodes by unit forces along x, y, z at each candidate [m/N], shape (3n, 3c)."""


@dataclass(frozen=True, eq=False, slots=True)
class Sensor:
    """Everything that stays the same from frame to frame."""

    robot: Robot
    recording: Recording
    calibration: Calibration
    driven: DrivenRobot
    surface: BodySurface
    options: SensingOptions
    places: FloatArray
    """Given places of contact at rest [m], shape (g, 3)."""
    candidates: IntArray
    """Surface nodes at which hidden contacts are searched, shape (c,)."""
    pivot: FloatArray
    """Point about which pose steps turn [m], shape (3,)."""
    size: float
    """Diagonal of the body at rest [m]."""
    knowledge: Knowledge
    answers: Answers
    """How the body answers to forces at the candidates, kept from frame to frame."""
    correction_std: FloatArray
    """Standard deviation of the correction of each marker observation along each axis [m], shape (K,); zero without one."""
    scenery: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    """Where something seems to touch in a free frame, on the body at rest [m], shape (s, 3)."""
    overlapping: tuple[Shape, ...] = ()
    """Completed objects that overlap the body in a free frame: a floor that is said to pass through it."""
    background: LocalPlanes | None = None  # None: no cloud of a free frame shows enough of it
