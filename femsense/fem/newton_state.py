"""The drives of a body, the state of the Newton iteration, and forces and travels of the drives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray
from femsense.fem.assembly import Internal
from femsense.fem.body import BodyModel
from femsense.fem.cables import cable_forces, shortening
from femsense.fem.chambers import volume_changes, volume_gradient
from femsense.fem.linalg.factorization import Factorization


class SolveStatus(StrEnum):
    """Reason for the end of a solve; `ADVICE` of `femsense.fem.equilibrium` lists causes and remedies."""

    CONVERGED = "converged"
    UNSTABLE = "unstable"
    SINGULAR = "singular"
    STALLED = "stalled"
    ITERATIONS = "iterations"
    CABLES = "cables"
    OVERLOAD = "overload"


@dataclass(frozen=True, slots=True)
class NewtonOptions:
    """When Newton's method makes a new factor, uses rotated steps, and gives up a trial state, which is a state that a search tries."""

    patience: int = 2
    """A factor in double precision is kept if this number of further steps is enough at the present rate; 0: every step has a new factor."""
    curved: float = 1e-3
    """A step longer than this share of the body is first tried with elements that turn, then straight."""
    patience_tried: int = 8
    """The same number for a trial state, whose steps are in single precision."""
    steps_tried: int = 30
    """Newton steps of a trial state."""
    indefinite_tried: int = 6
    """Indefinite stiffnesses of a trial state, before it is given up. Bodies that fold meet 8 to 11 of these in their 30 steps,
    bodies that converge 4 at most (a trial on bars of `benchmarks/improve.py`)."""
    most_steps: int = 1500
    """Newton steps of a state in all, load steps included."""
    watch: Callable[[float], None] | None = None
    """Called with the largest unbalanced nodal force of every iterate [N]."""


@dataclass(frozen=True, eq=False, slots=True)
class Loads:
    """Dead loads and drives of a body. The drives are its a cables, then its c chambers.

    The effort of a drive is the tension of a cable [N] or the pressure of a chamber [Pa]; its travel is the shortening of a cable [m] or
    the growth of a chamber [m³] since rest. One of the two is imposed. A drive is *held* if that is its travel.
    """

    forces: FloatArray
    """Dead nodal forces [N], shape (n, 3)."""
    effort: FloatArray
    """Imposed efforts, 0 for held drives, shape (a + c,)."""
    target: FloatArray
    """Imposed travels, 0 for the other drives, shape (a + c,)."""
    held: BoolArray
    """Whether a drive is held, shape (a + c,)."""
    lever: FloatArray
    """Effort × lever is a force, travel / lever a length: 1, or the surface of a chamber [m²], shape (a + c,)."""
    bilateral: bool
    """Whether held cables may push."""
    before: tuple[FloatArray, ...]
    """Tensions along each cable before the motion [N], for friction."""
    tolerance: float
    """Of the residual [N]."""

    def part_way(self, first: Loads, part: float) -> Loads:
        """Return the loads on the straight way from other loads (part 0) to these loads (part 1)."""
        mixed = {
            name: (1.0 - part) * getattr(first, name) + part * getattr(self, name) for name in ("forces", "effort", "target")
        }
        return replace(self, **mixed)


@dataclass(eq=False, slots=True)
class State:
    """State of the Newton iteration."""

    x: FloatArray
    """Node positions [m], shape (n, 3)."""
    T: FloatArray
    """Present efforts: motor tensions [N], then pressures [Pa], shape (a + c,)."""
    active: BoolArray
    """The active set: held drives whose imposed travel is a constraint now, so that their efforts are unknowns, shape (a + c,). A held
    chamber always is active; a held cable is slack otherwise, and its tension is 0."""
    shares: list[FloatArray]
    """Tension of each segment of each cable relative to the motor tension [1]: below or above 1 by friction."""
    factor: Factorization | None = None
    """The last factor of the stiffness."""
    borrowed: bool = False
    """Whether the factor was made at another state."""
    iterations: int = 0
    residual: float = np.inf
    """Largest unbalanced nodal force [N]."""
    shifted: bool = False
    """Whether the stiffness was not positive definite at the last factorisation."""
    shift: float = 0.0
    """Shift that made the stiffness positive definite at the last factorisation [N/m]."""
    single: bool = False
    """Whether factors are made in single precision."""
    rough: bool = False
    """Whether the state is a trial of a search: it converges by the length of a step as well, and is given up early."""
    indefinite_steps: int = 0
    """Stiffnesses that were not positive definite."""
    factored_at: float = 0.0
    """Residual at the last factorisation [N]."""
    here: Internal | None = None
    """Internal forces at x."""
    options: NewtonOptions = field(default_factory=NewtonOptions)


def is_cable(body: BodyModel) -> BoolArray:
    """Return which drives are cables, shape (a + c,)."""
    return np.arange(len(body.cables) + len(body.chambers)) < len(body.cables)


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
    """Return the shortening of each cable [m] and the increase of the volume of each chamber [m³] since rest, shape (a + c,)."""
    return np.concatenate([shortening(body, positions), volume_changes(body, positions)])


def drive_compliance(body: BodyModel) -> FloatArray:
    """Return the compliance of each cable itself [m/N], and 0 for each chamber, shape (a + c,)."""
    return np.array([1.0 / c.stretch_stiffness for c in body.cables] + [0.0] * len(body.chambers))
