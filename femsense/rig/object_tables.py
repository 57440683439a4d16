"""Contacts in a script: objects, and contacts that follow a path."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from femsense.io.tables import Color, NotNegative, Positive, Schema, Share, Vector

COLOR = "three numbers from 0 to 1: [red, green, blue]"
PLACE = "three numbers in metres [x, y, z], on the surface at rest, robot frame"
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

    name: Annotated[str, Field(min_length=1, description="a unique name")]
    kind: Literal["ball", "rod", "plate", "box", "mesh", "weight"] = Field(
        description=('"ball" or "plate" on a stick, transverse "rod", "box", "mesh", or "weight" on a stick on the body')
    )
    radius_m: Positive = Field(0.008, description="of a ball, of a rod, or of the tip of a weight's stick [m], > 0")
    length_m: Positive = Field(0.15, description="of a rod [m], > 0")
    size_m: Vector | None = Field(None, description="of a plate or box: extent along x and y, and thickness [m]")
    stick_m: NotNegative = Field(0.12, description="length of the stick of a ball, plate or weight [m]; 0: none")
    mesh: str | None = Field(None, description="of a mesh: file with a closed surface, relative to the script")
    unit: Literal["m", "cm", "mm"] | None = Field(None, description='of a mesh: "m", "cm" or "mm"')
    mass_kg: Positive | None = Field(None, description="of a weight [kg], > 0")
    color_rgb: Color = Field([0.85, 0.30, 0.12], description=COLOR)
    albedo: Share = Field(0.5, description="infrared albedo, 0 … 1; black foam 0.03, white paper 0.9")
    gloss: Share = Field(0.0, description="probability of a missing depth at specular reflections, 0 … 1")
    declared: bool = Field(False, description="true: declared in [[tools]] of the recording (ball, rod or mesh)")

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
        None, description="instead of point_m: path of a sliding contact, at constant speed over the frames of the sweep [m]"
    )
    force_n: NotNegative | list[NotNegative] | None = Field(
        None,
        description="normal force [N], one number or one per frame of the sweep, ≥ 0; 0: no contact; default of a weight: its own weight",
    )
    direction: Vector | None = Field(
        None, description="direction of the force; default: into the surface, following its rotation"
    )
    tangent: NotNegative | list[NotNegative] = Field(
        0.0, description="ratio of tangential to normal force, one number or one per frame of the sweep, ≥ 0"
    )
    tangent_direction: Vector | None = Field(None, description="direction of the tangential force; default: along path_m")
    radius_m: Positive | None = Field(
        None,
        description="radius of the loaded surface [m], > 0; default: computed from the object, without one 0.006",
    )
    object: str | None = Field(None, description="name of the object, one of [[objects]]; default: a probe")
    along: Vector | None = Field(None, description="direction of the object's x axis (the axis of a rod); default: along path_m")
    away_m: NotNegative | list[NotNegative] | None = Field(
        None,
        description="distance from the surface in frames without force [m], one number or one per frame; default: the object is absent",
    )
    shown: bool = Field(True, description="false: the object is invisible to the camera")
    probe: Literal["sphere", "cylinder"] = Field("sphere", description='shape of the probe: "sphere" or "cylinder"')
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
