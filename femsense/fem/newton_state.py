"""The drives of a body, the state of the Newton iteration, and forces and travels of the drives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray
from femsense.fem.assembly import Internal
from femsense.fem.body import BodyModel
from femsense.fem.cables import cable_forces, shortening
from femsense.fem.chambers import volume_changes, volume_gradient
from femsense.fem.linalg.factorization import Factorization

CONVERGED = "converged"


@dataclass(frozen=True, slots=True)
class NewtonOptions:
    """When Newton factorises a new stiffness, when it uses rotated steps, and when it gives up a trial state."""

    chord: float = 1e-2
    """A stiffness serves for another step where the last one left less than this share of the residual,
    or where two more such steps are enough (unless it was factorised so far off that another one is needed at the end)."""
    curved: float = 1e-3
    """Steps longer than this share of the body are tried with elements that turn before they are tried straight."""
    patience_tried: int = 8
    """In single precision a stiffness of a state that is only tried serves where so many more steps are enough if each leaves the
    share that the last one left: about what a factor takes."""
    steps_tried: int = 30
    """Newton steps of a state that is only tried."""
    indefinite_tried: int = 6
    """Stiffnesses of such a state that are indefinite: it is too far off where it meets more.
    Bodies that fold meet 8 to 11 of these in their 30 steps,
    those that converge 4 at most (a trial on bars of `benchmarks/improve.py`)."""
    most_steps: int = 1500
    """Newton steps of a state in all, load steps included."""
    watch: Callable[[float], None] | None = None
    """Called with the largest unbalanced nodal force of every iterate [N]."""


@dataclass(frozen=True, eq=False, slots=True)
class Loads:
    """The drives of the body (cables, then chambers: a + c)."""

    forces: FloatArray  # dead nodal forces [N], (n, 3)
    effort: FloatArray  # tensions [N] and pressures [Pa] that are given, (a + c,)
    target: FloatArray  # imposed shortening [m] or growth [m³] of held drives, (a + c,)
    controlled: BoolArray  # whether the travel is imposed, (a + c,)
    lever: FloatArray  # effort × lever is a force, travel / lever a length: 1, or the surface of a chamber [m²], (a + c,)
    bilateral: bool
    before: tuple[FloatArray, ...]  # tensions along the cables until now [N]
    tolerance: float  # of the residual [N]

    def part_way(self, first: Loads, part: float) -> Loads:
        """Return the loads on the straight way from the first ones (part 0) to these (part 1)."""
        mixed = {
            name: (1.0 - part) * getattr(first, name) + part * getattr(self, name) for name in ("forces", "effort", "target")
        }
        return replace(self, **mixed)


@dataclass(eq=False, slots=True)
class State:
    """State of the Newton iteration."""

    x: FloatArray  # (n, 3)
    T: FloatArray  # motor tensions [N], then pressures [Pa], (a + c,)
    taut: BoolArray  # held cables that carry load, and held chambers, (a + c,)
    shares: list[FloatArray]  # segment tension / motor tension
    factor: Factorization | None = None
    borrowed: bool = False  # the factor belongs to another state; it serves as long as the residual falls fast
    iterations: int = 0
    residual: float = np.inf
    shifted: bool = False  # the stiffness was not positive definite where it was last factorised
    shift: float = 0.0  # shift that made the stiffness positive definite there [N/m]
    single: bool = False  # factors in single precision
    rough: bool = False  # a trial state
    indefinite_steps: int = 0
    factored_at: float = 0.0  # residual where the stiffness was last factorised [N]
    here: Internal | None = None  # last residual of Newton, at x
    serves: bool = False  # the factor is likely to serve for the step after this one
    options: NewtonOptions = field(default_factory=NewtonOptions)


def unbalanced_force(loads: Loads, state: State, here: Internal, rows: FloatArray) -> FloatArray:
    """Return the unbalanced force of every unknown [N], shape (3n,)."""
    pull = state.T @ rows if len(rows) else 0.0
    return np.asarray(loads.forces.ravel() - here.forces.ravel() + pull)


def drive_rows(body: BodyModel, state: State) -> FloatArray:
    """Return the nodal forces of unit motor tensions, with the loss along each cable, and of unit pressures,
    shape (a + c, 3n)."""
    n = len(body.mesh.nodes)
    rows = [cable_forces(c, state.x, s, n).ravel() for c, s in zip(body.cables, state.shares)]
    rows += [volume_gradient(c, state.x).ravel() for c in body.chambers]
    return np.array(rows) if rows else np.zeros((0, 3 * n))


def kinematic_rows(body: BodyModel, state: State, rows: FloatArray) -> FloatArray:
    """Return dδ/dx and dV/dx, shape (a + c, 3n): the rows without the loss along the cables."""
    n = len(body.mesh.nodes)
    result = rows.copy()
    for i, cable in enumerate(body.cables):
        if (state.shares[i] != 1.0).any():
            result[i] = cable_forces(cable, state.x, np.ones(len(cable.path)), n).ravel()
    return result


def travel_of(body: BodyModel, positions: FloatArray) -> FloatArray:
    """Return the shortening of each cable [m] and the growth of each chamber [m³] since rest, shape (a + c,)."""
    return np.concatenate([shortening(body, positions), volume_changes(body, positions)])


def drive_compliance(body: BodyModel) -> FloatArray:
    """Return the compliance of each cable itself [m/N], and 0 for each chamber, shape (a + c,)."""
    return np.array([1.0 / c.stretch_stiffness for c in body.cables] + [0.0] * len(body.chambers))
