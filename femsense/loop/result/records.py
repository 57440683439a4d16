"""The parts of the result of a closed loop: errors, effects, candidates, and limits of the data."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from femsense.loop.result.tables import LEFT_OUT, NAN, Columns, Number, Triple, Vector
from femsense.loop.thresholds import DEFAULTS
from femsense.model.effects import Entry

NAMED, PASSES = "named", "passes"
"""Verdicts on a refit: added to the model; passes the acceptance test, but another one was added."""


@dataclass(frozen=True, eq=False, slots=True)
class Errors:
    """Errors of a model: of the markers, and along the normals of the clouds; without markers both are those of the clouds."""

    train_rms_m: Number = NAN
    """Of the fitted data [m]."""
    validation_rms_m: Number = NAN
    """Of the held-out data [m]."""
    validation_ci_m: Vector = ()
    """Its 95 % interval [m]."""
    validation_ci_by: str = ""
    """Units of the bootstrap: "sweeps" or "frames"."""
    train_normal_rms_m: float | None = field(default=None, metadata=LEFT_OUT)
    """Along the normals of the clouds [m]; None without clouds."""
    validation_normal_rms_m: float | None = field(default=None, metadata=LEFT_OUT)
    validation_normal_ci_m: Vector | None = field(default=None, metadata=LEFT_OUT)


@dataclass(frozen=True, eq=False, slots=True)
class Value:
    """One key of an effect. Vectors and tables keep their shape."""

    value: Any = None
    """In `unit`."""
    std: Any = None
    """Standard deviation of each number, in the same shape; None: not fitted."""
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
    """The result of refitting a candidate jointly with the whole model."""

    name: str
    seed: Entry = field(default_factory=dict)
    """Numbers that were selected, not fitted: a place, a radius, a time."""
    verdict: str = ""
    """NAMED, PASSES, or the reason of the rejection."""
    step: int | None = field(default=None, metadata=LEFT_OUT)
    """Number of the model that it extends."""
    in_place_of: str | None = field(default=None, metadata=LEFT_OUT)
    """The effect that it was tried in place of; None: in addition to all."""
    dchi2: float | None = field(default=None, metadata=LEFT_OUT)
    """Decrease of χ²."""
    dbic: float | None = field(default=None, metadata=LEFT_OUT)
    """Decrease of χ² minus the penalty."""
    validation_rms_m: float | None = field(default=None, metadata=LEFT_OUT)
    """Held-out error with it [m]."""
    cv_gain: float | None = field(default=None, metadata=LEFT_OUT)
    """Gain in the log predictive density of left-out sweeps, times two."""
    cv_std: float | None = field(default=None, metadata=LEFT_OUT)
    """Its standard error."""
    held_dchi2: float | None = field(default=None, metadata=LEFT_OUT)
    """Decrease of χ² on held-out data."""
    takes_over: tuple[str, ...] | None = field(default=None, metadata=LEFT_OUT)
    """Nuisance effects that are significant without it, and not with it."""
    seed_std: Vector | None = field(default=None, metadata=LEFT_OUT)
    """Standard deviation of its coordinates over seeds that fit equally well."""

    @property
    def passes(self) -> bool:
        """Whether it passes the acceptance test although another effect was added."""
        return self.verdict == PASSES

    @property
    def is_named(self) -> bool:
        """Whether it was added."""
        return self.verdict == NAMED

    @property
    def evidence(self) -> float:
        """Its dBIC; NaN if the fit was stopped early."""
        return float("nan") if self.dbic is None else self.dbic

    def answers_as(self, other: RefitRecord) -> bool:
        """Return whether both extend the same model."""
        return (self.step, self.in_place_of) == (other.step, other.in_place_of)


@dataclass(frozen=True, eq=False, slots=True)
class TriedEffect:
    """An effect that was tried, with its linear scores and its refits."""

    name: str
    seed: Entry = field(default_factory=dict)
    dchi2: float | None = None
    """Decrease of χ² by its linear step."""
    dbic: float | None = None
    retained_share: float | None = None
    """ρ, the share of its field that calibration leaves; None: not screened."""
    dbic_at_end: float | None = None
    """Linear dBIC in addition to the accepted effects."""
    refits: tuple[RefitRecord, ...] = ()
    verdict: str = ""


@dataclass(frozen=True, eq=False, slots=True)
class ConfoundedPair:
    """Two effects that these data cannot distinguish, with the evidence for that."""

    pair: tuple[str, str]
    dbic_gap: float | None = field(default=None, metadata=LEFT_OUT)
    """Difference between the dBIC of their refits."""
    absorbed_share: float | None = field(default=None, metadata=LEFT_OUT)
    """√(1 − ρ²): the share of one that calibration absorbs, if the other is a nuisance effect."""

    @property
    def is_by_model_error(self) -> bool:
        """Whether the refits differ by more than `Thresholds.evidence`: the model error that the weights include may still be the reason of the difference."""
        return self.absorbed_share is None and self.dbic_gap is not None and self.dbic_gap >= DEFAULTS.evidence


def alternatives(pairs: Iterable[ConfoundedPair], names: Collection[str]) -> dict[str, list[str]]:
    """Return for each accepted effect the others that form a pair with it."""
    found: dict[str, list[str]] = {}
    for pair in pairs:
        for own, other in (pair.pair, pair.pair[::-1]):
            if own in names and other not in names:
                found.setdefault(own, []).append(other)
    return found


@dataclass(frozen=True, eq=False, slots=True)
class Untestable:
    """An effect that calibration absorbs in these data."""

    name: str
    absorbed_share: Number = NAN
    """√(1 − ρ²), the share of its field that calibration absorbs."""
    retained_share: Number = NAN
    """ρ, the share of its field that remains."""


@dataclass(frozen=True, eq=False, slots=True)
class Detectable:
    """The smallest detectable size of an effect."""

    smallest: Mapping[str, float | None] = field(default_factory=dict)
    """Label of a parameter → size in `unit`, of the given `kind`; empty for a discrete alternative."""
    would_be_seen: bool = True
    """Whether a plausible size is detectable."""
    kind: str | None = field(default=None, metadata=LEFT_OUT)
    """"change", "factor" or "softer_than"."""
    unit: str | None = field(default=None, metadata=LEFT_OUT)
    share_seen: float | None = field(default=None, metadata=LEFT_OUT)
    """Of a discrete alternative: the share of its full change that is detectable."""


@dataclass(frozen=True, eq=False, slots=True)
class Correlation:
    """Spearman's correlation of a number per frame with a covariate."""

    covariate: str
    rank_correlation: Number = NAN
    p_value: Number = NAN
    p_holm: Number = NAN
    """Adjusted after Holm (1979)."""


