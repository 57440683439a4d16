"""Elements that lock and elements that do not: error against milliseconds on a block and on the diamond robot.

Prints the tables of docs/method/elements.md. Small displacements, written with scipy beside the package's own elements, so that elements
which the package does not have stand in the same table; its default is compared with its own row of them. The diamond is the
one of the data folder beside the project (or the argument); without it only the block is done. `--fine N` sets how often the
meshes of the converged values are refined (1: three minutes). `--only finest` refines the diamond twice (a quarter of an hour,
7 GB).
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import LinearOperator, cg

from femsense import BodyModel, Robot, TetMesh, load_robot, make_body, solve_equilibrium
from femsense.core.arrays import FloatArray
from femsense.fem.assembly import internal, reduced_matrix, reduced_values
from femsense.fem.linalg.cholesky import cholesky
from femsense.fem.linalg.factorization import Pattern, factorize
from femsense.fem.mesh import EDGES, oriented, refined, shape_values, surface_triangles, to_quadratic
from femsense.fem.stencil import QUADRATURE
from femsense.model.remeshing import finer_mesh, robot_on_mesh
from femsense.rig.script import TruthTable
from femsense.rig.truth import true_robot

POISSON = (0.30, 0.45, 0.49, 0.499)
SHARED = Path(__file__).parents[1].parent / "shared" / "data" / "diamond"
KUHN = np.array([[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]])
ELEMENTS = {
    "tet4": (False, "points"),
    "tet4, dilatation averaged at nodes": (False, "nodes"),
    "tet10, four points": (True, "points"),
    "tet10, dilatation averaged at corners": (True, "nodes"),
    "tet10, mean dilatation of all strain": (True, "all"),
    "tet10, mean dilatation": (True, "mean"),
    "tet10, mean dilatation for λ − ½ μ": (True, 0.5),
    "tet10, mean dilatation for λ − ¾ μ (the default)": (True, 0.75),
    "tet10, mean dilatation for λ − μ": (True, 1.0),
}


@dataclass(frozen=True, eq=False, slots=True)
class Case:
    """A body at rest with clamped nodes and one load."""

    name: str
    body: BodyModel
    load: FloatArray
    """[N], shape (n, 3)."""
    pushed: FloatArray
    """Displacement of the clamped nodes [m], shape (n, 3)."""


def block(cells: tuple[int, int, int], size: tuple[float, float, float]) -> TetMesh:
    """Return a box of cells × 6 tetrahedra."""
    axes = [np.linspace(0.0, length, count + 1) for length, count in zip(size, cells)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(len(nodes)).reshape(np.array(cells) + 1)
    corners = [(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    cubes = np.stack([number[i : i + cells[0], j : j + cells[1], k : k + cells[2]].ravel() for i, j, k in corners], axis=1)
    return oriented(TetMesh(nodes, cubes[:, KUHN].reshape(-1, 4)))


def traction(mesh: TetMesh, on: Callable[[FloatArray], FloatArray], field: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Return nodal forces [N] of a traction field [Pa] on the boundary faces that lie on a plane."""
    corners = surface_triangles(TetMesh(mesh.nodes, mesh.tets[:, :4]))
    x = mesh.nodes[corners]
    keep = on(x.reshape(-1, 3)).reshape(-1, 3).all(axis=1)
    corners, x = corners[keep], x[keep]
    area = np.linalg.norm(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]), axis=1) / 2.0
    forces = np.zeros_like(mesh.nodes)
    middle = {}
    if mesh.is_quadratic:
        pairs = np.sort(mesh.tets[:, EDGES], axis=-1).reshape(-1, 2)
        middle = dict(zip(map(tuple, pairs.tolist()), mesh.tets[:, 4:].ravel().tolist()))
    for a, b in ((0, 1), (1, 2), (2, 0)):
        value = area[:, None] / 3.0 * field((x[:, a] + x[:, b]) / 2.0)
        if mesh.is_quadratic:
            nodes = [middle[pair] for pair in map(tuple, np.sort(corners[:, [a, b]], axis=1).tolist())]
            np.add.at(forces, nodes, value)
            continue
        for corner in (a, b):
            np.add.at(forces, corners[:, corner], value / 2.0)
    return forces


