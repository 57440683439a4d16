"""Blind cases for the loop: three robots, both control modes, one hidden thing or none, made by another path than the fitter's.

The truth lives on a finer mesh than the declared robot, under a law that the declared robot states (or not:
then the law is what is hidden), with the rig's own integrators of friction and creep, followed in small steps. Every case has a
modulus that is off by up to 20 %, an unknown camera pose, and markers with noise of their own, of the frame, of the sweep, and of
the place where they are glued.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from femsense import (
    About,
    Drives,
    Equilibrium,
    LoadRows,
    MarkerRows,
    Recording,
    RestMarkers,
    Robot,
    TetMesh,
    Timeline,
    apply_effects,
    embed_points,
    make_body,
    make_recording,
    tie_cable,
)
from femsense.core.arrays import FloatArray, freeze
from femsense.core.pose import invert_pose, make_pose, rotation_from_vector, transform_points
from femsense.fem.mesh import to_quadratic
from femsense.model.robot import Observation, plain_actuation, spread_features
from femsense.rig.plan import Plan, PlannedContact
from femsense.rig.script import ContactTable
from femsense.rig.true_path import true_path

CUBE_TETS = np.array([[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]])
"""Six tetrahedra of a cube with corners 4 x + 2 y + z (Kuhn)."""
EARTH = (0.0, 0.0, -9.81)


# --- three robots ----------------------------------------------------------------------------------------------------------


def bar_mesh(cells: Sequence[int], shape: Callable[[FloatArray], FloatArray], element: str = "tet10") -> TetMesh:
    """Return a bar of cells × 6 tetrahedra; `shape` maps the box [0, 1] × [−1, 1]² to metres."""
    axes = [np.linspace(low, 1.0, count + 1) for low, count in zip((0.0, -1.0, -1.0), cells)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(len(nodes)).reshape(np.asarray(cells) + 1)
    corner = [(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    cubes = np.stack([number[i : i + cells[0], j : j + cells[1], k : k + cells[2]].ravel() for i, j, k in corner], axis=1)
    nodes = shape(nodes)
    tets = cubes[:, CUBE_TETS].reshape(-1, 4)
    x = nodes[tets]
    flip = np.linalg.det(x[:, 1:] - x[:, :1]) < 0
    tets[flip] = tets[flip][:, [0, 2, 1, 3]]
    mesh = TetMesh(nodes, tets)
    return to_quadratic(mesh) if element == "tet10" else mesh


@dataclass(frozen=True)
class Design:
    """One kind of robot: its shape, cables and markers."""

    name: str
    coarse: tuple[int, int, int]
    fine: tuple[int, int, int]
    shape: Callable[[FloatArray], FloatArray]
    cables: dict[str, tuple[list[list[float]], list[float]]]
    """name → (path, pull point)."""
    marker_stations: tuple[float, ...]
    """Shares of the length."""
    modulus: float
    tension: float
    """Highest tension of one cable [N]."""

    def finer(self, times: int) -> Design:
        """Return the design with a truth of so many times the declared cells along each side."""
        return replace(self, fine=(times * self.coarse[0], times * self.coarse[1], times * self.coarse[2]))

    def robot(self, *, fine: bool, law: str, gravity: Sequence[float], modulus: float, element: str = "tet10") -> Robot:
        """Return the robot on its coarse (declared) or fine (true) mesh."""
        mesh = bar_mesh(self.fine if fine else self.coarse, self.shape, element)
        clamped = np.flatnonzero(mesh.nodes[:, 0] < 1e-9)
        corners = clamped[np.isin(clamped, mesh.tets[:, :4])]
        cables = tuple(
            tie_cable(
                mesh,
                name,
                path,
                pull,
                exit_direction=[-0.5, *(np.asarray(pull[1:]) / max(np.linalg.norm(pull[1:]), 1e-9))],
                max_tension=20.0,
            )
            for name, (path, pull) in self.cables.items()
        )
        body = make_body(
            mesh,
            young_modulus=modulus,
            poisson_ratio=0.45,
            density=1070.0,
            law=law,
            clamped=clamped,
            cables=cables,
            gravity=gravity,
        ).with_clamp_nodes(clamped if fine else corners)  # as a file has it that declares corners, whatever the elements
        corners = [self.shape(np.array([[s, *c]]))[0] for s in self.marker_stations for c in ((0, 1), (0, -1), (1, 0), (-1, 0))]
        points = np.array(corners)
        names = tuple(f"m{i:02d}" for i in range(len(points)))
        return Robot(
            self.name,
            body,
            names,
            freeze(points),
            embed_points(mesh, points),
            spread_features(body, 30),
            None,
            plain_actuation(len(cables)),
            Observation(),
        )


def _arm(p: FloatArray) -> FloatArray:
    return np.column_stack([0.1 * p[:, 0], 0.010 * p[:, 1:]])


def _trunk(p: FloatArray) -> FloatArray:
    return np.column_stack([0.12 * p[:, 0], (0.012 - 0.004 * p[:, :1]) * p[:, 1:]])


def _finger(p: FloatArray) -> FloatArray:
    return np.column_stack([0.09 * p[:, 0], 0.008 * p[:, 1], 0.007 * p[:, 2] * (1.0 - 0.3 * p[:, 0]) + 0.001])


def _around(radius: float, angle: float) -> list[float]:
    return [radius * np.cos(angle), radius * np.sin(angle)]


ARM = Design(
    "arm",
    (11, 2, 2),
    (15, 3, 3),
    _arm,
    {
        n: ([[0.095, *_around(0.007, a)], [0.05, *_around(0.007, a)]], [-0.01, *_around(0.010, a)])
        for n, a in (("a", 0.0), ("b", np.pi / 2), ("c", np.pi), ("d", -np.pi / 2))
    },
    (0.04, 0.35, 0.65, 0.98),
    300e3,
    2.0,
)
TRUNK = Design(
    "trunk",
    (12, 2, 2),
    (16, 3, 3),
    _trunk,
    {
        n: ([[0.115, *_around(0.005, a)], [0.08, *_around(0.006, a)], [0.04, *_around(0.007, a)]], [-0.01, *_around(0.011, a)])
        for n, a in (("a", 0.1), ("b", 2.2), ("c", 4.3))
    },
    (0.04, 0.3, 0.6, 0.97),
    250e3,
    1.6,
)
FINGER = Design(
    "finger",
    (11, 2, 2),
    (15, 3, 3),
    _finger,
    {"bend": ([[0.085, 0.0, -0.0045], [0.06, 0.0, -0.005], [0.04, 0.0, -0.0055], [0.02, 0.0, -0.006]], [-0.012, 0.0, -0.009])},
    (0.05, 0.35, 0.65, 0.98),
    400e3,
    0.9,
)
DESIGNS = (ARM, TRUNK, FINGER)


# --- cases -------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """What is hidden in one recording. `kind`: null, single, two, outside or poor."""

    number: int
    kind: str
    design: Design
    control: str
    white_m: float
    hidden: tuple[dict[str, Any], ...]
    """Entries of `[[effects]]` that only the truth has."""
    outside: str = ""
    size: float = 1.0
    placements: bool = False
    """Whether rest.csv measures the placement of the markers."""
    poor: bool = False
    """One sweep up only."""
    hyperelastic: bool = True
    """Whether truth is neo-Hookean (and the declared robot says so, unless the law is what is hidden)."""
    declared_gravity: bool = True
    element: str = "tet10"
    """Of the declared mesh."""
    modulus_scale: float | None = None
    """True over declared modulus; None draws it."""

    @property
    def label(self) -> str:
        return "+".join(e["name"] for e in self.hidden) or self.outside or "none"


def _size(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def hidden_effect(name: str, design: Design, control: str, rng: np.random.Generator) -> dict[str, Any]:
    """Return an entry with a size drawn log-uniformly over its plausible range."""
    cables = list(design.cables)
    span = design.shape(np.array([[1.0, 0.0, 0.0]]))[0, 0]
    sign = float(rng.choice([-1, 1]))
    one = {str(rng.choice(cables)): 1.0}
    unit = "tension_n" if control == "tension" else "displacement_m"
    scale = design.tension if control == "tension" else 6e-3
    force = rng.normal(size=3)
    place = design.shape(np.array([[rng.uniform(0.5, 1.0), 0.0, 1.0]]))[0]
    middle = design.shape(np.array([[rng.uniform(0.15, 0.8), 0.0, 0.0]]))[0]
    tables: dict[str, Callable[[], dict[str, Any]]] = {
        "gravity": lambda: {"vector_m_s2": list(EARTH)},
        "stiffness": lambda: {"scale": float(np.exp(sign * _size(rng, 0.05, 0.3)))},
        "poisson": lambda: {"poisson_ratio": float(0.45 - _size(rng, 0.02, 0.15))},
        "soft_region": lambda: {
            "center_m": middle.tolist(),
            "radius_m": float(rng.uniform(0.15, 0.22) * span),
            "scale": float(np.exp(sign * _size(rng, 0.2, 0.9))),
        },
        "hyperelastic": lambda: {"law": "neo_hookean"},
        "creep": lambda: {"fraction": _size(rng, 0.04, 0.3), "time_s": _size(rng, 2.0, 30.0)},
        "payload": lambda: {
            "point_m": place.tolist(),
            "force_n": (force / np.linalg.norm(force) * _size(rng, 0.02, 0.2)).tolist(),
        },
        "base_compliance": lambda: {"stiffness_n_m": _size(rng, 30.0, 1500.0)},
        "cable_friction": lambda: {"coefficient": _size(rng, 0.03, 0.4)},
        "cable_offset": lambda: {
            unit: {
                k: sign * scale * _size(rng, 0.04, 0.2) if control == "displacement" else scale * _size(rng, 0.04, 0.2)
                for k in one
            }
        },
        "cable_gain": lambda: {"scale": {k: float(np.exp(sign * _size(rng, 0.03, 0.25))) for k in one}},
        "cable_stretch": lambda: {"stiffness_n_m": _size(rng, 500.0, 1e4)},
        "cable_slack": lambda: {"displacement_m": {k: _size(rng, 2e-4, 2e-3) for k in one}},
        "geometry": lambda: {"scale": 1.0 + sign * _size(rng, 0.005, 0.05)},
        "depth_scale": lambda: {"scale": 1.0 + sign * _size(rng, 0.003, 0.03), "offset_m": 0.0},
        "marker_offset": lambda: {
            "offset_m": {
                f"m{rng.integers(len(design.marker_stations) * 4):02d}": (
                    force / np.linalg.norm(force) * _size(rng, 8e-4, 4e-3)
                ).tolist()
            }
        },
    }
    return {"name": name, **tables[name]()}


TENSION_EFFECTS = (
    "gravity",
    "poisson",
    "soft_region",
    "hyperelastic",
    "creep",
    "payload",
    "base_compliance",
    "cable_friction",
    "cable_offset",
    "cable_gain",
    "depth_scale",
    "marker_offset",
    "geometry",
)
DISPLACEMENT_EFFECTS = (
    "gravity",
    "poisson",
    "soft_region",
    "hyperelastic",
    "payload",
    "base_compliance",
    "cable_offset",
    "cable_gain",
    "cable_stretch",
    "cable_slack",
    "depth_scale",
    "marker_offset",
    "geometry",
)
OUTSIDE = ("contact", "cross_talk", "slipped_marker", "draught", "kinked_cable", "camera_drift", "late_log")


def make_cases(seed: int, counts: dict[str, int], finer: int | None = None, element: str = "tet10") -> list[Case]:
    """Return cases of the kinds and numbers asked for; the same for the same seed. `finer`: cells of truths,
    in units of the declared ones; by default 1.3 to 1.5. `element`: of the declared meshes."""
    rng = np.random.default_rng(seed)
    cases: list[Case] = []
    for kind, count in counts.items():
        for i in range(count):
            case = replace(_case(len(cases), kind, i, rng), element=element)
            cases.append(case if finer is None else replace(case, design=case.design.finer(finer)))
    return cases


def _case(number: int, kind: str, i: int, rng: np.random.Generator) -> Case:
    control = "displacement" if i % 3 == 2 else "tension"
    design = DESIGNS[int(rng.integers(3))]
    names = TENSION_EFFECTS if control == "tension" else DISPLACEMENT_EFFECTS
    hidden: tuple[dict[str, Any], ...] = ()
    outside = ""
    if kind == "single":
        hidden = (
            hidden_effect(names[(i // 3 * 2 + i % 3 if control == "tension" else i // 3) % len(names)], design, control, rng),
        )
    if kind == "two":
        pair = rng.choice([n for n in names if n not in ("marker_offset", "gravity")], 2, replace=False)
        hidden = tuple(hidden_effect(str(n), design, control, rng) for n in pair)
    if kind == "outside":
        options = [o for o in OUTSIDE if len(design.cables) > 1 or o != "cross_talk"]
        outside = options[i % len(options)]
    if kind == "poor":
        control = "tension"
        hidden = (hidden_effect(("cable_friction", "gravity")[i % 2], design, control, rng),)
    found = [e["name"] for e in hidden]
    law_hidden = "hyperelastic" in found
    return Case(
        number,
        kind,
        design,
        control,
        float(rng.choice([1e-4, 3e-4])),
        hidden,
        outside,
        _size(rng, 0.5, 2.0),
        bool(rng.random() < 0.5) and "marker_offset" not in found,
        kind == "poor",
        law_hidden or bool(rng.random() < 0.5),
        "gravity" not in found,
    )


# --- from case to data ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Made:
    """A case with its data."""

    case: Case
    declared: Robot
    recording: Recording
    truth: FloatArray
    """True markers without noise [m], shape (F, k, 3), robot frame."""
    T_robot_camera: FloatArray
    modulus_scale: float
    noise: dict[str, float]


def make_data(case: Case, seed: int) -> Made:
    """Follow the true path of a case and measure it."""
    rng = np.random.default_rng([seed, case.number])
    design = case.design
    law = "neo_hookean" if case.hyperelastic else "corotational"
    law_hidden = any(e["name"] == "hyperelastic" for e in case.hidden)
    drawn = float(rng.uniform(0.8, 1.2))
    scale = drawn if case.modulus_scale is None else case.modulus_scale
    declared = design.robot(
        fine=False,
        law="corotational" if law_hidden else law,
        gravity=EARTH if case.declared_gravity else (0, 0, 0),
        modulus=design.modulus,
        element=case.element,
    )
    if law == "corotational" and any(e["name"] == "hyperelastic" for e in case.hidden):
        raise ValueError("the hidden law needs a hyperelastic truth")
    true = design.robot(fine=True, law=law, gravity=EARTH if case.declared_gravity else (0, 0, 0), modulus=scale * design.modulus)
    true = apply_effects(true, [on_other_clamp(e, declared, true) for e in case.hidden if e["name"] != "hyperelastic"])
    recorded, labels, time_s = excursions(design, case.control, rng, poor=case.poor)
    loads = _known_loads(design, labels, rng) if not case.poor else (np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
    F, a = recorded.shape
    plan = Plan(
        control=case.control,
        time_s=freeze(time_s),
        sweep=tuple(labels),
        free=freeze(np.ones(F), bool),
        commanded=freeze(_driven(case, recorded, time_s)),
        initial=freeze(np.zeros(a)),
        pressures=freeze(np.zeros((F, 0))),
        gravity=None,
        load_frame=freeze(loads[0], np.int64),
        load_points=freeze(loads[1]),
        load_forces=freeze(loads[2]),
        contacts=_contacts(case, labels, rng),
    )
    if case.outside == "draught":
        true = replace(true, body=true.body.with_gravity(true.body.gravity + 1.2 * case.size * np.array([0.3, 1.0, 0.2])))
        plan = replace(plan, gravity=freeze(_gusts(declared, true, labels)))
    states = [f.state for f in true_path(true, plan, substeps=2)]
    recording, T, noise = _measure(case, declared, true, plan, recorded, states, rng)
    return Made(case, declared, recording, _seen(true, states), T, scale, noise)


def _seen(true: Robot, states: Sequence[Equilibrium], placement: FloatArray | None = None) -> FloatArray:
    """Return the true markers [m], shape (F, k, 3), that sit elsewhere on the body at rest by `placement` (k, 3):
    their error turns with the body."""
    ties = true.markers if placement is None else true.tie_markers(true.marker_points + placement)
    return np.array([ties.positions(s.positions) for s in states])


def on_other_clamp(entry: dict[str, Any], declared: Robot, other: Robot) -> dict[str, Any]:
    """Return an entry whose springs, one a node of the declared mesh,
    are spread over the nodes of another one and resist turning alike."""
    if entry["name"] != "base_compliance" or "stiffness_n_m" not in entry:
        return entry
    second = [
        float(np.sum(np.square(n - n.mean(axis=0)))) for n in (r.body.mesh.nodes[r.body.clamp_nodes] for r in (declared, other))
    ]
    return {**entry, "stiffness_n_m": entry["stiffness_n_m"] * second[0] / second[1]}


def excursions(design: Design, control: str, rng: np.random.Generator, *, poor: bool) -> tuple[FloatArray, list[str], FloatArray]:
    """Return inputs (F, a), sweep labels and times: each cable up, held and down at two levels, then mixtures;
    one sweep up if poor."""
    count, top = len(design.cables), design.tension if control == "tension" else 6e-3
    if poor:
        rows = np.outer(np.linspace(0, 1, 8), np.eye(count)[0])
        return top * rows, ["only"] * 8, np.arange(8) * 1.0
    mixes = [np.eye(count)[i] for i in range(count)]
    if count > 1:
        mixes += [rng.uniform(0.3, 0.8, count) * (rng.random(count) < 0.6) + 0.2 for _ in range(2)]
    else:
        mixes += [np.array([0.6]), np.array([0.85]), np.array([0.4])]
    levels = [0.0, 0.5, 1.0, 1.0, 0.5, 0.0]
    pace = [1.0, 1.0, 1.0, 12.0, 1.0, 1.0]
    order = rng.permutation(len(mixes))
    rows = np.array([level * mixes[m] for m in order for level in levels])
    labels = [f"s{i}" for i in range(len(mixes)) for _ in levels]
    return top * rows, labels, np.cumsum(pace * len(mixes)) - 1.0


def _known_loads(design: Design, labels: list[str], rng: np.random.Generator) -> tuple[Any, FloatArray, FloatArray]:
    """Hang a known weight on the tip in one sweep."""
    rows = np.flatnonzero([label == "s1" for label in labels])
    point = design.shape(np.array([[0.97, 0.0, 1.0]]))[0]
    return rows, np.tile(point, (len(rows), 1)), np.tile([0.0, 0.0, -0.08], (len(rows), 1))


def _driven(case: Case, recorded: FloatArray, time_s: FloatArray) -> FloatArray:
    """Return what the motors were truly told."""
    if case.outside == "cross_talk":
        mix = np.eye(recorded.shape[1])
        mix[0, 1] = 0.12 * case.size
        return recorded @ mix.T if case.control == "tension" else recorded @ mix
    if case.outside == "commanded":  # motors hold a tension to 2 % of itself and of the largest one, and nobody measures it
        rng, level = np.random.default_rng([7, case.number]), recorded.max()
        off = 0.02 * case.size * (recorded * rng.normal(size=recorded.shape) + level * rng.normal(size=recorded.shape[1]))
        return np.maximum(recorded + np.where(recorded > 0.0, off, 0.0), 0.0)
    if case.outside == "kinked_cable":
        limit = 0.7 / case.size**0.3 * recorded[:, 0].max()
        return np.column_stack([np.minimum(recorded[:, 0], limit), recorded[:, 1:]])
    if case.outside == "late_log":
        lag = 0.35 * case.size
        return np.column_stack([np.interp(time_s - lag, time_s, c) for c in recorded.T])
    return recorded


def _contacts(case: Case, labels: list[str], rng: np.random.Generator) -> tuple[PlannedContact, ...]:
    if case.outside != "contact":
        return ()
    where = sorted(set(labels))
    chosen = where[int(rng.integers(len(where)))]
    point = case.design.shape(np.array([[rng.uniform(0.4, 0.9), 1.0, 0.0]]))[0]
    force = np.where(np.array(labels) == chosen, 0.06 * case.size, 0.0)
    table = ContactTable.model_validate({"sweep": chosen, "point_m": point.tolist(), "radius_m": 0.006, "force_n": 1.0})
    return (PlannedContact(table, freeze(force)),)


def _gusts(declared: Robot, true: Robot, labels: list[str]) -> FloatArray:
    """A draught that blows in every second sweep."""
    names = sorted(set(labels))
    blown = np.array([names.index(label) % 2 for label in labels], dtype=float)
    return declared.body.gravity + blown[:, None] * (true.body.gravity - declared.body.gravity)


def _measure(
    case: Case,
    declared: Robot,
    true: Robot,
    plan: Plan,
    recorded: FloatArray,
    states: Sequence[Equilibrium],
    rng: np.random.Generator,
) -> tuple[Recording, FloatArray, dict[str, float]]:
    noise = {"white": case.white_m, "marker": 2e-4, "frame": 0.5 * case.white_m, "sweep": 0.5 * case.white_m}
    T = make_pose(rotation_from_vector([2.3, 0.2, 0.1] + 0.1 * rng.normal(size=3)), [0.05, 0.24, 0.3] + 0.01 * rng.normal(size=3))
    F, k = len(states), len(true.marker_points)
    sweep = np.unique(plan.sweep, return_inverse=True)[1]
    placement = noise["marker"] * rng.normal(size=(k, 3))
    shown = _seen(true, states, placement)
    if case.outside == "slipped_marker":
        shown[F // 2 :, -2] += 1.5e-3 * case.size * np.array([0.6, 0.6, 0.5])
    if case.outside == "no_name":
        shown += _no_name(case, recorded, shown, declared.marker_points)
    if case.outside == "camera_drift":
        shown += np.linspace(0, 1, F)[:, None, None] * 6e-4 * case.size * np.array([0.5, 0.7, 0.5])
    shown = shown + noise["frame"] * rng.normal(size=(F, 1, 3)) + noise["sweep"] * rng.normal(size=(sweep.max() + 1, 1, 3))[sweep]
    seen = _through(T, shown.reshape(-1, 3), true.observation) + case.white_m * rng.normal(size=(F * k, 3))
    rest = None
    if case.placements:
        points = _through(T, true.marker_points + placement, true.observation) + case.white_m * rng.normal(size=(k, 3))
        rest = RestMarkers(true.marker_names, freeze(points), freeze(np.full(k, case.white_m)), freeze(np.zeros(k), np.int64))
    recording = make_recording(
        Timeline(plan.time_s, sweep=list(plan.sweep), free=np.ones(F, bool)),
        drives=Drives(actuation=case.control, cable_names=declared.body.cable_names, inputs=recorded),
        markers=MarkerRows(declared.marker_names, np.repeat(np.arange(F), k), np.tile(np.arange(k), F), seen),
        loads=LoadRows(plan.load_frame, plan.load_points, plan.load_forces),
        about=About(rest=rest),
    )
    return recording, T, noise


def _no_name(case: Case, recorded: FloatArray, shown: FloatArray, places: FloatArray) -> FloatArray:
    """Return an error of the model without a name [m], shape (F, k, 3): smooth along the body and quadratic in the inputs,
    5 % of the motion."""
    rng = np.random.default_rng([9, case.number])
    u = recorded / recorded.max()
    drive = np.stack([u[:, i] * u[:, j] for i in range(u.shape[1]) for j in range(i, u.shape[1])], axis=1)
    along = places[:, 0] / places[:, 0].max()
    field = np.einsum("fq,qc,k->fkc", drive, rng.normal(size=(drive.shape[1], 3)), along**2)
    motion = np.sqrt(np.mean((shown - shown[0]) ** 2))
    return np.asarray(0.05 * case.size * motion * field / np.sqrt(np.mean(field**2)))


def _through(T_robot_camera: FloatArray, points: FloatArray, seen: Observation) -> FloatArray:
    camera = transform_points(invert_pose(T_robot_camera), points)
    distance = np.linalg.norm(camera, axis=1, keepdims=True)
    return np.asarray(camera * (seen.depth_scale * distance + seen.depth_offset) / distance)