@dataclass(frozen=True, eq=False, slots=True)
class FrameError:
    """A frame and its rms residual."""

    recording: int = 0
    frame: int | None = None
    rms_m: Number = NAN


@dataclass(frozen=True, eq=False, slots=True)
class WorstMarker:
    """The marker with the largest residual."""

    marker: str = ""
    position_m: Vector = ()
    """On the body at rest [m], (3,)."""
    mean_residual_m: Vector = ()
    """[m], (3,)."""
    direction: Vector = ()
    """First principal direction of its residuals, (3,), with the sign of the mean."""
    direction_share: Number = NAN
    """Share of its mean square along `direction`."""


@dataclass(frozen=True, eq=False, slots=True)
class Structure:
    """Tests for structure in a residual; p-values are not adjusted."""

    lag_one: Number = NAN
    """Correlation of consecutive states."""
    p_value: Number = NAN
    """The smallest p-value of all tests."""
    tests: Mapping[str, Number] = field(default_factory=dict)
    """Test → p-value: `neighbours`, `pattern`, `sweep` (see `structure_tests`)."""
    significant: bool | None = None
    """Whether the smallest p-value is significant after Holm's adjustment."""


@dataclass(frozen=True, eq=False, slots=True)
class Left:
    """The remaining residual: its size, place, frames, direction, and correlations."""

    rms_m: Number = NAN
    marker_rms_m: Mapping[str, Number] = field(default_factory=dict)
    where: WorstMarker = field(default_factory=WorstMarker)
    worst_frame: FrameError = field(default_factory=FrameError)
    worst_frames: tuple[FrameError, ...] = ()
    half_in_frames: Number = NAN
    """Share of the frames, the worst first, that contribute half of the mean square."""
    goes_with: tuple[Correlation, ...] = ()
    held_out: bool = False
    """Whether it is the residual of the held-out data, because only these show it."""
    structure: Structure = field(default_factory=Structure)
    explained_share: Number = NAN
    """Share of the mean square beyond the noise that the effects removed."""