def stiffness(body: BodyModel, kind: str | float) -> sp.csr_matrix:
    """Return the small-displacement stiffness of all nodes [N/m], shape (3n, 3n).

    2μ ε:ε at the points, and λ times the square of the dilatation: at the points, averaged over elements ("mean"), over the
    patches of the corner nodes ("nodes"), over elements with the μ part of the dilatation ("all"), or over elements for what λ
    exceeds a share of μ (a number).
    """
    stencil, n = body.stencil, len(body.mesh.nodes)
    g, w, tets = stencil.gradients, stencil.volumes, stencil.tets.astype(np.int64)
    mu, lam = body.material.lame()
    volume = w.sum(axis=1)
    dot = np.einsum("mqia,mqib,mq->mab", g, g, w * mu[:, None])
    K = np.einsum("mab,ij->maibj", dot, np.eye(3)) + np.einsum("mqja,mqib,mq->maibj", g, g, w * mu[:, None])
    local = (
        np.minimum(lam, kind * mu) if isinstance(kind, float) else {"points": lam, "all": -2.0 / 3.0 * mu}.get(kind, 0.0 * lam)
    )
    K += np.einsum("mqia,mqjb,mq->maibj", g, g, w * local[:, None])
    if kind not in ("points", "nodes"):
        mean = np.einsum("mqia,mq->mai", g, w)
        K += np.einsum("mai,mbj,m->maibj", mean, mean, (lam - local) / volume)
    dofs = (3 * tets[:, :, None] + np.arange(3)).reshape(len(tets), -1)
    k = dofs.shape[1]
    matrix = sp.coo_matrix((K.ravel(), (np.repeat(dofs, k, axis=1).ravel(), np.tile(dofs, (1, k)).ravel())), shape=(3 * n,) * 2)
    if kind != "nodes":
        return matrix.tocsr()
    points = QUADRATURE if body.mesh.is_quadratic else np.full((1, 4), 0.25)
    corners = body.mesh.tets[:, :4]
    D = np.einsum("mqia,mq,qk->mkai", g, w, points).reshape(len(tets), 4, -1)
    patch = np.bincount(corners.ravel(), weights=np.repeat(volume / 4.0, 4), minlength=n)
    rows = np.repeat(corners, k, axis=1).ravel()
    divergence = sp.csr_matrix((D.ravel(), (rows, np.repeat(dofs[:, None], 4, axis=1).ravel())), shape=(n, 3 * n))
    weight = np.divide(lam[0], patch, out=np.zeros(n), where=patch > 0)
    return (matrix + divergence.T @ sp.diags_array(weight) @ divergence).tocsr()


def responses(cases: list[Case], kind: str | float) -> list[float]:
    """Return the work of each load on its displacement [J] or, of a given displacement, the reciprocal of its work [1/J]."""
    result: list[float] = []
    body = K = factor = None
    for case in cases:
        if case.body is not body:
            body, K = case.body, stiffness(case.body, kind)
            free = body.free_map.dofs
            inner = K[free][:, free].tocsc().sorted_indices()
            factor = factorize(Pattern(inner.indptr, inner.indices), inner.data)
        u = case.pushed.ravel().copy()
        u[free] = factor.solve((case.load.ravel() - K @ u)[free])
        result.append(float(case.load.ravel() @ u) if case.load.any() else 1.0 / float(u @ (K @ u)))
    return result


