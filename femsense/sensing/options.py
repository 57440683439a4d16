"""Options of an estimate, in Python and on the command line."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

from femsense.core.options import Flag


class SensingMethod(StrEnum):
    """Method of the force estimate."""

    rays = "rays"
    """Every pixel is a measurement; one objective (docs/method/estimator.md)."""
    paper = "paper"
    """The published method: feature points along their normals and one linear step."""


@dataclass(frozen=True, slots=True)
class SensingOptions:
    """Options of `estimate`: method, and assumptions on contacts, noise and smoothness."""

    method: Annotated[
        SensingMethod,
        Flag("--method", help="rays: every point a measurement; paper: feature points and normal forces, one linear step."),
    ] = SensingMethod.rays
    friction: Annotated[float | None, Flag("--friction", "MU", "Coefficient of the friction cone of contact forces.")] = 1.0
    """Coulomb coefficient of contacts: a force lies within the friction cone about the inward normal. None: no cone."""
    push: Annotated[
        bool, Flag("--push", help="Forces at the points of --at push, within the friction cone; otherwise they may pull too.")
    ] = False
    smooth_s: Annotated[float, Flag("--smooth", "SECONDS", "Time over which forces are averaged; they lag by as much.")] = 0.0
    """Time constant of the low-pass filter of the forces of a track [s]. 0: frames are independent."""
    modulus_std: float = 0.03
    """Prior standard deviation of the modulus, relative."""
    marker_std_m: float | None = None
    """Noise of a marker along each axis [m]. None: from the residual of the calibration."""
    marker_model_std: float = 0.015
    """Model error of frames with markers only, relative to the displacement of a point."""
    correct: Annotated[
        bool, Flag("--correct", help="Use the empirical correction of femsense improve --correct, which applies to markers.")
    ] = False
    """Subtract the empirical correction of the robot from the markers, and add its variance to theirs."""