@dataclass(frozen=True, eq=False, slots=True)
class ModelError:
    """Decomposition of the held-out error.

        model error² = residual² − noise² − placement² − discretisation²

    All are root mean squares [m]: of the 3-D distances of markers, or, with clouds only, of the distances along the surface normal.
    """

    fitted_m: Number = NAN
    """Model error of the fitted data, with all effects that were found."""
    held_out_m: Number = NAN
    """Model error of the returned model on held-out data."""
    noise_m: Number = NAN
    """Standard deviation of repeated measurements of a point [m]."""
    noise_is_measured: bool = True
    """True if the noise is declared or measured from repetitions; False if it is an assumption."""
    noise_source: str = ""
    """Where the noise is taken from, in words."""
    placement_m: Number = NAN
    """Standard deviation of the declared marker positions."""
    discretisation_m: float | None = None
    """Discretisation error; None if unknown."""
    discretisation_note: str = ""
    """Why it is unknown; empty if it is known."""


@dataclass(frozen=True, eq=False, slots=True)
class CorrectionRecord:
    """An empirical correction: the residual of the markers as a function of the inputs. It is not a cause."""

    accepted: bool = False
    """Whether it significantly improves the prediction of held-out markers."""
    verdict: str = ""
    """The reason, in words."""
    validation_rms_before_m: float | None = None
    """Held-out error of the markers without it [m]."""
    validation_rms_after_m: float | None = None
    """Held-out error with it [m]."""
    largest_input: float | None = None
    """Largest held-out input, relative to the largest fitted one."""
    kernel: str | None = None
    length: float | None = None
    """Correlation length of the kernel, in ranges of an input."""
    terms: int | None = None
    noise_m: float | None = None
    """Residual of a marker along each axis in the fitted data [m]."""


@dataclass(frozen=True, eq=False, slots=True)
class CloudCard:
    """The cloud data that were fitted."""

    frames: tuple[int, ...] = ()
    """Number of frames of each recording."""
    rows: tuple[int, ...] = ()
    """Number of rows of each recording."""
    points_m: Mapping[str, Triple] = field(default_factory=dict)
    """Name of a surface point → its place at rest [m], (3,)."""
    noise_components_m: Mapping[str, Number] = field(default_factory=dict)
    noise_m: Number = NAN


@dataclass(frozen=True, eq=False, slots=True)
class Outlier:
    """A marker in a frame that was left out."""

    frame: int
    marker: str = ""


@dataclass(frozen=True, eq=False, slots=True)
class DataCard:
    """The data and how they were split."""

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
    """Discretisation error [m], root mean square; None if it is unknown."""
    outliers: tuple[Outlier, ...] = ()
    effective_observations: Number = NAN
    nuisance_after: Mapping[str, Mapping[str, Value]] = field(default_factory=dict)
    """Nuisance effect → its values in the final model."""
    placement_std_m: Number = NAN
    """Standard deviation of the declared marker positions [m]."""
    seed: int | None = field(default=None, metadata=LEFT_OUT)
    """Seed of the random numbers."""


@dataclass(frozen=True, eq=False, slots=True)
class AllRecordings:
    """Results in all recordings of a model that was searched for in some: rms errors of the markers [m]."""

    recordings: int = 0
    searched: int = 0
    """Number of recordings that were searched."""
    before_train_rms_m: Number = NAN
    """Of the declared model, with calibrated cameras."""
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
    """Of the returned model [m], (k, 3)."""

    def known(self) -> Residuals:
        """Return the rows that are finite before and after."""
        whole = [i for i, pair in enumerate(zip(self.before_m, self.after_m)) if np.isfinite(pair).all()]
        return Residuals(*(tuple(getattr(self, f.name)[i] for i in whole) for f in fields(self)))


@dataclass(frozen=True, eq=False, slots=True)
class InputFile:
    """A robot or a recording that a result was computed from."""

    name: str | None = None
    path: str | None = None
    sha256: str | None = None


@dataclass(frozen=True, eq=False, slots=True)
class LoopInputs:
    """The inputs of a loop."""

    robot: InputFile = field(default_factory=InputFile)
    recordings: tuple[InputFile, ...] = ()
    validation: tuple[InputFile, ...] = ()
