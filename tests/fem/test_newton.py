"""Newton where it is hard: order of convergence, buckling, snap-through, held cables past a limit, load steps, abuse."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from abuse import Outcome, cases, certify, run_case
from analytic import bar_body
from helpers import block_mesh
from hollow_bar_cable import hollow

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.fem import newton_state, stiffness_factor
from femsense.fem.assembly import internal, reduced_matrix
from femsense.fem.body import BodyModel, make_body, tie_cable
from femsense.fem.cables import bend_angles
from femsense.fem.cavities import find_chamber
from femsense.fem.compliance import tangent_at
from femsense.fem.equilibrium import Equilibrium, NewtonOptions, SolveOptions, solve_equilibrium
from femsense.fem.linalg.factorization import factorize, factorize_definite
from femsense.fem.mesh import TetMesh, to_quadratic

E, LENGTH, WIDTH, SIDE = 200e3, 0.1, 0.013, 0.01
EULER = np.pi**2 * E * WIDTH * SIDE**3 / 12 / (4 * LENGTH**2)
"""Load at which a clamped column with a free end buckles [N]."""


# Order


@pytest.mark.parametrize("law", ["corotational", "neo_hookean", "gent"])
@pytest.mark.parametrize(
    "given",
    [
        {"tension": {"top": 2.0}, "pressure": {"core": 8e3}},
        {"shortening": {"top": 0.008}, "pressure": {"core": 8e3}},
        {"tension": {"top": 2.0}, "volume": {"core": 8e-7}},
    ],
)
def test_newton_is_quadratic_near_the_solution(law: str, given: dict[str, Any]) -> None:
    """The last steps above rounding: log r₂/r₁ over log r₁/r₀ is 2, at least 1.6.

    Every step has a stiffness of its own and is straight: where elements turn, too few steps are left to see an order.
    """
    body = hollow(law)
    if law == "gent":
        body = body.with_material(replace(body.material, stretch_limit=2.0))
    residuals = list[float]()
    how = NewtonOptions(patience=0, curved=np.inf, watch=residuals.append)
    state = solve_equilibrium(body, options=SolveOptions(relative_tolerance=1e-13, newton=how), **given)
    assert state.converged and state.indefinite_steps == 0
    near = [r for r in residuals if r > 1e-8]
    order = np.log(near[-1] / near[-2]) / np.log(near[-2] / near[-3])
    assert order > 1.6, (order, residuals)


# Buckling


def column(cells: int = 8) -> BodyModel:
    mesh = to_quadratic(block_mesh((cells, 1, 1), (LENGTH, WIDTH, SIDE)))
    return make_body(mesh, young_modulus=E, poisson_ratio=0.0, clamped=mesh.nodes[:, 0] < 1e-9)


def pressed(body: BodyModel, load: float, side: float = 0.0, **given: Any) -> Equilibrium:
    end = body.mesh.nodes[:, 0] > LENGTH - 1e-9
    # forces of an even pressure on the end: only the middles of the sides of quadratic faces carry it
    forces = np.zeros_like(body.mesh.nodes)
    for tet in body.mesh.tets:
        corners = [i for i in range(4) if end[tet[i]]]
        if len(corners) == 3:
            middles = [n for n in tet[4:] if end[n]]
            forces[middles] += np.array([-load, 0.0, side]) / 6.0
    return solve_equilibrium(body, nodal_forces=forces, **given)


def tip(body: BodyModel, state: Equilibrium) -> float:
    end = body.mesh.nodes[:, 0] > LENGTH - 1e-9
    return float((state.positions - body.mesh.nodes)[end, 2].mean())


def test_a_column_buckles_at_eulers_load() -> None:
    """Southwell (1932): under a small side load the deflection is w = w₀ / (1 − P / P_cr), so that P / w falls on a line."""
    body = column()
    loads = np.array([0.3, 0.5, 0.7]) * EULER
    w0 = tip(body, pressed(body, 0.0, 1e-6))
    w = np.array([tip(body, pressed(body, load, 1e-6)) for load in loads])
    slope = np.polyfit(loads, w0 / w, 1)[0]
    assert -1 / slope == pytest.approx(EULER, rel=0.03)


def test_a_perfect_column_is_stable_below_eulers_load_and_unstable_above() -> None:
    body = column()
    below, above = pressed(body, 0.9 * EULER), pressed(body, 1.15 * EULER)
    assert below.converged and below.indefinite_steps == 0
    assert above.status == "unstable" and "buckle" in above.advice and not above.converged
    assert above.residual_n < 1e-6 * EULER
    assert pressed(body, 1.15 * EULER, start=above).status == "unstable"
    assert np.linalg.eigvalsh(stiffness(body, below))[0] > 0 > np.linalg.eigvalsh(stiffness(body, above))[0]


def test_an_imperfect_column_bends_to_its_side_and_says_that_it_buckled() -> None:
    body = column()
    state = pressed(body, 1.3 * EULER, 1e-5 * EULER)
    assert state.converged and state.indefinite_steps > 0 and tip(body, state) > 0.3 * LENGTH
    assert np.linalg.eigvalsh(stiffness(body, state))[0] > 0
    other = pressed(body, 1.3 * EULER, -1e-5 * EULER)
    assert tip(body, other) == pytest.approx(-tip(body, state), rel=0.05)


def stiffness(body: BodyModel, state: Equilibrium) -> np.ndarray:
    """Return the stiffness at a state without cables, dense."""
    from femsense.fem.assembly import reduced_matrix

    blocks = internal(body, state.positions).blocks
    assert blocks is not None
    return np.asarray(reduced_matrix(body, blocks).toarray())


# Snap-through


def arch(rise: float = 0.01) -> BodyModel:
    """A shallow arch, clamped at both ends, with a cable that pulls its crown down."""
    mesh = block_mesh((16, 1, 1), (0.1, 0.01, 0.002))
    nodes = mesh.nodes.copy()
    nodes[:, 2] += rise * np.sin(np.pi * nodes[:, 0] / 0.1)
    mesh = to_quadratic(TetMesh(nodes, mesh.tets))
    ends = (mesh.nodes[:, 0] < 1e-9) | (mesh.nodes[:, 0] > 0.1 - 1e-9)
    crown = tie_cable(mesh, "down", [[0.05, 0.005, rise]], [0.05, 0.005, -0.1])
    return make_body(mesh, young_modulus=E, poisson_ratio=0.3, clamped=ends, cables=(crown,))


def test_an_arch_snaps_through_under_tension_and_is_led_through_by_a_held_cable() -> None:
    """With the cable held, its tension rises to the limit load and falls again, where the stiffness alone is indefinite; with
    the tension given above that limit the state lies on the other side, and the solver says that it came through."""
    body = arch()
    depths, state = np.linspace(0.0, 0.014, 15), None
    tensions, negative = [], []
    for depth in depths:
        state = solve_equilibrium(body, shortening={"down": depth}, start=state)
        assert state.converged and state.indefinite_steps == 0, (depth, state.status)  # the held cable bears what is soft
        tensions.append(state.tension["down"])
        negative.append(tangent_at(body, state).factor.negative)
    peak = int(np.argmax(tensions))
    assert 2 < peak < len(depths) - 2 and min(tensions[peak:]) < 0.9 * tensions[peak]
    assert max(negative[: peak - 1]) == 0 and max(negative[peak + 1 :]) > 0
    below = solve_equilibrium(body, tension={"down": 0.95 * tensions[peak]})
    above = solve_equilibrium(body, tension={"down": 1.1 * tensions[peak]})
    assert below.converged and below.shortening["down"] < depths[peak] + 1e-4
    assert above.converged and above.shortening["down"] > 0.014 and above.indefinite_steps > 0


def test_a_column_that_a_held_cable_shortens_buckles_all_the_same() -> None:
    """The cable holds the way along the axis alone:
    the column goes to its side at nearly the same tension however far it is shortened."""
    mesh = to_quadratic(block_mesh((8, 2, 2), (LENGTH, WIDTH, SIDE)))
    axis = tie_cable(mesh, "axis", [[LENGTH, WIDTH / 2, SIDE / 2]], [0.0, WIDTH / 2, SIDE / 2])
    body = make_body(mesh, young_modulus=E, poisson_ratio=0.0, clamped=mesh.nodes[:, 0] < 1e-9, cables=(axis,))
    straight, bent, further = (solve_equilibrium(body, shortening={"axis": d}) for d in (0.0005, 0.0015, 0.002))
    assert straight.converged and straight.indefinite_steps == 0 and abs(tip(body, straight)) < 1e-4
    assert bent.converged and bent.indefinite_steps > 0
    assert bent.tension["axis"] < 1.1 * 4 * EULER  # pulled towards the clamp, it buckles at four times Euler's load
    assert further.tension["axis"] == pytest.approx(bent.tension["axis"], rel=0.02)


# Load steps


def test_a_load_that_cannot_be_borne_is_reported_with_the_share_that_was() -> None:
    body = hollow("neo_hookean")
    state = solve_equilibrium(body, pressure={"core": 1e6})
    assert state.status == "overload" and 0.0 < state.reached < 1.0
    assert certify(Outcome(state.status, state, body)) > 1e-6
    part = solve_equilibrium(body, pressure={"core": 1e6 * state.reached * 0.9})
    assert part.converged and part.reached == 1.0


def test_load_steps_keep_the_given_losses_along_a_cable() -> None:
    """A cable without friction of its own carries the shares that are given along it, also where load steps are needed."""
    body = bar_body(block_mesh((4, 1, 1)))
    start = solve_equilibrium(body, tension={"side": 1.0})
    along = (np.ones_like(start.segment_tensions[0]), np.array([0.4, 1.0]))
    wanted = solve_equilibrium(body, tension={"side": 4.0}, start=start, options=SolveOptions(along=along))
    assert wanted.segment_tensions[1].tolist() == [1.6, 4.0]
    stepped = solve_equilibrium(body, tension={"side": 4.0}, start=start, options=SolveOptions(along=along, max_iterations=4))
    assert stepped.converged and stepped.iterations > 3 * 4  # more than the first try, and a step or two: these failed
    np.testing.assert_allclose(stepped.segment_tensions[1], [1.6, 4.0])
    np.testing.assert_allclose(stepped.positions, wanted.positions, atol=1e-8)


def test_load_steps_go_on_from_the_start() -> None:
    """Past a snap the way back leads along the other branch, not from rest."""
    body = arch()
    snapped = solve_equilibrium(body, shortening={"down": 0.02})
    let = solve_equilibrium(body, tension={"down": 0.0}, start=snapped)
    most = let.iterations - 1
    again = solve_equilibrium(body, tension={"down": 0.0}, start=snapped, options=SolveOptions(max_iterations=most))
    assert again.converged and again.iterations > most
    np.testing.assert_allclose(again.positions, let.positions, atol=1e-7)


# Cables that contradict each other, friction


def test_of_two_commands_on_one_path_the_shorter_holds() -> None:
    mesh = block_mesh((4, 1, 1))
    twins = tuple(tie_cable(mesh, n, [[0.1, 0.015, 0.03]], [0.0, 0.015, 0.04]) for n in "ab")
    body = make_body(mesh, young_modulus=100e3, poisson_ratio=0.4, clamped=mesh.nodes[:, 0] < 1e-9, cables=twins)
    state = solve_equilibrium(body, shortening={"a": 0.004, "b": 0.007})
    assert state.converged and state.held.tolist() == [False, True] and state.tension["a"] == 0.0
    assert state.shortening["b"] == pytest.approx(0.007, abs=1e-11)
    rigid = solve_equilibrium(body, shortening={"a": 0.004, "b": 0.007}, bilateral=True)
    assert rigid.status == "cables" and "contradict" in rigid.advice


def test_tension_behind_a_bend_is_within_the_limits_of_the_capstan() -> None:
    """Pulled from rest the tension falls by e^(−μθ) at each bend; let go by half it is e^(+μθ) at most and sticks in between."""
    mu = 0.3
    body = bar_body(block_mesh((4, 1, 1)), friction=mu)
    pulled = solve_equilibrium(body, tension={"side": 4.0})
    theta = bend_angles(body.cables[1], pulled.positions)
    along = pulled.segment_tensions[1]
    assert theta.min() > 0.01
    assert along[1] == pytest.approx(4.0 * np.exp(-mu * theta[1]), rel=1e-7)
    assert along[0] == pytest.approx(along[1] * np.exp(-mu * theta[0]), rel=1e-7)
    eased = solve_equilibrium(body, tension={"side": 3.9}, start=pulled)
    np.testing.assert_allclose(eased.segment_tensions[1], along, rtol=1e-9)  # it sticks
    back = solve_equilibrium(body, tension={"side": 1.0}, start=pulled)
    theta = bend_angles(body.cables[1], back.positions)
    assert back.segment_tensions[1][1] == pytest.approx(np.exp(mu * theta[1]), rel=1e-7)
    assert back.segment_tensions[1][0] == pytest.approx(np.exp(mu * theta.sum()), rel=1e-7)


# Bodies that nothing holds


def test_a_loose_part_beside_a_clamped_one_is_singular() -> None:
    one, two = block_mesh((2, 1, 1)), block_mesh((2, 1, 1), start=(0.15, 0.0, 0.0))
    mesh = TetMesh(np.vstack([one.nodes, two.nodes]), np.vstack([one.tets, two.tets + len(one.nodes)]))
    body = make_body(mesh, young_modulus=1e5, poisson_ratio=0.4, density=1e3, clamped=mesh.nodes[:, 0] < 1e-9)
    for gravity in ([0, 0, 0], [0, 0, -9.81]):
        assert solve_equilibrium(body.with_gravity(gravity)).status == "singular"
    ends = make_body(
        mesh,
        young_modulus=1e5,
        poisson_ratio=0.4,
        density=1e3,
        gravity=(0, 0, -9.81),
        clamped=(mesh.nodes[:, 0] < 1e-9) | (mesh.nodes[:, 0] > 0.25 - 1e-9),
    )
    assert solve_equilibrium(ends).converged


@pytest.mark.parametrize(
    "given",
    [
        {"relative_tolerance": float("nan")},
        {"relative_tolerance": 0.0},
        {"max_iterations": 0},
        {"before": (np.ones(3), np.ones(2))},
        {"before": (np.array([np.nan]), np.ones(2))},
    ],
)
def test_settings_that_cannot_be(given: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        solve_equilibrium(bar_body(block_mesh((2, 1, 1))), options=SolveOptions(**given))


def test_a_start_of_a_body_with_other_drives_is_refused() -> None:
    body = hollow()
    start = solve_equilibrium(body)
    bare = make_body(
        body.mesh,
        young_modulus=1e5,
        poisson_ratio=0.4,
        clamped=body.clamped,
        chambers=(find_chamber(body.mesh, "other", [0.05, 0.015, 0.015]),),
    )
    with pytest.raises(InputError, match="other cables or chambers"):
        solve_equilibrium(bare, start=start)


# Abuse


@pytest.mark.parametrize("case", list(cases(25, small=True)), ids=lambda case: f"{case.number} {case.kind}")
def test_abuse_ends_with_a_certificate_or_a_reason(case: Any) -> None:
    outcome = run_case(case)
    if outcome.state is None:
        assert outcome.status == "InputError"
        return
    share = certify(outcome)
    assert outcome.status != "converged" or share < 1e-5


@pytest.mark.parametrize("law", ["corotational", "neo_hookean"])
def test_a_held_cable_moves_a_body_on_which_nothing_at_all_acts_at_rest(law: str) -> None:
    mesh = block_mesh((4, 2, 2), size=(0.5, 0.25, 0.25))  # powers of two: the first residual is 0, not nearly 0
    cable = tie_cable(mesh, "c", [[0.5, 0.125, 0.25]], [-0.5, 0.125, 0.25])
    body = make_body(mesh, young_modulus=1e5, poisson_ratio=0.3, clamped=mesh.nodes[:, 0] < 1e-9, cables=(cable,), law=law)
    assert not internal(body, np.array(mesh.nodes)).forces.any()
    state = solve_equilibrium(body, shortening={"c": 0.01})
    assert state.converged and state.tension["c"] > 1.0 and abs(state.shortening["c"] - 0.01) < 1e-9


def test_a_state_that_is_only_tried_is_given_up_after_some_steps() -> None:
    body = bar_body(block_mesh((5, 2, 2), (LENGTH, WIDTH, SIDE)))
    rest = solve_equilibrium(body)
    pull = dict.fromkeys(body.cable_names, 0.5)
    assert solve_equilibrium(body, tension=pull, start=rest, options=SolveOptions(rough=True)).converged
    once = NewtonOptions(steps_tried=1)
    tried = solve_equilibrium(body, tension=pull, start=rest, options=SolveOptions(rough=True, newton=once))
    assert tried.status == "iterations" and tried.iterations == 1
    wanted = solve_equilibrium(body, tension=pull, start=rest, options=SolveOptions(newton=once))
    assert wanted.converged  # what is not only tried goes on


def test_a_state_that_is_only_tried_is_given_up_where_its_stiffness_stays_indefinite() -> None:
    body = bar_body(block_mesh((5, 2, 2), (LENGTH, WIDTH, SIDE)))
    rest = solve_equilibrium(body)
    x = rest.positions * [1.0, 1.0, 0.1]  # pressed flat
    flat = replace(rest, positions=np.where(body.mesh.nodes[:, :1] < 1e-9, body.mesh.nodes, x))
    back = solve_equilibrium(body, start=flat, options=SolveOptions(rough=True))
    assert back.converged and 1 <= back.indefinite_steps <= NewtonOptions().indefinite_tried
    fewer = NewtonOptions(indefinite_tried=back.indefinite_steps - 1)
    tried = solve_equilibrium(body, start=flat, options=SolveOptions(rough=True, newton=fewer))
    assert tried.status == "iterations" and tried.iterations < back.iterations
    wanted = solve_equilibrium(body, start=flat, options=SolveOptions(newton=fewer))
    assert wanted.converged  # what is not only tried goes on


def test_a_stiffness_is_shifted_in_single_precision_where_it_is_indefinite_in_double_too() -> None:
    body = bar_body(block_mesh((5, 2, 2), (LENGTH, WIDTH, SIDE)))
    pattern, K = body.free_map.pattern, reduced_matrix(body, internal(body, body.mesh.nodes).blocks)
    lowest = float(np.linalg.eigvalsh(K.toarray())[0])

    whole = factorize(pattern, K.data).bytes

    def lowered(share: float, scale: float = 1.0) -> FloatArray:
        return scale * (
            K.data - share * lowest * (pattern.indices == np.repeat(np.arange(pattern.size), np.diff(pattern.indptr)))
        )

    def factored(share: float, shift: float = 0.0, scale: float = 1.0) -> tuple[Any, newton_state.State]:
        state = newton_state.State(body.mesh.nodes, np.zeros(0), np.zeros(0, dtype=bool), [], single=True, shift=shift)
        return stiffness_factor.definite_factor(pattern, lowered(share, scale), state), state

    for share, shift in ((1.5, 0.0), (1.5, 2.2 * lowest), (30.0, 0.0)):
        factor, state = factored(share, shift)
        assert state.single and factor.bytes == whole / 2 and (share - 1.0) * lowest < state.shift
    factor, state = factored(0.5, 30.0 * lowest)
    assert state.single and factor.bytes == whole / 2 and state.shift == 0.0
    share = 1.0 - 1e-8  # definite, but not with seven digits: rounding, which differs with the scale, says where that fails
    scales = np.linspace(1.0, 2.0, 41)
    scale = next(s for s in scales if factorize_definite(pattern, lowered(share, s), single=True, tries=0)[0] is None)
    factor, state = factored(share, scale=scale)
    assert not state.single and factor.bytes == whole and state.shift == 0.0


class _Known:
    """A stiffness that is solved exactly."""

    def __init__(self, matrix: np.ndarray) -> None:
        self.matrix = matrix

    def solve(self, right: np.ndarray) -> np.ndarray:
        return np.linalg.solve(self.matrix, right)


def test_a_stiffness_learns_from_the_steps_since_it_was_factorised() -> None:
    rng = np.random.default_rng(2)
    turned = np.linalg.qr(rng.standard_normal((20, 20)))[0]
    true = turned * np.geomspace(1.0, 100.0, 20) @ turned.T
    factor: Any = _Known(true + 0.4 * turned[:, :3] @ turned[:, :3].T)  # too stiff along three motions
    load, ends = rng.standard_normal(20), list[float]()
    for learns in (False, True):
        secants, x = stiffness_factor.Secants(factor), np.zeros(20)
        for _ in range(7):
            force = load - true @ x
            if learns:
                secants.learn(x, force)
            x = x + secants.solve(force)
        ends.append(float(np.linalg.norm(load - true @ x)))
    assert ends[1] < 0.02 * ends[0]
    step, fell, _ = secants.pairs[-1]
    np.testing.assert_allclose(secants.solve(fell), step, atol=1e-12 + 1e-9 * np.abs(step).max())
    inverse = np.array([secants.solve(unit) for unit in np.eye(20)])
    np.testing.assert_allclose(inverse, inverse.T, atol=1e-9 * np.abs(inverse).max())


def test_a_state_that_is_only_tried_takes_a_lent_factor_as_far_as_it_goes() -> None:
    body = bar_body(block_mesh((5, 2, 2), (LENGTH, WIDTH, SIDE)))
    pull = {"top": 0.3}
    start = solve_equilibrium(body, tension=pull)
    start = replace(start, factor=tangent_at(body, start).factor)
    soft = body.with_stiffness_scale(0.97)
    there = solve_equilibrium(soft, tension=pull, start=start)
    assert np.abs(there.positions - start.positions).max() > 1e-3 * body.reach
    lent = SolveOptions(reuse_factor=True, rough=True)
    tried = solve_equilibrium(soft, tension=pull, start=start, options=lent)
    assert tried.converged and tried.factor is start.factor
    assert np.abs(tried.positions - there.positions).max() < 2 * stiffness_factor.ARRIVED * body.reach
    impatient = replace(lent, newton=NewtonOptions(patience_tried=0))
    assert solve_equilibrium(soft, tension=pull, start=start, options=impatient).factor is not start.factor
