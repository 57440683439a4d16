"""What a closed loop says, piece by piece: errors, effects, candidates, and what the data cannot tell."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from femsense.loop.result.tables import LEFT_OUT, NAN, Columns, Number, Triple, Vector
from femsense.model.effects import Entry

NAMED, PASSES = "named", "passes"
"""What becomes of a refit that is added to the model, and of one that passes the acceptance test though another one is added."""


@dataclass(frozen=True, eq=False, slots=True)
class Errors:
    """Errors of a model: of the markers, of clouds along their normals beside them; where there are no markers, twice those."""

    train_rms_m: Number = NAN
    """Where it is fitted [m]."""
    validation_rms_m: Number = NAN
    """On held-out data [m]."""
    validation_ci_m: Vector = ()
    """Its 95 % interval [m]."""
    validation_ci_by: str = ""
    """What was drawn again for that: "sweeps" or "frames"."""
    train_normal_rms_m: float | None = field(default=None, metadata=LEFT_OUT)
    """Along the normals of clouds [m]; None without clouds."""
    validation_normal_rms_m: float | None = field(default=None, metadata=LEFT_OUT)
    validation_normal_ci_m: Vector | None = field(default=None, metadata=LEFT_OUT)


@dataclass(frozen=True, eq=False, slots=True)
class Value:
    """One key of an effect. Vectors and tables keep their shape."""

    value: Any = None
    """In `unit`."""
    std: Any = None
    """Standard deviation of each number in the same shape; None: not fitted."""
    unit: str = "1"


@dataclass(frozen=True, eq=False, slots=True)
class NamedEffect:
    """An effect that the model lacks."""

    name: str
    parameters: Mapping[str, Value] = field(default_factory=dict)
    """Key of robot.toml → value."""
    validation_rms_before_m: Number = NAN
    """Held-out error without it [m]."""
    validation_rms_after_m: Number = NAN
    """Held-out error with it [m]."""


@dataclass(frozen=True, eq=False, slots=True)
class RefitRecord:
    """What became of a candidate that was refitted together with all that the model has."""

    name: str
    seed: Entry = field(default_factory=dict)
    """What was not fitted of it: a place, a radius, a time."""
    verdict: str = ""
    """NAMED, PASSES, or why not, in words."""
    step: int | None = field(default=None, metadata=LEFT_OUT)
    """Number of the model that it was tried on."""
    in_place_of: str | None = field(default=None, metadata=LEFT_OUT)
    """The effect that was taken out for it; None: it was added."""
    dchi2: float | None = field(default=None, metadata=LEFT_OUT)
    """Decrease of χ²."""
    dbic: float | None = field(default=None, metadata=LEFT_OUT)
    """That less the cost of its freedom."""
    validation_rms_m: float | None = field(default=None, metadata=LEFT_OUT)
    """Held-out error with it [m]."""
    cv_gain: float | None = field(default=None, metadata=LEFT_OUT)
    """By how much left-out sweeps are predicted better."""
    cv_std: float | None = field(default=None, metadata=LEFT_OUT)
    """Standard error of that."""
    held_dchi2: float | None = field(default=None, metadata=LEFT_OUT)
    """Decrease of χ² on held-out data."""
    moved_m: float | None = field(default=None, metadata=LEFT_OUT)
    """How far it moves the markers beyond what calibration does [m]."""
    mesh_cost_m: float | None = field(default=None, metadata=LEFT_OUT)
    """Discretisation error that calibration leaves [m]."""
    takes_over: tuple[str, ...] | None = field(default=None, metadata=LEFT_OUT)
    """Nuisances that are significant without it, and not with it."""
    seed_std: Vector | None = field(default=None, metadata=LEFT_OUT)
    """Scatter of its coordinates over seeds that explain as much."""

    @property
    def passes(self) -> bool:
        """Whether it passes the acceptance test, and another one was added instead."""
        return self.verdict == PASSES

    @property
    def is_named(self) -> bool:
        """Whether it was added."""
        return self.verdict == NAMED

    @property
    def evidence(self) -> float:
        """Its dBIC; NaN where it was stopped before it had one."""
        return float("nan") if self.dbic is None else self.dbic

    def answers_as(self, other: RefitRecord) -> bool:
        """Return whether both were made on top of the same model."""
        return (self.step, self.in_place_of) == (other.step, other.in_place_of)


@dataclass(frozen=True, eq=False, slots=True)
class TriedEffect:
    """An effect that was tried, with its linear scores at the start and its refits."""

    name: str
    seed: Entry = field(default_factory=dict)
    dchi2: float | None = None
    """Decrease of χ² by its linear step."""
    dbic: float | None = None
    retained_share: float | None = None
    """Share of its field that calibration leaves; None: not screened."""
    dbic_at_end: float | None = None
    """Linear dBIC beside all that is named."""
    refits: tuple[RefitRecord, ...] = ()
    verdict: str = ""


@dataclass(frozen=True, eq=False, slots=True)
class ConfoundedPair:
    """Two effects that these data cannot distinguish, and what is known of that."""

    pair: tuple[str, str]
    dbic_gap: float | None = field(default=None, metadata=LEFT_OUT)
    """How far apart their refits are."""
    absorbed_share: float | None = field(default=None, metadata=LEFT_OUT)
    """How much of the one calibration absorbs, where the other is a nuisance."""
    cosine: float | None = field(default=None, metadata=LEFT_OUT)
    """How much their fields agree, calibration projected out."""


@dataclass(frozen=True, eq=False, slots=True)
class Untestable:
    """An effect that these data cannot show."""

    name: str
    absorbed_share: Number = NAN
    """Share of its field that is absorbed by calibration."""
    retained_share: Number = NAN
    """Share that is left; the squares of the two add up to 1."""


@dataclass(frozen=True, eq=False, slots=True)
class Detectable:
    """The smallest size of an effect that would have been seen."""

    smallest: Mapping[str, float | None] = field(default_factory=dict)
    """Label of a parameter → size in `unit`, as `kind` says; empty where the effect is there as a whole or not."""
    would_be_seen: bool = True
    """Whether any plausible size would be."""
    kind: str | None = field(default=None, metadata=LEFT_OUT)
    """"change", "factor" or "softer_than"."""
    unit: str | None = field(default=None, metadata=LEFT_OUT)
    share_seen: float | None = field(default=None, metadata=LEFT_OUT)
    """Share of the whole that would be seen."""


@dataclass(frozen=True, eq=False, slots=True)
class Correlation:
    """Spearman's correlation of a number a frame with a covariate."""

    covariate: str
    rank_correlation: Number = NAN
    p_value: Number = NAN
    p_holm: Number = NAN
    """Adjusted after Holm (1979)."""