def block_cases(level: float, quadratic: bool, nu: float) -> list[Case]:
    """Return sag, bending, torsion of a bar (100 × 30 × 30 mm) and the squeeze of a pad (30 × 30 × 15 mm) between sticky
    plates."""
    wide, long = round(3 * level), round(8 * level)
    bar, pad = (
        block((long, wide, wide), (0.1, 0.03, 0.03)),
        block((round(5 * level),) * 2 + (round(4 * level),), (0.03, 0.03, 0.015)),
    )
    if quadratic:
        bar, pad = to_quadratic(bar), to_quadratic(pad)
    body = make_body(
        bar, young_modulus=1e5, poisson_ratio=nu, density=1000.0, gravity=[0, 0, -9.81], clamped=bar.nodes[:, 0] < 1e-9
    )
    still = np.zeros_like(bar.nodes)

    def at_end(x: FloatArray) -> FloatArray:
        return np.asarray(x[:, 0] > 0.1 - 1e-9)

    down = traction(bar, at_end, lambda x: np.tile([0.0, 0.0, -1.0], (len(x), 1)))
    twist = traction(bar, at_end, lambda x: np.cross([1.0, 0.0, 0.0], x - [0.0, 0.015, 0.015]))
    low, high = pad.nodes[:, 2] < 1e-9, pad.nodes[:, 2] > 0.015 - 1e-9
    squeezed = make_body(pad, young_modulus=1e5, poisson_ratio=nu, clamped=low | high)
    pushed = np.zeros_like(pad.nodes)
    pushed[high, 2] = -1.0
    bars = [Case(name, body, load, still) for name, load in (("sag", body.weight()), ("bending", down), ("torsion", twist))]
    return [*bars, Case("squeeze", squeezed, np.zeros_like(pad.nodes), pushed)]


