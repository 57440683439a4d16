"""Mullins softening: the share of its modulus that each element retains in each frame, by the largest energy density so far.

The energy history is that of the body without softening, so that frames can be solved independently.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from femsense.core.arrays import FloatArray, freeze
from femsense.fem.energy import energy_density
from femsense.fem.equilibrium import Equilibrium
from femsense.model.drive import DrivenRobot
from femsense.model.quasi_static_path import solve_path


def softened_share(terms: Sequence[tuple[float, float]], most: FloatArray, now: FloatArray) -> FloatArray:
    """Return the share of its modulus that an element has: Π 1 − share (1 − exp(−(most − now)/energy)),
    after Ogden and Roxburgh (1999).

    Arguments:
        terms: (share [1], energy [J/m³]).
        most: largest energy density so far [J/m³].
        now: energy density [J/m³], of the same shape: where it is the largest so far,
            the loading is the first and the modulus whole.
    """
    beyond = np.maximum(most - now, 0.0)
    return np.asarray(np.prod([1.0 - share * (1.0 - np.exp(-beyond / energy)) for share, energy in terms], axis=0) + 0.0 * beyond)


def path_energies(driven: DrivenRobot, last: int, starts: Mapping[int, Equilibrium] | None = None) -> FloatArray:
    """Return the energy density of each element [J/m³], shape (last + 1, m), along the path of a body that does not soften.

    Arguments:
        driven: the body and what drives it.
        last: frame up to which it is wanted.
        starts: nearby states as warm starts.

    Raises:
        DataError: a frame has no equilibrium.
    """
    virgin = replace(driven, drive=replace(driven.drive, softness=None))
    frames = range(last + 1)
    path = solve_path(virgin, frames, lambda robot: robot.markers, starts=dict(starts or {}))
    return np.array([energy_density(driven.robot.body, state.positions) for _, state, *_ in path])


def softened(driven: DrivenRobot, energies: FloatArray) -> DrivenRobot:
    """Return a driven robot with the shares of its moduli by its own terms, for the energies of a path (`path_energies`)."""
    if not driven.robot.softening:
        return driven
    most = np.maximum.accumulate(energies, axis=0)
    shares = softened_share(driven.robot.softening, most, energies)
    return replace(driven, drive=replace(driven.drive, softness=freeze(shares)))


def with_softening(driven: DrivenRobot, last: int, starts: Mapping[int, Equilibrium] | None = None) -> DrivenRobot:
    """Return a driven robot as it softens along its path up to a frame; itself where it does not. Raises DataError."""
    return softened(driven, path_energies(driven, last, starts)) if driven.robot.softening else driven
