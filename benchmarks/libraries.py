"""Own sparse factors and own search for neighbours beside those of libraries, on what `estimate` and `improve` meet.

    pip install cvxopt sksparse-minimal pypardiso
    python benchmarks/libraries.py [--data DATA]

One thread, processor time, median of the runs, all in one process in turn. The analysis is made once and kept,
as it is in `estimate` and `improve` (sksparse-minimal cannot keep it: its factor is analysis and numbers).
Every library has its own order of elimination.
"""

from __future__ import annotations

import argparse
import ctypes
import importlib.util
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from femsense import BodyModel, block_mesh, embed_points, load_robot, make_body
from femsense.core.arrays import FloatArray
from femsense.fem.assembly import internal, reduced_matrix
from femsense.fem.compliance import direction_rows
from femsense.fem.linalg.cholesky import cholesky
from femsense.fem.mesh import surface_triangles, to_quadratic
from femsense.io.clouds.cloud_files import read_cloud
from femsense.pointcloud.grid import build_grid, connected_labels, count_neighbors, count_within

DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data"
MANY = 24
"""Right-hand sides solved together: the derivatives of a state of the loop."""
POINTS = 17
"""Points that forces may act at: 51 columns of B."""


def bodies(data: Path) -> dict[str, BodyModel]:
    """Return the bodies by name."""
    diamond = load_robot(data / "diamond").body
    quadratic = make_body(
        to_quadratic(diamond.mesh), young_modulus=180e3, poisson_ratio=0.45, density=1070.0, clamped=diamond.clamped
    )
    bar = to_quadratic(block_mesh([np.linspace(0, 0.12, 17), np.linspace(-0.012, 0.012, 5), np.linspace(-0.012, 0.012, 5)]))
    held = np.flatnonzero(bar.nodes[:, 0] < 1e-9)
    return {
        "diamond, tet4": diamond,
        "diamond, tet10": quadratic,
        "bar of 1536, tet10": make_body(bar, young_modulus=180e3, poisson_ratio=0.45, density=1070.0, clamped=held),
        "four-leg": load_robot("four-leg").body,
    }


def columns_of(body: BodyModel) -> sp.csc_matrix:
    """Return forces on points of the surface as columns, shape (f, 3 POINTS)."""
    triangles = surface_triangles(body.mesh)
    chosen = triangles[np.linspace(0, len(triangles) - 1, POINTS).astype(int)]
    places = embed_points(body.mesh, body.mesh.nodes[chosen].mean(axis=1))
    along = [direction_rows(places, np.tile(axis, (POINTS, 1)), len(body.mesh.nodes)) for axis in np.eye(3)]
    rows = np.concatenate(along)
    return sp.csc_matrix(rows[:, body.free_map.dofs].T)


class Own:
    """The project's Cholesky."""

    def __init__(self, body: BodyModel, matrix: sp.csc_matrix, *, single: bool) -> None:
        self.analysis, self.values, self.single = body.free_map.pattern.analysis(), matrix.data, single
        self.factor()

    def factor(self) -> None:
        made = cholesky(self.analysis, self.values, single=self.single)
        assert made is not None
        self.made = made

    def solve(self, right: FloatArray) -> FloatArray:
        return self.made.solve(right)

    def gram(self, columns: sp.csc_matrix) -> FloatArray:
        return self.made.gram(columns)


class _WithoutGram:
    """Makes W of solves; its heirs say how these are made."""

    solve: Callable[[FloatArray], FloatArray]

    def gram(self, columns: sp.csc_matrix) -> FloatArray:
        return np.asarray(columns.T @ self.solve(columns.toarray()))


class Cvxopt(_WithoutGram):
    """CHOLMOD as cvxopt brings it: supernodal, with OpenBLAS, analysis kept."""

    def __init__(self, body: BodyModel, matrix: sp.csc_matrix) -> None:
        from cvxopt import cholmod, spmatrix
        from cvxopt import matrix as dense

        lower = sp.tril(matrix, format="coo")
        self.cholmod, self.dense = cholmod, dense
        cholmod.options["supernodal"] = 2
        self.matrix = spmatrix(lower.data, lower.row.tolist(), lower.col.tolist(), matrix.shape)
        self.made = cholmod.symbolic(self.matrix, uplo="L")
        self.factor()

    def factor(self) -> None:
        self.cholmod.numeric(self.matrix, self.made)

    def solve(self, right: FloatArray) -> FloatArray:
        answer = self.dense(right)
        self.cholmod.solve(self.made, answer)
        return np.asarray(answer).reshape(right.shape)


class Minimal(_WithoutGram):
    """CHOLMOD of sksparse-minimal: analysis in every factor."""

    def __init__(self, body: BodyModel, matrix: sp.csc_matrix) -> None:
        self.matrix = sp.csc_matrix((matrix.data.copy(), matrix.indices.copy(), matrix.indptr.copy()), matrix.shape)
        self.factor()

    def factor(self) -> None:
        from sksparse_minimal import SparseCholesky

        self.made = SparseCholesky(self.matrix)

    def solve(self, right: FloatArray) -> FloatArray:
        columns = right.reshape(len(right), -1)
        return np.column_stack([self.made.solve_A(np.ascontiguousarray(column)) for column in columns.T]).reshape(right.shape)