@dataclass(frozen=True, eq=False, slots=True)
class FrameError:
    """A frame and what is left in it."""

    recording: int = 0
    frame: int | None = None
    rms_m: Number = NAN


@dataclass(frozen=True, eq=False, slots=True)
class WorstMarker:
    """The marker with most of what is left."""

    marker: str = ""
    position_m: Vector = ()
    """On the body at rest [m], (3,)."""
    mean_residual_m: Vector = ()
    """[m], (3,)."""
    direction: Vector = ()
    """The direction that holds most of its mean square, (3,); its sign is that of the mean."""
    direction_share: Number = NAN
    """How much it holds."""


@dataclass(frozen=True, eq=False, slots=True)
class Structure:
    """Tests for structure in a residual; p-values as they are, not adjusted."""

    lag_one: Number = NAN
    """Correlation of neighbouring states."""
    p_value: Number = NAN
    """The smallest of all tests."""
    tests: Mapping[str, Number] = field(default_factory=dict)
    """Test → p-value: neighbouring states alike, one pattern in many states, one sweep apart."""
    significant: bool | None = None
    """Whether any test stands after Holm's adjustment."""


@dataclass(frozen=True, eq=False, slots=True)
class Left:
    """What is left of the residual at the end: how large, where on the body, in which frames, which way, and what it goes with."""

    rms_m: Number = NAN
    marker_rms_m: Mapping[str, Number] = field(default_factory=dict)
    where: WorstMarker = field(default_factory=WorstMarker)
    worst_frame: FrameError = field(default_factory=FrameError)
    worst_frames: tuple[FrameError, ...] = ()
    half_in_frames: Number = NAN
    """Share of the frames, the worst first, that hold half of the mean square."""
    goes_with: tuple[Correlation, ...] = ()
    held_out: bool = False
    """Whether it is that of held-out data, which alone show it."""
    structure: Structure = field(default_factory=Structure)
    explained_share: Number = NAN
    """Share of the mean square beyond the noise that the effects took away."""


@dataclass(frozen=True, eq=False, slots=True)
class ModelError:
    """What the held-out error consists of: the model's own error is what is left beyond noise, placements and discretisation, in squares.

    Root mean squares [m] over all axes of a marker; where there are only clouds, along their normals.
    """

    fitted_m: Number = NAN
    """The model's own error where it is fitted, with all that was found."""
    held_out_m: Number = NAN
    """That of the model that is handed back, on held-out data."""
    noise_m: Number = NAN
    """What a point repeats to."""
    noise_is_measured: bool = True
    """Whether that is declared or measured, not assumed."""
    noise_source: str = ""
    """Where it comes from, in words."""
    placement_m: Number = NAN
    """How far markers are likely to sit from where they are declared."""
    discretisation_m: float | None = None
    """Discretisation error; None where it is not known."""
    discretisation_note: str = ""
    """Why it is not known; empty where it is."""