def body_load(mesh: TetMesh, field: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Return nodal forces [N], shape (n, 3), of a field of force [N/m³] that takes and gives (p, 3)."""
    corners = mesh.nodes[mesh.tets[:, :4]]
    places = np.einsum("qa,mac->mqc", QUADRATURE, corners)
    values = (
        field(places.reshape(-1, 3)).reshape(places.shape) * np.linalg.det(corners[:, 1:] - corners[:, :1])[:, None, None] / 24.0
    )
    forces = np.zeros_like(mesh.nodes)
    np.add.at(forces, mesh.tets, np.einsum("qa,mqc->mac", shape_values(QUADRATURE, quadratic=mesh.is_quadratic), values))
    return forces


DIAMOND = {
    "sag": lambda x: np.tile([0.0, 0.0, -1.0], (len(x), 1)),
    "bending": lambda x: np.tile([1.0, 0.0, 0.0], (len(x), 1)),
    "torsion": lambda x: np.cross([0.0, 0.0, 1.0], x),
    "squeeze": lambda x: x * [-1.0, -1.0, 0.0],
}
"""Fields of force on the diamond: down, sideways, about its axis, towards its axis."""


def diamond_body(folder: Path, refinements: int, quadratic: bool, nu: float) -> BodyModel:
    """Return the diamond with its base held."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mesh = load_robot(folder).body.mesh
    for _ in range(refinements):
        mesh = refined(mesh)
    mesh = to_quadratic(mesh) if quadratic else mesh
    box = np.array([[-0.015, -0.015, -0.04], [0.015, 0.015, 0.01]])
    held = ((mesh.nodes >= box[0] - 1e-9) & (mesh.nodes <= box[1] + 1e-9)).all(axis=1)
    return make_body(mesh, young_modulus=450e3, poisson_ratio=nu, density=1070.0, gravity=[0, 0, -9.81], clamped=held)


def diamond_cases(folder: Path, refinements: int, quadratic: bool, nu: float) -> list[Case]:
    """Return the diamond under its own weight, the weight sideways, and fields that turn and squeeze it."""
    body = diamond_body(folder, refinements, quadratic, nu)
    return [Case(name, body, body_load(body.mesh, field), np.zeros_like(body.mesh.nodes)) for name, field in DIAMOND.items()]


def converged(f: float, p: float, F: float, P: float) -> float:
    """Return the value that two elements tend to at one and the same rate, from f and p on a mesh and F and P on a finer one."""
    return (p * F - f * P) / (p + F - P - f)


def references(make: Callable[[int], list[Case]]) -> list[tuple[float, float]]:
    """Return the converged response of each case, and how far the two finest values lie apart, relative."""
    (f, p), (F, P) = ([responses(cases, kind) for kind in ("points", "mean")] for cases in (make(0), make(1)))
    return [(converged(*four), abs(four[3] / four[2] - 1.0)) for four in zip(f, p, F, P)]


def table(title: str, make: Callable[[int, bool, float], list[Case]], fine: Callable[[int, bool, float], list[Case]]) -> None:
    """Print the errors of all elements, in percent of the converged response, + too soft."""
    names = [case.name for case in make(0, False, 0.3)]
    print(f"\n{title}: error of the displacement, %, at ν = {', '.join(map(str, POISSON))}")
    truth = {nu: references(lambda k, nu=nu: fine(k, True, nu)) for nu in POISSON}  # type: ignore[misc]
    for i, name in enumerate(names):
        print(f"  {name}: the finest meshes disagree by {', '.join(f'{100 * truth[nu][i][1]:.2f}' for nu in POISSON)} %")
    print("| element | " + " | ".join(names) + " |\n|---|" + "---|" * len(names))
    for label, (quadratic, kind) in ELEMENTS.items():
        found = [responses(make(0, quadratic, nu), kind) for nu in POISSON]
        errors = [[100.0 * (found[k][i] / truth[nu][i][0] - 1.0) for k, nu in enumerate(POISSON)] for i in range(len(names))]
        print(f"| {label} | " + " | ".join(", ".join(f"{e:+.1f}" for e in row) for row in errors) + " |", flush=True)


def stiffly(body: BodyModel, loads: list[FloatArray]) -> list[float]:
    """Return the work of loads [N], (n, 3), on their displacements [J], of the package's own element at rest:
    conjugate gradients with a factor in single precision, which is all that a huge mesh leaves room for."""
    free, pattern, blocks = body.free_map.dofs, body.free_map.pattern, internal(body, np.array(body.mesh.nodes)).blocks
    assert blocks is not None
    values = reduced_values(body, blocks)
    factor = cholesky(pattern.analysis(), values, single=True)
    assert factor is not None
    K = sp.csc_matrix((values, pattern.indices, pattern.indptr), shape=(pattern.size,) * 2)
    rough = LinearOperator(K.shape, factor.solve)
    found = [cg(K, load.ravel()[free], rtol=1e-8, M=rough) for load in loads]
    assert not any(failed for _, failed in found)
    return [float(load.ravel()[free] @ u) for load, (u, _) in zip(loads, found)]


def finest(folder: Path, nu: float = 0.499) -> None:
    """Print what the default gives on the diamond as it is, refined once and twice:
    where elements that bracket bracket nothing."""
    print(f"\nDiamond, ν = {nu}, the default: work of the loads, and how far it is from that on the mesh refined twice")
    rows = []
    for refinements in (0, 1, 2):
        cases = diamond_cases(folder, refinements, True, nu)
        rows.append(stiffly(cases[0].body, [case.load for case in cases]))
        print(
            f"  {len(cases[0].body.mesh.tets)} tetrahedra: " + ", ".join(f"{c.name} {w:.4e} J" for c, w in zip(cases, rows[-1])),
            flush=True,
        )
    for refinements, row in enumerate(rows):
        print(
            f"  refined {refinements} times: "
            + ", ".join(f"{name} {100.0 * (w / W - 1.0):+.2f} %" for name, w, W in zip(DIAMOND, row, rows[-1]))
        )


def agreement(case: Case) -> float:
    """Return how far the package's stiffness at rest is from the one written here, relative."""
    free = case.body.free_map.dofs
    blocks = internal(case.body, np.array(case.body.mesh.nodes)).blocks
    assert blocks is not None
    K = stiffness(case.body, 0.75)[free][:, free]
    return float(abs(reduced_matrix(case.body, blocks) - K).max() / abs(K).max())


def median_ms(run: Callable[[], object], times: int = 15) -> str:
    """Return median wall and process time of a call [ms]."""
    run()
    wall, used = [], []
    for _ in range(times):
        a, b = time.perf_counter(), time.process_time()
        run()
        wall.append(time.perf_counter() - a)
        used.append(time.process_time() - b)
    return f"{1e3 * np.median(wall):.2f} / {1e3 * np.median(used):.2f}"


def timing(body: BodyModel, label: str) -> None:
    """Print one row of the table of times."""
    rng = np.random.default_rng(0)
    x = body.mesh.nodes + rng.normal(0.0, 1e-6, body.mesh.nodes.shape)
    blocks = internal(body, x).blocks
    assert blocks is not None
    values = reduced_values(body, blocks)
    factor = factorize(body.free_map.pattern, values)
    assert factor is not None
    right = rng.normal(size=len(body.free_map.dofs))
    runs: list[Callable[[], object]] = [
        lambda: internal(body, x, tangent=False),
        lambda: internal(body, x),
        lambda: reduced_values(body, blocks),
        lambda: factorize(body.free_map.pattern, values),
        lambda: factor.solve(right),
    ]
    print(f"| {label} | {len(right)} | " + " | ".join(median_ms(run) for run in runs) + " |", flush=True)


def pad_case(cells: tuple[int, int, int], grading: float, nu: float) -> Case:
    """Return the squeezed pad of `block_cases`, quadratic, with cells that are smaller towards its faces (grading 0:
    all alike)."""
    mesh = block(cells, (1.0, 1.0, 1.0))
    nodes = (mesh.nodes - grading * np.sin(2.0 * np.pi * mesh.nodes) / (2.0 * np.pi)) * [0.03, 0.03, 0.015]
    mesh = to_quadratic(TetMesh(nodes, mesh.tets))
    low, high = mesh.nodes[:, 2] < 1e-9, mesh.nodes[:, 2] > 0.015 - 1e-9
    pushed = np.zeros_like(mesh.nodes)
    pushed[high, 2] = -1.0
    return Case(
        "squeeze", make_body(mesh, young_modulus=1e5, poisson_ratio=nu, clamped=low | high), np.zeros_like(pushed), pushed
    )


def pads(nu: float = 0.499) -> None:
    """Print the errors of the squeezed pad on finer and on graded meshes: the edges along which it sticks are what is missed."""
    (f, p), (F, P) = (
        [responses([pad_case(c, 0.0, nu)], kind)[0] for kind in ("points", "mean")] for c in ((8, 8, 6), (12, 12, 9))
    )
    print(f"\nSqueezed pad, ν = {nu}; the finest meshes disagree by {100.0 * abs(P / F - 1.0):.2f} %")
    print("| cells | grading | default, % | mean dilatation, % | four points, % |\n|---|---|---|---|---|")
    meshes = [((4, 4, 3), 0.0), ((4, 4, 3), 0.4), ((4, 4, 3), 0.7), ((5, 5, 4), 0.0), ((5, 5, 4), 0.5), ((6, 6, 4), 0.0)]
    for cells, grading in meshes:
        found = [responses([pad_case(cells, grading, nu)], kind)[0] for kind in (0.75, "mean", "points")]
        errors = " | ".join(f"{100.0 * (value / converged(f, p, F, P) - 1.0):+.1f}" for value in found)
        print(f"| {' × '.join(map(str, cells))} | {grading} | {errors} |", flush=True)


def large_displacements() -> None:
    """Print the sag of four-leg and how far 2 N of one cable move its tip, on its mesh and on one refined once."""
    table = "| four-leg | tetrahedra | sag, mm | tip under 2 N, mm |\n|---|---|---|---|"
    print(f"\n{table}")
    robot = load_robot("four-leg")
    for refinements in (0, 1):
        for element in ("tet4", "tet10"):
            truth = TruthTable.model_validate({"refinements": refinements, "element": element, "law": "corotational"})
            body = true_robot(robot, truth, []).body
            top = int(np.argmax(body.mesh.nodes[:, 2]))
            rest = solve_equilibrium(body)
            pulled = solve_equilibrium(body, tension={"north": 2.0}, start=rest)
            sag = body.mesh.nodes[top, 2] - rest.positions[top, 2]
            moved = np.linalg.norm(pulled.positions[top] - rest.positions[top])
            print(f"| {element} | {len(body.mesh.tets)} | {1e3 * sag:.2f} | {1e3 * moved:.2f} |", flush=True)


def ties(folder: Path) -> None:
    """Print what elements of half the size do to a pulled cable: to the robot's motion at one tension, and to the length that is wound up."""
    print(
        "\n| robot | tetrahedra | path points | motion [mm] | wound up [mm] | motion, finer | wound up, finer |\n|---|---|---|---|---|---|---|"
    )
    for which in ("finger", "arm", "four-leg", "gripper", *([folder] if folder.exists() else [])):
        robot = load_robot(which)
        cable = robot.body.cables[0]
        tension = 0.5 * (cable.max_tension if np.isfinite(cable.max_tension) else 4.0)
        (moved, wound), (moved_finer, wound_finer) = (pulled(robot, n, cable.name, tension) for n in (0, 1))
        shares = f"{100 * (moved_finer / moved - 1):+.1f} % | {100 * (wound_finer / wound - 1):+.1f} %"
        counts = f"{len(robot.body.mesh.tets)} | {len(cable.path.element)}"
        print(f"| {robot.name} | {counts} | {1e3 * moved:.1f} | {1e3 * wound:.2f} | {shares} |", flush=True)


def pulled(robot: Robot, refinements: int, cable: str, tension: float) -> tuple[float, float]:
    """Return how far a cable moves the node that it moves farthest [m], and the length that is wound up for it [m]; quadratic elements."""
    body = robot_on_mesh(robot, finer_mesh(robot.body.mesh, "tet10", refinements)).body
    rest = solve_equilibrium(body)
    state = solve_equilibrium(body, tension={cable: tension}, start=rest)
    moved = float(np.linalg.norm(state.positions - rest.positions, axis=1).max())
    return moved, state.shortening[cable] - rest.shortening[cable]


def main() -> None:
    """Print errors on block and diamond, large displacements, then times."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("diamond", nargs="?", type=Path, default=SHARED)
    parser.add_argument("--fine", type=int, default=1)
    parser.add_argument("--only", choices=("errors", "diamond", "pad", "large", "ties", "times", "finest"))
    arguments = parser.parse_args()
    folder: Path = arguments.diamond
    if arguments.only in (None, "errors"):
        worst = max(agreement(case) for quadratic in (False, True) for case in block_cases(0.5, quadratic, 0.49))
        print(f"the package's elements against the ones written here, at rest: {worst:.1e}")
        table(
            "Block, 8 × 3 × 3 and 5 × 5 × 4 cells",
            lambda k, q, nu: block_cases(1.0, q, nu),
            lambda k, q, nu: block_cases(2.0 * 2**k * arguments.fine, q, nu),
        )
    if arguments.only in (None, "errors", "diamond") and folder.exists():
        table(
            "Diamond, fields of force",
            lambda k, q, nu: diamond_cases(folder, 0, q, nu),
            lambda k, q, nu: diamond_cases(folder, k + arguments.fine - 1, q, nu),
        )
    if arguments.only in (None, "pad"):
        pads()
    if arguments.only == "finest" and folder.exists():
        finest(folder)
    if arguments.only in (None, "large"):
        large_displacements()
    if arguments.only in (None, "ties"):
        ties(folder)
    if arguments.only in (None, "times"):
        print(
            "\n| ms, wall / process | free unknowns | force | force and tangent | into the matrix | factor | one solve "
            "|\n|---|---|---|---|---|---|---|"
        )
        for quadratic in (False, True):
            for law in ("corotational", "neo_hookean"):
                body = diamond_body(folder, 0, quadratic, 0.45) if folder.exists() else block_cases(3.0, quadratic, 0.45)[0].body
                chosen = (
                    body
                    if law == "corotational"
                    else make_body(body.mesh, young_modulus=450e3, poisson_ratio=0.45, law=law, clamped=body.clamped)
                )
                timing(chosen, f"{'tet10' if quadratic else 'tet4'}, {law.replace('_', '-')}")


if __name__ == "__main__":
    main()
