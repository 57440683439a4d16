"""Data for the figures and tables of the report, so that loop.json alone suffices to draw it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.loop.result.records import Correlation, Structure
from femsense.loop.result.tables import AS_EMPTY, LEFT_OUT, NAN, Columns, Number, Triple, Vector


@dataclass(frozen=True, eq=False, slots=True)
class FrameTable(Columns):
    """One row per frame of all trials, fitted ones first, as columns of equal length."""

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
    """Amplitude of the leading pattern in the frame [m]."""
    score_after_m: Vector = ()


@dataclass(frozen=True, eq=False, slots=True)
class Pattern:
    """The leading pattern of the residual before, and its correlations."""

    share: Number = NAN
    """Share of the mean square in this pattern."""
    pattern: Mapping[str, Vector] = field(default_factory=dict)
    """Marker → direction, (3,)."""
    goes_with_before: tuple[Correlation, ...] = ()
    goes_with_after: tuple[Correlation, ...] = ()
    covariate: str | None = None
    """The covariate with the strongest correlation."""
    covariate_values: Vector = ()


@dataclass(frozen=True, eq=False, slots=True)
class Tip(Columns):
    """Path of the marker farthest from the clamp, along its main direction of motion."""

    marker: str = ""
    direction: Vector = ()
    recording: tuple[int, ...] = ()
    frame: tuple[int, ...] = ()
    measured_m: Vector = ()
    before_m: Vector = ()
    after_m: Vector = ()


@dataclass(frozen=True, eq=False, slots=True)
class Snapshot:
    """The residuals of one frame, on the surface of the declared body."""

    title: str
    recording: int
    frame: int
    marker: tuple[str, ...]
    measured_m: tuple[Triple, ...]
    before_m: tuple[Triple, ...]
    after_m: tuple[Triple, ...]
    nodes_m: tuple[Triple, ...] | None = None
    """Corners of the surface; None if there are too many."""


@dataclass(frozen=True, eq=False, slots=True)
class CameraPlace:
    """Position and viewing direction of a camera, robot frame."""

    axis: Triple
    position_m: Vector = ()


@dataclass(frozen=True, eq=False, slots=True)
class Pictures:
    """Some frames, with the triangles of the surface (None if there are too many) and the cameras."""

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
    """Share of bootstrap draws of sweeps in which it has the best score; None: too few sweeps."""


@dataclass(frozen=True, eq=False, slots=True)
class ConfoundingMap:
    """Share of each effect's field (row) that is collinear with that of another one (column), calibration projected out."""

    names: tuple[str, ...] = ()
    share: tuple[Vector, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class PoseShift:
    """Change of a camera pose by model, relative to the declared model."""

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
    """A nuisance value by model: (value, standard deviation)."""

    label: str
    unit: str = "1"
    declared: Number = NAN
    values: Mapping[str, Vector] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, slots=True)
class CalibrationShift:
    """Calibration results of the declared model, with all nuisance effects, and with the accepted effects."""

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
    """Tests of the residual of a model."""

    structure: Structure = field(default_factory=Structure)
    lack_of_fit: LackOfFit | None = None
    """None if too few states repeat."""
    train_rms_m: Number = NAN


@dataclass(frozen=True, eq=False, slots=True)
class Tests:
    """Tests of the residual before and after."""

    before: Tested = field(default_factory=Tested)
    after: Tested = field(default_factory=Tested)


@dataclass(frozen=True, eq=False, slots=True)
class Size:
    """The smallest detectable change of a parameter."""

    label: str
    kind: str
    """"change", "factor", "softer_than", or "whole"."""
    size: float | None = None
    unit: str = "1"


@dataclass(frozen=True, eq=False, slots=True)
class LoadRow:
    """The largest declared load of a frame, and the force that each model estimates there."""

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
    """Ratio of the compliances of two models in one frame."""

    title: str
    frame: int
    ratio: Vector = ()
    """Forces after / before at each point, for the same indentation."""
    phantom_before_n: Number = NAN
    """Force at the free end that the residual would be interpreted as, in a contact-free frame [N]."""
    phantom_after_n: Number = NAN


@dataclass(frozen=True, eq=False, slots=True)
class Compliance:
    """Change of an estimated force between the models."""

    points_m: tuple[Vector, ...] = ()
    frames: tuple[Softer, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class ForceImpact:
    """Effect of the model change on forces: at declared loads, or if there are none, by the compliances."""

    loads: tuple[LoadRow, ...] | None = field(default=None, metadata=LEFT_OUT)
    compliance: Compliance | None = field(default=None, metadata=LEFT_OUT)


@dataclass(frozen=True, eq=False, slots=True)
class ForceField:
    """Surface forces that would fit the frame with the largest residual."""

    recording: int = 0
    frame: int | None = None
    points_m: tuple[Triple, ...] = ()
    forces_n: tuple[Triple, ...] = ()
    total_n: Vector = ()
    explained_share: Number = NAN


@dataclass(frozen=True, eq=False, slots=True)
class Evidence:
    """Data for the figures and tables of the report."""

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
    """Number of stays that repeat an earlier one."""
    forces: ForceImpact = field(default_factory=ForceImpact)
    tip: Tip | None = field(default=None, metadata=AS_EMPTY)
    """None for clouds: they do not identify a material point."""
    equivalent_forces: ForceField | None = field(default=None, metadata=AS_EMPTY)
    """None if no frame exceeds the noise."""