@dataclass(frozen=True, eq=False, slots=True)
class CorrectionRecord:
    """An empirical correction: how far markers are from the model as a function of the inputs. It is no cause."""

    accepted: bool = False
    """Whether held-out markers are predicted better with it."""
    verdict: str = ""
    """Why, in words."""
    validation_rms_before_m: float | None = None
    """Error of the markers on held-out data without it [m]."""
    validation_rms_after_m: float | None = None
    """The same with it [m]."""
    largest_input: float | None = None
    """Largest input of held-out data, in its range where the correction was learned."""
    kernel: str | None = None
    length: float | None = None
    """Of the kernel, in ranges of an input."""
    terms: int | None = None
    noise_m: float | None = None
    """What it leaves of a marker along each axis where it is fitted [m]."""


@dataclass(frozen=True, eq=False, slots=True)
class CloudCard:
    """What was used of clouds."""

    frames: tuple[int, ...] = ()
    """Frames of each recording."""
    rows: tuple[int, ...] = ()
    """Rows of each recording."""
    points_m: Mapping[str, Triple] = field(default_factory=dict)
    """Name of a point of the surface → its place at rest [m], (3,)."""
    noise_components_m: Mapping[str, Number] = field(default_factory=dict)
    noise_m: Number = NAN


@dataclass(frozen=True, eq=False, slots=True)
class Outlier:
    """A marker in a frame that is left out."""

    frame: int
    marker: str = ""


@dataclass(frozen=True, eq=False, slots=True)
class DataCard:
    """What the data are and how they were split."""

    recordings: tuple[str | None, ...] = ()
    split: tuple[str, ...] = ()
    """How each recording was split, in words."""
    frames_fitted: tuple[tuple[int, ...], ...] = ()
    frames_held_out: tuple[tuple[int, ...], ...] = ()
    measured: tuple[str, ...] = ("markers",)
    """"markers", "clouds" or both."""
    clouds: CloudCard | None = None
    noise_components_m: Mapping[str, Number] = field(default_factory=dict)
    noise_source: str = ""
    mesh_error_m: float | None = None
    """Discretisation error [m], root mean square; None where it is not known."""
    outliers: tuple[Outlier, ...] = ()
    effective_observations: Number = NAN
    nuisance_after: Mapping[str, Mapping[str, Value]] = field(default_factory=dict)
    """What calibration moves → its values beside all effects."""
    placement_std_m: Number = NAN
    """How well markers are placed [m]."""
    seed: int | None = field(default=None, metadata=LEFT_OUT)
    """Of the random numbers."""


@dataclass(frozen=True, eq=False, slots=True)
class AllRecordings:
    """What all recordings say of a model that was sought in some of them: errors of the markers, root mean squares [m]."""

    recordings: int = 0
    searched: int = 0
    """Recordings in which effects were sought."""
    before_train_rms_m: Number = NAN
    """Of the declared model, the camera of each recording calibrated."""
    before_validation_rms_m: Number = NAN
    """On held-out sweeps."""
    after_train_rms_m: Number = NAN
    """Of the fitted model."""
    after_validation_rms_m: Number = NAN
    dbic: Mapping[str, float] = field(default_factory=dict)
    """Effect that the model lacks → linear dBIC of its best form in all recordings."""


@dataclass(frozen=True, eq=False, slots=True)
class Residuals(Columns):
    """Held-out residuals, one row for each measured point, as columns of equal length."""

    recording: tuple[int, ...] = ()
    frame: tuple[int, ...] = ()
    marker: tuple[str, ...] = ()
    before_m: tuple[Triple, ...] = ()
    """Of the declared model, calibrated [m], (k, 3)."""
    after_m: tuple[Triple, ...] = ()
    """Of the model that is handed back [m], (k, 3)."""

    def known(self) -> Residuals:
        """Return the rows that are finite before and after."""
        whole = [i for i, pair in enumerate(zip(self.before_m, self.after_m)) if np.isfinite(pair).all()]
        return Residuals(*(tuple(getattr(self, f.name)[i] for i in whole) for f in fields(self)))


@dataclass(frozen=True, eq=False, slots=True)
class InputFile:
    """A robot or a recording that a result was made from."""

    name: str | None = None
    path: str | None = None
    sha256: str | None = None


@dataclass(frozen=True, eq=False, slots=True)
class LoopInputs:
    """What a loop was made from."""

    robot: InputFile = field(default_factory=InputFile)
    recordings: tuple[InputFile, ...] = ()
    validation: tuple[InputFile, ...] = ()
