"""What the test suite of another program (SOFA 25.06 with its solid mechanics) expects, asked of our elements with its figures.

Checked here: the single tetrahedra of `TetrahedronFEMForceField_stepTest` (A1) and `FastTetrahedralCorotationalForceField_test`
(A3), the traction of `LinearElasticity_test` (C), the patch of `AffinePatch_test` (D), the neo-Hookean law of `Material_test`
(F), and the weight on springs of `EulerImplicitSolverStatic_test` (G) at rest.

Not checked, because it says nothing about this program:
A2 – layout of matrices inside the "large" element, whose frame depends on the order of nodes; ours has no such frame;
B – a swinging beam of "large" elements at 1 s, a transient of one time integrator (we solve for rest);
E – residuals of ten Newton steps of the St. Venant–Kirchhoff law under a follower pressure; we have neither;
F – a Mooney–Rivlin beam on a mesh of that program's distribution; we have not the law;
H – cables and inverse problems: their figures belong to `test_fem_cables.py` and `test_qp_forces.py`; the finger scene moves on
springs of 1e12 N/m under an implicit Euler step and fixes no number that a static solver could share.
Whole robots against equilibria of that program stand in `test_fem_reference.py`.
"""

from __future__ import annotations

import numpy as np
import pytest
from analytic import central_gradient, dense_stiffness, face_traction, random_rotation, relative_error
from helpers import block_mesh
from scipy.sparse.linalg import spsolve

from femsense.fem.assembly import internal, reduced_matrix
from femsense.fem.body import BodyModel, make_body
from femsense.fem.equilibrium import SolveOptions, solve_equilibrium
from femsense.fem.mesh import TetMesh, to_quadratic

QUADRATIC = pytest.mark.parametrize("quadratic", [False, True])


@QUADRATIC
def test_a1_a_regular_tetrahedron_at_twice_its_height(quadratic: bool) -> None:
    """E = 40, ν = 0: internal forces √3·10/9 at the base nodes, −√3·10/3 at the tip, along z (of ten nodes: their sums)."""
    nodes = np.array([[0, 0, 0], [1, 0, 0], [0.5, 0.8660254037844386, 0], [0.5, 0.2886751345948129, 1.0]])
    mesh = TetMesh(nodes, [[0, 1, 2, 3]])
    mesh = to_quadratic(mesh) if quadratic else mesh
    body = make_body(mesh, young_modulus=40.0, poisson_ratio=0.0)
    forces = -internal(body, mesh.nodes * [1.0, 1.0, 2.0]).forces
    if quadratic:  # a constant stress: a mid-edge node carries for the two corners of its edge
        assert forces[:, 2] @ mesh.nodes[:, 2] == pytest.approx(-5.773502692, abs=1e-8)
        return
    np.testing.assert_allclose(forces, [[0, 0, 1.924500897]] * 3 + [[0, 0, -5.773502692]], atol=1e-8)


def test_a3_stiffness_blocks_of_the_corner_tetrahedron() -> None:
    """E = 1000, ν = 0.3, nodes in the order 2 3 1 0: diagonal and edge blocks to the printed digits."""
    nodes = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    body = make_body(TetMesh(nodes, [[0, 1, 2, 3]]), young_modulus=1000.0, poisson_ratio=0.3)
    K = dense_stiffness(body, nodes.copy()).reshape(4, 3, 4, 3).transpose(0, 2, 1, 3)[np.ix_([2, 3, 1, 0], [2, 3, 1, 0])]
    s, p, c = 64.1026, 224.359, 96.1538
    diagonal = [np.diag([s, p, s]), np.diag([s, s, p]), np.diag([p, s, s]), np.full((3, 3), 160.25641) + 192.30769 * np.eye(3)]
    for i, block in enumerate(diagonal):
        np.testing.assert_allclose(K[i, i], block, atol=1e-3)
    edges = {
        (0, 1): [[0, 0, 0], [0, 0, c], [0, s, 0]],
        (0, 2): [[0, s, 0], [c, 0, 0], [0, 0, 0]],
        (0, 3): [[-s, -s, 0], [-c, -p, -c], [0, -s, -s]],
        (1, 2): [[0, 0, s], [0, 0, 0], [c, 0, 0]],
        (1, 3): [[-s, 0, -s], [0, -s, -s], [-c, -c, -p]],
        (2, 3): [[-p, -c, -c], [-s, -s, 0], [-s, 0, -s]],
    }
    for (i, j), block in edges.items():  # printed there is the transposed block
        np.testing.assert_allclose(K[i, j], block, atol=1e-3)
        np.testing.assert_allclose(K[j, i], np.transpose(block), atol=1e-3)


