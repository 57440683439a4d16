"""Types of force sensing."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import femsense
from femsense.calib.calibration import Calibration
from femsense.core.arrays import FloatArray, IntArray
from femsense.fem.equilibrium import Equilibrium
from femsense.inference.error_field import ErrorField
from femsense.model.camera import CameraNoise
from femsense.model.contact_patch import BodySurface, ContactPatch
from femsense.model.drive import DrivenRobot
from femsense.model.recording import Recording
from femsense.model.robot import Robot
from femsense.pointcloud.local_planes import LocalPlanes
from femsense.pointcloud.primitives import Shape
from femsense.sensing import run_arrays
from femsense.sensing.options import SensingOptions


@dataclass(frozen=True, eq=False, slots=True)
class ContactForce:
    """A contact in one frame of a recording: contact point, force, and their standard deviations, in the robot's coordinate system.

    A contact that lasts six frames gives six objects with the same `track`.
    """

    frame: int
    """Number of the frame as in frames.csv."""
    time_s: float
    """Time of the frame [s]."""
    contact: int
    """Number of the contact in its frame, from 0."""
    position_m: FloatArray
    """Contact point on the deformed body [m], shape (3,)."""
    normal: FloatArray
    """Outward unit normal of the body there, shape (3,)."""
    force_n_xyz: FloatArray
    """Force on the body [N], shape (3,)."""
    force_n: float
    """Magnitude of the force [N]."""
    std_n: float
    """Standard deviation of the magnitude [N]: that along the force, and to second order that across it."""
    source: str
    """"cloud": visible contact, its object was observed; "shape": inferred from the deformation alone; "given": at a point of `at`."""
    track: int = 0
    """Number of the contact over the frames: contacts of different frames with one number are the same."""
    position_std_m: FloatArray = field(default_factory=lambda: np.zeros(3))
    """Standard deviation of the contact point along each axis [m], shape (3,)."""
    radius_m: float = 0.0
    """Radius of the contact patch [m]."""
    force_std_n_xyz: FloatArray = field(default_factory=lambda: np.zeros(3))
    """Standard deviation of each component of the force [N], shape (3,)."""


@dataclass(frozen=True, eq=False, slots=True)
class FrameReport:
    """Status, residuals and times of one frame."""

    frame: int
    """Number of the frame, as in frames.csv."""
    time_s: float
    """Time of the frame [s]."""
    status: str
    """"ok", or the reason why the result is not to be trusted or missing (docs/guides/statuses.md)."""
    contacts: int  # number of contacts with a significant force
    matched: int
    """Number of pixels or markers used."""
    rms_before_m: float
    """Residual of the model without contact forces [m]: along the normal for clouds, in 3-D for markers."""
    rms_after_m: float
    """Residual with the contact forces [m], as above."""
    ms: float
    """Run time of the frame [ms]."""
    tension_n: dict[str, float]
    pressure_pa: dict[str, float] = field(default_factory=dict)
    stages_ms: dict[str, float] = field(default_factory=dict)
    """Time of each stage [ms]."""


@dataclass(frozen=True, eq=False, slots=True)
class States:
    """The deformed body in each frame."""

    time_s: FloatArray
    """shape (F,)."""
    nodes_m: npt.NDArray[np.float32]
    """shape (F, n, 3)."""
    tets: npt.NDArray[np.int64]
    """Node indices of the tetrahedra, shape (m, 4) or (m, 10)."""
    rest_nodes_m: FloatArray
    """shape (n, 3)."""


@dataclass(frozen=True, slots=True)
class LoadComparison:
    """A declared load and the force estimated at its point."""

    frame: int
    """Its number."""
    declared_n: float
    """Magnitude of the declared resultant [N]."""
    sensed_n: float
    """Magnitude of the estimated resultant [N]."""
    error_percent: float
    """Relative error of the estimate [%]."""


@dataclass(frozen=True, eq=False, slots=True)
class Run:
    """The result of `estimate`: contacts, status of each frame, and deformed states.

    `forces` and `positions` are arrays over frames and contacts; `to_dataframe`, `plot` and `show` serve notebooks.
    """

    contacts: tuple[ContactForce, ...]
    """Contacts of all frames, in order of frames."""
    frames: tuple[FrameReport, ...]
    """Status, residuals and times of each frame."""
    states: States
    """The deformed body in each frame."""
    robot: Robot
    """The robot of the estimate."""
    recording_folder: Path | None
    """Folder of the recording; None: made in Python."""
    known_loads: tuple[LoadComparison, ...] = ()
    """Declared loads at the given contact points, and their estimates."""

    def __repr__(self) -> str:
        return run_arrays.describe_run(self)

    @property
    def forces(self) -> FloatArray:
        """Forces [N], shape (frames, contacts, 3); nan in frames without the contact."""
        return run_arrays.forces_of(self)

    @property
    def positions(self) -> FloatArray:
        """Contact points on the deformed body [m], shape (frames, contacts, 3); nan in frames without the contact."""
        return run_arrays.positions_of(self)

    def to_dataframe(self) -> Any:
        """Return the contacts as a pandas DataFrame with the columns of contacts.csv. Raises MissingDependency."""
        return run_arrays.data_frame_of(self)

    def plot(self) -> Any:
        """Return a matplotlib figure of the forces over time."""
        return femsense.plot_run(self)

    def show(self, *, height: int = 480) -> Any:
        """Return the viewer's page for a notebook, `height` pixels high. Raises MissingDependency."""
        return femsense.show_run(self, height=height)


class Case(Enum):
    """What is asked of a frame."""

    CONTACT_FREE = "the recording declares that nothing touches"
    GIVEN_PLACES = "forces at given places"
    UNKNOWN_CONTACTS = "number, places and forces of contacts"


