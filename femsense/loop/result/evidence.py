"""What the report draws and tabulates besides the verdict, so that loop.json alone is enough."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.loop.result.records import Correlation, Structure
from femsense.loop.result.tables import AS_EMPTY, LEFT_OUT, NAN, Columns, Number, Triple, Vector


@dataclass(frozen=True, eq=False, slots=True)
class FrameTable(Columns):
    """One row for each frame of all trials, fitted ones first, as columns of equal length."""

    recording: tuple[int, ...] = ()
    frame: tuple[int, ...] = ()
    time_s: Vector = ()
    sweep: tuple[str, ...] = ()
    held_out: tuple[bool, ...] = ()
    actuation: Vector = ()
    unloading: tuple[bool, ...] = ()
    load_n: Vector = ()
    before_rms_m: Vector = ()
    after_rms_m: Vector = ()
    score_before_m: Vector = ()
    """How strongly a frame shows the leading pattern [m]."""
    score_after_m: Vector = ()


@dataclass(frozen=True, eq=False, slots=True)
class Pattern:
    """The leading pattern of the residual before, and what its strength goes with."""

    share: Number = NAN
    """Share of the mean square that it holds."""
    pattern: Mapping[str, Vector] = field(default_factory=dict)
    """Marker → direction, (3,)."""
    goes_with_before: tuple[Correlation, ...] = ()
    goes_with_after: tuple[Correlation, ...] = ()
    covariate: str | None = None
    """What it goes with the most."""
    covariate_values: Vector = ()


@dataclass(frozen=True, eq=False, slots=True)
class Tip(Columns):
    """The way of the marker farthest from the clamp along its main direction of motion."""

    marker: str = ""
    direction: Vector = ()
    recording: tuple[int, ...] = ()
    frame: tuple[int, ...] = ()
    measured_m: Vector = ()
    before_m: Vector = ()
    after_m: Vector = ()


@dataclass(frozen=True, eq=False, slots=True)
class Snapshot:
    """The residuals in one frame, on the skin of the declared body."""

    title: str
    recording: int
    frame: int
    marker: tuple[str, ...]
    measured_m: tuple[Triple, ...]
    before_m: tuple[Triple, ...]
    after_m: tuple[Triple, ...]
    nodes_m: tuple[Triple, ...] | None = None
    """Corners of the skin; None where they are many."""


@dataclass(frozen=True, eq=False, slots=True)
class CameraPlace:
    """Where a camera stands and which way it looks, robot frame."""

    axis: Triple
    position_m: Vector = ()


@dataclass(frozen=True, eq=False, slots=True)
class Pictures:
    """Some frames, with the skin's triangles (None where they are many) and the cameras."""

    triangles: tuple[tuple[int, ...], ...] | None = None
    frames: tuple[Snapshot, ...] = ()
    cameras: tuple[CameraPlace, ...] = ()

    @property
    def camera_axes(self) -> list[FloatArray]:
        """Unit vectors along which cameras look, robot frame, shape (3,) each."""
        return [axis for camera in self.cameras if np.isfinite(axis := np.asarray(camera.axis, float)).all()]


@dataclass(frozen=True, eq=False, slots=True)
class Estimate:
    """The linear estimate of a parameter, with its plausible range."""

    label: str
    value: float | None = None
    std: float | None = None
    ends: Vector = ()
    unit: str = "1"


@dataclass(frozen=True, eq=False, slots=True)
class Ranked:
    """An effect in the first screening."""

    parameters: tuple[Estimate, ...] = ()
    first_share: float | None = None
    """How often it comes first when sweeps are drawn again; None: too few sweeps."""


@dataclass(frozen=True, eq=False, slots=True)
class ConfoundingMap:
    """How much of each effect's field (row) is collinear with that of another one (column), calibration projected out."""

    names: tuple[str, ...] = ()
    share: tuple[Vector, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class PoseShift:
    """How a camera's pose moved, by model; the declared one stands at zero."""

    recording: int
    camera: int
    turn_rad: Mapping[str, Triple] = field(default_factory=dict)
    shift_m: Mapping[str, Triple] = field(default_factory=dict)
    turn_std_rad: Mapping[str, Triple] = field(default_factory=dict)
    shift_std_m: Mapping[str, Triple] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, slots=True)
