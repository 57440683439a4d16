"""What run.json and demo.json hold, as far as a report shows it.

What is missing is left out; a wrong type is an InputError.
"""

from __future__ import annotations

from pydantic import ConfigDict, Field

from femsense.io.tables import Schema

Number = float | None


class Document(Schema):
    """Other keys than those named are left alone; null and NaN stand for what is not known."""

    model_config = ConfigDict(extra="ignore", strict=True, frozen=True, allow_inf_nan=True)


class Input(Document):
    name: str | None = None
    path: str | None = None
    sha256: str | None = None


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
