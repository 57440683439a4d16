"""What sensing takes and returns."""

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


class Case(Enum):
    """What is asked of a frame."""

    CONTACT_FREE = "the recording declares that nothing touches"
    GIVEN_PLACES = "forces at given places"
    UNKNOWN_CONTACTS = "number, places and forces of contacts"


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
    tau: FloatArray = field(default_factory=lambda: np.zeros(0))
    """Prior scale of each force [N], shape (m,)."""
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
    """The state near which the answers at the candidates were computed: an estimate that was stopped goes on with the same."""


@dataclass(frozen=True, eq=False, slots=True)
class Knowledge:
    """Noise of the cameras, and the errors that neighbouring pixels share."""

    noises: tuple[CameraNoise, ...]
    """One a camera."""
    bias_m: float
    """Size of the shared error that does not depend on motion (camera) [m]."""
    model_share: float
    """Size of the shared error relative to the way from rest (model) [1]."""
    together: float = 1.0
    """T: how many pixels count as one, since neighbours err together."""

    def depth_std(self, depth: FloatArray, view: IntArray) -> FloatArray:
        """Return the noise of points at some depths (k,) [m], each of its camera (k,), shape (k,) [m]."""
        std = np.empty(len(depth))
        for v, noise in enumerate(self.noises):
            std[view == v] = noise.std(depth[view == v])
        return std


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
    touchable: IntArray
    """Triangles of the surface that are not on the clamp, where a holder always touches, shape (t,)."""
    candidates: IntArray
    """Surface nodes at which hidden contacts are searched, shape (c,)."""
    pivot: FloatArray
    """Point about which pose steps turn [m], shape (3,)."""
    size: float
    """Diagonal of the body at rest [m]."""
    error_field: ErrorField
    """Over the surface of the body."""
    knowledge: Knowledge
    correction_std: FloatArray
    """Standard deviation of the correction of each marker observation along each axis [m], shape (K,); zero without one."""
    scenery: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    """Where something seems to touch in a free frame, on the body at rest [m], shape (s, 3)."""
    overlapping: tuple[Shape, ...] = ()
    """Completed objects that overlap the body in a free frame: a floor that is said to pass through it."""
    passing: tuple[Shape, ...] = ()
    """Plates among them through which the body reaches by more than an edge: these do not say where they touch."""
    background: LocalPlanes | None = None  # None: no cloud of a free frame shows enough of it
    declares_law: bool = True
    """Whether the robot itself determines the constitutive law; else forces are known to within the difference of two laws (`law.moved_by_law`)."""
