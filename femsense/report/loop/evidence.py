"""What the figures of a loop need: the part `evidence` of loop.json."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from femsense.core.arrays import FloatArray
from femsense.report.documents import Document, Number, Table, Triple
from femsense.report.words import known


class Covariate(Document):
    covariate: str
    rank_correlation: Number = None
    p_value: Number = None
    p_holm: Number = None


class Structure(Document):
    lag_one: Number = None
    p_value: Number = None
    tests: dict[str, Number] = Field(default_factory=dict)
    significant: bool | None = None


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

    def camera_axes(self) -> list[FloatArray]:
        """Return the unit vectors along which cameras look, robot frame, shape (3,) each."""
        return [np.asarray(c.axis, float) for c in self.cameras if all(map(known, c.axis))]


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
