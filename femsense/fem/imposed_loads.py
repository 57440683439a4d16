"""From what a caller imposes, by names of cables and chambers, to the arrays of a solve, and to its tolerance."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import BoolArray, FloatArray, as_points
from femsense.core.errors import InputError
from femsense.fem.body import BodyModel
from femsense.fem.chambers import volume_gradient
from femsense.fem.newton_state import Loads

SOFTNESS = 1e-2
"""Stiffness of a body relative to its modulus times its size: the order of magnitude for slender bodies. It converts travels to forces."""
LEAST_TRAVEL = 1e-6
"""A load counts at least as the force that moves a body by this share of its size: a body without loads has a tolerance, too."""
ROUNDING = 1e-13
"""Rounding errors of the internal forces relative to modulus times size²."""


def collect_loads(
    body: BodyModel,
    given: Mapping[str, Mapping[str, float] | None],
    nodal_forces: npt.ArrayLike | None,
    *,
    before: tuple[FloatArray, ...] | None,
    bilateral: bool,
    relative_tolerance: float,
) -> Loads:
    """Return the loads of a solve.

    Arguments:
        given: `tension`, `shortening`, `pressure` and `volume`: name → imposed value, or None.
        nodal_forces: in addition to the dead load of the body [N], shape (n, 3), or None.
        before: tensions along the cables before the motion [N], one array (s,) a cable; None: 0.
        bilateral: whether held cables may push.
        relative_tolerance: largest unbalanced force relative to the sum of all loads [1].

    Raises:
        InputError: an unknown drive, one with two inputs, or arrays with other shapes or non-finite values.
    """
    tension, shortening, cable_held = _drive_values(body.cable_names, "a cable", "tension", "shortening", given)
    pressure, growth, chamber_held = _drive_values(body.chamber_names, "a chamber", "pressure", "volume", given)
    pushes = np.flatnonzero(tension < 0)
    if len(pushes) and not bilateral:
        name = body.cable_names[pushes[0]]
        raise InputError("a cable cannot push", where=f"tension[{name}]", found=f"{tension[pushes[0]]:g} N", expected="≥ 0")
    areas = [np.linalg.norm(volume_gradient(c, body.mesh.nodes), axis=1).sum() for c in body.chambers]
    lever = np.concatenate([np.ones(len(tension)), areas])
    forces, effort, target = (
        _dead_forces(body, nodal_forces),
        np.concatenate([tension, pressure]),
        np.concatenate([shortening, growth]),
    )
    return Loads(
        forces=forces,
        effort=effort,
        target=target,
        held=np.concatenate([cable_held, chamber_held]),
        lever=lever,
        bilateral=bilateral,
        before=_tensions_before(body, before),
        tolerance=_tolerance(body, forces, np.abs(effort) * lever, np.abs(target) / lever, relative_tolerance),
    )


def _dead_forces(body: BodyModel, nodal_forces: npt.ArrayLike | None) -> FloatArray:
    """Return the dead load of the body with additional nodal forces [N], shape (n, 3)."""
    if nodal_forces is None:
        return body.dead_load()
    extra = as_points(nodal_forces, "nodal_forces")
    if extra.shape != body.mesh.nodes.shape:
        raise InputError("wrong shape", where="nodal_forces", found=extra.shape, expected=body.mesh.nodes.shape)
    return body.dead_load() + extra


def _tensions_before(body: BodyModel, before: tuple[FloatArray, ...] | None) -> tuple[FloatArray, ...]:
    """Return the tensions along the cables before the motion [N], one array (s,) a cable."""
    if before is None:
        return tuple(np.zeros(len(c.path)) for c in body.cables)
    if [len(b) for b in before] != [len(c.path) for c in body.cables] or not all(np.isfinite(b).all() for b in before):
        raise InputError(
            "not the tensions along these cables",
            where="before",
            found=[len(b) for b in before],
            expected=f"finite, segments {[len(c.path) for c in body.cables]}",
        )
    return before


def _drive_values(
    names: tuple[str, ...], kind: str, effort: str, travel: str, given: Mapping[str, Mapping[str, float] | None]
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return the imposed efforts and travels of cables or chambers, 0 where there is none, and which of these drives are held."""
    tables = {where: dict(given[where] or {}) for where in (effort, travel)}
    for where, values in tables.items():
        for name, value in values.items():
            if name not in names:
                raise InputError(
                    f"unknown {kind.split()[1]}",
                    where=where,
                    found=name,
                    expected=", ".join(names) or f"a body with {kind.split()[1]}s",
                )
            if not np.isfinite(value):
                raise InputError("must be finite", where=f"{where}[{name}]", found=value)
    twice = set(tables[effort]) & set(tables[travel])
    if twice:
        what = "pulled or held" if effort == "tension" else "under pressure or held"
        raise InputError(f"{kind} is either {what}", where=travel, found=f"{sorted(twice)} in {effort} too")
    return (
        np.array([tables[effort].get(name, 0.0) for name in names], dtype=float),
        np.array([tables[travel].get(name, 0.0) for name in names], dtype=float),
        np.array([name in tables[travel] for name in names], dtype=bool),
    )


def _tolerance(
    body: BodyModel, forces: FloatArray, drive_forces: FloatArray, travels: FloatArray, relative_tolerance: float
) -> float:
    """Return the largest unbalanced nodal force of an equilibrium [N].

    The tolerance is a share of the sum of all loads, plus rounding errors of the internal forces.

    Arguments:
        forces: dead nodal forces [N], shape (n, 3).
        drive_forces: forces of the drives with imposed efforts [N], shape (a + c,).
        travels: imposed travels as lengths [m], shape (a + c,), which count as the forces that they cause in a body of typical stiffness.
        relative_tolerance: the share [1].
    """
    size, modulus = body.reach, float(np.median(body.material.young_modulus))
    stiffness = SOFTNESS * modulus * size  # [N/m]
    total = np.linalg.norm(forces, axis=1).sum() + drive_forces.sum() + stiffness * travels.sum()
    return float(relative_tolerance * max(total, stiffness * LEAST_TRAVEL * size) + ROUNDING * modulus * size**2)
