"""The script of a virtual experiment (`femsense-script-1`): what is pulled when, what touches, what the truth has, what is seen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from femsense.core.errors import InputError
from femsense.core.text import did_you_mean, key_path
from femsense.io.robot_tables import Matrix, Share, Vector
from femsense.io.tables import Schema, read_toml, validated
from femsense.rig.sensors import SensorTable

FORMAT = "femsense-script-1"
COLOR = "three numbers from 0 to 1: [red, green, blue]"
PLACE = "three numbers in metres [x, y, z], on the surface at rest, robot frame"
Color = Annotated[list[Share], Field(min_length=3, max_length=3)]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Count = Annotated[int, Field(ge=0)]


class SweepTable(Schema):
    """One excursion from rest and back."""

    label: Annotated[str, Field(min_length=1, description="a label, each sweep its own")]
    cables: dict[str, float | list[float]] = Field(
        {}, description="cable → its value at the height of the sweep [N or m], or a list with one value a frame"
    )
    chambers: dict[str, float | list[float]] = Field(
        {}, description="chamber → its pressure at the height of the sweep [Pa], or a list with one value a frame"
    )
    rest: Count = Field(0, description="frames at rest before the sweep, ≥ 0")
    up: Count = Field(3, description="frames on the way up, the height included, ≥ 0")
    hold: Count = Field(0, description="frames at the height, ≥ 0")
    down: Count = Field(3, description="frames on the way down, rest included, ≥ 0")
    levels: list[float] | None = Field(None, description="one factor a frame, in place of rest, up, hold and down")
    dt_s: Positive | None = Field(None, description="time from frame to frame [s], > 0")
    free: bool | None = Field(None, description="true: nothing undeclared touches; by default false where a contact acts")
    gravity_m_s2: Vector | None = Field(None, description="gravity in the robot frame during this sweep [m/s²]")

    def profile(self) -> list[float]:
        """Return the factor of each frame."""
        if self.levels is not None:
            return list(self.levels)
        rise = [(i + 1) / self.up for i in range(self.up)]
        fall = [1.0 - (i + 1) / self.down for i in range(self.down)]
        return [0.0] * self.rest + rise + [1.0] * self.hold + fall


class ContactTable(Schema):
    """Something that presses on the body and is not declared in the recording."""

    sweep: str = Field(description="label of the sweep in which it acts")
    point_m: Vector = Field(description=PLACE)
    force_n: NotNegative | list[NotNegative] = Field(
        description="newton, one number or one a frame of the sweep, ≥ 0; at 0 it does not touch"
    )
    direction: Vector | None = Field(None, description="direction of the force; by default into the surface, as it turns")
    radius_m: Positive = Field(0.006, description="the force is spread over the surface within this distance [m], > 0")
    probe: Literal["sphere", "cylinder"] = Field("sphere", description='what the camera sees: "sphere" or "cylinder"')
    probe_radius_m: Positive = Field(0.006, description="[m], > 0")


class LoadTable(Schema):
    """A known load: it stands in loads.csv."""

    sweep: str = Field(description="label of the sweep in which it acts")
    point_m: Vector = Field(description=PLACE)
    force_n: Vector | list[Vector] = Field(description="newton [x, y, z], or one such vector a frame of the sweep")


class TruthTable(Schema):
    """How the truth differs from the estimator's model beside the effects."""

    refinements: Annotated[int, Field(ge=0, le=3)] = Field(
        1, description="how often every tetrahedron is split into eight, 0 … 3"
    )
    element: Literal["tet4", "tet10"] = Field("tet10", description='"tet4" or "tet10"')
    law: Literal["corotational", "neo_hookean", "gent"] = Field(
        "neo_hookean", description='"neo_hookean", "gent" or "corotational"'
    )
    stretch_limit: Positive | None = Field(None, description="Gent's limit jm of I₁ − 3, > 0")
    substeps: Annotated[int, Field(ge=1)] = Field(3, description="steps from frame to frame, ≥ 1")

    @model_validator(mode="after")
    def _gent_needs_its_limit(self) -> TruthTable:
        if (self.law == "gent") != (self.stretch_limit is not None):
            raise ValueError('law = "gent" and stretch_limit go together')
        return self


class NoiseTable(Schema):
    """Noise of a depth image, after active stereo cameras."""

    subpixel_px: NotNegative = Field(0.08, description="error of the disparity [px], ≥ 0")
    baseline_m: Positive = Field(0.055, description="distance of the two imagers [m], > 0")
    focal_px: Positive | None = Field(None, description="focal length of the imagers [px]; by default fx")
    correlated_share: Share = Field(0.5, description="share of the variance that neighbouring pixels have in common, 0 … 1")
    correlation_px: Positive = Field(2.0, description="width of that common part [px], > 0")
    grazing_deg: Annotated[float, Field(gt=0, le=90)] = Field(
        82.0, description="surfaces seen more obliquely than this give no depth [°]"
    )
    edge_dropout: Share = Field(0.5, description="share of the pixels at depth edges that give no depth, 0 … 1")
    flying_share: Share = Field(0.05, description="share of the pixels at depth edges that fall between front and back, 0 … 1")
    quantum_m: NotNegative = Field(0.0, description="step of the depth values [m]; 0: the camera's depth_unit_m")


