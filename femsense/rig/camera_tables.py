"""The cameras of a script: intrinsics, pose, and depth errors."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from femsense.io.tables import Matrix, NotNegative, Positive, Schema, Share, Vector

LENSES = {"D415": (1280, 720, 65.0)}
"""Pixels and horizontal field of view [°] of the depth image of a camera (Grunnet-Jepsen, Sweetser and Woodfill, *Tuning depth
cameras for best performance*, Intel)."""
LIKE: dict[str, dict[str, Any]] = {
    "D415": {
        "subpixel_px": 0.08,
        "baseline_m": 0.055,
        "disparity_step_px": 1 / 32,
        "bleeding_px": 2.0,
        "shadows": True,
        "dark_signal": 0.03,
        "shiny_deg": 6.0,
    }
}
"""Keys that a camera's name sets; explicit keys take precedence."""
STEREO = {
    *("like", "subpixel_px", "baseline_m", "focal_px", "correlated_share", "correlation_px", "grazing_deg", "flying_share"),
    *("disparity_step_px", "bleeding_px", "shadows", "dark_signal", "shiny_deg"),
}
FLIGHT = {"amplitude_std_m", "multipath", "mixing_px", "least_signal"}
BOTH = {"edge_dropout", "quantum_m"}


class NoiseTable(Schema):
    """Errors of the depth: active stereo, time of flight, or none."""

    kind: Literal["stereo", "time-of-flight", "perfect"] = Field("stereo", description='"stereo", "time-of-flight" or "perfect"')
    like: Literal["D415"] | None = Field(
        None, description='stereo: "D415" sets the values of that camera for the keys below, and its pixels and lens'
    )
    subpixel_px: NotNegative = Field(0.08, description="stereo: error of the disparity [px], ≥ 0")
    baseline_m: Positive = Field(0.055, description="stereo: distance of the two imagers [m], > 0")
    focal_px: Positive | None = Field(None, description="stereo: focal length of the imagers [px]; by default fx")
    correlated_share: Share = Field(
        0.5, description="stereo: share of the variance that is correlated between neighbouring pixels, 0 … 1"
    )
    correlation_px: Positive = Field(2.0, description="stereo: width of the correlation [px], > 0")
    disparity_step_px: NotNegative = Field(0.0, description="stereo: quantisation of the disparity [px]; 0: none")
    bleeding_px: NotNegative = Field(
        0.0, description="stereo: maximum width by which the foreground bleeds over the background [px]"
    )
    shadows: bool = Field(False, description="stereo: true: no depth where one of the two imagers is occluded")
    dark_signal: NotNegative = Field(
        0.0, description="stereo: signal (albedo × cosine) at which half of the pixels have no depth; 0: all have one"
    )
    shiny_deg: NotNegative = Field(
        0.0, description="stereo: angle to the line of sight within which specular surfaces have no depth [°]"
    )
    grazing_deg: Annotated[float, Field(gt=0, le=90)] = Field(
        82.0, description="stereo: angle of incidence above which surfaces have no depth [°]"
    )
    edge_dropout: Share = Field(0.5, description="share of the pixels at depth edges without depth, 0 … 1")
    flying_share: Share = Field(
        0.05, description="stereo: share of flying pixels at depth edges (depth between foreground and background), 0 … 1"
    )
    amplitude_std_m: NotNegative = Field(
        0.0005,
        description="time of flight: standard deviation at 1 m, normal incidence and albedo 1 [m]; proportional to 1 / amplitude",
    )
    multipath: NotNegative = Field(
        1.0, description="time of flight: factor on the light of second reflections; 1: physical, 0: none"
    )
    mixing_px: NotNegative = Field(0.7, description="time of flight: width of the averaging of a pixel [px]")
    least_signal: NotNegative = Field(
        0.05, description="time of flight: minimum amplitude of a depth (1: normal incidence, albedo 1, 1 m)"
    )
    quantum_m: NotNegative = Field(0.0, description="quantisation of depth values [m]; 0: the camera's depth_unit_m")

    @model_validator(mode="before")
    @classmethod
    def _as_that_camera(cls, given: Any) -> Any:
        like = given.get("like") if isinstance(given, dict) else None
        return {**LIKE[like], **given} if isinstance(like, str) and like in LIKE else given

    @model_validator(mode="after")
    def _keys_of_its_kind(self) -> NoiseTable:
        known = {"kind"} | {"perfect": set(), "stereo": BOTH | STEREO, "time-of-flight": BOTH | FLIGHT}[self.kind]
        strange = sorted(self.model_fields_set - known)
        if strange:
            raise ValueError(f'{", ".join(strange)}: of another kind of camera than kind = "{self.kind}"')
        return self