class InputShift:
    """The initial input of a cable, by model: (value, standard deviation)."""

    recording: int
    cable: str
    unit: str = "1"
    values: Mapping[str, Vector] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, slots=True)
class TermShift:
    """A value that calibration may move, by model: (value, standard deviation)."""

    label: str
    unit: str = "1"
    declared: Number = NAN
    values: Mapping[str, Vector] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, slots=True)
class CalibrationShift:
    """What calibration says before, with all it may move, and beside the effects."""

    poses: tuple[PoseShift, ...] = ()
    initial_inputs: tuple[InputShift, ...] = ()
    parameters: tuple[TermShift, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class LackOfFit:
    """The F test of lack of fit against pure error."""

    f: Number
    p_value: Number
    df_lack: int
    df_pure: int
    pure_error_m: Number


@dataclass(frozen=True, eq=False, slots=True)
class Tested:
    """Tests of what a model leaves."""

    structure: Structure = field(default_factory=Structure)
    lack_of_fit: LackOfFit | None = None
    """None where too little is repeated."""
    train_rms_m: Number = NAN


@dataclass(frozen=True, eq=False, slots=True)
class Tests:
    """Tests of what is left before and after."""

    before: Tested = field(default_factory=Tested)
    after: Tested = field(default_factory=Tested)


@dataclass(frozen=True, eq=False, slots=True)
class Size:
    """The smallest change of a parameter that would have been seen."""

    label: str
    kind: str
    """"change", "factor", "softer_than", or "whole"."""
    size: float | None = None
    unit: str = "1"


@dataclass(frozen=True, eq=False, slots=True)
class LoadRow:
    """The strongest declared load of a frame next to what either model senses there."""

    recording: int
    frame: int
    held_out: bool = False
    declared_n: Number = NAN
    before_n: Number = NAN
    before_std_n: Number = NAN
    after_n: Number = NAN
    after_std_n: Number = NAN


@dataclass(frozen=True, eq=False, slots=True)
class Softer:
    """How the compliance of two models differs in one frame."""

    title: str
    frame: int
    ratio: Vector = ()
    """Forces after / before at each point, for the same dent."""
    phantom_before_n: Number = NAN
    """Force at the free end that the model would sense where nothing touches."""
    phantom_after_n: Number = NAN


@dataclass(frozen=True, eq=False, slots=True)
class Compliance:
    """How much a sensed force changes from model to model."""

    points_m: tuple[Vector, ...] = ()
    frames: tuple[Softer, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class ForceImpact:
    """What both models make of forces: at declared loads, or where there are none by their compliance."""

    loads: tuple[LoadRow, ...] | None = field(default=None, metadata=LEFT_OUT)
    compliance: Compliance | None = field(default=None, metadata=LEFT_OUT)


@dataclass(frozen=True, eq=False, slots=True)
class ForceField:
    """Forces on the surface that would explain the frame with the largest residual."""

    recording: int = 0
    frame: int | None = None
    points_m: tuple[Triple, ...] = ()
    forces_n: tuple[Triple, ...] = ()
    total_n: Vector = ()
    explained_share: Number = NAN


@dataclass(frozen=True, eq=False, slots=True)
class Evidence:
    """What the figures and tables of the report need."""

    frames: FrameTable = field(default_factory=FrameTable)
    score: Pattern = field(default_factory=Pattern)
    pictures: Pictures = field(default_factory=Pictures)
    ranking: Mapping[str, Ranked] = field(default_factory=dict)
    confounding: ConfoundingMap = field(default_factory=ConfoundingMap)
    calibration: CalibrationShift = field(default_factory=CalibrationShift)
    tests: Tests = field(default_factory=Tests)
    power: Mapping[str, tuple[Size, ...]] = field(default_factory=dict)
    """Effect → sizes of its parameters."""
    excluded: tuple[Mapping[str, tuple[int, ...]], ...] = ()
    """Reason → frames that are neither fitted nor held out, for each recording."""
    repeats: int | None = None
    """Stays that repeat an earlier one."""
    forces: ForceImpact = field(default_factory=ForceImpact)
    tip: Tip | None = field(default=None, metadata=AS_EMPTY)
    """None: clouds do not tell where a point of the surface went."""
    equivalent_forces: ForceField | None = field(default=None, metadata=AS_EMPTY)
    """None: no frame holds more than noise."""
