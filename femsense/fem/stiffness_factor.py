"""The factor of the stiffness in Newton's method: when and how a new factor is made, and quasi-Newton updates in between."""

from __future__ import annotations

from femsense.core.arrays import FloatArray
from femsense.fem.assembly import Internal, internal, reduced_values
from femsense.fem.body import BodyModel
from femsense.fem.cables import add_cable_stiffness
from femsense.fem.chambers import add_pressure_stiffness
from femsense.fem.clamp import with_turning_plate
from femsense.fem.linalg.factorization import Factorization, Pattern, factorize, factorize_definite, least_shift
from femsense.fem.newton_equations import NewtonEquations
from femsense.fem.newton_state import Loads, State

FAST = 1e-2
"""A factor is kept if the last step reduced the residual below this share: the state at the end is then far more exact than the tolerance."""
FAST_BORROWED = 0.1
"""The same share if the factor belongs to a nearby state."""
FAST_FOLLOWING = 0.3
"""The same share while the tensions along cables with friction follow the bends, at which rate they converge with a new factor, too."""
FAR = 1e6
"""A factor made at a residual above this multiple of the tolerance does not decide the stability of the final state."""
PATIENCE_SINGLE = 5
"""A factor in single precision is kept if this number of further steps is enough at the present rate."""
ARRIVED = 5e-7
"""A trial state has converged after a step shorter than this share of the body's size."""
PROMISING = 0.1
"""If the last step reduced the residual below this share, the next step will probably end at a state where the factor is kept."""
PAIRS = 8
"""Steps since the last factor that are remembered (`Secants`)."""


class Secants:
    """A factor K⁻¹, updated by the steps since it was made (BFGS in product form, Matthies & Strang 1979)."""

    def __init__(self, factor: Factorization) -> None:
        self.factor = factor
        self.pairs: list[tuple[FloatArray, FloatArray, float]] = []
        """Steps s [m], the decreases y of the unbalanced force [N], and 1/(sᵀy)."""
        self._last: tuple[FloatArray, FloatArray] | None = None

    def learn(self, x: FloatArray, force: FloatArray) -> None:
        """See the free positions x [m] and the unbalanced force there [N], each (f,)."""
        if self._last is not None:
            step, fell = x - self._last[0], self._last[1] - force
            work = float(step @ fell)
            if work > 0.0:
                self.pairs = [*self.pairs[1 - PAIRS :], (step, fell, 1.0 / work)]
        self._last = x, force

    def solve(self, right: FloatArray) -> FloatArray:
        """Return the updated K⁻¹ right, shape (f,); of the factor itself for (f, k), which takes no updates."""
        shares = []
        for step, fell, weight in reversed(self.pairs):
            shares.append(weight * float(step @ right))
            right = right - shares[-1] * fell
        answer = self.factor.solve(right)
        for (step, fell, weight), share in zip(self.pairs, reversed(shares)):
            answer = answer + (share - weight * float(fell @ answer)) * step
        return answer


