"""The script of a virtual experiment (`femsense-script-1`): inputs, contacts, ground truth and measurements."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from femsense.core.errors import InputError
from femsense.core.text import did_you_mean, key_path
from femsense.io.tables import Color, NotNegative, Positive, Schema, Share, Vector, read_toml, validated
from femsense.rig.camera_tables import NoiseTable, ViewTable
from femsense.rig.object_tables import COLOR, PLACE, ContactTable, ObjectTable
from femsense.rig.sensors import SensorTable

__all__ = ["ContactTable", "NoiseTable", "ObjectTable", "ViewTable"]

FORMAT = "femsense-script-1"
Count = Annotated[int, Field(ge=0)]


class SweepTable(Schema):
    """Loading from rest and unloading."""

    label: Annotated[str, Field(min_length=1, description="a unique label")]
    cables: dict[str, float | list[float]] = Field(
        {}, description="input of each cable at the peak of the sweep [N or m], or a list with one value per frame"
    )
    chambers: dict[str, float | list[float]] = Field(
        {}, description="pressure of each chamber at the peak of the sweep [Pa], or a list with one value per frame"
    )
    rest: Count = Field(0, description="frames at rest before the sweep, ≥ 0")
    up: Count = Field(3, description="frames of loading, with the peak, ≥ 0")
    hold: Count = Field(0, description="frames at the peak, ≥ 0")
    down: Count = Field(3, description="frames of unloading, with the rest state, ≥ 0")
    levels: list[float] | None = Field(None, description="one factor per frame, instead of rest, up, hold and down")
    dt_s: Positive | None = Field(None, description="time between frames [s], > 0")
    free: bool | None = Field(None, description="true: contact-free; default: false if a contact acts")
    gravity_m_s2: Vector | None = Field(None, description="gravity in the robot frame during this sweep [m/s²]")

    def profile(self) -> list[float]:
        """Return the factor of each frame."""
        if self.levels is not None:
            return list(self.levels)
        rise = [(i + 1) / self.up for i in range(self.up)]
        fall = [1.0 - (i + 1) / self.down for i in range(self.down)]
        return [0.0] * self.rest + rise + [1.0] * self.hold + fall


class LoadTable(Schema):
    """A known load, written to loads.csv."""

    sweep: str = Field(description="label of the sweep in which it acts")
    point_m: Vector = Field(description=PLACE)
    force_n: Vector | list[Vector] = Field(description="force [x, y, z] [N], or one vector per frame of the sweep")


class TruthTable(Schema):
    """The model of the ground truth, apart from the effects."""

    refinements: Annotated[int, Field(ge=0, le=3)] = Field(
        1, description="number of uniform refinements (each splits every tetrahedron into eight), 0 … 3"
    )
    element: Literal["tet4", "tet10"] = Field("tet10", description='"tet4" or "tet10"')
    law: Literal["corotational", "neo_hookean", "gent"] = Field(
        "neo_hookean", description='"neo_hookean", "gent" or "corotational"'
    )
    stretch_limit: Positive | None = Field(None, description="Gent's limit jm of I₁ − 3, > 0")
    substeps: Annotated[int, Field(ge=1)] = Field(3, description="load steps between two frames, ≥ 1")

    @model_validator(mode="after")
    def _gent_needs_its_limit(self) -> TruthTable:
        if (self.law == "gent") != (self.stretch_limit is not None):
            raise ValueError('law = "gent" and stretch_limit go together')
        return self


class MotorsTable(Schema):
    """Differences between true and recorded inputs; the gain of each cable is drawn from the seed."""

    gain_std: NotNegative = Field(
        0.0, description="standard deviation of the ratio of true to recorded input, independent for each cable, ≥ 0"
    )
    backlash: NotNegative = Field(0.0, description="backlash: reversal of the motor before the cable follows [N or m], ≥ 0")


class MarkersTable(Schema):
    """Errors and visibility of the markers."""

    names: list[str] | None = Field(None, description="the markers, in their order in markers.csv; default: all of the robot")
    std_m: NotNegative = Field(
        0.0, description="noise of each coordinate of each marker in each frame, standard deviation [m], ≥ 0"
    )
    frame_std_m: NotNegative = Field(
        0.0, description="noise of each coordinate common to all markers of a frame, standard deviation [m], ≥ 0"
    )
    placement_std_m: NotNegative = Field(
        0.0, description="error of the place of each marker on the body, standard deviation of each coordinate [m], ≥ 0"
    )
    occlusion: bool = Field(True, description="true: markers hidden from the camera have no row")
    rest_file: bool = Field(False, description="true: write rest.csv with the markers of the unloaded body")


class CloudsTable(Schema):
    """The frames with clouds, and their format."""

    kind: Literal["none", "ply", "depth"] = Field("none", description='"none", "ply" (clouds/) or "depth" (depth/ and color/)')
    frames: Literal["all", "contact"] = Field("all", description='"all" or "contact"')
    extra_frames: list[Count] = Field([], description="additional frames, counted from 0")
    voxel_m: NotNegative = Field(0.0, description="PLY only: size of the voxels, one point per voxel [m]; 0: all points")
    crop_m: Annotated[list[Vector], Field(min_length=2, max_length=2)] | None = Field(
        None, description="PLY only: two corners of a box in the robot frame [m]"
    )


class SceneTable(Schema):
    """Appearance of floor, probe and robot."""

    floor_z_m: float | None = Field(0.0, description="height of the floor [m]")
    floor_rgb: Color = Field([0.55, 0.53, 0.50], description=COLOR)
    probe_rgb: Color = Field([0.85, 0.30, 0.12], description=COLOR)
    robot_rgb: Color | None = Field(None, description=COLOR + "; default: the robot's appearance")
    robot_albedo: Share = Field(0.6, description="infrared albedo of the robot, 0 … 1")
    robot_gloss: Share = Field(0.0, description="probability of a missing depth at specular reflections of the robot, 0 … 1")
    floor_albedo: Share = Field(0.6, description="infrared albedo of the floor, 0 … 1")


class ScriptTable(Schema):
    """A script, version femsense-script-1."""

    format: Literal["femsense-script-1"] = Field(description=f'format = "{FORMAT}"')
    seed: Count = Field(0, description="a whole number ≥ 0")
    actuation: Literal["tension", "displacement"] = Field("tension", description='"tension" [N] or "displacement" [m]')
    actuation_zero: Literal["absolute", "unknown"] = Field("absolute", description='"absolute" or "unknown"')
    initial: dict[str, float] = Field({}, description="true input of each cable before the first sweep [N or m]")
    input_std: NotNegative = Field(0.0, description="noise of the recorded inputs, standard deviation [N or m], ≥ 0")
    dt_s: Positive = Field(0.5, description="time between frames [s], > 0")
    sweeps: Annotated[list[SweepTable], Field(min_length=1)] = Field(description="at least one [[sweeps]] with label and cables")
    objects: list[ObjectTable] = Field([], description="tables [[objects]]: objects that can touch the body")
    contacts: list[ContactTable] = Field([], description="tables [[contacts]]")
    loads: list[LoadTable] = Field([], description="tables [[loads]]")
    truth: TruthTable = Field(default_factory=lambda: TruthTable.model_validate({}), description="a table [truth]")
    effects: list[dict[str, Any]] = Field([], description="tables [[effects]] of the ground truth alone")
    motors: MotorsTable = Field(default_factory=lambda: MotorsTable.model_validate({}), description="a table [motors]")
    sensors: list[SensorTable] = Field([], description="tables [[sensors]]: sensors in the body, written to sensors.csv")
    camera: ViewTable | None = Field(None, description="a table [camera] with eye_m and target_m, or T_robot_camera")
    cameras: dict[str, ViewTable] = Field({}, description="tables [cameras.NAME] instead of [camera] for several cameras")
    markers: MarkersTable = Field(default_factory=lambda: MarkersTable.model_validate({}), description="a table [markers]")
    clouds: CloudsTable = Field(default_factory=lambda: CloudsTable.model_validate({}), description="a table [clouds]")
    scene: SceneTable = Field(default_factory=lambda: SceneTable.model_validate({}), description="a table [scene]")

    @model_validator(mode="after")
    def _one_or_several_cameras(self) -> ScriptTable:
        if (self.camera is None) == (not self.cameras):
            raise ValueError("either a table [camera] or tables [cameras.NAME]")
        return self

    @property
    def views(self) -> dict[str, ViewTable]:
        """The cameras by their names; "" for a single camera."""
        return self.cameras or ({} if self.camera is None else {"": self.camera})


def read_script(path: str | Path) -> ScriptTable:
    """Return a script after checking it. Raises InputError with file, key, what was found and what was expected."""
    file = Path(path)
    if not file.is_file():
        raise InputError("no such script", where=file, expected=f'a TOML file with format = "{FORMAT}"')
    return check_script(read_toml(file), file)


def check_script(document: dict[str, Any], where: Path = Path("script")) -> ScriptTable:
    """Return the checked script of plain tables; `where` is what messages name. Raises InputError."""
    script = validated(ScriptTable, document, where)
    labels = [sweep.label for sweep in script.sweeps]
    for i, label in enumerate(labels):
        if label in labels[:i]:
            raise script_problem("a label occurs twice", where, ("sweeps", i, "label"), repr(label), "each sweep its own label")
    named = [("contacts", i, table.sweep) for i, table in enumerate(script.contacts)]
    named += [("loads", i, table.sweep) for i, table in enumerate(script.loads)]
    for kind, i, label in named:
        if label not in labels:
            raise script_problem(
                "no such sweep", where, (kind, i, "sweep"), repr(label), ", ".join(labels), did_you_mean(label, labels)
            )
    for i, sweep in enumerate(script.sweeps):
        _check_sweep(sweep, i, where)
    _check_objects(script, where)
    return script


def _check_objects(script: ScriptTable, where: Path) -> None:
    names = [item.name for item in script.objects]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise script_problem("a name occurs twice", where, ("objects", i, "name"), repr(name), "each object its own name")
    for i, table in enumerate(script.contacts):
        if table.object is not None and table.object not in names:
            hint = did_you_mean(table.object, names)
            raise script_problem(
                "no such object", where, ("contacts", i, "object"), repr(table.object), ", ".join(names) or "[[objects]]", hint
            )
        item = next((item for item in script.objects if item.name == table.object), None)
        if table.force_n is None and (item is None or item.kind != "weight"):
            raise script_problem(
                "a required key is missing", where, ("contacts", i, "force_n"), "nothing", "newton; a weight has its own"
            )


def _check_sweep(sweep: SweepTable, i: int, where: Path) -> None:
    count = len(sweep.profile())
    if not count:
        raise script_problem("a sweep without frames", where, ("sweeps", i), repr(sweep.label), "rest, up, hold, down or levels")
    for kind, table in (("cables", sweep.cables), ("chambers", sweep.chambers)):
        for name, values in table.items():
            if isinstance(values, list) and len(values) != count:
                found, expected = f"{len(values)} values", f"{count} values, or one number"
                raise script_problem("another number of values than frames", where, ("sweeps", i, kind, name), found, expected)


def script_problem(
    what: str, where: Path, location: Sequence[int | str], found: object, expected: str, hint: str | None = None
) -> InputError:
    """Return the error of one key of a script."""
    return InputError(what, where=f"{where}: {key_path(location)}", found=found, expected=expected, hint=hint)