class Pardiso(_WithoutGram):
    """PARDISO of the MKL, told that the matrix is positive definite; its analysis kept."""

    def __init__(self, body: BodyModel, matrix: sp.csc_matrix) -> None:
        from pypardiso import PyPardisoSolver

        mkl = PyPardisoSolver().libmkl
        mkl.MKL_Set_Num_Threads(1)
        self.library = mkl.pardiso
        upper = sp.csr_matrix(sp.triu(matrix, format="csr"))
        upper.sort_indices()
        self.size, self.values = matrix.shape[0], upper.data
        self.indptr, self.indices = upper.indptr.astype(np.int32), upper.indices.astype(np.int32)
        self.pt, self.iparm = np.zeros(64, np.int64), np.zeros(64, np.int32)
        self.iparm[[0, 1, 34]] = 1, 2, 1  # own settings, METIS, indices from 0
        self.call(11)
        self.factor()

    def call(self, phase: int, right: FloatArray | None = None, answer: FloatArray | None = None) -> None:
        def integer(value: int) -> Any:
            return ctypes.byref(ctypes.c_int32(value))

        def at(array: Any) -> Any:
            kinds = {"i8": ctypes.c_int64, "i4": ctypes.c_int32, "f8": ctypes.c_double}
            return None if array is None else array.ctypes.data_as(ctypes.POINTER(kinds[array.dtype.str[1:]]))

        count, error = 1 if right is None or right.ndim == 1 else right.shape[1], ctypes.c_int32(0)
        matrix = at(self.values), at(self.indptr), at(self.indices), at(np.zeros(1, np.int32))
        tail = integer(count), at(self.iparm), integer(0), at(right), at(answer), ctypes.byref(error)
        self.library(at(self.pt), integer(1), integer(1), integer(2), integer(phase), integer(self.size), *matrix, *tail)
        assert error.value == 0

    def factor(self) -> None:
        self.call(22)

    def solve(self, right: FloatArray) -> FloatArray:
        given = np.asfortranarray(right)
        answer = np.empty_like(given, order="F")
        self.call(33, given, answer)
        return answer


def solvers(body: BodyModel, matrix: sp.csc_matrix) -> dict[str, Any]:
    """Return the solvers that are installed, by name."""
    found: dict[str, Any] = {"own, double": Own(body, matrix, single=False), "own, single": Own(body, matrix, single=True)}
    if importlib.util.find_spec("cvxopt"):
        found["CHOLMOD (cvxopt)"] = Cvxopt(body, matrix)
    if importlib.util.find_spec("sksparse_minimal"):
        found["CHOLMOD (sksparse-minimal)"] = Minimal(body, matrix)
    if importlib.util.find_spec("pypardiso"):
        found["PARDISO"] = Pardiso(body, matrix)
    return found


def median_ms(call: Callable[[], Any], count: int = 9) -> float:
    """Return the median processor time of a call [ms]; short ones are repeated within a run."""
    call()
    began = time.process_time()
    call()
    repeats = max(1, int(0.01 / max(time.process_time() - began, 1e-5)))
    times = []
    for _ in range(count):
        began = time.process_time()
        for _ in range(repeats):
            call()
        times.append(1e3 * (time.process_time() - began) / repeats)
    return float(np.median(times))


def neighbours(robot: str = "four-leg") -> None:
    """Print what the grid of cells takes beside SciPy's tree, building included."""
    frame = Path(__file__).resolve().parents[1] / "meshes" / robot / "recordings" / "demo" / "clouds" / "000041.ply"
    plain = np.array(read_cloud(frame).points)
    dense = np.repeat(plain, 20, axis=0) + np.random.default_rng(0).normal(0.0, 5e-4, (20 * len(plain), 3))
    print("\n| ms | | count all neighbours | is one near | connected parts |\n|---|---|---|---|---|")
    for name, points, radius in (("a frame of the demo", plain, 0.006), ("20 times as dense", dense, 0.003)):
        queries, feature = points[::7], np.zeros((len(points), 1))

        def parts(points: FloatArray = points, radius: float = radius) -> Any:
            pairs = cKDTree(points).query_pairs(radius, output_type="ndarray")
            graph = sp.coo_matrix((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
            return connected_components(graph, directed=False)

        rows: dict[str, list[Callable[[], Any]]] = {
            "own grid": [
                lambda p=points, r=radius: count_neighbors(build_grid(p, r), r),
                lambda p=points, r=radius, q=queries: count_within(build_grid(p, r), q, r, enough=1),
                lambda p=points, r=radius, f=feature: connected_labels(build_grid(p, r), r, f, 1.0),
            ],
            "cKDTree": [
                lambda p=points, r=radius: cKDTree(p).query_ball_point(p, r, return_length=True),
                lambda p=points, r=radius, q=queries: cKDTree(p).query(q, distance_upper_bound=r),
                parts,
            ],
        }
        for kind, calls in rows.items():
            cells = " | ".join(f"{median_ms(call, 3):.1f}" for call in calls)
            print(f"| {name}, {len(points)} points | {kind} | {cells} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA)
    data = parser.parse_args().data
    print(f"| ms | | factor | one solve | {MANY} solves | W of {POINTS} points |\n|---|---|---|---|---|---|")
    for name, body in bodies(data).items():
        matrix = reduced_matrix(body, internal(body, body.mesh.nodes).blocks)
        columns = columns_of(body)
        right = np.random.default_rng(0).standard_normal((matrix.shape[0], MANY))
        true = None
        for solver_name, solver in solvers(body, matrix).items():
            answer = solver.solve(right)
            true = answer if true is None else true
            assert np.abs(answer - true).max() < (1e-2 if "single" in solver_name else 1e-6) * np.abs(true).max(), solver_name
            calls = [
                solver.factor,
                *(partial(solver.solve, b) for b in (right[:, 0].copy(), right)),
                partial(solver.gram, columns),
            ]
            with threadpool_limits(1):
                cells = " | ".join(f"{median_ms(call):.2f}" for call in calls)
            print(f"| {name}, {matrix.shape[0]} unknowns | {solver_name} | {cells} |", flush=True)
    neighbours()


if __name__ == "__main__":
    main()
