"""What sensing takes and returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from femsense.calib.calibration import Calibration
from femsense.core.arrays import FloatArray
from femsense.fem.equilibrium import Equilibrium
from femsense.model.contact_patch import BodySurface
from femsense.model.drive import DrivenRobot
from femsense.model.recording import Recording
from femsense.model.robot import Robot


@dataclass(frozen=True, slots=True)
class SensingOptions:
    """Thresholds; those left None follow from the size of the robot."""

    voxel_m: float | None = None
    """Edge of the voxel grid [m]; None: 1 % of the robot's diagonal."""
    match_line_m: float | None = None
    """d_m: largest distance of a match from the normal line [m]; None: 3 voxels."""
    match_reach_m: float | None = None
    """d_l: largest distance along the normal [m]; None: 20 % of the diagonal."""
    contact_radius_m: float | None = None
    """Search radius of Algorithm 2 [m]; None: 3 voxels."""
    contact_neighbors: int = 3
    """Robot points that make a contact."""
    friction: float | None = None
    """Coulomb coefficient of a contact that was found: its force lies within that cone about the inward normal, with 0 along it. None: the
    data say where the force points; beside an edge the normal that the camera sees may be that of another side than the one that is touched."""
    match_points: int = 200
    """Points of the surface that are matched, spread evenly off sharp edges; at least as many as the robot has features."""
    modulus_std: float = 0.03
    """What is not known of the modulus, relative; it enters the standard deviation of every force."""
    model_std: float = 0.015
    """What is not known of the modelled motion of a point, relative to its way from rest (mesh, law, boundary)."""
    cloud_force_std: float = 0.15
    """Relative error of a force from clouds beside noise, pose, modulus and place: occlusion, edges, one view (see docs/forces.md)."""
    correlation_m: float | None = None
    """Length over which errors of model and depth go together [m]; None: 12 % of the diagonal. Matches within it count once."""
    cloud_std_m: float = 5e-4
    """What averaging cannot remove from a cloud [m]."""
    marker_std_m: float | None = None
    """Noise of a marker along each axis [m]; None: from the residual of the calibration."""
    iterations: int = 6
    """Linearisations a frame at most."""


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
    """One standard deviation of the force along its direction [N]."""
    source: str
    """"cloud" or "given"."""


@dataclass(frozen=True, eq=False, slots=True)
class FrameReport:
    """What became of one frame."""

    frame: int
    time_s: float
    status: str
    """"ok", or why there is no result."""
    contacts: int
    matched: int
    """Features or markers that were found."""
    rms_before_m: float
    """Residual of the model without contact forces: normal distance for clouds, 3-D for markers."""
    rms_after_m: float
    ms: float
    tension_n: dict[str, float]
    pressure_pa: dict[str, float] = field(default_factory=dict)


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


@dataclass(frozen=True, eq=False, slots=True)
class Run:
    """The result of `estimate`."""

    contacts: tuple[ContactForce, ...]
    frames: tuple[FrameReport, ...]
    states: States
    robot: Robot
    recording_folder: Path | None
    known_loads: tuple[dict[str, float], ...] = ()
    """Declared loads at the given places next to what was sensed: {frame, declared_n, sensed_n, error_percent}."""


@dataclass(frozen=True, eq=False, slots=True)
class SensedFrame:
    """One frame, sensed."""

    state: Equilibrium
    """With the forces found."""
    free_state: Equilibrium
    """Under the inputs alone."""
    forces: FloatArray
    """Components of all contact forces [N], shape (3k,)."""
    report: FrameReport
    contacts: tuple[ContactForce, ...]


@dataclass(eq=False, slots=True)
class Done:
    """The frames of a recording that are sensed so far."""

    reports: list[FrameReport] = field(default_factory=list)
    contacts: list[ContactForce] = field(default_factory=list)
    states: list[FloatArray] = field(default_factory=list)
    """Node positions [m], shape (n, 3), one array a frame."""
    last: SensedFrame | None = None
    """The last frame that gave a result."""


@dataclass(frozen=True, eq=False, slots=True)
class SeenPoints:
    """What the cameras see in one frame, robot frame."""

    robot: FloatArray
    """Points of the robot [m], shape (r, 3)."""
    normals: FloatArray | None
    """Their normals towards the camera, shape (r, 3); None with several cameras."""
    others: FloatArray
    """Points of everything else [m], shape (o, 3)."""


@dataclass(frozen=True, eq=False, slots=True)
class Rows:
    """Linearised measurements: `functional` maps node displacements to them."""

    functional: Callable[[FloatArray], FloatArray]
    """Node displacements (k, n, 3) → rows (r, k)."""
    residual: FloatArray
    """Measured minus modelled [m], shape (r,)."""
    std: FloatArray
    """[m], shape (r,)."""
    by_pose: FloatArray
    """d residual / d (pose in units of its standard deviation), shape (r, ≤ 6)."""
    count: int
    """Features or markers."""
    rms: float
    """[m]."""
    sharp: FloatArray
    """The same before residuals that stand out got more [m], shape (r,)."""
    crowding: float = 1.0
    """By how much errors that neighbours share widen standard deviations [1]."""


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
    probes: npt.NDArray[np.int64]
    """Surface nodes that are matched with clouds, shape (e,)."""
    pose_root: FloatArray
    """Square root of the pose covariance (rotation about the pivot, shift), shape (6, ≤ 6)."""
    size: float = field(default=0.0)
    """Diagonal of the body at rest [m]."""