@dataclass(frozen=True, eq=False, slots=True)
class Touch:
    """A possible contact, with its prior."""

    place: FloatArray
    """Contact point on the surface at rest [m], shape (3,)."""
    normal: FloatArray
    """Outward unit normal of the surface at rest there, shape (3,)."""
    patch: ContactPatch
    """Contact patch: the weights of the nodes that carry the force."""
    expected: FloatArray
    """Prior mean of the contact point, on the surface at rest [m], shape (3,)."""
    std_m: float
    """Prior standard deviation along the surface [m]; 0: fixed."""
    source: str  # "cloud", "shape" or "given"
    object_radius_m: float = np.inf  # radius of curvature [m]; inf: flat or unknown
    spread_m: float = 0.0  # radius of the contact zone, if larger than the resolution of the mesh [m]
    along: FloatArray | None = None  # longer half axis of the zone of a line contact at rest [m], shape (3,)
    line: FloatArray = field(default_factory=lambda: np.zeros(3))
    """Direction at rest to which `std_m` applies, such as the axis of a rod, unit vector; zero: to all tangential directions."""
    across_m: float = 0.0  # prior standard deviation across the line [m]
    pulls: bool = False  # whether it is a hanging weight, with a force along gravity
    undetermined: bool = False  # a touching object whose force the data do not determine
    shape: Shape | None = None  # the touching rigid object, if one is observed or declared


@dataclass(frozen=True, eq=False, slots=True)
class Refuted:
    """A proposal that was fitted and did not lower J, and the error of its linear prediction."""

    frame: int
    """Index of the frame in which it was fitted."""
    before: tuple[Touch, ...]
    """Contacts of the hypothesis from which it was proposed."""
    contacts: tuple[Touch, ...]
    """Its own contacts, as proposed."""
    error: float
    """Expected minus actual decrease of J."""


@dataclass(frozen=True, eq=False, slots=True)
class SensedFrame:
    """The result of one frame, from which the next one starts."""

    touches: tuple[Touch, ...]
    state: Equilibrium
    """Equilibrium under the forces."""
    forces: FloatArray
    """[N], shape (m, 3)."""
    free_state: Equilibrium
    """Equilibrium under the inputs without contacts (the predicted state)."""
    report: FrameReport
    contacts: tuple[ContactForce, ...]
    tau: FloatArray = field(default_factory=lambda: np.zeros(0))
    """Prior scale of each force [N], shape (m,)."""
    trusted: bool = True
    """Whether the next frame may start from this one."""
    objects: tuple[Shape, ...] = ()
    """Observed objects near the body, so that a ball keeps its radius."""
    refuted: tuple[Refuted, ...] = ()
    """Proposals that did not lower J, in this frame or a few before."""


@dataclass(eq=False, slots=True)
class Done:
    """The completed frames of a recording."""

    reports: list[FrameReport] = field(default_factory=list)
    contacts: list[ContactForce] = field(default_factory=list)
    states: list[FloatArray] = field(default_factory=list)
    """Node positions of each frame [m], shape (n, 3)."""
    last: SensedFrame | None = None
    """The warm start of the next frame."""
    tracks: int = 0
    """Number of tracks so far."""
    answered_at: Equilibrium | None = None
    """The state at which the compliance at the candidates was computed, so that a resumed estimate uses the same."""


@dataclass(frozen=True, eq=False, slots=True)
class Knowledge:
    """Noise of the cameras, and correlated errors of neighbouring pixels."""

    noises: tuple[CameraNoise, ...]
    """Noise of each camera."""
    bias_m: float
    """Standard deviation of the error field of the camera [m]."""
    model_share: float
    """Standard deviation of the error field of the model, relative to the displacement [1]."""
    together: float = 1.0
    """T: number of correlated pixels that count as one independent measurement."""

    def depth_std(self, depth: FloatArray, view: IntArray) -> FloatArray:
        """Return the noise of points [m], shape (k,), from their depths [m] and cameras, shape (k,)."""
        std = np.empty(len(depth))
        for v, noise in enumerate(self.noises):
            std[view == v] = noise.std(depth[view == v])
        return std


@dataclass(frozen=True, eq=False, slots=True)
class Sensor:
    """The constants of a recording."""

    robot: Robot
    recording: Recording
    calibration: Calibration
    driven: DrivenRobot
    surface: BodySurface
    options: SensingOptions
    places: FloatArray
    """Given contact points at rest [m], shape (g, 3)."""
    touchable: IntArray
    """Triangles of the surface outside the clamp, which a holder always touches, shape (t,)."""
    candidates: IntArray
    """Surface nodes at which inferred contacts are searched, shape (c,)."""
    pivot: FloatArray
    """Point about which pose steps rotate [m], shape (3,)."""
    size: float
    """Diagonal of the body at rest [m]."""
    error_field: ErrorField
    """Error field over the surface of the body."""
    knowledge: Knowledge
    correction_std: FloatArray
    """Standard deviation of the correction of each marker observation along each axis [m], shape (K,); zero without one."""
    scenery: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    """Points at rest where an object appears to touch in a contact-free frame [m], shape (s, 3)."""
    overlapping: tuple[Shape, ...] = ()
    """Completed objects that overlap the body in a contact-free frame, such as a floor that passes through it."""
    passing: tuple[Shape, ...] = ()
    """Plates among them through which the body reaches by more than an edge: these do not say where they touch."""
    background: LocalPlanes | None = None  # None: no cloud of a free frame shows enough of it
    declares_law: bool = True
    """Whether the robot itself determines the constitutive law; else forces are known to within the difference of two laws (`law.moved_by_law`)."""
