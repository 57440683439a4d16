"""Slow, clear second implementations and closed forms that the tests of the body compare with."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy.linalg
from scipy.spatial.transform import Rotation

from femsense.fem.assembly import internal, reduced_matrix
from femsense.fem.body import BodyModel, make_body, tie_cable
from femsense.fem.mesh import EDGES, TetMesh, surface_triangles, to_quadratic

MIDDLES = EDGES


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Return a rotation matrix, evenly distributed."""
    return Rotation.random(rng=rng).as_matrix()


def distorted(mesh: TetMesh, rng: np.random.Generator, *, noise: float = 0.08) -> np.ndarray:
    """Return node positions after a large rotation, 40 % of stretch, shear and noise (a share of the shortest extent)."""
    F = random_rotation(rng) @ np.array([[1.4, 0.3, 0.0], [0.0, 0.8, -0.2], [0.1, 0.0, 1.1]])
    size = float(np.ptp(mesh.nodes, axis=0).min())
    return mesh.nodes @ F.T + rng.normal(0.0, noise * size, mesh.nodes.shape) + rng.normal(0.0, size, 3)


def dense_stiffness(body: BodyModel, positions: np.ndarray) -> np.ndarray:
    """Return d²W/dx² over all unknowns of an unclamped body, shape (3n, 3n)."""
    K = np.zeros((body.mesh.nodes.size,) * 2)
    blocks = internal(body, positions).blocks
    assert blocks is not None
    K[np.ix_(body.free_map.dofs, body.free_map.dofs)] = reduced_matrix(body, blocks).toarray()
    return K


def central_gradient(value: Callable[[np.ndarray], float | np.ndarray], x: np.ndarray, step: float) -> np.ndarray:
    """Return d value / dx by central differences: one row an entry of x, shape (x.size, …)."""
    rows = []
    for i in range(x.size):
        delta = np.zeros(x.size)
        delta[i] = step
        delta = delta.reshape(x.shape)
        rows.append((np.asarray(value(x + delta)) - np.asarray(value(x - delta))) / (2 * step))
    return np.array(rows)


def relative_error(found: np.ndarray, wanted: np.ndarray) -> float:
    """Return the largest difference over the largest entry of what is wanted."""
    return float(np.abs(np.asarray(found) - wanted).max() / np.abs(wanted).max())


# A second implementation of the elements: monomials for the shape functions, scipy's polar decomposition, loops.


def monomials(x: np.ndarray, quadratic: bool) -> np.ndarray:
    a, b, c = x
    return np.array([1, a, b, c] + ([a * a, b * b, c * c, a * b, b * c, a * c] if quadratic else []), dtype=float)


def monomial_gradients(x: np.ndarray, quadratic: bool) -> np.ndarray:
    a, b, c = x
    linear = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    more = [[2 * a, 0, 0], [0, 2 * b, 0], [0, 0, 2 * c], [b, a, 0], [0, c, b], [c, 0, a]]
    return np.array(linear + (more if quadratic else []), dtype=float)


def local_part(F: np.ndarray, law: str, mu: float, limit: float) -> tuple[float, np.ndarray]:
    """Return W [J/m³] without its λ term, and dW/dF [Pa], as in textbooks."""
    if law == "corotational":
        R = polar_rotation(F)
        strain = R.T @ F - np.eye(3)  # symmetric where R is the polar rotation
        strain = (strain + strain.T) / 2
        return mu * float((strain**2).sum()), R @ (2 * mu * strain)
    J, I1 = np.linalg.det(F), float((F**2).sum())
    if J <= 0 or limit <= I1 - 3:
        return np.inf, np.full((3, 3), np.nan)
    inverse = np.linalg.inv(F).T
    if law == "neo_hookean":
        return mu / 2 * (I1 - 3) - mu * np.log(J), mu * F - mu * inverse
    return -mu * limit / 2 * np.log(1 - (I1 - 3) / limit) - mu * np.log(J), mu / (1 - (I1 - 3) / limit) * F - mu * inverse


def polar_rotation(F: np.ndarray) -> np.ndarray:
    """Return the rotation closest to F."""
    R = np.asarray(scipy.linalg.polar(F)[0])
    if np.linalg.det(R) < 0:
        U, _, Vt = np.linalg.svd(F)
        R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return R


def dilatation(F: np.ndarray, law: str) -> tuple[float, np.ndarray]:
    """Return what the λ term measures, tr(RᵀF) − 3 or J, and its derivative by F."""
    if law == "corotational":
        R = polar_rotation(F)
        return float(np.trace(R.T @ F)) - 3, R
    J = float(np.linalg.det(F))
    return J, J * np.linalg.inv(F).T


def volumetric(theta: float, law: str, lam: float) -> tuple[float, float]:
    """Return the λ term [J/m³] for a dilatation (see `dilatation`) and its derivative [Pa]."""
    if law == "corotational":
        return lam / 2 * theta**2, lam * theta
    return lam / 2 * np.log(theta) ** 2, lam * np.log(theta) / theta


