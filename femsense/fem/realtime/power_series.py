# mypy: allow-untyped-decorators
"""Equilibria along a path of loads as a power series: the nonlinear response of a body, from one factor.

The loads change along a straight line, from the loads of an equilibrium x₀ (s = 0) to the wanted ones (s = 1). The state is
x(s) = x₀ + s x₁ + s² x₂ + …, and each term follows from the terms before by one solve with the tangent K of x₀ (asymptotic numerical
method; Cochelin, Damil & Potier-Ferry 1994):

    K x_{N+1} = g_N,    g_N = Σ_{n ≤ N+1} of the coefficients of the unbalanced force, with x_{N+1} = 0.

The sum is over all orders up to N + 1, so that the next term corrects the error of a solve in single precision. A quasi-Newton correction
would take the force of x₀ + x₁ as a whole instead. There a slender body that rotates by ω is stretched by |ω|²/2; the force of this
stretch, which the second term cancels, has a transverse part that K⁻¹ turns into a large motion. In the series it cancels term by term.

Coefficients of the corotational element: F = R₀ F̂ and R = R₀ A with A = I + s A₁ + …, A_n = [a_n]ₓ + M_n. AᵀA = I gives

    M₂ = (a₁a₁ᵀ − |a₁|² I)/2,    M₃ = (a₁a₂ᵀ + a₂a₁ᵀ)/2 − a₁·a₂ I    (M₁ = 0),

and that S = AᵀF̂ be symmetric, with S₀ = R₀ᵀF₀ and B = F̂_n + M_n S₀ + Σ_{0<k<n} A_kᵀ F̂_{n−k}:

    (tr(S₀) I − S₀) a_n = axial(B − Bᵀ),    θ_n = tr B,    P_n = R₀ (2μ (F̂_n − A_n) + Σ_k p_k A_{n−k}),

p as in `corotational`. Elements are worked on eight at a time.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.fem.assembly import internal
from femsense.fem.body import BodyModel
from femsense.fem.cables import add_cable_stiffness, pull_rows
from femsense.fem.corotational import LOCAL
from femsense.fem.linalg.cholesky import Cholesky, cholesky
from femsense.fem.linalg.simd_lanes import LANES
from femsense.fem.realtime.series_kernels import cable_series, element_frames, series_forces
from femsense.fem.stencil import in_lanes, lanes_of

MEMORY = 8
"""Number of equilibria whose stretches are kept."""
SAMPLE = 300
"""Number of nodes whose positions measure the distance of two states."""
ALIKE = 0.06
"""Correlation length ℓ of states in `combination`: root mean square distance of the nodes, as a share of the body's size."""
NOISE = 1e-5
"""Variance of a quantity at a known state, relative to its variance between states that are far apart (`combination`)."""
TERMS = 3
"""Largest number of terms of a series."""


@dataclass(frozen=True, eq=False, slots=True)
class SeriesLanes:
    """Data of the elements for a series, in groups of LANES elements (last axis); elements without volume fill the last group."""

    nodes: IntArray
    """shape (g, a, LANES)."""
    gradients: FloatArray
    """Single precision, shape (g, q, 3 a, LANES)."""
    constants: FloatArray
    """Volumes of the points, λ', λ − λ' and 2μ, shape (g, q + 3, LANES)."""
    frames: FloatArray
    """R₀ (nine rows) and S₀ (00 01 02 11 12 22) at the start of the series, shape (g, q, 15 LANES)."""


