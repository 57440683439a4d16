"""What loop.json holds, as far as a report shows it; its figures are in `evidence`."""

from __future__ import annotations

import math
from typing import Any, Self

from pydantic import Field, model_validator

from femsense.report.documents import Document, Input, Number, Pair, Triple
from femsense.report.loop.evidence import Covariate, Evidence, Structure


class Errors(Document):
    train_rms_m: Number = None
    validation_rms_m: Number = None
    validation_ci_m: list[Number] | None = None
    train_normal_rms_m: Number = None
    validation_normal_rms_m: Number = None
    validation_normal_ci_m: list[Number] | None = None


class Parameter(Document):
    value: Any = None
    std: Any = None
    unit: str | None = None


class Effect(Document):
    name: str
    parameters: dict[str, Parameter] = Field(default_factory=dict)
    validation_rms_before_m: Number = None
    validation_rms_after_m: Number = None


class Refit(Document):
    dchi2: Number = None
    dbic: Number = None
    validation_rms_m: Number = None
    cv_gain: Number = None
    cv_std: Number = None
    verdict: str = ""


class Candidate(Document):
    name: str
    dchi2: Number = None
    dbic: Number = None
    retained_share: Number = None
    dbic_at_end: Number = None
    refits: list[Refit] = Field(default_factory=list)
    verdict: str = ""


class Confounded(Document):
    pair: Pair
    dbic_gap: Number = None
    absorbed_share: Number = None
    cosine: Number = None


class Untestable(Document):
    name: str
    absorbed_share: Number = None
    retained_share: Number = None


class Detectable(Document):
    smallest: dict[str, Number] = Field(default_factory=dict)
    kind: str = "change"
    unit: str = "1"
    would_be_seen: bool | None = None


class Where(Document):
    marker: str = ""
    position_m: list[Number] | None = None
    mean_residual_m: list[Number] | None = None
    direction: list[Number] | None = None
    direction_share: Number = None


class WorstFrame(Document):
    recording: int = 0
    frame: int | None = None
    rms_m: Number = None


class Left(Document):
    rms_m: Number = None
    marker_rms_m: dict[str, Number] = Field(default_factory=dict)
    where: Where = Where()
    worst_frame: WorstFrame = WorstFrame()
    worst_frames: list[WorstFrame] = Field(default_factory=list)
    held_out: bool = False
    half_in_frames: Number = None
    explained_share: Number = None
    goes_with: list[Covariate] = Field(default_factory=list)
    structure: Structure = Structure()


class Clouds(Document):
    frames: list[int] = Field(default_factory=list)
    rows: list[int] = Field(default_factory=list)
    noise_components_m: dict[str, Number] = Field(default_factory=dict)
    noise_m: Number = None
    points_m: dict[str, Triple] = Field(default_factory=dict)


class Outlier(Document):
    frame: int
    marker: str = ""


class Card(Document):
    measured: list[str] = Field(default_factory=lambda: ["markers"])
    clouds: Clouds | None = None
    recordings: list[str | None] = Field(default_factory=list)
    split: list[str] = Field(default_factory=list)
    frames_fitted: list[list[int]] = Field(default_factory=list)
    frames_held_out: list[list[int]] = Field(default_factory=list)
    outliers: list[Outlier] = Field(default_factory=list)
    noise_components_m: dict[str, Number] = Field(default_factory=dict)
    noise_source: str = ""
    mesh_error_m: Number = None
    effective_observations: Number = None
    nuisance_after: dict[str, dict[str, Parameter]] = Field(default_factory=dict)
    placement_std_m: Number = None
    seed: int | None = None


class Residuals(Document):
    recording: list[int] = Field(default_factory=list)
    frame: list[int] = Field(default_factory=list)
    marker: list[str] = Field(default_factory=list)
    before_m: list[Triple] = Field(default_factory=list)
    after_m: list[Triple] = Field(default_factory=list)

    @model_validator(mode="after")
    def _even(self) -> Self:
        counts = {len(column) for column in (self.frame, self.marker, self.before_m, self.after_m)}
        if len(counts) > 1 or (self.recording and len(self.recording) not in counts):
            raise ValueError("the columns differ in length")
        return self

    def known(self) -> Self:
        """Return the rows that are finite before and after."""
        keep = [i for i, values in enumerate(zip(self.before_m, self.after_m)) if all(map(_finite, [*values[0], *values[1]]))]
        columns = {name: [column[i] for i in keep] if (column := getattr(self, name)) else [] for name in type(self).model_fields}
        return self.model_copy(update=columns)


def _finite(value: Number) -> bool:
    return value is not None and math.isfinite(value)


class LoopInputs(Document):
    robot: Input = Input()
    recordings: list[Input] = Field(default_factory=list)
    validation: list[Input] = Field(default_factory=list)


class ModelError(Document):
    fitted_m: Number = None
    held_out_m: Number = None
    noise_m: Number = None
    noise_is_measured: bool = True
    noise_source: str = ""
    placement_m: Number = None
    discretisation_m: Number = None
    discretisation_note: str = ""


class Corrected(Document):
    """An empirical correction that was asked for."""

    accepted: bool = False
    verdict: str = ""
    validation_rms_before_m: Number = None
    validation_rms_after_m: Number = None


class Loop(Document):
    """loop.json."""

    verdict: str = ""
    sentence: str = ""
    noise_m: Number = None
    before: Errors = Errors()
    after: Errors = Errors()
    effects: list[Effect] = Field(default_factory=list)
    fitted_along: dict[str, dict[str, Parameter]] = Field(default_factory=dict)
    candidates: list[Candidate] = Field(default_factory=list)
    confounded: list[Confounded] = Field(default_factory=list)
    next_experiment: str = ""
    not_testable: list[Untestable] = Field(default_factory=list)
    detectable: dict[str, Detectable] = Field(default_factory=dict)
    left: Left = Left()
    model_error: ModelError = ModelError()
    correction: Corrected | None = None
    data: Card = Card()
    residuals: Residuals = Residuals()
    evidence: Evidence | None = None
    inputs: LoopInputs = LoopInputs()
    versions: dict[str, str] = Field(default_factory=dict)