def cylinder(quadratic: bool) -> TetMesh:
    """Return a cylinder of radius 0.2 and height 1 (its section a rounded square, which the state does not feel)."""
    mesh = block_mesh((4, 4, 5), (2.0, 2.0, 1.0), start=(-1.0, -1.0, 0.0))
    x, y, z = mesh.nodes.T
    nodes = np.stack([0.2 * x * np.sqrt(1 - 0.35 * y**2), 0.2 * y * np.sqrt(1 - 0.35 * x**2), z], axis=1)
    return to_quadratic(TetMesh(nodes, mesh.tets)) if quadratic else TetMesh(nodes, mesh.tets)


@QUADRATIC
@pytest.mark.parametrize("nu", [0.0, 0.3, 0.49])
def test_c_traction_of_a_cylinder(quadratic: bool, nu: float) -> None:
    """E ∈ {1, 2}, p ∈ {±0.2, ±0.6}: longitudinal strain p/E to 1e-4, radial strain −ν p/E to 2e-4, in one linear step."""
    mesh = cylinder(quadratic)
    pull = face_traction(mesh, lambda q: q[:, 2] > 1 - 1e-9, [0.0, 0.0, 1.0])
    axis = np.flatnonzero(np.linalg.norm(mesh.nodes, axis=1) < 1e-9)[0]
    side = int(np.argmax(mesh.nodes[:, 0] - mesh.nodes[:, 2]))  # on the x axis of the bottom: may move along x only
    held = np.concatenate([3 * np.flatnonzero(mesh.nodes[:, 2] < 1e-9) + 2, [3 * axis, 3 * axis + 1, 3 * side + 1]])
    free = np.setdiff1d(np.arange(mesh.nodes.size), held)
    for E in (1.0, 2.0):
        body = make_body(mesh, young_modulus=E, poisson_ratio=nu)
        blocks = internal(body, np.array(mesh.nodes)).blocks
        assert blocks is not None
        order = np.argsort(body.free_map.dofs)
        K = reduced_matrix(body, blocks)[order][:, order][free][:, free]
        u = np.zeros(mesh.nodes.size)
        u[free] = spsolve(K.tocsc(), pull.ravel()[free])
        u = u.reshape(-1, 3)
        for p in (0.6, 0.2, -0.2, -0.6):
            np.testing.assert_allclose(p * u[:, 2], p / E * mesh.nodes[:, 2], atol=1e-8)
            np.testing.assert_allclose(p * u[:, :2], -nu * p / E * mesh.nodes[:, :2], atol=1e-8)


@QUADRATIC
@pytest.mark.parametrize("law", ["corotational", "neo_hookean"])
def test_d_the_inside_of_a_cube_follows_its_turned_boundary(quadratic: bool, law: str) -> None:
    """Unit cube, E = 20, ν = 0.4, boundary turned and moved at random: the inside follows within 1.1e-4 (here 1e-9)."""
    mesh = block_mesh((4, 4, 4) if not quadratic else (2, 2, 2), (1.0, 1.0, 1.0))
    mesh = to_quadratic(mesh) if quadratic else mesh
    edge = ((mesh.nodes < 1e-9) | (mesh.nodes > 1 - 1e-9)).any(axis=1)
    rng = np.random.default_rng(1)
    turned = mesh.nodes @ random_rotation(rng).T + rng.normal(0, 3, 3)
    body = make_body(TetMesh(mesh.nodes, mesh.tets), young_modulus=20.0, poisson_ratio=0.4, law=law, clamped=edge)
    x, dofs = turned.copy(), body.free_map.dofs
    x[~edge] += rng.normal(0, 0.02, (int((~edge).sum()), 3))
    for _ in range(10):
        here = internal(body, x)
        x.ravel()[dofs] -= spsolve(reduced_matrix(body, here.blocks), here.forces.ravel()[dofs])
    np.testing.assert_allclose(x, turned, atol=1e-9)