class ViewTable(Schema):
    """A pinhole camera and where it stands."""

    width: Annotated[int, Field(gt=0)] = Field(424, description="pixels, > 0")
    height: Annotated[int, Field(gt=0)] = Field(240, description="pixels, > 0")
    fx: Positive = Field(306.0, description="focal length in pixels, > 0")
    fy: Positive | None = Field(None, description="focal length in pixels, > 0; by default fx")
    cx: float | None = Field(None, description="pixels; by default the middle")
    cy: float | None = Field(None, description="pixels; by default the middle")
    depth_unit_m: Positive = Field(1e-4, description="metres in one unit of a depth image, > 0")
    T_robot_camera: Matrix | None = Field(None, description="4 rows of 4 numbers, in place of eye_m and target_m")
    eye_m: Vector | None = Field(None, description="where the camera stands, robot frame [m]")
    target_m: Vector | None = Field(None, description="what it looks at, robot frame [m]")
    roll_deg: float = Field(0.0, description="turn about the line of sight [°]")
    declare_pose: bool = Field(False, description="true: the recording says where the camera stands")
    noise: NoiseTable | None = Field(None, description="a table [camera.noise]; without it depth is exact")

    @model_validator(mode="after")
    def _one_pose(self) -> ViewTable:
        looks = self.eye_m is not None and self.target_m is not None
        if looks == (self.T_robot_camera is not None):
            raise ValueError("a camera stands either by eye_m and target_m or by T_robot_camera")
        return self


class MarkersTable(Schema):
    """How well markers are seen."""

    names: list[str] | None = Field(
        None, description="the markers that there are, in their order in markers.csv; by default all of the robot"
    )
    std_m: NotNegative = Field(0.0, description="noise of each coordinate of each marker in each frame [m], ≥ 0")
    frame_std_m: NotNegative = Field(
        0.0, description="noise of each coordinate that all markers of a frame have in common [m], ≥ 0"
    )
    placement_std_m: NotNegative = Field(0.0, description="how far from its place each marker is glued, each coordinate [m], ≥ 0")
    occlusion: bool = Field(True, description="true: markers that the camera cannot see have no row")
    rest_file: bool = Field(False, description="true: rest.csv holds the markers of the unloaded body")


class CloudsTable(Schema):
    """Which frames get clouds, and in which form."""

    kind: Literal["none", "ply", "depth"] = Field("none", description='"none", "ply" (clouds/) or "depth" (depth/ and color/)')
    frames: Literal["all", "contact"] = Field("all", description='"all" or "contact"')
    extra_frames: list[Count] = Field([], description="further frames, counted from 0")
    voxel_m: NotNegative = Field(0.0, description="PLY only: one point a cube of this size [m]; 0: all points")
    crop_m: Annotated[list[Vector], Field(min_length=2, max_length=2)] | None = Field(
        None, description="PLY only: two corners of a box in the robot frame [m]"
    )


class SceneTable(Schema):
    """What else is in the picture."""

    floor_z_m: float | None = Field(0.0, description="height of the floor [m]")
    floor_rgb: Color = Field([0.55, 0.53, 0.50], description=COLOR)
    probe_rgb: Color = Field([0.85, 0.30, 0.12], description=COLOR)
    robot_rgb: Color | None = Field(None, description=COLOR + "; by default the robot's appearance")


class ScriptTable(Schema):
    """A script, version femsense-script-1."""

    format: Literal["femsense-script-1"] = Field(description=f'format = "{FORMAT}"')
    seed: Count = Field(0, description="a whole number ≥ 0")
    actuation: Literal["tension", "displacement"] = Field("tension", description='"tension" [N] or "displacement" [m]')
    actuation_zero: Literal["absolute", "unknown"] = Field("absolute", description='"absolute" or "unknown"')
    initial: dict[str, float] = Field({}, description="cable → its true input before the first sweep [N or m]")
    input_std: NotNegative = Field(0.0, description="noise of the recorded inputs [N or m], ≥ 0")
    dt_s: Positive = Field(0.5, description="time from frame to frame [s], > 0")
    sweeps: Annotated[list[SweepTable], Field(min_length=1)] = Field(description="at least one [[sweeps]] with label and cables")
    contacts: list[ContactTable] = Field([], description="tables [[contacts]]")
    loads: list[LoadTable] = Field([], description="tables [[loads]]")
    truth: TruthTable = Field(default_factory=lambda: TruthTable.model_validate({}), description="a table [truth]")
    effects: list[dict[str, Any]] = Field([], description="tables [[effects]] that only the truth has")
    sensors: list[SensorTable] = Field([], description="tables [[sensors]]: sensors in the body, written to sensors.csv")
    camera: ViewTable = Field(description="a table [camera] with eye_m and target_m, or T_robot_camera")
    markers: MarkersTable = Field(default_factory=lambda: MarkersTable.model_validate({}), description="a table [markers]")
    clouds: CloudsTable = Field(default_factory=lambda: CloudsTable.model_validate({}), description="a table [clouds]")
    scene: SceneTable = Field(default_factory=lambda: SceneTable.model_validate({}), description="a table [scene]")


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
            raise script_problem("a label stands twice", where, ("sweeps", i, "label"), repr(label), "each sweep its own label")
    named = [("contacts", i, table.sweep) for i, table in enumerate(script.contacts)]
    named += [("loads", i, table.sweep) for i, table in enumerate(script.loads)]
    for kind, i, label in named:
        if label not in labels:
            raise script_problem(
                "no such sweep", where, (kind, i, "sweep"), repr(label), ", ".join(labels), did_you_mean(label, labels)
            )
    for i, sweep in enumerate(script.sweeps):
        _check_sweep(sweep, i, where)
    return script


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
    return InputError(what, where=f"{where}: {key_path(location)}", found=found, expected=expected, hint=hint)
