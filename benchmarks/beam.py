"""A silicone beam under known weights, in motion capture: modulus, forces, the effect that the model lacks,
and what six markers cannot tell.

    python benchmarks/beam.py [FOLDER of data/beam] [--cells NX NY NZ] [--declared-mesh] [--tables | --loops]

Prints every figure of docs/studies/beam-study.md and writes its pictures into docs/pictures.
The beam is made of 8 × 3 × 3 cells unless told otherwise; `--declared-mesh` runs the loops on the mesh that comes with the data.
Tables take one frame a state: the five repeat each other.
"""

from __future__ import annotations

import argparse
import itertools
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from femsense import (
    Effect,
    LoopResult,
    Recording,
    Robot,
    TetMesh,
    apply_effects,
    calibrate,
    estimate,
    improve,
    load_recording,
    load_robot,
)
from femsense.core.arrays import FloatArray
from femsense.fem.mesh import to_quadratic
from femsense.loop.data.dataset import Data, groups_of, prepare
from femsense.loop.data.trial import Trial
from femsense.loop.fit.covariance import coordinate_std
from femsense.loop.fit.fitted_model import FittedModel, fit_model, poses_and_inputs
from femsense.loop.fit.joint_fit import Prior
from femsense.loop.fit.noise_components import Noise
from femsense.loop.result.tables import table_of
from femsense.model.camera_frame import in_robot_frame
from femsense.model.effects import FORMS, Entry
from femsense.model.observation import Hypothesis
from femsense.model.remeshing import robot_on_mesh
from femsense.report.text import known_part

EDGE = [[0.1, 0.0, 0.015]]
"""The middle of the loaded edge at rest [m]."""
BASE = ["Base-1", "Base-2", "Base-3"]
DOWN = {"name": "gravity", "vector_m_s2": [0.0, 0.0, -9.80665]}
HELD = {"name": "clamped_marker", "markers": BASE, "share": 0.0}
NOISE = Noise({"white": 3e-4}, "what the best of these models leave")
"""Of a marker in a state, along each axis [m]."""
REPEAT_MM = 0.59
"""How far a repeat of the run at 1.00 N lies from the first, root mean square [mm] (the README of the data)."""
PICTURES = Path(__file__).parents[1] / "docs" / "pictures"


# The data and the fits


@dataclass(frozen=True)
class Beam:
    """The robot on one mesh and its three recordings, split."""

    robot: Robot
    recordings: dict[str, Recording]
    data: Data


def load_beam(folder: Path, cells: Sequence[int]) -> Beam:
    """Return the weightless robot, a block of cells, with a frame a state; fitted on 0 and 0.51 N, judged on 1.00 N."""
    robot = in_cells(load_robot(folder / "robot"), cells)
    recordings = {name: load_recording(folder / "recordings" / name) for name in ("gravity_a", "load52_a", "load101_a")}
    data = prepare(robot, [recordings["gravity_a"], recordings["load52_a"]], [recordings["load101_a"]])
    return Beam(
        robot, recordings, replace(data, train=[one_frame(t) for t in data.train], held=[one_frame(t) for t in data.held])
    )


