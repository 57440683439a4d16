"""Abuse of the equilibrium solver: random bodies and loads of every bad kind, and a certificate that owes it nothing.

`cases(count)` draws them; `certify` recomputes what a converged state claims. `benchmarks/abuse.py` prints 200 of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from helpers import block_mesh
from hollow import hollow_bar

from femsense.core.errors import InputError
from femsense.fem.assembly import internal
from femsense.fem.body import BodyModel, make_body, tie_cable
from femsense.fem.body_parts import Cable
from femsense.fem.cables import bend_angles, cable_forces, cable_length
from femsense.fem.capstan import capstan_tensions
from femsense.fem.cavities import find_chamber
from femsense.fem.chambers import chamber_volume, volume_gradient
from femsense.fem.equilibrium import ADVICE, Equilibrium, SolveOptions, solve_equilibrium
from femsense.fem.mesh import TetMesh, to_quadratic

SIZE = np.array([0.1, 0.03, 0.03])
CORNER, END = np.array([0.1, 0.03, 0.03]), 0.1 - 1e-9
Solve = Callable[[], tuple[BodyModel, Equilibrium]]


@dataclass(frozen=True, eq=False, slots=True)
class Case:
    """A body with loads; `solve` makes the body too, so that errors of either count."""

    kind: str
    number: int
    solve: Solve


@dataclass(frozen=True, eq=False, slots=True)
class Outcome:
    """How a case ended: a status, or "InputError"."""

    status: str
    state: Equilibrium | None = None
    body: BodyModel | None = None


def run_case(case: Case) -> Outcome:
    """Solve a case. Anything but an InputError is let through."""
    try:
        body, state = case.solve()
    except InputError:
        return Outcome("InputError")
    assert state.status in ADVICE
    return Outcome(state.status, state, body)


# The certificate


def certify(outcome: Outcome, given: dict[str, Any] | None = None) -> float:
    """Return the largest unbalanced force of a state over the sum of all forces [1], put together anew.

    A converged state must also keep the rules of its cables: no held cable pushes, a taut one has its length, a slack one is
    short enough already, friction stays within its cone; and the report must say the same residual.
    """
    state, body = outcome.state, outcome.body
    assert state is not None and body is not None
    force = body.dead_load() + state.nodal_forces - internal(body, state.positions).forces
    size = float(np.abs(body.dead_load() + state.nodal_forces).sum()) + float(
        np.abs(internal(body, state.positions).forces).sum()
    )
    for cable, along in zip(body.cables, state.segment_tensions):
        pull = cable_forces(cable, state.positions, along, len(force))
        force, size = force + pull, size + float(np.abs(pull).sum())
    for chamber in body.chambers:
        push = state.pressure[chamber.name] * volume_gradient(chamber, state.positions)
        force, size = force + push, size + float(np.abs(push).sum())
        grown = chamber_volume(chamber, state.positions) - chamber_volume(chamber, body.mesh.nodes)
        assert abs(grown - state.volume[chamber.name]) <= 1e-12 * abs(chamber_volume(chamber, body.mesh.nodes))
    free = np.zeros(force.size, dtype=bool)
    free[body.free_map.dofs] = True
    worst = float(np.linalg.norm(np.where(free.reshape(-1, 3), force, 0.0), axis=1).max())
    assert abs(worst - state.residual_n) <= 1e-6 * worst + 1e-13 * size, (worst, state.residual_n)
    if state.converged:
        _check_rules(body, state)
    return worst / max(size, 1e-6)  # below a micronewton all is rounding


def _check_rules(body: BodyModel, state: Equilibrium) -> None:
    assert np.isfinite(state.positions).all() and np.isfinite(internal(body, state.positions).energy)
    np.testing.assert_array_equal(
        np.delete(state.positions, body.free_map.dofs // 3, axis=0), np.delete(body.mesh.nodes, body.free_map.dofs // 3, axis=0)
    )
    for cable, along in zip(body.cables, state.segment_tensions):
        T = state.tension[cable.name]
        angles = bend_angles(cable, state.positions)
        if cable.friction > 0 and T > 0:
            low, high = np.exp(-cable.friction * angles), np.exp(cable.friction * angles)
            inner = np.append(along[1:], T)
            assert (along >= inner * low * (1 - 1e-5)).all() and (along <= inner * high * (1 + 1e-5)).all()
            np.testing.assert_allclose(capstan_tensions(cable, angles, along, T), along, rtol=1e-5)
        shorter = cable_length(cable, body.mesh.nodes) - cable_length(cable, state.positions)
        assert abs(shorter - state.shortening[cable.name]) < 1e-12


def check_cables(case_given: dict[str, Any], outcome: Outcome) -> None:
    """Check a converged state against what was asked of cables and chambers: complementarity, tensions, volumes."""
    state, body = outcome.state, outcome.body
    assert state is not None and body is not None
    for i, (name, wanted) in enumerate((n, case_given.get("shortening", {}).get(n)) for n in body.cable_names):
        T = state.tension[name]
        if wanted is None:
            assert case_given.get("tension", {}).get(name, 0.0) == T
            continue
        reached = state.shortening[name] + T / body.cables[i].stretch_stiffness
        if case_given.get("bilateral") or state.held[i]:
            assert abs(reached - wanted) < 1e-10
        if not case_given.get("bilateral"):
            assert T >= -1e-10 and reached >= wanted - 2e-9 and (state.held[i] or T == 0.0)
    for name in body.chamber_names:
        if name in case_given.get("volume", {}):
            assert abs(state.volume[name] - case_given["volume"][name]) < 1e-14
        else:
            assert state.pressure[name] == case_given.get("pressure", {}).get(name, 0.0)


# The cases


def cases(count: int, *, small: bool = False) -> Iterator[Case]:
    """Yield cases, all kinds in turn. `small`: meshes of a few elements."""
    for number in range(count):
        kind = list(KINDS)[number % len(KINDS)]
        yield Case(kind, number, _maker(kind, number, small))


def _maker(kind: str, number: int, small: bool) -> Solve:
    def solve() -> tuple[BodyModel, Equilibrium]:
        rng = np.random.default_rng([number, 7])
        body, given = KINDS[kind](rng, small)
        memory = {key: given[key] for key in ("before", "reuse_factor", "relative_tolerance") if key in given}
        drive = {key: value for key, value in given.items() if key not in memory}
        state = solve_equilibrium(body, **drive, options=SolveOptions(**memory))
        if state.converged:
            check_cables(given, Outcome(state.status, state, body))
        return body, state

    return solve


def _mesh(rng: np.random.Generator, small: bool) -> TetMesh:
    mesh = block_mesh((3, 1, 1) if small else (6, 2, 2), SIZE)
    return to_quadratic(mesh) if rng.random() < 0.4 and not small else mesh


def _cables(mesh: TetMesh, friction: float = 0.0) -> tuple[Cable, ...]:
    ends = {"exit_direction": [0.0, 0.0, -1.0], "friction": friction}
    return (
        tie_cable(mesh, "top", [[0.1, 0.015, 0.03], [0.05, 0.012, 0.03]], [-0.005, 0.015, 0.042], **ends),
        tie_cable(mesh, "low", [[0.1, 0.015, 0.0]], [-0.005, 0.015, -0.012], **ends),
        tie_cable(mesh, "side", [[0.1, 0.03, 0.015], [0.06, 0.027, 0.021]], [-0.005, 0.042, 0.015], **ends),
    )


def _body(rng: np.random.Generator, small: bool, mesh: TetMesh | None = None, **changes: Any) -> BodyModel:
    mesh = mesh or _mesh(rng, small)
    law = str(rng.choice(["corotational", "neo_hookean", "gent"]))
    friction = changes.pop("friction", 0.0)
    settings = {
        "young_modulus": 100e3,
        "poisson_ratio": 0.42,
        "density": 1070.0,
        "law": law,
        "gravity": (0.0, 0.0, -9.81),
        "clamped": mesh.nodes[:, 0] < 1e-9,
        "cables": _cables(mesh, friction),
        **changes,
    }
    body = make_body(mesh, **settings)
    return body.with_material(replace(body.material, stretch_limit=float(rng.uniform(0.5, 5.0)))) if law == "gent" else body


def _random_forces(rng: np.random.Generator, body: BodyModel, size: float) -> np.ndarray:
    forces = np.zeros_like(body.mesh.nodes)
    forces[rng.choice(len(forces), 3, replace=False)] = rng.normal(0.0, size, (3, 3))
    return forces


def _end(body: BodyModel, total: np.ndarray) -> np.ndarray:
    at = body.mesh.nodes[:, 0] > END
    return np.where(at[:, None], np.asarray(total) / at.sum(), 0.0)


def _random(rng: np.random.Generator, small: bool) -> tuple[BodyModel, dict[str, Any]]:
    body = _body(rng, small)
    tension = dict(zip(body.cable_names, rng.uniform(0.0, 6.0, 3)))
    return body, {"tension": tension, "nodal_forces": _random_forces(rng, body, 10 ** rng.uniform(-2, 1.5))}


def _column(rng: np.random.Generator, small: bool) -> tuple[BodyModel, dict[str, Any]]:
    body = _body(rng, small, cables=(), gravity=(0.0, 0.0, 0.0))
    push = [-(10 ** rng.uniform(0.5, 2.2)), 0.0, rng.choice([0.0, 1e-6, 1e-2])]
    return body, {"nodal_forces": _end(body, np.array(push))}


def _held(rng: np.random.Generator, small: bool) -> tuple[BodyModel, dict[str, Any]]:
    body = _body(rng, small)
    return body, {"shortening": dict(zip(body.cable_names, rng.normal(0.0, 10 ** rng.uniform(-3.5, -1.5), 3)))}


def _mixed(rng: np.random.Generator, small: bool) -> tuple[BodyModel, dict[str, Any]]:
    body = _body(rng, small, young_modulus=10 ** rng.uniform(3.5, 6))
    given: dict[str, Any] = {
        "tension": {"top": rng.uniform(0, 10)},
        "shortening": {"low": rng.normal(0, 0.01), "side": rng.normal(0, 0.02)},
    }
    return body, given | {"nodal_forces": _random_forces(rng, body, 0.5)}


def _bilateral(rng: np.random.Generator, small: bool) -> tuple[BodyModel, dict[str, Any]]:
    body = _body(rng, small)
    return body, {"shortening": dict(zip(body.cable_names, rng.normal(0.0, 0.01, 3))), "bilateral": True}


def _conflict(rng: np.random.Generator, small: bool) -> tuple[BodyModel, dict[str, Any]]:
    """Two cables on one path, held at two lengths."""
    mesh = _mesh(rng, small)
    twins = tuple(tie_cable(mesh, n, [[0.1, 0.015, 0.03]], [0.0, 0.015, 0.04]) for n in "ab")
    body = _body(rng, small, mesh, cables=twins)
    return body, {"shortening": {"a": rng.uniform(0.0, 0.01), "b": rng.uniform(0.0, 0.01)}, "bilateral": bool(rng.random() < 0.5)}


def _touching(rng: np.random.Generator, small: bool) -> tuple[BodyModel, dict[str, Any]]:
    """A cable whose pull point is where it is tied."""
    mesh = _mesh(rng, small)
    body = _body(rng, small, mesh, cables=(tie_cable(mesh, "knot", [[0.1, 0.015, 0.03]], [0.1, 0.015, 0.03]),))
    return body, {"tension": {"knot": 10 ** rng.uniform(-2, 1)}} if rng.random() < 0.5 else {
        "shortening": {"knot": rng.normal(0, 0.01)}
    }


def _squeezed(rng: np.random.Generator, small: bool) -> tuple[BodyModel, dict[str, Any]]:
    body = _body(rng, small)
    z = body.mesh.nodes[:, 2]
    squeeze = 10 ** rng.uniform(0, 3.5)
    return body, {
        "nodal_forces": np.outer(np.where(z > 0.03 - 1e-9, -1.0, np.where(z < 1e-9, 1.0, 0.0)), [0, 0, squeeze / len(z)])
    }


def _huge(rng: np.random.Generator, small: bool) -> tuple[BodyModel, dict[str, Any]]:
    body = _body(rng, small)
    size = 10 ** rng.uniform(3, 9)
    return body, {"tension": {"top": size}} if rng.random() < 0.5 else {"nodal_forces": _random_forces(rng, body, size)}


def _one_node(rng: np.random.Generator, small: bool) -> tuple[BodyModel, dict[str, Any]]:
    """Held at one node, at two, or nowhere; by cables besides, or not."""
    mesh = _mesh(rng, small)
    clamped = rng.choice(len(mesh.nodes), int(rng.integers(0, 3)), replace=False)
    body = _body(rng, small, mesh, clamped=clamped, gravity=(0.0, 0.0, rng.choice([0.0, -9.81])))
    return body, {"tension": dict(zip(body.cable_names, rng.uniform(0.0, 2.0, 3)))} if rng.random() < 0.5 else {
        "shortening": {"top": 0.0, "low": 0.0, "side": 0.0}
    }


def _two_bodies(rng: np.random.Generator, small: bool) -> tuple[BodyModel, dict[str, Any]]:
    one, two = block_mesh((2, 1, 1)), block_mesh((2, 1, 1), start=(0.15, 0.0, 0.0))
    mesh = TetMesh(np.vstack([one.nodes, two.nodes]), np.vstack([one.tets, two.tets + len(one.nodes)]))
    body = _body(rng, small, mesh, cables=(), gravity=(0.0, 0.0, rng.choice([0.0, -9.81])))
    return body, {"nodal_forces": _random_forces(rng, body, 0.1)} if rng.random() < 0.7 else {}


def _slivers(rng: np.random.Generator, small: bool) -> tuple[BodyModel, dict[str, Any]]:
    mesh = block_mesh((3, 1, 1) if small else (5, 2, 2), SIZE)
    nodes = mesh.nodes.copy()
    inner = (nodes[:, 0] > 1e-9) & (nodes[:, 0] < END)
    nodes[inner, 0] += rng.uniform(-0.49, 0.49, inner.sum()) * SIZE[0] / (3 if small else 5) * (1 - 10 ** rng.uniform(-6, -1))
    body = _body(rng, small, TetMesh(nodes * [1.0, 1.0, 10 ** rng.uniform(-3, 0)], mesh.tets), cables=())
    return body, {"nodal_forces": _random_forces(rng, body, 10 ** rng.uniform(-4, 0))}


def _inverted(rng: np.random.Generator, small: bool) -> tuple[BodyModel, dict[str, Any]]:
    mesh = block_mesh((3, 1, 1), SIZE)
    nodes, tets = mesh.nodes.copy(), mesh.tets.copy()
    if rng.random() < 0.5:
        nodes[tets[3, 0]] = nodes[tets[3, 1:]].mean(axis=0)  # flat
    else:
        tets[2] = tets[2][[1, 0, 2, 3]]
    return _body(rng, small, TetMesh(nodes, tets), cables=()), {}


def _not_numbers(rng: np.random.Generator, small: bool) -> tuple[BodyModel, dict[str, Any]]:
    body, bad = _body(rng, small), float(rng.choice([np.nan, np.inf, -np.inf]))
    forces = np.zeros_like(body.mesh.nodes)
    forces[0, 0] = bad
    which = int(rng.integers(0, 8))
    if which == 5:
        return body.with_gravity([0.0, bad, 0.0]), {}
    if which == 6:
        return _body(rng, small, density=bad), {}
    if which == 7:
        return _body(rng, small, friction=bad), {}
    given: list[dict[str, Any]] = [
        {"nodal_forces": forces},
        {"tension": {"top": bad}},
        {"shortening": {"top": bad}},
        {"before": (np.full(2, bad), np.zeros(1), np.zeros(2))},
        {"relative_tolerance": bad},
    ]
    return body, given[which]


def _material(rng: np.random.Generator, small: bool) -> tuple[BodyModel, dict[str, Any]]:
    nu = float(rng.choice([0.4999, 0.499999, 0.49999999, -0.5, -0.999]))
    E = 10 ** float(rng.choice([-300.0, -12.0, -3.0, 1.0, 5.0, 12.0, 100.0]))
    body = _body(rng, small, young_modulus=E, poisson_ratio=nu)
    return body, {"tension": {"top": 0.5}, "shortening": {"low": 0.001}}


def _friction(rng: np.random.Generator, small: bool) -> tuple[BodyModel, dict[str, Any]]:
    body = _body(rng, small, friction=10 ** rng.uniform(-2, 0.5))
    before = tuple(rng.uniform(0.0, 3.0, len(c.path)) for c in body.cables)
    if rng.random() < 0.5:
        return body, {"tension": dict(zip(body.cable_names, rng.uniform(0.0, 6.0, 3))), "before": before}
    return body, {"shortening": dict(zip(body.cable_names, rng.normal(0.0, 0.008, 3))), "before": before}


def _chambers(rng: np.random.Generator, small: bool) -> tuple[BodyModel, dict[str, Any]]:
    mesh = hollow_bar(cells=(3, 3, 3), quadratic=not small and bool(rng.random() < 0.4))
    body = _body(rng, small, mesh, chambers=(find_chamber(mesh, "core", [0.05, 0.015, 0.015]),))
    given: dict[str, Any] = {"shortening": {"top": rng.normal(0.0, 0.004)}}
    if rng.random() < 0.5:
        return body, given | {"pressure": {"core": rng.choice([-1, 1]) * 10 ** rng.uniform(3, 6.5)}}
    return body, given | {"volume": {"core": rng.normal(0.0, 3.0) * 3.3e-6 * 10 ** rng.uniform(-2, 0.5)}}


def _wild_start(rng: np.random.Generator, small: bool) -> tuple[BodyModel, dict[str, Any]]:
    """A start that is another body's, far away, perhaps inside out, with its factor."""
    body = _body(rng, small)
    state = solve_equilibrium(
        body.with_material(replace(body.material, law="corotational")), nodal_forces=_random_forces(rng, body, 3.0)
    )
    if rng.random() < 0.5:
        state = replace(state, positions=state.positions + rng.normal(0.0, 0.01, state.positions.shape))
    tension = dict(zip(body.cable_names, rng.uniform(0.0, 3.0, 3)))
    given = {"tension": tension} if rng.random() < 0.5 else {"shortening": dict(zip(body.cable_names, rng.normal(0.0, 0.005, 3)))}
    return body, given | {"start": state, "reuse_factor": bool(rng.random() < 0.7)}