class Expansion:
    """An expansion point of a body, and series about it: cables under given tensions, a rigid clamp.

    Only the corotational law has a series. For other laws there are two terms; the second is a quasi-Newton correction.
    """

    def __init__(self, body: BodyModel, *, single: bool) -> None:
        """Prepare for a body; `single` keeps the factor in single precision."""
        self.body, self._single = body, single
        self.is_series = body.material.law == "corotational"
        self._lanes = _lanes(body) if self.is_series else None
        self._blocks = np.zeros((len(body.stencil.block_columns), 9), np.float32 if single else np.float64)
        self._source = np.asarray(body.free_map.source[body.free_map.pattern.analysis().tree.source], dtype=np.int32)
        self.positions = body.mesh.nodes
        self.factor: Cholesky | None = None
        self.unbalanced = np.zeros_like(self.positions)
        """Unbalanced force from which the last term was computed [N], shape (n, 3)."""
        self.tension, self._held = np.zeros(len(body.cables)), np.zeros_like(self.positions)
        keeps = body.mesh.is_quadratic and self._lanes is not None
        self._room = np.zeros((len(body.mesh.tets), 4, 9)) if keeps else None
        self._stretches: list[tuple[FloatArray, FloatArray]] = []  # of the last equilibria that were learnt
        self.length = ALIKE * body.reach
        self._loads: FloatArray | None = None  # dead loads of the last series
        self._answers: FloatArray | None = (
            None  # responses to the residual at the expansion point and to each cable, shape (a + 1, f)
        )

    def learn(self, x: FloatArray) -> None:
        """Keep the stretches of an equilibrium x: the stiffness of later expansion points is computed with them."""
        if self._room is not None:
            stretch = self._stretches.pop(0)[1] if len(self._stretches) == MEMORY else np.empty_like(self._room)
            internal(self.body, x, tangent=False, stretch=stretch)
            self._stretches.append((self.sample(x), stretch))

    def sample(self, x: FloatArray) -> FloatArray:
        """Return the positions [m] of SAMPLE nodes, shape (k, 3), by which `combination` compares states."""
        return np.asarray(x[:: max(1, len(x) // SAMPLE)]).copy()

    def forget(self) -> None:
        """Forget the learnt stretches, after a jump."""
        self._stretches = []

    def move(self, x: FloatArray, tension: FloatArray) -> bool:
        """Expand about node positions x [m] and tensions [N], shape (a,);
        return whether the stiffness is positive definite there."""
        body, blocks = self.body, self._blocks
        stretch = None
        if self._room is not None and self._stretches:
            weights, _ = combination(self.sample(x), [state for state, _ in self._stretches], self.length)
            stretch = np.einsum("k,keqi->eqi", weights, np.array([s for _, s in self._stretches]), out=self._room)
        here = internal(body, x, room=blocks, stretch=stretch)
        add_cable_stiffness(body, x, tuple(np.full(len(c.path), t) for c, t in zip(body.cables, tension)), blocks)
        self.factor = None  # its memory goes to the next factor
        self.factor = cholesky(body.free_map.pattern.analysis(), blocks.ravel(), single=self._single, source=self._source)
        self.positions, self.tension, self._answers = x, tension.copy(), None
        self._held = -here.forces
        if len(tension):
            self._held += (tension @ pull_rows(body, x)).reshape(-1, 3)
        if self._lanes is not None:
            element_frames(_read_only(x), self._lanes.nodes, self._lanes.gradients, self._lanes.frames)
        return self.factor is not None

    def terms(self, tension: FloatArray, loads: FloatArray) -> Iterator[FloatArray]:
        """Yield x₁, x₂ and x₃ [m], shape (n, 3), for tensions [N] and dead loads [N], shape (n, 3)."""
        assert self.factor is not None
        count, free = TERMS if self._lanes is not None else 2, self.body.free_map.dofs
        terms = np.zeros((count, *self.positions.shape))
        for n in range(count):
            self.unbalanced.reshape(-1)[free] = self._forces(terms[:n], tension, loads).ravel()[free]
            known = self._first_term(tension, loads) if n == 0 else None
            terms[n].reshape(-1)[free] = self.factor.solve(self.unbalanced.ravel()[free]) if known is None else known
            yield terms[n]

    def _first_term(self, tension: FloatArray, loads: FloatArray) -> FloatArray | None:
        """Return x₁ of the free unknowns, shape (f,), if the dead loads are those of the last series: x₁ is linear in the tensions, so
        that one solve with a few right-hand sides suffices for an expansion point. None if the loads have changed."""
        assert self.factor is not None
        free, before = self.body.free_map.dofs, self._loads
        self._loads = loads.copy()
        if before is None or not np.array_equal(loads, before):
            self._answers = None
            return None
        if self._answers is None:
            pulls = pull_rows(self.body, self.positions)[:, free]
            self._answers = self.factor.solve(np.vstack([(loads + self._held).ravel()[free], pulls]).T).T
        return np.asarray(self._answers[0] + (tension - self.tension) @ self._answers[1:])

    def _forces(self, terms: FloatArray, tension: FloatArray, loads: FloatArray) -> FloatArray:
        """Return g_N [N], shape (n, 3)."""
        x, lanes, force = _read_only(self.positions), self._lanes, np.zeros_like(self.positions)
        if lanes is None and len(terms):
            there = self.positions + terms[0]
            pull = (tension @ pull_rows(self.body, there)).reshape(-1, 3) if len(tension) else 0.0
            return np.asarray(loads + pull - internal(self.body, there, tangent=False).forces)
        if lanes is not None and len(terms):
            series_forces(terms, lanes.nodes, lanes.gradients, lanes.constants, lanes.frames, force)
        force = loads + self._held - force
        for cable, before, after in zip(self.body.cables, self.tension, tension):
            cable_series(cable.path.nodes, cable.path.weights, cable.pull_point, x, terms, before, after - before, force)
        return force


def combination(x: FloatArray, states: list[FloatArray], length: float) -> tuple[FloatArray, float]:
    """Return the weights of known states, shape (k,) with sum 1, by which a quantity is interpolated at the state x, and its uncertainty.

    Ordinary kriging (Cressie 1993, 3.2) with the covariance exp(−d²/2ℓ²) of states at a distance d (root mean square [m]) and a variance
    of NOISE at the known states. The uncertainty is a standard deviation, relative to the difference of states far from each other.
    """
    k, ways = len(states), (np.array([*states, x]) - x).reshape(len(states) + 1, -1)
    products = ways @ ways.T / ways.shape[1]
    squares = np.diag(products)
    covariance = np.exp(-(0.5 * (squares[:, None] + squares) - products) / length**2)
    matrix = np.ones((k + 1, k + 1))
    matrix[:k, :k] = covariance[:k, :k] + NOISE * np.eye(k)
    matrix[k, k] = 0.0
    right = np.append(covariance[:k, k], 1.0)
    solution = np.linalg.solve(matrix, right)
    return solution[:k], float(np.sqrt(max(1.0 - solution @ right, 0.0)))


def _read_only(x: FloatArray) -> FloatArray:
    view = np.ascontiguousarray(x).view()
    view.flags.writeable = False  # one compiled kernel, whether the caller's array can be written to or not
    return view


def _lanes(body: BodyModel) -> SeriesLanes:
    stencil, (mu, lam) = body.stencil, body.material.lame()
    count, points = stencil.volumes.shape
    lanes, local = lanes_of(stencil), np.minimum(lam, LOCAL * mu)
    constants = in_lanes(np.column_stack([stencil.volumes, local, lam - local, 2.0 * mu]))
    groups = len(constants)
    constants[-1, :points, LANES - (groups * LANES - count) :] = 1e-300
    gradients: FloatArray = np.asarray(lanes.gradients, dtype=np.float32)
    return SeriesLanes(lanes.nodes, gradients, constants, np.zeros((groups, points, 15 * LANES)))
