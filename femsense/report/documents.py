"""What loop.json and run.json hold, as far as a report shows it. What is missing is left out; a wrong type is an InputError."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar

from pydantic import ConfigDict, Field, model_validator

from femsense.errors import InputError
from femsense.tables import Schema, read_text, short, validated

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
    verdict: str = ""


class Candidate(Document):
    name: str
    dchi2: Number = None
    dbic: Number = None
    retained_share: Number = None
    dbic_at_end: Number = None
    refits: list[Refit] = Field(default_factory=list)
    verdict: str = ""


class Rivals(Document):
    pair: Pair
    dbic_gap: Number = None
    cosine: Number = None


class Untestable(Document):
    name: str
    absorbed_share: Number = None
    retained_share: Number = None


class Detectable(Document):
    smallest: dict[str, Number] = Field(default_factory=dict)
    coordinate: str = "linear"
    unit: str = "1"


class Covariate(Document):
    covariate: str
    rank_correlation: Number = None
    p_value: Number = None


class Where(Document):
    marker: str = ""
    position_m: list[Number] | None = None
    mean_residual_m: list[Number] | None = None


class WorstFrame(Document):
    frame: int | None = None
    rms_m: Number = None


class Structure(Document):
    lag_one: Number = None
    p_value: Number = None


class Left(Document):
    rms_m: Number = None
    marker_rms_m: dict[str, Number] = Field(default_factory=dict)
    where: Where = Where()
    worst_frame: WorstFrame = WorstFrame()
    goes_with: list[Covariate] = Field(default_factory=list)
    structure: Structure = Structure()


class Card(Document):
    recordings: list[str | None] = Field(default_factory=list)
    split: list[str] = Field(default_factory=list)
    frames_fitted: list[list[int]] = Field(default_factory=list)
    frames_held_out: list[list[int]] = Field(default_factory=list)
    noise_components_m: dict[str, Number] = Field(default_factory=dict)
    noise_source: str = ""
    effective_observations: Number = None
    nuisance_after: dict[str, dict[str, Parameter]] = Field(default_factory=dict)
    seat_std_m: Number = None
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


class Input(Document):
    name: str | None = None
    path: str | None = None


class LoopInputs(Document):
    robot: Input = Input()


class Loop(Document):
    """loop.json."""

    verdict: str = ""
    sentence: str = ""
    noise_m: Number = None
    before: Errors = Errors()
    after: Errors = Errors()
    effects: list[Effect] = Field(default_factory=list)
    candidates: list[Candidate] = Field(default_factory=list)
    confounded: list[Rivals] = Field(default_factory=list)
    next_experiment: str = ""
    not_testable: list[Untestable] = Field(default_factory=list)
    detectable: dict[str, Detectable] = Field(default_factory=dict)
    left: Left = Left()
    data: Card = Card()
    residuals: Residuals = Residuals()
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