def _springs(rng: np.random.Generator, small: bool) -> tuple[BodyModel, dict[str, Any]]:
    """Cables that stretch, a clamp of springs."""
    body = _body(rng, small)
    body = body.with_cables(tuple(replace(c, stretch_stiffness=10 ** rng.uniform(0, 4)) for c in body.cables))
    body = body.with_clamp_stiffness(10 ** rng.uniform(-2, 5))
    return body, {"shortening": dict(zip(body.cable_names, rng.normal(0.0, 0.01, 3)))}


def _snap(rng: np.random.Generator, small: bool) -> tuple[BodyModel, dict[str, Any]]:
    """A shallow arch, clamped at both ends, pressed at its crown; sometimes by a held cable."""
    mesh = block_mesh((8 if small else 16, 1, 1), (0.1, 0.01, 0.003))
    nodes = mesh.nodes.copy()
    nodes[:, 2] += rng.uniform(0.002, 0.008) * np.sin(np.pi * nodes[:, 0] / 0.1)
    crown = [[0.05, 0.005, nodes[:, 2].max()]]
    mesh = TetMesh(nodes, mesh.tets)
    ends = (nodes[:, 0] < 1e-9) | (nodes[:, 0] > END)
    body = _body(rng, small, mesh, clamped=ends, cables=(tie_cable(mesh, "down", crown, [0.05, 0.005, -0.05]),))
    return body, {"tension": {"down": rng.uniform(0, 3)}} if rng.random() < 0.5 else {
        "shortening": {"down": rng.uniform(0, 0.02)}
    }


KINDS: dict[str, Callable[[np.random.Generator, bool], tuple[BodyModel, dict[str, Any]]]] = {
    "random loads": _random,
    "columns": _column,
    "held cables": _held,
    "mixed control": _mixed,
    "bilateral": _bilateral,
    "two lengths at once": _conflict,
    "cable without length": _touching,
    "squeezed": _squeezed,
    "huge loads": _huge,
    "hardly clamped": _one_node,
    "two bodies": _two_bodies,
    "slivers": _slivers,
    "flat or inverted": _inverted,
    "not numbers": _not_numbers,
    "absurd material": _material,
    "friction": _friction,
    "chambers": _chambers,
    "wild start": _wild_start,
    "springs": _springs,
    "snap-through": _snap,
}