class FactorKeeper:
    """Decides at each Newton step whether the last factor is kept or a new factor is made.

    With the residual r (largest unbalanced nodal force) and the length l of the last step (largest displacement), and their ratios q and p
    to those of the step before, a factor is kept if one of these rules holds:

    | rule | for | kept if | why |
    |---|---|---|---|
    | fast | all states | q ≤ FAST; FAST_BORROWED or FAST_FOLLOWING where these apply | a new factor would hardly be faster |
    | residual in sight | factors made near the solution (FAR) | r qⁿ ≤ tolerance, n = `patience` (2) | two steps take less time than a factor |
    | | single precision | the same with n = PATIENCE_SINGLE (5), for trial states n = `patience_tried` (8) | eight steps take the time of a factor |
    | length in sight | trial states | l pⁿ ≤ ARRIVED · size, n = 8 | trial states converge by the length of a step as well |

    A ratio above 1 counts as 1. A first step has q = 0, so that it takes the factor of a nearby state, if there is one. More patience saves 5 % of the
    factors, but leaves errors of exact states close to the tolerance, which differences of states then show four times as large.
    """

    def __init__(self, body: BodyModel, loads: Loads, state: State) -> None:
        self._body, self._loads, self._state = body, loads, state
        self._has_friction = any(c.friction > 0 for c in body.cables)
        self._residual, self._length = float("inf"), float("inf")
        self.expects_new_factor = True
        """Whether the state behind the next step will probably need a new factor: its tangent is then assembled with its forces, which takes
        less time than both apart."""
        self._updated: Secants | None = None

    def factor(self, here: Internal, equations: NewtonEquations, length: float, *, follows: bool) -> Secants | None:
        """Return the factor for the next step; None where the stiffness is singular.

        Arguments:
            here: internal forces of the state.
            equations: equations of the next Newton step.
            length: length of the last step [m]; inf before the first step.
            follows: tensions along cables follow friction.
        """
        state, residual, tolerance = self._state, equations.residual, self._loads.tolerance
        q, p = _ratio(residual, self._residual), _ratio(length, self._length)
        self._residual, self._length = residual, length
        options = state.options
        fast = FAST_FOLLOWING if follows else FAST_BORROWED if state.borrowed else FAST
        in_single = options.patience_tried if state.rough else PATIENCE_SINGLE
        keeps = (
            options.patience > 0 and q <= fast,
            state.factored_at <= FAR * tolerance and residual * min(q, 1.0) ** options.patience <= tolerance,
            state.single and residual * min(q, 1.0) ** in_single <= tolerance,
            state.single and state.rough and length * min(p, 1.0) ** in_single <= ARRIVED * self._body.reach,
        )
        if state.factor is None or not any(keeps):
            state.factor, state.borrowed, state.factored_at = factor_here(self._body, here, state, equations), False, residual
            self._updated = None
        self.expects_new_factor = not (state.borrowed or 0.0 < q <= PROMISING)
        if state.factor is None:
            return None
        updated = self._updated = self._updated or Secants(state.factor)
        if not self._has_friction and not len(equations.active):  # else the force changes with the tensions, too
            updated.learn(state.x.ravel()[self._body.free_map.dofs], equations.force)
        return updated


def _ratio(now: float, before: float) -> float:
    return now / before if before > 0.0 else float("inf")


def factor_here(body: BodyModel, here: Internal, state: State, equations: NewtonEquations) -> Factorization | None:
    """Factorise the stiffness at a state, shifted where it is not positive definite, so that steps lead downhill.

    A stiffness that is indefinite only along motions that active drives prevent is not shifted. Sets `state.shifted`.
    """
    values = reduced_values(body, stiffness_blocks(body, here, state))
    plain = definite_factor(body.free_map.pattern, values, state)
    whole = with_turning_plate(body, state.x, plain)
    state.shifted = state.shift > 0.0 or whole is None or whole.negative > 0
    if state.shifted and len(equations.active):
        exact = with_turning_plate(body, state.x, factorize(body.free_map.pattern, values))
        state.shifted = exact is None or not equations.is_definite(exact, exact.negative)
        whole = whole if state.shifted else exact
    state.indefinite_steps += state.shifted
    # the plate only softens the stiffness, so the factor without it still gives a descent direction
    return plain if state.shifted and whole is not None and whole.negative > 0 else whole


def definite_factor(pattern: Pattern, values: FloatArray, state: State) -> Factorization | None:
    """Factorise a stiffness with the shift that makes it positive definite, beginning with a quarter of the last shift.

    A stiffness may be indefinite in single precision only, as that of a body about to buckle. All further factors of the state are then
    made in double precision (`state.single`).
    """
    first, plain = state.shift / 4.0, None
    if state.single:
        plain, state.shift = factorize_definite(pattern, values, single=True, tries=0)
    if plain is None and state.single and first < least_shift(pattern, values):
        plain, state.shift = factorize_definite(pattern, values, tries=0)
        state.single = plain is None
    if plain is None:
        plain, state.shift = factorize_definite(pattern, values, first=first, single=state.single, indefinite=state.single)
    return plain


def stiffness_blocks(body: BodyModel, here: Internal, state: State) -> FloatArray:
    """Return the blocks of the tangent stiffness of body, cables and chambers at a state [N/m], as `internal` has them."""
    blocks = internal(body, state.x).blocks if here.blocks is None else here.blocks.copy()
    assert blocks is not None
    a = len(body.cables)
    add_cable_stiffness(body, state.x, tuple(T * s for T, s in zip(state.T[:a], state.shares)), blocks)
    add_pressure_stiffness(body, state.x, state.T[a:], blocks)
    return blocks