def slow_internal(body: BodyModel, positions: np.ndarray) -> tuple[float, np.ndarray]:
    """Return internal energy [J] and dW/dx [N], shape (n, 3), element by element.

    λ up to ¾ μ acts on the dilatation of the points, the rest on the mean over the element.
    """
    mesh, law, limit = body.mesh, body.material.law, body.material.stretch_limit
    quadratic = mesh.tets.shape[1] == 10
    a = (5 + 3 * np.sqrt(5)) / 20
    b = (5 - np.sqrt(5)) / 20
    places = [[a, b, b, b], [b, a, b, b], [b, b, a, b], [b, b, b, a]] if quadratic else [[0.25] * 4]
    energy, forces = 0.0, np.zeros_like(mesh.nodes)
    for tet, E, nu in zip(mesh.tets, body.material.young_modulus, body.material.poisson_ratio):
        mu, lam = E / 2 / (1 + nu), E * nu / (1 + nu) / (1 - 2 * nu)
        X = mesh.nodes[tet]
        volume = abs(np.dot(X[1] - X[0], np.cross(X[2] - X[0], X[3] - X[0]))) / 6
        origin, size = X[0], np.ptp(X, axis=0).max()  # well scaled monomials
        inverse = np.linalg.inv(np.array([monomials((p - origin) / size, quadratic) for p in X]))
        mean, mean_slope = 0.0, np.zeros((len(tet), 3))
        for place in places:
            at = (np.array(place) @ X[:4] - origin) / size
            gradients = inverse.T @ monomial_gradients(at, quadratic) / size
            F = positions[tet].T @ gradients
            W, P = local_part(F, law, mu, limit)
            theta, slope = dilatation(F, law)
            W_local, factor = volumetric(theta, law, min(lam, 0.75 * mu))
            energy += volume / len(places) * (W + W_local)
            forces[tet] += volume / len(places) * gradients @ (P + factor * slope).T
            mean += theta / len(places)
            mean_slope += gradients @ slope.T / len(places)
        W_mean, factor = volumetric(mean, law, lam - min(lam, 0.75 * mu))
        energy += volume * W_mean
        forces[tet] += volume * factor * mean_slope
    return energy, forces


# Loads and quadrature


def face_traction(mesh: TetMesh, on: Callable[[np.ndarray], np.ndarray], traction: Sequence[float]) -> np.ndarray:
    """Return the nodal forces [N] of a constant traction [Pa] on the boundary triangles whose nodes all satisfy `on`."""
    linear = TetMesh(mesh.nodes, mesh.tets[:, :4])
    middle = (
        {frozenset(t[list(e)].tolist()): t[4 + k] for t in mesh.tets for k, e in enumerate(EDGES)} if mesh.is_quadratic else {}
    )
    forces = np.zeros_like(mesh.nodes)
    for triangle in surface_triangles(linear):
        p = mesh.nodes[triangle]
        if not on(p).all():
            continue
        area = np.linalg.norm(np.cross(p[1] - p[0], p[2] - p[0])) / 2
        nodes = triangle
        if mesh.is_quadratic:
            nodes = [middle[frozenset((int(triangle[i]), int(triangle[j])))] for i, j in ((0, 1), (1, 2), (2, 0))]
        forces[nodes] += area / 3 * np.asarray(traction)
    return forces


def tet_quadrature(order: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Return barycentric points (q, 4) and weights (q,) that sum to one: Gauss points of a cube folded into a tetrahedron."""
    g, w = np.polynomial.legendre.leggauss(order)
    g, w = (g + 1) / 2, w / 2
    points, weights = [], []
    for r, wr in zip(g, w):
        for s, ws in zip(g, w):
            for t, wt in zip(g, w):
                a, b, c = r, s * (1 - r), t * (1 - r) * (1 - s)
                points.append([1 - a - b - c, a, b, c])
                weights.append(6 * wr * ws * wt * (1 - r) ** 2 * (1 - s))
    return np.array(points), np.array(weights)


# Small bodies


def bar_body(
    mesh: TetMesh,
    *,
    law: str = "corotational",
    quadratic: bool = False,
    young_modulus: float = 150e3,
    poisson_ratio: float = 0.4,
    density: float = 1000.0,
    gravity: Sequence[float] = (0.0, 0.0, 0.0),
    clamped: bool = True,
    friction: float = 0.0,
    cables: bool = True,
) -> BodyModel:
    """Return a bar along x, clamped at its lowest x, with a straight cable above and one along the side through two points."""
    mesh = to_quadratic(mesh) if quadratic else mesh
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    size, middle = high - low, (low + high) / 2
    ends = ()
    if cables:
        top = [[high[0], middle[1], high[2]]]
        side = [[high[0], high[1], middle[2]], [low[0] + 0.6 * size[0], high[1] - 0.1 * size[1], low[2] + 0.7 * size[2]]]
        ends = (
            tie_cable(mesh, "top", top, low + size * [-0.05, 0.5, 1.4], exit_direction=[-1.0, 0.0, -1.0], friction=friction),
            tie_cable(mesh, "side", side, low + size * [-0.05, 1.4, 0.5], exit_direction=[0.0, 0.0, -1.0], friction=friction),
        )
    return make_body(
        mesh,
        young_modulus=young_modulus,
        poisson_ratio=poisson_ratio,
        density=density,
        law=law,
        gravity=gravity,
        clamped=mesh.nodes[:, 0] <= low[0] + 1e-9 if clamped else (),
        cables=ends,
    )


def timoshenko_tip(force: float, length: float, width: float, height: float, E: float, nu: float) -> float:
    """Return the deflection of a cantilever's tip [m]: bending and shear, shear factor 10 (1 + ν) / (12 + 11 ν)."""
    area, inertia = width * height, width * height**3 / 12
    shear_factor = 10 * (1 + nu) / (12 + 11 * nu)
    return force * length**3 / (3 * E * inertia) + force * length / (shear_factor * E / 2 / (1 + nu) * area)
