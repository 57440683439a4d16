"""Contacts in a script: objects, and contacts that follow a path."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from femsense.io.robot_tables import Share, Vector
from femsense.io.tables import Schema

COLOR = "three numbers from 0 to 1: [red, green, blue]"
PLACE = "three numbers in metres [x, y, z], on the surface at rest, robot frame"
Color = Annotated[list[Share], Field(min_length=3, max_length=3)]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
KEYS: dict[str, set[str]] = {
    "ball": {"radius_m", "stick_m"},
    "rod": {"radius_m", "length_m"},
    "plate": {"size_m", "stick_m"},
    "box": {"size_m"},
    "mesh": {"mesh", "unit"},
    "weight": {"radius_m", "stick_m", "mass_kg"},
}
"""Keys of the shape of each kind."""
NEEDED = {"plate": {"size_m"}, "box": {"size_m"}, "mesh": {"mesh", "unit"}, "weight": {"mass_kg"}}


class ObjectTable(Schema):
    """An object that can touch the body. Its contact point is its lowest point; its z axis points away from the body."""

    name: Annotated[str, Field(min_length=1, description="a name, each object its own")]
    kind: Literal["ball", "rod", "plate", "box", "mesh", "weight"] = Field(
        description=(
            '"ball" or "plate" on a stick, "rod" that lies across, "box", "mesh", or "weight" on a stick that stands on the body'
        )
    )
    radius_m: Positive = Field(0.008, description="of a ball, of a rod, or of the tip of a weight's stick [m], > 0")
    length_m: Positive = Field(0.15, description="of a rod [m], > 0")
    size_m: Vector | None = Field(None, description="of a plate or box: along its x, its y, and its thickness [m]")
    stick_m: NotNegative = Field(0.12, description="length of the stick of a ball, plate or weight [m]; 0: none")
    mesh: str | None = Field(None, description="of a mesh: a closed surface in a file beside the script")
    unit: Literal["m", "cm", "mm"] | None = Field(None, description='of a mesh: "m", "cm" or "mm"')
    mass_kg: Positive | None = Field(None, description="of a weight [kg], > 0")
    color_rgb: Color = Field([0.85, 0.30, 0.12], description=COLOR)
    albedo: Share = Field(0.5, description="what it sends back of infrared light, 0 … 1; black foam 0.03, white paper 0.9")
    gloss: Share = Field(0.0, description="how likely a depth is lost where it gleams, 0 … 1")
    declared: bool = Field(False, description="true: it stands in [[tools]] of the recording (ball, rod or mesh)")

    @model_validator(mode="after")
    def _form_fits_kind(self) -> ObjectTable:
        form = {key for keys in KEYS.values() for key in keys}
        strange = sorted((self.model_fields_set & form) - KEYS[self.kind])
        missing = sorted(key for key in NEEDED.get(self.kind, set()) if getattr(self, key) is None)
        if strange or missing:
            raise ValueError(f"a {self.kind} has {', '.join(sorted(KEYS[self.kind]))}")
        if self.size_m is not None and min(self.size_m) <= 0:
            raise ValueError("size_m has three numbers above 0")
        if self.declared and self.kind not in ("ball", "rod", "mesh"):
            raise ValueError(f"a {self.kind} cannot stand in [[tools]]: a ball, a rod or a mesh can")
        return self


class ContactTable(Schema):
    """An undeclared contact on the body."""

    sweep: str = Field(description="label of the sweep in which it acts")
    point_m: Vector | None = Field(None, description=PLACE)
    path_m: Annotated[list[Vector], Field(min_length=2)] | None = Field(
        None, description="in place of point_m: places along which it slides, evenly over the frames of the sweep [m]"
    )
    force_n: NotNegative | list[NotNegative] | None = Field(
        None,
        description="newton, one number or one a frame of the sweep, ≥ 0; at 0 it does not touch; by default the weight of a weight",
    )
    direction: Vector | None = Field(None, description="direction of the force; by default into the surface, as it turns")
    tangent: NotNegative | list[NotNegative] = Field(
        0.0, description="force along the surface over force into it, one number or one a frame of the sweep, ≥ 0"
    )
    tangent_direction: Vector | None = Field(
        None, description="where the force along the surface points; by default along path_m"
    )
    radius_m: Positive | None = Field(
        None,
        description="the force is spread over the surface within this distance [m], > 0; by default as the object presses, else 0.006",
    )
    object: str | None = Field(None, description="name of what touches, one of [[objects]]; else a probe")
    along: Vector | None = Field(
        None, description="where the object's x axis points (a rod lies along it); by default along path_m"
    )
    away_m: NotNegative | list[NotNegative] | None = Field(
        None,
        description="distance from the surface in frames without force [m], one number or one a frame; by default it is gone",
    )
    shown: bool = Field(True, description="false: the camera does not see what touches")
    probe: Literal["sphere", "cylinder"] = Field("sphere", description='what the camera sees: "sphere" or "cylinder"')
    probe_radius_m: Positive = Field(0.006, description="[m], > 0")

    @model_validator(mode="after")
    def _one_place(self) -> ContactTable:
        if (self.point_m is None) == (self.path_m is None):
            raise ValueError("a contact has either point_m or path_m")
        if self.direction is not None and self.tangent_direction is not None:
            raise ValueError("direction says all of it: without tangent and tangent_direction")
        slides = self.tangent != 0.0 and (self.tangent_direction is None and self.path_m is None)
        if slides or (self.tangent != 0.0 and self.direction is not None):
            raise ValueError("tangent needs tangent_direction or path_m, and no direction")
        return self