@QUADRATIC
def test_f_the_neo_hookean_law_and_its_derivative(quadratic: bool) -> None:
    """W = μ/2 (tr C − 3) − μ ln J + λ/2 (ln J)² for random C; forces against central differences of W, h = 1e-6, to 1e-8."""
    rng = np.random.default_rng(2)
    mesh = TetMesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), [[0, 1, 2, 3]])
    mesh = to_quadratic(mesh) if quadratic else mesh
    body = make_body(mesh, young_modulus=2.6, poisson_ratio=0.3, law="neo_hookean")  # μ = 1, λ = 1.5
    for _ in range(5):
        F = np.eye(3) + rng.normal(0, 0.2, (3, 3))
        if np.linalg.det(F) < 0.3:
            continue
        x = mesh.nodes @ F.T
        log_J = np.log(np.linalg.det(F))
        W = 0.5 * (np.trace(F.T @ F) - 3) - log_J + 0.75 * log_J**2
        assert 6.0 * internal(body, x).energy == pytest.approx(W, rel=1e-12)
        slope = central_gradient(lambda y: internal(body, y, tangent=False).energy, x, 1e-6)
        assert np.abs(internal(body, x).forces.ravel() - slope).max() < 1e-8


def test_g_a_weight_on_springs_rests_at_its_weight_over_their_stiffness() -> None:
    """k = 1000 N/m, 1 kg, g = 9.81: rest at y = −0.00981 (there two particles; here a stiff block on eight springs)."""
    mesh = block_mesh((1, 1, 1), (0.1, 0.1, 0.1))
    body = make_body(
        mesh, young_modulus=1e9, poisson_ratio=0.3, density=1000.0, clamped=np.ones(8, dtype=bool), gravity=[0, -9.81, 0]
    )
    state = solve_equilibrium(body.with_clamp_stiffness(1000.0 / 8.0))
    assert state.positions[:, 1].mean() - mesh.nodes[:, 1].mean() == pytest.approx(-0.00981, rel=1e-6)


# Laws that every element keeps


def bar(law: str, quadratic: bool, nu: float) -> BodyModel:
    mesh = block_mesh((4, 1, 1), (0.1, 0.03, 0.03))
    mesh = to_quadratic(mesh) if quadratic else mesh
    return make_body(mesh, young_modulus=1e5, poisson_ratio=nu, law=law, clamped=mesh.nodes[:, 0] < 1e-9)


@QUADRATIC
@pytest.mark.parametrize("law", ["corotational", "neo_hookean"])
def test_the_work_of_the_loads_is_the_energy(law: str, quadratic: bool) -> None:
    """A bar bent far in eight steps: f·u(1) − ∫ f·u ds (Simpson) against the energy that is stored."""
    body = bar(law, quadratic, 0.49)
    end = body.mesh.nodes[:, 0] > 0.1 - 1e-9
    load = np.where(end[:, None], [0.1, 0.05, -0.4], 0.0) / end.sum() * (1.0 if quadratic else 6.0)  # four nodes lock
    work, state = [], None
    for s in np.linspace(0.0, 1.0, 9):
        state = solve_equilibrium(body, nodal_forces=s * load, start=state)
        assert state.converged
        work.append(float((load * (state.positions - body.mesh.nodes)).sum()))
    weights = np.array([1, 4, 2, 4, 2, 4, 2, 4, 1]) / 24.0
    stored = work[-1] - float(weights @ work)
    assert np.abs(state.positions - body.mesh.nodes).max() > 0.01
    assert internal(body, state.positions).energy == pytest.approx(stored, rel=2e-4)


@QUADRATIC
def test_two_loads_do_the_same_work_on_each_others_displacements(quadratic: bool) -> None:
    body, rng = bar("corotational", quadratic, 0.499), np.random.default_rng(3)
    loads = 1e-6 * rng.normal(size=(2, *body.mesh.nodes.shape))
    u = [
        solve_equilibrium(body, nodal_forces=load, options=SolveOptions(relative_tolerance=1e-12)).positions - body.mesh.nodes
        for load in loads
    ]
    assert relative_error(np.array([(loads[0] * u[1]).sum()]), np.array([(loads[1] * u[0]).sum()])) < 1e-4