class ViewTable(Schema):
    """A camera and its pose."""

    like: Literal["D415"] | None = Field(
        None, description='"D415" sets width, height, fx and noise of that camera; explicit keys take precedence'
    )
    width: Annotated[int, Field(gt=0)] = Field(424, description="pixels, > 0")
    height: Annotated[int, Field(gt=0)] = Field(240, description="pixels, > 0")
    fx: Positive = Field(306.0, description="focal length in pixels, > 0")
    fy: Positive | None = Field(None, description="focal length in pixels, > 0; default: fx")
    cx: float | None = Field(None, description="pixels; by default the middle")
    cy: float | None = Field(None, description="pixels; by default the middle")
    distortion: Annotated[list[float], Field(min_length=4, max_length=8)] = Field(
        [0.0, 0.0, 0.0, 0.0, 0.0], description="five numbers in OpenCV's order: k1, k2, p1, p2, k3 (or 4, or 8 with k4, k5, k6)"
    )
    distortion_model: Literal["brown_conrady", "inverse_brown_conrady", "kannala_brandt"] = Field(
        "brown_conrady", description='"brown_conrady", "inverse_brown_conrady" or "kannala_brandt"'
    )
    depth_unit_m: Positive = Field(1e-4, description="metres in one unit of a depth image, > 0")
    T_robot_camera: Matrix | None = Field(None, description="4 rows of 4 numbers, instead of eye_m and target_m")
    eye_m: Vector | None = Field(None, description="position of the camera, robot frame [m]")
    target_m: Vector | None = Field(None, description="point on the optical axis, robot frame [m]")
    roll_deg: float = Field(0.0, description="rotation about the optical axis [°]")
    declare_pose: bool = Field(False, description="true: the recording declares the camera pose")
    declare_noise: bool = Field(False, description="true: the recording declares the depth noise")
    noise: NoiseTable | None = Field(None, description="a table [camera.noise]; without it depth is exact")

    @model_validator(mode="before")
    @classmethod
    def _as_that_camera(cls, given: Any) -> Any:
        """Fill in the keys that `like` sets, of the camera too if only its noise has the name."""
        if not isinstance(given, dict):
            return given
        noise = given.get("noise")
        like = given.get("like", noise.get("like") if isinstance(noise, dict) else None)
        if not isinstance(like, str) or like not in LENSES:
            return given
        width, height, field = LENSES[like]
        width = given.get("width", width)
        own: dict[str, Any] = {"width": width, "height": height}
        if isinstance(width, int | float) and width > 0:
            own["fx"] = 0.5 * width / math.tan(math.radians(0.5 * field))
        return {**own, **({"noise": {"like": like}} if "like" in given else {}), **given}

    @model_validator(mode="after")
    def _one_pose(self) -> ViewTable:
        looks = self.eye_m is not None and self.target_m is not None
        if looks == (self.T_robot_camera is not None):
            raise ValueError("the pose of a camera is given either by eye_m and target_m or by T_robot_camera")
        return self

    @model_validator(mode="after")
    def _distortion_fits(self) -> ViewTable:
        if len(self.distortion) in (6, 7) or (self.distortion_model == "kannala_brandt" and any(self.distortion[4:])):
            raise ValueError(f"{len(self.distortion)} numbers of distortion do not fit {self.distortion_model}")
        return self
