"""What run.json and demo.json hold, as far as a report shows it."""

from __future__ import annotations

from pydantic import Field

from femsense.report.documents import Document, Input, Number


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
