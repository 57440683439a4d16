"""How fast the body is: cold equilibria beside SOFA's, parts, real time, growth with the mesh.
Prints the tables of docs/results/speed.md.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/body.py
    [cold|parts|orders|frames|terms|kept|growth|iterative …] [--data FOLDER]

CPU time of one thread, the least of several runs (what others do on the machine only adds); SOFA's figures are those of
`reference/cases.json`, measured on a like machine.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from femsense import BodyModel, Tracker, compliance, embed_points, load_robot, make_body, solve_equilibrium, tie_cable
from femsense.fem.assembly import internal, reduced_values
from femsense.fem.cables import pull_rows
from femsense.fem.compliance import direction_rows, tangent_at
from femsense.fem.equilibrium import NewtonOptions, SolveOptions
from femsense.fem.linalg.cholesky import cholesky
from femsense.fem.linalg.factorization import factorize
from femsense.fem.linalg.ordering import elimination_work, minimum_degree, nested_dissection
from femsense.fem.mesh import refined, surface_triangles, to_quadratic, vertex_normals
from femsense.fem.realtime.power_series import Expansion
from femsense.fem.realtime.tracker import Tracked
from femsense.fem.rotated_step import rotated_step

DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data"


def least_and_median_ms(call: Callable[[], Any], count: int = 41) -> tuple[float, float]:
    """Return the least and the median CPU time of a call [ms]."""
    call()
    times = []
    for _ in range(count):
        began = time.process_time()
        call()
        times.append(1e3 * (time.process_time() - began))
    return min(times), float(np.median(times))


def least_ms(call: Callable[[], Any], count: int = 15) -> float:
    """Return the least CPU time of a call [ms]: what others do on the machine only adds to it."""
    return least_and_median_ms(call, count)[0]


def verdict(value: float, target: float, *, most: bool = True) -> str:
    reached = value <= target if most else value >= target
    return f"to reach {'≤' if most else '≥'} {target:g}: {'yes' if reached else 'NO'}"


def cold(data: Path) -> None:
    """Cold equilibria of the reference cases beside SOFA."""
    body = load_robot(data / "diamond").body.with_gravity([0, 0, 0])
    cases = json.loads((data / "reference" / "cases.json").read_text(encoding="utf-8"))
    for kind in ("corotational_polar", "neo_hookean"):
        law = "neo_hookean" if kind == "neo_hookean" else "corotational"
        lawful = body.with_material(replace(body.material, law=law))
        for case, document in cases[kind].items():
            if "newton_steps" not in document:
                continue
            forces = np.tile(0.5 / len(body.mesh.nodes) * np.array(document["gravity_m_s2"]), (len(body.mesh.nodes), 1))
            for node, force in document["nodal_force_n"]:
                forces[node] += force
            held = document["held_cables"]
            tension = {name: value for name, value in document["tension_n"].items() if name not in held}

            def solve(
                lawful: BodyModel = lawful, tension: Any = tension, held: Any = held, forces: Any = forces, **given: Any
            ) -> Any:
                return solve_equilibrium(lawful, tension=tension, shortening=held, nodal_forces=forces, **given)

            (ms, median), sofa = least_and_median_ms(solve), document["newton_steps"] * document["ms_per_step"]
            print(
                f"{law:13} {case:13} {solve().iterations:3d} steps ({straight_steps(solve):2d} straight) {ms:6.1f} ms "
                f"(median {median:5.1f})   SOFA {document['newton_steps']:3d} × {document['ms_per_step']:5.2f} = "
                f"{sofa:6.1f} ms"
                f"   ratio {ms / sofa:.3f}   {verdict(ms / sofa, 0.15)}"
            )


def straight_steps(solve: Callable[..., Any]) -> int:
    """Return how many Newton steps a solve takes where no step lets the elements turn."""
    return int(solve(options=SolveOptions(newton=NewtonOptions(curved=np.inf))).iterations)


def diamond(data: Path, quadratic: bool) -> tuple[BodyModel, np.ndarray]:
    """Return the diamond, quadratic with a modulus of its own, and its feature points at rest."""
    robot = load_robot(data / "diamond")
    body, features = robot.body, robot.body.mesh.nodes[robot.features]
    if quadratic:
        mesh = to_quadratic(body.mesh)
        path = {c.name: c.path.positions(body.mesh.nodes) for c in body.cables}
        cables = tuple(tie_cable(mesh, c.name, path[c.name], c.pull_point) for c in body.cables)
        inside = in_boxes(mesh.nodes)
        body = make_body(
            mesh,
            young_modulus=450e3,
            poisson_ratio=0.45,
            density=1070.0,
            clamped=inside,
            cables=cables,
            gravity=[0, 0, -9.81],
        )
    return body, features


def in_boxes(nodes: np.ndarray) -> np.ndarray:
    return np.asarray(((nodes >= [-0.015, -0.015, -0.04]) & (nodes <= [0.015, 0.015, 0.01])).all(axis=1))


def parts(data: Path) -> None:
    """Assembly, factor, solves."""
    for quadratic in (False, True):
        body, features = diamond(data, quadratic)
        state = solve_equilibrium(body, tension=dict.fromkeys(body.cable_names, 1.0))
        print(f"\n{'tet10' if quadratic else 'tet4'}, {body.free_map.pattern.size} free unknowns")
        parts_at(body, features, np.array(state.positions))


def parts_at(body: BodyModel, features: np.ndarray, x: np.ndarray) -> None:
    pattern = body.free_map.pattern
    whole, forces = least_ms(lambda: internal(body, x)), least_ms(lambda: internal(body, x, tangent=False))
    print(f"  assembly {whole:.2f} ms, forces alone {forces:.2f} ms")
    blocks = internal(body, x).blocks
    assert blocks is not None
    values = reduced_values(body, blocks)
    normals = np.tile([0.0, 0.0, 1.0], (len(features), 1))
    rows = np.vstack([direction_rows(embed_points(body.mesh, features), normals, len(x)), pull_rows(body, x)])
    columns = sp.csc_matrix(rows[:, body.free_map.dofs].T)
    solver_line("Cholesky, double", partial(cholesky, pattern.analysis(), values), columns)
    solver_line("Cholesky, single", partial(cholesky, pattern.analysis(), values, single=True), columns)
    os.environ["FEMSENSE_SOLVER"] = "superlu"
    solver_line("SuperLU", partial(factorize, pattern, values), columns)
    del os.environ["FEMSENSE_SOLVER"]


def solver_line(name: str, make: Callable[[], Any], columns: sp.csc_matrix) -> None:
    factor, right = make(), np.random.default_rng(0).normal(size=columns.shape[0])
    one, gram = least_ms(lambda: factor.solve(right)), least_ms(lambda: factor.gram(columns), 5)
    print(f"  {name:17} factor {least_ms(make):7.2f} ms, one solve {one:6.2f} ms, W of {columns.shape[1]} rows {gram:7.2f} ms")


def orders(data: Path) -> None:
    """Work of a factor by minimum degree and by nested dissection: thin limbs (diamond), a solid bar (beam), both quadratic."""
    for name, body in (("diamond", diamond(data, True)[0]), ("beam", load_robot(data / "beam" / "robot").body)):
        free = np.zeros(len(body.mesh.nodes), dtype=bool)
        free[body.free_map.dofs // 3] = True
        pairs = body.mesh.tets[:, np.array(np.triu_indices(10, 1)).T].reshape(-1, 2)
        graph = sp.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(free), len(free))).tocsr()
        graph = (graph + graph.T)[free][:, free]
        work = [27e-9 * elimination_work(graph, order) for order in (minimum_degree(graph), *nested_dissection(graph))]
        x = np.array(body.mesh.nodes)
        blocks = internal(body, x).blocks
        assert blocks is not None
        values, analysis = reduced_values(body, blocks), body.free_map.pattern.analysis()
        factor = least_ms(partial(cholesky, analysis, values), 5)
        text = ", ".join(f"{value:.2f} Gflop" for value in work)
        print(f"  {name}, {analysis.size} unknowns: minimum degree, METIS {text}; factor as chosen {factor:.0f} ms")


PASSES, SETTLING = 9, 6
"""How often the path of `frames` is gone, and frames at its beginning that do not count."""
Seen = tuple[dict[str, float], Tracked, np.ndarray, np.ndarray]
"""Tensions [N], frame, normals at the features and W there."""


def frames(data: Path) -> None:
    """A sensing frame: tensions move on, about 1 mm of motion, then W of 51 feature normals and the cables.
    The rate is that of the mean.

    The path is gone PASSES times for the time of each frame, and what the last pass saw is compared with the full solver.
    """
    for quadratic in (False, True):
        body, features = diamond(data, quadratic)
        for jitter in (0.0, 0.01, 0.03):
            noise = np.random.default_rng(1).normal(0, jitter, (44, len(body.cables)))
            inputs = [dict(zip(body.cable_names, along_the_way(k, len(body.cables)) + more)) for k, more in enumerate(noise)]
            spent, seen = zip(*(ride(body, inputs, features) for _ in range(PASSES)))
            worst = np.max([missed(body, features, one) for one in seen[-1][SETTLING:]], axis=0)
            starts = [frame.factorisations for _, frame, _, _ in seen[-1][SETTLING:]]
            name = f"{'tet10' if quadratic else 'tet4 '} input jitter {jitter:g} N"
            show_frames(name, np.array(spent)[:, SETTLING:], worst, starts, 40.0 if quadratic else 100.0)
        print(f"      a frame with a factor of its own would take {start_anew(body, features, seen[-1][-1]):.1f} ms")


def ride(body: BodyModel, inputs: list[dict[str, float]], features: np.ndarray) -> tuple[list[float], list[Seen]]:
    """Follow a path; return what each frame took [ms] and what was seen in it."""
    nearest = np.array([np.argmin(np.linalg.norm(body.mesh.nodes - p, axis=1)) for p in features])
    triangles = surface_triangles(body.mesh)
    triangles = triangles[np.isin(triangles, nearest).any(axis=1)]
    tracker, spent, seen = Tracker(body), list[float](), list[Seen]()
    for tension in inputs:
        began = time.process_time()
        frame = tracker.step(tension=tension)
        normals = vertex_normals(frame.positions, triangles)[nearest]
        W = tracker.compliance(points=features, directions=normals)
        spent.append(1e3 * (time.process_time() - began))
        seen.append((tension, frame, normals, W))
    return spent, seen


def missed(body: BodyModel, features: np.ndarray, seen: Seen) -> list[float]:
    """Return error and reported error as shares of the motion, that of W, the motion [m], and true over reported error."""
    tension, frame, normals, W = seen
    full = solve_equilibrium(body, tension=tension, options=SolveOptions(relative_tolerance=1e-10))
    exact = compliance(body, full, points=features, directions=normals)
    off = float(np.abs(full.positions - frame.positions).max())
    wrong = float(np.linalg.norm(W - exact) / np.linalg.norm(exact))
    return [off / frame.motion_m, frame.error_m / frame.motion_m, wrong, frame.motion_m, off / frame.error_m]


def show_frames(name: str, passes: np.ndarray, worst: np.ndarray, starts: list[int], wanted: float) -> None:
    """Print times of the frames of a path [ms], shape (passes, frames), and the worst of its errors."""
    least = passes.min(axis=0)
    print(
        f"{name}: {least.mean():5.1f} ms a frame in the mean ({np.median(least):.1f} median, {least.max():.1f} slowest; "
        f"means of the passes {', '.join(f'{m:.1f}' for m in passes.mean(axis=1))}), "
        f"{1e3 / least.mean():5.1f} Hz   {verdict(1e3 / least.mean(), wanted, most=False)}\n"
        f"      a start in {sum(starts)} of {len(starts)} frames; motion ≤ {1e3 * worst[3]:.2f} mm, error ≤ "
        f"{worst[0]:.1e} of it (reported ≤ {worst[1]:.1e}, true / reported ≤ {worst[4]:.2f}), W within {worst[2]:.1e}"
    )


def terms(data: Path) -> None:
    """What series of one, two and three terms leave, frames after their start: medians over ten starts,
    as shares of the motion of a frame."""
    body, _ = diamond(data, True)
    start = Expansion(body, single=True)
    for jitter in (0.0, 0.03):
        noise, states, rows = np.random.default_rng(1).normal(0, jitter, (40, len(body.cables))), [], []
        inputs = [along_the_way(k, len(body.cables)) + noise[k] for k in range(40)]
        for T in inputs:
            given = dict(zip(body.cable_names, T))
            states.append(
                solve_equilibrium(
                    body, tension=given, start=states[-1] if states else None, options=SolveOptions(relative_tolerance=1e-10)
                )
            )
        for k in range(6, 36, 3):
            start.learn(states[k].positions)
            start.move(states[k].positions, inputs[k])
            for lag in range(1, 5):
                there, before = states[k + lag].positions, states[k + lag - 1].positions
                parts = list(start.terms(inputs[k + lag], body.dead_load()))
                left = [np.abs(states[k].positions + sum(parts[:n]) - there).max() for n in (1, 2, 3)]
                rows.append([lag, *np.array([*left, np.abs(parts[2]).max()]) / np.abs(there - before).max()])
        table = np.array(rows)
        for lag in range(1, 5):
            shares = 100.0 * np.median(table[table[:, 0] == lag, 1:], axis=0)
            print(
                f"input jitter {jitter:g} N, {lag} frames old: one {shares[0]:.2g} %, two {shares[1]:.2g} %, three "
                f"{shares[2]:.2g} %, third {shares[3]:.2g} %"
            )


def along_the_way(k: int, cables: int) -> np.ndarray:
    """Return the tensions of frame k of the smooth path [N], shape (cables,)."""
    i = np.arange(cables)
    return np.asarray(2.0 + np.sin(0.023 * k + i * np.pi / 2) + 0.6 * np.sin(1.7 * 0.023 * k + i))


def start_anew(body: BodyModel, features: np.ndarray, seen: Seen) -> float:
    """Return what a frame takes at least where each has a factor of its own [ms]: assembly, factor, two corrections, W."""
    tension, frame, normals, _ = seen
    x, T, start = (
        np.array(frame.positions),
        np.array(list(tension.values())),
        Expansion(body, single=len(body.free_map.dofs) > 10_000),
    )
    rows = np.vstack([direction_rows(embed_points(body.mesh, features), normals, len(x)), pull_rows(body, x)])
    columns = sp.csc_matrix(rows[:, body.free_map.dofs].T)

    def once() -> None:
        start.move(x, T)
        list(islice(start.terms(T, body.dead_load()), 2))
        assert start.factor is not None
        start.factor.gram(columns)

    return least_ms(once)


def kept(data: Path) -> None:
    """Corrections with the factor of an earlier frame, straight and with elements that turn: what they leave,
    as a share of the motion."""
    for quadratic in (False, True):
        body, _ = diamond(data, quadratic)
        inputs = [along_the_way(k, len(body.cables)) for k in range(4)]
        states = [solve_equilibrium(body, tension=dict(zip(body.cable_names, inputs[0])))]
        for T in inputs[1:]:
            states.append(solve_equilibrium(body, tension=dict(zip(body.cable_names, T)), start=states[-1]))
        factor = tangent_at(body, states[0]).factor
        for lag in (1, 2, 3):
            motion = np.abs(states[lag].positions - states[lag - 1].positions).max()
            for turns in (False, True):
                x, left = np.array(states[lag - 1].positions), []
                for _ in range(4):
                    pull = (inputs[lag] @ pull_rows(body, x)).reshape(-1, 3)
                    force = body.dead_load() - internal(body, x, tangent=False).forces + pull
                    step = np.zeros(x.size)
                    step[body.free_map.dofs] = factor.solve(force.ravel()[body.free_map.dofs])
                    turned = rotated_step(body, x, step.reshape(-1, 3)) if turns else None
                    x = x + step.reshape(-1, 3) if turned is None else turned
                    left.append(np.abs(x - states[lag].positions).max() / motion)
                name = "turned" if turns else "straight"
                print(f"{'tet10' if quadratic else 'tet4 '} {lag} frames old, {name:8}", *(f"{100 * v:10.2g} %" for v in left))


def growth(data: Path, levels: int) -> None:
    """Uniform refinement: each mesh in a process of its own."""
    rows = []
    for level in range(levels):
        text = subprocess.run(
            [sys.executable, __file__, "one", "--level", str(level), "--data", str(data)],
            capture_output=True,
            text=True,
            check=False,
        ).stdout
        print(text.strip() or f"level {level}: did not finish")
        if text.strip():
            rows.append([float(v) for v in text.split("|")[1].split()])
    if len(rows) > 1:
        table = np.log(np.array(rows))
        slopes = (table[-1, 1:] - table[0, 1:]) / (table[-1, 0] - table[0, 0])
        print(
            (
                "exponents in unknowns: assembly {:.2f}, factor {:.2f}, solve {:.2f}, memory of the factor {:.2f}, work of "
                "the factor {:.2f}"
            ).format(*slopes)
        )
    if len(rows) > 2:  # the smallest mesh stays in the cache
        slopes = (table[-1, 1:] - table[1, 1:]) / (table[-1, 0] - table[1, 0])
        print("the same without the smallest mesh: {:.2f}, {:.2f}, {:.2f}, {:.2f}, {:.2f}".format(*slopes))


def one_level(data: Path, level: int) -> None:
    """Assembly, factor and solve on the diamond refined so many times."""
    small = load_robot(data / "diamond").body
    small.free_map.pattern.analysis()  # compiled code is loaded
    mesh = small.mesh
    for _ in range(level):
        mesh = refined(mesh)
    began = time.process_time()
    body = make_body(mesh, young_modulus=180e3, poisson_ratio=0.45, density=1070.0, clamped=in_boxes(mesh.nodes))
    pattern = body.free_map.pattern
    made = time.process_time() - began
    analysis = pattern.analysis()
    analysed = time.process_time() - began - made
    x = np.array(mesh.nodes)
    blocks = internal(body, x).blocks
    assert blocks is not None
    values = reduced_values(body, blocks)
    factor = cholesky(analysis, values)
    assert factor is not None
    right = body.weight().ravel()[body.free_map.dofs]
    count = 15 if len(mesh.tets) < 100_000 else 5
    times = (
        least_ms(lambda: internal(body, x), count),
        least_ms(lambda: cholesky(analysis, values), count),
        least_ms(lambda: factor.solve(right), count),
    )
    columns = analysis.tree.unit * np.diff(analysis.tree.firsts)
    heights = columns + analysis.tree.unit * np.diff(analysis.tree.begin)
    work = sum(float((np.arange(h, h - c, -1.0) ** 2).sum()) for c, h in zip(columns, heights))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{len(mesh.tets):7d} tetrahedra, {pattern.size} unknowns: made and ordered {made:.2f} s, analysis "
        f"{analysed:.2f} s, assembly {times[0]:.1f} ms, factor {times[1]:.1f} ms ({1e-6 * work / times[1]:.1f} Gflop/s),"
        f" solve {times[2]:.2f} ms, factor {factor.bytes / 2**20:.0f} MB, peak of the process {peak:.0f} MB | "
        f"{pattern.size} {times[0]} {times[1]} {times[2]} {factor.bytes} {work}"
    )


def iterative_growth(data: Path, levels: int) -> None:
    """The iterative solver beside the direct one, each mesh, element and solver in a process of its own."""
    print(
        "  element tetrahedra unknowns    solver | prepared, anew, a solve (iterations) | equilibrium under weight | "
        "memory of the factor, of the process"
    )
    for element, counts in (("tet4", levels), ("tet10", levels - 1)):
        for level in range(counts):
            for solver in ("direct", "iterative"):
                arguments = [sys.executable, __file__, "side", "--level", str(level), "--element", element, "--data", str(data)]
                done = subprocess.run(
                    arguments, capture_output=True, text=True, check=False, env={**os.environ, "FEMSENSE_SOLVER": solver}
                )
                print(done.stdout.rstrip() or f"{element}, level {level}, {solver}: did not finish", flush=True)


def one_side(data: Path, level: int, element: str) -> None:
    """Set-up, solve and a cold equilibrium under weight with the solver that FEMSENSE_SOLVER names."""
    mesh = load_robot(data / "diamond").body.mesh
    for _ in range(level):
        mesh = refined(mesh)
    mesh = to_quadratic(mesh) if element == "tet10" else mesh
    body = make_body(
        mesh, young_modulus=180e3, poisson_ratio=0.45, density=1070.0, clamped=in_boxes(mesh.nodes), gravity=[0, 0, -9.81]
    )
    pattern, blocks = body.free_map.pattern, internal(body, np.array(mesh.nodes)).blocks
    assert blocks is not None
    values, right = reduced_values(body, blocks), body.weight().ravel()[body.free_map.dofs]
    began = time.process_time()
    analysed = pattern.levels() if os.environ["FEMSENSE_SOLVER"] == "iterative" else pattern.analysis()
    first = time.process_time() - began
    assert analysed is not None
    small = load_robot(data / "diamond").body
    solve_equilibrium(small, tension={small.cable_names[0]: 0.1})  # compiled code is loaded
    factor = factorize(pattern, values)
    assert factor is not None
    again, solve = least_ms(lambda: factorize(pattern, values), 2), least_ms(lambda: factor.solve(right), 2)
    cold = "not run (minutes)"
    if os.environ["FEMSENSE_SOLVER"] == "direct" or pattern.size < 100_000:
        began = time.process_time()
        state = solve_equilibrium(body)
        cold = f"{time.process_time() - began:.2f} s, {state.status} in {state.iterations} steps"
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"  {element:5} {len(mesh.tets):9d} {pattern.size:9d} {os.environ['FEMSENSE_SOLVER']:>9} | analysis {first:.2f} "
        f"s, then {again:.0f} ms, {solve:.1f} ms ({getattr(factor, 'iterations', 0)})"
        f" | {cold} | {factor.bytes / 2**20:.0f} MB, {peak:.0f} MB"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("what", nargs="*", default=["cold", "parts", "orders", "frames", "terms", "kept", "growth", "iterative"])
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--level", type=int, default=0)
    parser.add_argument("--levels", type=int, default=3)
    parser.add_argument("--element", choices=["tet4", "tet10"], default="tet4")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    for what in given.what:
        if what == "one":
            one_level(given.data, given.level)
            continue
        if what == "side":
            one_side(given.data, given.level, given.element)
            continue
        print(f"\n== {what}", flush=True)
        {
            "cold": lambda: cold(given.data),
            "parts": lambda: parts(given.data),
            "orders": lambda: orders(given.data),
            "frames": lambda: frames(given.data),
            "terms": lambda: terms(given.data),
            "kept": lambda: kept(given.data),
            "growth": lambda: growth(given.data, given.levels),
            "iterative": lambda: iterative_growth(given.data, given.levels),
        }[what]()
