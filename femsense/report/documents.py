"""What loop.json and run.json hold, as far as a report shows it. What is missing is left out; a wrong type is an InputError."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar

from pydantic import ConfigDict, Field, model_validator

from femsense.core.errors import InputError
from femsense.core.text import short
from femsense.io.tables import Schema, read_text, validated

Number = float | None
Pair = Annotated[list[str], Field(min_length=2, max_length=2)]
Triple = Annotated[list[Number], Field(min_length=3, max_length=3)]


class Document(Schema):
    """Other keys than those named are left alone; null and NaN stand for what is not known."""

    model_config = ConfigDict(extra="ignore", strict=True, frozen=True, allow_inf_nan=True)


DocumentType = TypeVar("DocumentType", bound=Document)


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


class Covariate(Document):
    covariate: str
    rank_correlation: Number = None
    p_value: Number = None
    p_holm: Number = None


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


class Structure(Document):
    lag_one: Number = None
    p_value: Number = None
    tests: dict[str, Number] = Field(default_factory=dict)
    significant: bool | None = None


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


class Table(Document):
    """Columns of equal length."""

    @model_validator(mode="after")
    def _even(self) -> Self:
        counts = {len(column) for name in type(self).model_fields if isinstance(column := getattr(self, name), list)}
        if len(counts) > 1:
            raise ValueError("the columns differ in length")
        return self


class Frames(Table):
    recording: list[int] = Field(default_factory=list)
    frame: list[int] = Field(default_factory=list)
    sweep: list[str] = Field(default_factory=list)
    held_out: list[bool] = Field(default_factory=list)
    actuation: list[Number] = Field(default_factory=list)
    unloading: list[bool] = Field(default_factory=list)
    before_rms_m: list[Number] = Field(default_factory=list)
    after_rms_m: list[Number] = Field(default_factory=list)
    score_before_m: list[Number] = Field(default_factory=list)
    score_after_m: list[Number] = Field(default_factory=list)


class Score(Document):
    share: Number = None
    goes_with_before: list[Covariate] = Field(default_factory=list)
    goes_with_after: list[Covariate] = Field(default_factory=list)
    covariate: str | None = None
    covariate_values: list[Number] = Field(default_factory=list)


class Tip(Document):
    marker: str = ""
    direction: list[Number] = Field(default_factory=list)
    recording: list[int] = Field(default_factory=list)
    frame: list[int] = Field(default_factory=list)
    measured_m: list[Number] = Field(default_factory=list)
    before_m: list[Number] = Field(default_factory=list)
    after_m: list[Number] = Field(default_factory=list)


class Snapshot(Document):
    title: str
    frame: int
    measured_m: list[Triple]
    before_m: list[Triple]
    after_m: list[Triple]
    nodes_m: list[Triple] | None = None


class CameraAxis(Document):
    axis: Triple


class Pictures(Document):
    triangles: list[Annotated[list[int], Field(min_length=3, max_length=3)]] | None = None
    frames: list[Snapshot] = Field(default_factory=list)
    cameras: list[CameraAxis] = Field(default_factory=list)


class Estimate(Document):
    label: str
    value: Number = None
    std: Number = None
    ends: list[Number] = Field(default_factory=list)
    unit: str = "1"


class Ranked(Document):
    parameters: list[Estimate] = Field(default_factory=list)
    first_share: Number = None


class Confounding(Document):
    names: list[str] = Field(default_factory=list)
    share: list[list[Number]] = Field(default_factory=list)


class PoseShift(Document):
    recording: int = 0
    camera: int = 0
    turn_rad: dict[str, Triple] = Field(default_factory=dict)
    shift_m: dict[str, Triple] = Field(default_factory=dict)
    turn_std_rad: dict[str, Triple] = Field(default_factory=dict)
    shift_std_m: dict[str, Triple] = Field(default_factory=dict)


class InputShift(Document):
    recording: int = 0
    cable: str
    unit: str = "1"
    values: dict[str, list[Number]] = Field(default_factory=dict)


class TermShift(Document):
    label: str
    unit: str = "1"
    declared: Number = None
    values: dict[str, list[Number]] = Field(default_factory=dict)


class CalibrationShift(Document):
    poses: list[PoseShift] = Field(default_factory=list)
    initial_inputs: list[InputShift] = Field(default_factory=list)
    parameters: list[TermShift] = Field(default_factory=list)


class LackOfFit(Document):
    f: Number = None
    p_value: Number = None
    df_lack: int | None = None
    df_pure: int | None = None
    pure_error_m: Number = None


class Tested(Document):
    structure: Structure = Structure()
    lack_of_fit: LackOfFit | None = None
    train_rms_m: Number = None


class Tests(Document):
    before: Tested = Tested()
    after: Tested = Tested()


class Size(Document):
    label: str = ""
    kind: str = "change"
    size: Number = None
    unit: str = "1"


class LoadRow(Document):
    recording: int = 0
    frame: int
    held_out: bool = False
    declared_n: Number = None
    before_n: Number = None
    before_std_n: Number = None
    after_n: Number = None
    after_std_n: Number = None


class Softer(Document):
    title: str = ""
    frame: int
    ratio: list[Number] = Field(default_factory=list)
    phantom_before_n: Number = None
    phantom_after_n: Number = None


class Compliance(Document):
    frames: list[Softer] = Field(default_factory=list)


class Forces(Document):
    loads: list[LoadRow] = Field(default_factory=list)
    compliance: Compliance = Compliance()


class ForceField(Document):
    recording: int = 0
    frame: int | None = None
    points_m: list[Triple] = Field(default_factory=list)
    forces_n: list[Triple] = Field(default_factory=list)
    total_n: list[Number] = Field(default_factory=list)
    explained_share: Number = None


class Evidence(Document):
    """What the figures need."""

    frames: Frames = Frames()
    score: Score = Score()
    tip: Tip = Tip()
    pictures: Pictures = Pictures()
    ranking: dict[str, Ranked] = Field(default_factory=dict)
    confounding: Confounding = Confounding()
    calibration: CalibrationShift = CalibrationShift()
    tests: Tests = Tests()
    power: dict[str, list[Size]] = Field(default_factory=dict)
    excluded: list[dict[str, list[int]]] = Field(default_factory=list)
    repeats: int | None = None
    forces: Forces = Forces()
    equivalent_forces: ForceField = ForceField()


class Input(Document):
    name: str | None = None
    path: str | None = None
    sha256: str | None = None


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


class Loop(Document):
    """loop.json."""

    verdict: str = ""
    sentence: str = ""
    noise_m: Number = None
    before: Errors = Errors()
    after: Errors = Errors()
    effects: list[Effect] = Field(default_factory=list)
    candidates: list[Candidate] = Field(default_factory=list)
    confounded: list[Confounded] = Field(default_factory=list)
    next_experiment: str = ""
    not_testable: list[Untestable] = Field(default_factory=list)
    detectable: dict[str, Detectable] = Field(default_factory=dict)
    left: Left = Left()
    model_error: ModelError = ModelError()
    data: Card = Card()
    residuals: Residuals = Residuals()
    evidence: Evidence | None = None
    inputs: LoopInputs = LoopInputs()
    versions: dict[str, str] = Field(default_factory=dict)


class KnownLoad(Document):
    frame: int
    declared_n: Number = None
    sensed_n: Number = None
    error_percent: Number = None


class RunInputs(Document):
    robot: Input = Input()
    recording: Input = Input()


class Timing(Document):
    seconds: Number = None
    ms_per_frame_median: Number = None


class RunFacts(Document):
    """run.json."""

    robot: str = ""
    frames: int = 0
    frames_ok: int = 0
    contacts: int = 0
    known_loads: list[KnownLoad] = Field(default_factory=list)
    inputs: RunInputs = RunInputs()
    timing: Timing = Timing()
    versions: dict[str, str] = Field(default_factory=dict)


class DemoRun(Document):
    force_error_n: Number = None
    force_error_share: Number = None
    place_error_m: Number = None
    contacts_found: int | None = None
    contacts_true: int | None = None
    contacts_false: int | None = None


class Demo(Document):
    """demo.json."""

    declared: DemoRun = DemoRun()
    improved: DemoRun = DemoRun()


def _finite(value: Number) -> bool:
    return value is not None and math.isfinite(value)


def read_document(file: Path, schema: type[DocumentType], expected: str) -> DocumentType:
    """Return a checked JSON document of a format.

    Arguments:
        file: the document.
        schema: what it holds.
        expected: its `format`.

    Raises:
        InputError: not readable, not JSON, another format, or a key of the wrong type; with the key and what was found.
    """
    document = read_json(file, f"a file of format {expected}")
    if document.get("format") != expected:
        raise InputError(
            "another kind of file", where=f"{file}: format", found=short(document.get("format")), expected=repr(expected)
        )
    return validated(schema, document, file)


def read_json(file: Path, expected: str) -> dict[str, Any]:
    """Return a JSON object; `expected` says what the file should be. Raises InputError."""
    try:
        document = json.loads(read_text(file))
    except ValueError as error:
        raise InputError("not valid JSON", where=file, found=error, expected=expected) from None
    if not isinstance(document, dict):
        raise InputError("another kind of file", where=file, found=short(document), expected=expected)
    return document
