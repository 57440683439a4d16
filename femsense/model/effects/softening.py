"""Mullins effect: material that was loaded before is softer than at its first loading."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from femsense.model.effects.base import Effect, Entry, Experiment, Parameter, number
from femsense.model.robot import Robot

MOST, USUAL = 0.8, 0.15
"""Largest share of the modulus that is lost, of filled rubbers, and that of a soft silicone."""
ENERGIES = (1e-4, 1e-3, 1e-2)
"""Energy densities that are tried, in shares of the modulus: of strains of 1, 4 and 14 %."""
LEAST_ENERGY, MOST_ENERGY = 1e-2, 1e7
"""[J/m³]."""


def _parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    return (Parameter("share", None, "1", 0.0, 0.0, MOST, 1e-4, plausible=USUAL),)


def _seeds(robot: Robot) -> tuple[Entry, ...]:
    modulus = float(np.median(robot.body.material.young_modulus))
    return tuple({"energy_j_m3": share * modulus} for share in ENERGIES)


def _polish(robot: Robot, control: str, seed: Entry) -> tuple[Parameter, ...]:
    start, far = float(np.log(seed["energy_j_m3"])), float(np.log(30.0))
    return (Parameter("energy_j_m3", None, "J/m³", start, start - far, start + far, 1e-4, "log"),)


def _apply(robot: Robot, entry: Entry) -> Robot:
    share = number(entry, "share", "softening", low=0.0, high=0.99)
    energy = number(entry, "energy_j_m3", "softening", low=LEAST_ENERGY, high=MOST_ENERGY)
    return replace(robot, softening=(*robot.softening, (share, energy)))


SOFTENING = Effect(
    "softening",
    "Mullins: the first loading is stiffer",
    _parameters,
    _apply,
    _seeds,
    keys=("share", "energy_j_m3"),
    path_dependent=True,
    polish=_polish,
    told_by=Experiment.LOAD_UNLOAD_AND_HOLD,
)