def in_cells(robot: Robot, cells: Sequence[int]) -> Robot:
    """Return the robot on a block of nx × ny × nz cells of six quadratic tetrahedra each."""
    size = np.array(cells) + 1
    axes = [np.linspace(low, high, n) for low, high, n in zip((0.0, -0.015, -0.015), (0.1, 0.015, 0.015), size)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    tets = []
    for corner in itertools.product(*(range(n) for n in cells)):
        for order in itertools.permutations(range(3)):
            steps = np.array(corner) + np.vstack([np.zeros(3, int), np.cumsum(np.eye(3, dtype=int)[list(order)], axis=0)])
            tet = np.ravel_multi_index(steps.T, size)
            tets.append(tet if np.linalg.det(nodes[tet[1:]] - nodes[tet[0]]) > 0 else tet[[0, 2, 1, 3]])
    return robot_on_mesh(robot, to_quadratic(TetMesh(nodes, np.array(tets))))


def one_frame(trial: Trial) -> Trial:
    """Return a trial with the middle one of its five frames: they repeat one state."""
    scene = trial.scene.pick(trial.scene.frames[2:3])
    return replace(trial, scene=scene, groups=groups_of(scene), starts={})


@dataclass(frozen=True)
class Term:
    """An effect that a fit moves."""

    form: int
    """Number among the forms of that name."""
    name: str
    start: list[float] | None = None
    seed: Entry | None = None


def fitted(data: Data, robot: Robot, terms: Sequence[Term]) -> FittedModel:
    """Return the joint fit of poses and terms on the first two recordings, with its error on the third."""
    parts: list[tuple[Effect, Entry, Any]] = []
    start: list[float] = []
    for term in terms:
        effect = [f for f in FORMS if f.name == term.name][term.form]
        parameters = effect.parameters(robot, data.control)
        parts.append((effect, term.seed or {}, parameters))
        start += term.start or [p.null for p in parameters]
    prior = Prior(np.zeros(len(start)), np.full(len(start), np.inf))
    fresh = replace(data, train=[replace(t, starts={}) for t in data.train], held=[replace(t, starts={}) for t in data.held])
    return fit_model(fresh, Hypothesis(robot, tuple(parts)), prior, NOISE, np.array(start))


STIFF = Term(0, "stiffness", [0.5])
FREE = Term(0, "gravity", [0.0, 0.0, -9.8])


def values(data: Data, model: FittedModel) -> dict[str, list[tuple[float, float]]]:
    """Return (value, standard deviation) of each parameter of each term."""
    std, at, table = coordinate_std(model.fit, data.train, NOISE), 0, dict[str, list[tuple[float, float]]]()
    for effect, _, parameters in model.fit.hypothesis.terms:
        u, s = model.fit.coordinates[at : at + len(parameters)], std[at : at + len(parameters)]
        table[effect.name] = [(p.value(a), p.value_std(a, b)) for p, a, b in zip(parameters, u, s)]
        at += len(parameters)
    return table


def shown(pairs: Sequence[tuple[float, float]]) -> str:
    return ", ".join(f"{v:.3g} ± {s:.2g}" if np.isfinite(v) else "rigid" for v, s in pairs)


def sensed(beam: Beam, robot: Robot) -> list[tuple[float, float]]:
    """Return the weights at the edge that a robot senses from the markers at 0.51 and 1.00 N:
    downward force and standard deviation [N]."""
    result = []
    for name in ("load52_a", "load101_a"):
        recording = beam.recordings[name]
        run = estimate(robot, recording, calibrate(robot, recording), at=EDGE)
        middle = sorted(run.contacts, key=lambda c: c.frame)[len(run.contacts) // 2]
        result.append((-float(middle.force_n_xyz[2]), middle.std_n))
    return result


# The tables


def print_models(beam: Beam) -> dict[str, tuple[FittedModel, list[tuple[float, float]]]]:
    """Print each model: its error where it was fitted and where not, its modulus, and the weights it senses."""
    down, held = apply_effects(beam.robot, [DOWN]), apply_effects(beam.robot, [DOWN, HELD])
    models: list[tuple[str, Robot, list[Term]]] = [
        ("as declared: 150 kPa, weightless", beam.robot, []),
        ("gravity alone, 150 kPa", down, []),
        ("modulus alone, weightless", beam.robot, [STIFF]),
        ("gravity straight down and modulus", down, [STIFF]),
        ("gravity free and modulus", beam.robot, [STIFF, FREE]),
        ("straight down, modulus, base markers on the clamp", held, [STIFF]),
        ("free, modulus, base markers on the clamp", apply_effects(beam.robot, [HELD]), [STIFF, FREE]),
        ("straight down, modulus, base markers, Poisson", held, [STIFF, Term(0, "poisson")]),
        ("straight down, modulus, base markers, rotating clamp", held, [STIFF, Term(1, "base_compliance", [1e-3])]),
    ]
    print(f"\nModels (fit on 0 and 0.51 N, judged on 1.00 N; a repeat of that run: {REPEAT_MM} mm)")
    print(
        "| model | fitted | held out | ratio | modulus | sensed at 0.510 N | at 1.001 N | further "
        "|\n|---|---|---|---|---|---|---|---|"
    )
    results: dict[str, tuple[FittedModel, list[tuple[float, float]]]] = {}
    for name, robot, terms in models:
        model = fitted(beam.data, robot, terms)
        forces = sensed(beam, model.fit.hypothesis.robot_at(model.fit.coordinates))
        results[name] = (model, forces)
        first = results[models[0][0]][0].held_rms
        table = values(beam.data, model)
        scale = table.pop("stiffness", [(1.0, 0.0)])[0]
        modulus = f"{150 * scale[0]:.0f} ± {150 * scale[1]:.0f} kPa" if scale[1] else "150 kPa"
        more = "; ".join(f"{k} {shown(v)}" for k, v in table.items())
        weights = " | ".join(f"{v:.3f} ± {s:.3f} N" for v, s in forces)
        print(
            (
                f"| {name} | {1e3 * model.fit.rms:.2f} mm | {1e3 * model.held_rms:.2f} mm | {model.held_rms / first:.2f} | "
                f"{modulus} | {weights} | {more} |"
            ),
            flush=True,
        )
    return results


def print_residuals(beam: Beam, results: dict[str, tuple[FittedModel, Any]]) -> None:
    """Print what three models leave at each marker at 0.51 N."""
    print("\nResiduals at 0.51 N, measured minus model [mm], along x, y, z")
    chosen = [
        n for n in results if n.startswith(("modulus alone", "gravity straight", "straight down, modulus, base markers on"))
    ]
    print("| marker | " + " | ".join(chosen) + " |\n" + "|---" * (len(chosen) + 1) + "|")
    for m, name in enumerate(beam.robot.marker_names):
        cells = [1e3 * results[n][0].fit.jets[1].residual[beam.data.train[1].scene.marker == m].mean(axis=0) for n in chosen]
        print(f"| {name} | " + " | ".join(", ".join(f"{v:+.2f}" for v in c) for c in cells) + " |")


def print_causes(beam: Beam) -> None:
    """Print where gravity points when it is fitted next to each thing that may tilt it."""
    print(
        "\nDirection of gravity if another parameter is fitted or another assumption is made (modulus and poses are always fitted)"
    )
    print(
        "| also fitted or changed | fitted | held out | χ² | gravity [m/s²] | modulus | its value |\n|---|---|---|---|---|---|---|"
    )
    robot = beam.robot
    cases: list[tuple[str, Data, Robot, list[Term]]] = [
        ("nothing", beam.data, robot, []),
        ("base markers on the clamp", beam.data, apply_effects(robot, [HELD]), []),
        (
            "share by which the base markers follow the beam",
            beam.data,
            robot,
            [Term(0, "clamped_marker", [0.5], {"markers": BASE})],
        ),
        ("rotating clamp", beam.data, robot, [Term(1, "base_compliance", [1e-3])]),
        ("compliant clamp", beam.data, robot, [Term(0, "base_compliance")]),
        ("Poisson ratio", beam.data, robot, [Term(0, "poisson")]),
        ("size of the body", beam.data, robot, [Term(0, "geometry")]),
        ("scale of the cameras", beam.data, robot, [Term(0, "depth_scale")]),
        ("neo-Hookean silicone", beam.data, apply_effects(robot, [{"name": "hyperelastic", "law": "neo_hookean"}]), []),
        ("tip held 0.5 mm too low at rest", with_tip(beam.data, [0, 0, -0.5e-3]), robot, []),
        ("tip held 0.5 mm too high at rest", with_tip(beam.data, [0, 0, 0.5e-3]), robot, []),
        ("beam stretched by 0.5 mm at rest", with_tip(beam.data, [0.5e-3, 0, 0]), robot, []),
        ("beam compressed by 0.5 mm at rest", with_tip(beam.data, PUSHED), robot, []),
        ("load tilted by 7° towards the tip", with_loads(beam.data, 7.0), robot, []),
    ]
    for name, data, body, terms in cases:
        try:
            print_cause(name, data, fitted(data, body, [STIFF, FREE, *terms]))
        except Exception as error:  # a row of the table says so
            print(f"| {name} | no fit: {str(error)[:60]} |", flush=True)
    for left_out in range(len(robot.marker_names)):
        data = without(beam.data, left_out)
        print_cause(f"without {robot.marker_names[left_out]}", data, fitted(data, robot, [STIFF, FREE]))


def print_cause(name: str, data: Data, model: FittedModel) -> None:
    table = values(data, model)
    scale, gravity = table.pop("stiffness")[0], table.pop("gravity")
    own = "; ".join(shown(v) for v in table.values())
    print(
        (
            f"| {name} | {1e3 * model.fit.rms:.2f} mm | {1e3 * model.held_rms:.2f} mm | {model.fit.chi2:.1f} | "
            f"{shown(gravity)} | {150 * scale[0]:.0f} ± {150 * scale[1]:.0f} kPa | {own} |"
        ),
        flush=True,
    )


def with_tip(data: Data, shift: Sequence[float]) -> Data:
    """Return the data as they would be, had the hand not moved the tip by a shift [m,
    robot frame] while rest.csv was measured."""

    def moved(trial: Trial) -> Trial:
        names = [data.robot.marker_names[m] for m in trial.scene.rest_marker]
        points = trial.scene.rest_points.copy()
        points[[name.startswith("Tip") for name in names]] -= trial.poses[0][:3, :3].T @ np.array(shift)
        return replace(trial, scene=replace(trial.scene, rest_points=points))

    return replace(data, train=[moved(t) for t in data.train], held=[moved(t) for t in data.held])


def with_loads(data: Data, degrees: float) -> Data:
    """Return the data with weights that pull towards the tip by an angle to −z."""
    a = np.deg2rad(degrees)
    turn = np.array([[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]])

    def turned(trial: Trial) -> Trial:
        recording = trial.scene.recording
        return replace(
            trial, scene=replace(trial.scene, recording=replace(recording, load_forces=recording.load_forces @ turn.T))
        )

    return replace(data, train=[turned(t) for t in data.train], held=[turned(t) for t in data.held])


def without(data: Data, marker: int) -> Data:
    """Return the data without one marker."""

    def fewer(trial: Trial) -> Trial:
        s, keep, rest = trial.scene, trial.scene.marker != marker, trial.scene.rest_marker != marker
        scene = replace(
            s,
            frame=s.frame[keep],
            marker=s.marker[keep],
            view=s.view[keep],
            points=s.points[keep],
            rest_marker=s.rest_marker[rest],
            rest_view=s.rest_view[rest],
            rest_points=s.rest_points[rest],
        )
        return replace(trial, scene=scene, groups=groups_of(scene))

    return replace(data, train=[fewer(t) for t in data.train], held=[fewer(t) for t in data.held])


CURVES = ("as declared", "base markers on the clamp", "and the beam compressed by 0.5 mm at rest")
TILTS = np.array([-35.0, -26.0, -18.0, -9.0, 0.0, 7.0, 14.0, 20.0, 26.0, 32.0, 40.0])


PUSHED = [-0.5e-3, 0.0, 0.0]
"""A hand that pushes the beam by half a millimetre while its rest is measured [m]."""


def profile(beam: Beam, data: Data, more: Sequence[Entry]) -> FloatArray:
    """Return χ², held-out error [mm] and modulus [kPa] for gravity tilted towards the tip by TILTS, shape (t, 3)."""
    rows = []
    for a in np.deg2rad(TILTS):
        gravity = {"name": "gravity", "vector_m_s2": [9.80665 * np.sin(a), 0.0, -9.80665 * np.cos(a)]}
        model = fitted(data, apply_effects(beam.robot, [gravity, *more]), [STIFF])
        rows.append([model.fit.chi2, 1e3 * model.held_rms, 150 * np.exp(model.fit.coordinates[0])])
    return np.array(rows)


def print_profile(beam: Beam) -> list[FloatArray]:
    """Print how well each tilt of gravity does, with base markers on the body and on the clamp."""
    print("\nGravity tilted towards the tip, modulus fitted: χ² (held-out mm, kPa)")
    pushed = with_tip(beam.data, PUSHED)
    tables = [profile(beam, beam.data, []), profile(beam, beam.data, [HELD]), profile(beam, pushed, [HELD])]
    print("| tilt | " + " | ".join(CURVES) + " |\n|---|---|---|---|")
    for tilt, *rows in zip(TILTS, *tables):
        print(f"| {tilt:+.0f}° | " + " | ".join(f"{c:.1f} ({h:.2f} mm, {e:.0f} kPa)" for c, h, e in rows) + " |")
    return tables


def print_loop(title: str, result: LoopResult, seconds: float) -> None:
    """Print what the loop says."""
    print(f"\n{title}: {result.verdict}: {result.sentence} ({seconds:.0f} s of processor time)")
    noise = ", ".join(f"{k} {1e3 * v:.3f}" for k, v in result.data.noise_components_m.items())
    print(
        f"  noise along each axis [mm]: {noise}; held out {1e3 * result.before.validation_rms_m:.2f} -> "
        f"{1e3 * result.after.validation_rms_m:.2f} mm"
    )
    for effect in result.effects:
        before, after = (1e3 * rms for rms in (effect.validation_rms_before_m, effect.validation_rms_after_m))
        print(f"  {effect.name}: {parameter_words(table_of(effect.parameters))}; held out {before:.2f} -> {after:.2f} mm")
    for row in result.candidates[:8]:
        print(f"  tried {row.name}: {row.verdict}")
    print(
        f"  left: {1e3 * result.left.rms_m:.2f} mm, most at {result.left.where.marker}; structure p = "
        f"{result.left.structure.p_value:.3f}"
    )
    print(f"  next: {result.next_experiment}", flush=True)


def parameter_words(parameters: dict[str, Any]) -> str:
    """Return parameters with their standard deviations."""

    def words(value: Any) -> str:
        if isinstance(value, list):
            return "(" + ", ".join(words(v) for v in value) + ")"
        return f"{value:.3g}" if isinstance(value, float) else str(value)

    return ", ".join(
        f"{k} {words(p['value'])} ± {words(p['std'])}" if p["std"] is not None else f"{k} {words(p['value'])}"
        for k, p in parameters.items()
    )


def print_meshes(beam: Beam, folder: Path) -> None:
    """Print what the mesh does to the modulus and to the error."""
    print(
        "\nThe mesh: gravity straight down and modulus\n| cells | unknowns | fitted | held out | modulus |\n|---|---|---|---|---|"
    )
    declared = load_robot(folder / "robot")
    for cells in ((5, 2, 2), (8, 3, 3), (12, 4, 4), (20, 6, 6)):
        robot = apply_effects(in_cells(declared, cells), [DOWN])
        model = fitted(beam.data, robot, [STIFF])
        scale = values(beam.data, model)["stiffness"][0][0]
        print(
            (
                f"| {' × '.join(map(str, cells))} | {3 * len(robot.body.mesh.nodes)} | {1e3 * model.fit.rms:.2f} mm | "
                f"{1e3 * model.held_rms:.2f} mm | {150 * scale:.0f} kPa |"
            ),
            flush=True,
        )


def print_loops(beam: Beam, folder: Path, declared_mesh: bool, cells: Sequence[int]) -> None:
    """Print the loop without gravity, with it, and on the unloaded run alone,
    with the weights that each improved robot senses."""
    names = ("robot", "robot_gravity")
    robots = {n: load_robot(folder / n) for n in names}
    if not declared_mesh:
        robots = {n: in_cells(r, cells) for n, r in robots.items()}
    r = beam.recordings
    cases = [
        (
            "(a) gravity undeclared, fit on 0 and 0.51 N, judged on 1.00 N",
            "robot",
            [r["gravity_a"], r["load52_a"]],
            [r["load101_a"]],
        ),
        (
            "(b) gravity declared, fit on 0 and 0.51 N, judged on 1.00 N",
            "robot_gravity",
            [r["gravity_a"], r["load52_a"]],
            [r["load101_a"]],
        ),
        ("(c) gravity declared, unloaded run alone", "robot_gravity", [r["gravity_a"]], []),
    ]
    for title, name, train, judge in cases:
        began = time.process_time()
        result = improve(robots[name], train, validation=judge)
        print_loop(title, result, time.process_time() - began)
        for label, robot in (("as declared", robots[name]), ("improved", result.robot)):
            print(f"  weights sensed, {label}: " + ", ".join(f"{v:.3f} ± {s:.3f} N" for v, s in sensed(beam, robot)), flush=True)
    noise = 1e-3 * REPEAT_MM / np.sqrt(3.0)
    for title, name, train, judge in cases[:2]:
        known = [[replace(recording, marker_noise_m=noise) for recording in part] for part in (train, judge)]
        result = improve(robots[name], known[0], validation=known[1])
        said = ", ".join(effect.name for effect in result.effects)
        print(
            f"{title}, marker_noise_m = {noise:.2g}: {result.verdict} ({said}), "
            f"{1e3 * result.after.validation_rms_m:.2f} mm held out"
        )


# The pictures


def draw_states(beam: Beam, results: dict[str, tuple[FittedModel, Any]]) -> None:
    """Draw the beam from its side in the three states, before and after, residuals three times as long."""
    from matplotlib import pyplot as plt

    chosen = [
        ("as declared: 150 kPa, weightless", "as declared: 150 kPa, weightless"),
        ("straight down, modulus, base markers on the clamp", "gravity, modulus, base markers on the clamp"),
    ]
    figure, axes = plt.subplots(1, 2, figsize=(9.0, 3.6), sharey=True)
    for axis, (name, title) in zip(axes, chosen):
        model = results[name][0]
        robot = model.fit.hypothesis.robot_at(model.fit.coordinates)
        draws = [(jet, t, p[0]) for jet, t, p in zip(model.fit.jets, beam.data.train, poses_and_inputs(beam.data, model.fit))]
        draws += [(h.jet, t, h.poses) for h, t in zip(model.held, beam.data.held)]
        for color, label, (jet, trial, poses) in zip(
            ("tab:blue", "tab:orange", "tab:red"), ("0 N", "0.51 N", "1.00 N, not fitted"), draws
        ):
            state = next(iter(jet.states.values())).positions
            line = robot.body.mesh.nodes
            for z in (-0.015, 0.015):
                row = np.flatnonzero((np.abs(line[:, 1]) < 0.006) & np.isclose(line[:, 2], z))
                row = row[np.argsort(line[row, 0])]
                axis.plot(1e3 * state[row, 0], 1e3 * state[row, 2], color=color, lw=0.8, alpha=0.6)
            seen = 1e3 * in_robot_frame(trial.scene.points, trial.scene.view, poses, robot.observation)
            way = 3e3 * jet.residual
            axis.plot(seen[:, 0], seen[:, 2], "o", ms=3, color=color, label=label)
            axis.quiver(
                seen[:, 0], seen[:, 2], -way[:, 0], -way[:, 2], angles="xy", scale_units="xy", scale=1, width=0.004, color=color
            )
        axis.set_title(f"{title}\nheld out {1e3 * model.held_rms:.2f} mm", fontsize=9)
        axis.set_xlabel("x [mm]")
        axis.set_aspect("equal")
        axis.set_xlim(-5, 115)
        axis.set_ylim(-62, 32)
    axes[0].set_ylabel("z [mm]")
    axes[1].legend(fontsize=7, loc="lower left", title="markers; arrows to the model × 3", title_fontsize=7)
    save(figure, "beam-states")


def draw_profile(tables: list[FloatArray]) -> None:
    """Draw χ² against the tilt of gravity."""
    from matplotlib import pyplot as plt

    figure, axis = plt.subplots(figsize=(5.2, 3.2))
    for table, label in zip(tables, CURVES):
        axis.plot(TILTS, table[:, 0] - table[:, 0].min(), "o-", ms=3, label=label)
    axis.axhline(10, color="gray", lw=0.8, ls="--")
    axis.text(TILTS[2], 10.3, "what a name has to bring", fontsize=7, color="gray")
    axis.set_ylim(-0.5, 16)
    axis.set_xlabel("gravity tilted towards the tip [°]")
    axis.set_ylabel("χ² above its least\n(0.3 mm a marker and axis)")
    axis.legend(fontsize=7)
    save(figure, "beam-tilt")


def draw_forces(results: dict[str, tuple[FittedModel, list[tuple[float, float]]]]) -> None:
    """Draw what each model leaves beside the weights that it senses."""
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(8.6, 3.4), sharey=True)
    rows = -np.arange(len(results))
    left.plot([1e3 * s.fit.rms for s, _ in results.values()], rows, "o", ms=5, label="0 and 0.51 N, fitted")
    left.plot([1e3 * s.held_rms for s, _ in results.values()], rows, "s", ms=5, label="1.00 N, held out")
    left.axvline(REPEAT_MM, color="gray", lw=0.8, ls="--", label="a repeat at 1.00 N")
    left.set_yticks(rows, list(results), fontsize=7)
    left.set_xlabel("what the model leaves [mm]")
    left.legend(fontsize=6)
    for i, (weight, marker) in enumerate(((0.51012, "o"), (1.00062, "s"))):
        percent = np.array([[100 * (f[i][0] / weight - 1), 100 * f[i][1] / weight] for _, f in results.values()])
        right.errorbar(
            percent[:, 0], rows + 0.12 - 0.24 * i, xerr=percent[:, 1], fmt=marker, ms=4, lw=0.8, label=f"{weight:.2f} N"
        )
    right.axvline(0, color="gray", lw=0.8)
    right.set_xlabel("sensed weight, too large by [%]")
    right.legend(fontsize=6)
    save(figure, "beam-forces")


def save(figure: Any, name: str) -> None:
    PICTURES.mkdir(exist_ok=True)
    figure.tight_layout()
    figure.savefig(PICTURES / f"{name}.png", dpi=110, bbox_inches="tight")
    print(f"wrote docs/pictures/{name}.png", flush=True)


def print_commands(folder: Path) -> None:
    """Print what a user gets by commands alone: a modulus from the sag, then the weights untold."""
    robot = load_robot(folder / "robot_gravity")
    better = improve(robot, [load_recording(folder / "recordings" / "gravity_a")]).robot
    print(
        "| weight | said | of it | without what deviations add | force | its deviations | status |\n|---|---|---|---|---|---|---|"
    )
    for name, weight in (("load52_a", 0.51012), ("load101_a", 1.00062)):
        recording = load_recording(folder / "recordings" / name)
        none = np.zeros((0, 3))
        untold = replace(recording, load_frame=np.zeros(0, dtype=np.int64), load_points=none, load_forces=none)
        run = estimate(better, untold, calibrate(better, untold), at=[[0.1, 0.0, 0.015]])
        first = run.contacts[0]
        size = f"{first.force_n:.3f} ± {first.std_n:.3f} N"
        unbiased = float(np.sqrt(max(first.force_n**2 - float((first.force_std_n_xyz**2).sum()), 0.0)))
        force, std = (np.round(v, 3).tolist() for v in (first.force_n_xyz, first.force_std_n_xyz))
        print(
            f"| {weight:.3f} N | {size} | {known_part(first)} | {unbiased:.3f} N | {force} | {std} | {run.frames[0].status} |",
            flush=True,
        )


def main() -> None:
    """Print tables, pictures and loops."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=Path(__file__).parents[1].parent / "shared" / "data" / "beam")
    parser.add_argument("--cells", nargs=3, type=int, default=[8, 3, 3])
    parser.add_argument("--declared-mesh", action="store_true", help="run the loops on the mesh that comes with the data")
    only = parser.add_mutually_exclusive_group()
    only.add_argument("--tables", action="store_true", help="tables and pictures only")
    only.add_argument("--loops", action="store_true", help="loops only")
    only.add_argument("--commands", action="store_true", help="what the commands say of the weights, on the declared mesh")
    given = parser.parse_args()
    if given.commands:
        print_commands(given.folder)
        return
    import matplotlib

    matplotlib.use("Agg")
    beam = load_beam(given.folder, given.cells)
    print(f"{' × '.join(map(str, given.cells))} cells, {len(beam.robot.body.mesh.tets)} quadratic tetrahedra")
    if not given.loops:
        print_tables(beam, given.folder)
    if not given.tables:
        print_loops(beam, given.folder, given.declared_mesh, given.cells)


def print_tables(beam: Beam, folder: Path) -> None:
    """Print all tables and write the pictures."""
    began = time.process_time()
    results = print_models(beam)
    print_residuals(beam, results)
    tables = print_profile(beam)
    print_causes(beam)
    print_meshes(beam, folder)
    draw_states(beam, results)
    draw_profile(tables)
    draw_forces(results)
    print(f"tables and pictures: {time.process_time() - began:.0f} s of processor time", flush=True)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()
