# mypy: allow-untyped-decorators
"""A Newton step along which elements turn instead of stretching.

A straight step u changes the deformation F = V R of an element by dF, which is a turn ω and a strain E:

    dF Rᵀ = [ω]ₓ V + E,    (tr(V) I − V) ω = axial(dF Rᵀ − R dFᵀ),

and where ω is not small it stretches the element by |ω|²/2, which a body that is stiff against stretch answers with large forces.
The element is to have F' = exp[ω]ₓ (V + E) R instead. The nodes that come nearest to that in the mean of squares,

    min Σ_q w_q ‖∇x − F'_q‖²,

follow from one Laplacian of the mesh, the same for every step; to first order in u they are those of the straight step.
References: Huang et al. 2011 (warping by rotation and strain), Bouaziz et al. 2014 (its global step).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import SuperLU, splu

from femsense.core.arrays import FloatArray, IntArray, read_only
from femsense.core.kernels import njit
from femsense.fem.body import BodyModel
from femsense.fem.mesh import EDGES
from femsense.fem.rotation import FAST, closest_rotation, turning_compliance


@dataclass(frozen=True, eq=False, slots=True)
class Corners:
    """The corners of the tetrahedra of a mesh: turns are made of them alone, and nodes in the middle of edges follow."""

    tets: IntArray
    """shape (m, 4)."""
    gradients: FloatArray
    """Of the linear shape functions at rest [1/m], shape (m, 3, 4)."""
    volumes: FloatArray
    """[m³], shape (m,)."""
    free: IntArray
    """Corners that are not clamped, shape (k,)."""
    middles: IntArray
    """Free nodes in the middle of edges and the ends of these, shape (e, 3)."""
    factor: SuperLU
    """Of Σ w ∇N_a·∇N_b over the free corners."""


def rotated_step(body: BodyModel, positions: FloatArray, step: FloatArray) -> FloatArray | None:
    """Return where a step [m], shape (n, 3), leads from node positions [m] when elements turn; None where nothing is clamped."""
    kept = body.free_map.laplacian
    if not kept:
        kept.append(corners_of(body) if body.clamp_is_rigid and body.is_clamped() else None)
    corners: Corners | None = kept[0]
    if corners is None:
        return None
    excess, further = np.zeros_like(step), np.zeros_like(step)
    x = read_only(positions)
    _excess(x, step, corners.tets, corners.gradients, corners.volumes, excess)
    further[corners.free] = corners.factor.solve(excess[corners.free])
    middle, one, other = corners.middles.T
    further[middle] = (further[one] + further[other]) / 2.0
    return np.asarray(x + step + further)


def corners_of(body: BodyModel) -> Corners:
    """Return the rest-shape data of rotated steps, with the factor of the Laplacian."""
    mesh, tets = body.mesh, body.mesh.tets[:, :4]
    edges = mesh.nodes[tets[:, 1:]] - mesh.nodes[tets[:, :1]]
    slopes = np.linalg.inv(edges)  # columns: gradients of N1, N2, N3
    gradients = np.concatenate([-slopes.sum(axis=2, keepdims=True), slopes], axis=2)
    volumes = np.linalg.det(edges) / 6.0
    values = np.einsum("m,mia,mib->mab", volumes, gradients, gradients)
    whole = sp.csr_matrix(
        (values.ravel(), (np.repeat(tets, 4, axis=1).ravel(), np.tile(tets, (1, 4)).ravel())), shape=(len(mesh.nodes),) * 2
    )
    nodes = body.free_map.dofs[::3] // 3  # in the order of elimination of the body, which serves here too
    is_corner = np.zeros(len(mesh.nodes), dtype=bool)
    is_corner[tets] = True
    free = nodes[is_corner[nodes]]
    part = sp.csc_matrix(whole[free][:, free])
    factor = splu(part, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    middles = np.zeros((0, 3), dtype=np.int64)
    if mesh.is_quadratic:
        triples = np.concatenate([mesh.tets[:, 4:, None], tets[:, EDGES]], axis=2).reshape(-1, 3)
        middles = np.unique(triples[np.isin(triples[:, 0], nodes)], axis=0)
    return Corners(np.ascontiguousarray(tets), gradients, volumes, free, middles, factor)


@njit(cache=True, nogil=True, fastmath=FAST)
def _excess(x: FloatArray, step: FloatArray, tets: IntArray, gradients: FloatArray, volumes: FloatArray, out: FloatArray) -> None:
    """Add Σ w (F' − F − dF) ∇N_a to out, shape (n, 3)."""
    F, R, D, A, P = np.empty((9, 1)), np.empty((9, 1)), np.empty(6), np.empty((3, 3)), np.empty((3, 3))
    first = np.int64(0)  # as in `corotational_tet4`
    V, dF, W, Q = np.empty((3, 3)), np.empty((3, 3)), np.zeros((3, 3)), np.empty((3, 3))
    for e in range(len(tets)):
        G = gradients[e]
        for i in range(3):
            for j in range(3):
                s = d = 0.0
                for a in range(4):
                    s += x[tets[e, a], i] * G[j, a]
                    d += step[tets[e, a], i] * G[j, a]
                F[3 * i + j, 0], dF[i, j] = s, d
        closest_rotation(F, R, first)
        turning_compliance(F, R, first, D)
        for i in range(3):
            for j in range(3):
                r0, r1, r2 = R[3 * j, 0], R[3 * j + 1, 0], R[3 * j + 2, 0]
                V[i, j] = F[3 * i, 0] * r0 + F[3 * i + 1, 0] * r1 + F[3 * i + 2, 0] * r2
                A[i, j] = dF[i, 0] * r0 + dF[i, 1] * r1 + dF[i, 2] * r2
        u, v, w = A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1]
        ox, oy, oz = D[0] * u + D[1] * v + D[2] * w, D[1] * u + D[3] * v + D[4] * w, D[2] * u + D[4] * v + D[5] * w
        square = ox * ox + oy * oy + oz * oz
        angle = np.sqrt(square)
        one, two = -square / 6.0, 0.5 - square / 24.0
        if angle > 1e-3:
            one, two = np.sin(angle) / angle - 1.0, (1.0 - np.cos(angle)) / square
        W[0, 1], W[0, 2], W[1, 2], W[1, 0], W[2, 0], W[2, 1] = -oz, oy, -ox, oz, -oy, ox
        for i in range(3):  # A becomes the strain E
            for j in range(3):
                A[i, j] -= W[i, 0] * V[0, j] + W[i, 1] * V[1, j] + W[i, 2] * V[2, j]
                Q[i, j] = one * W[i, j] + two * (W[i, 0] * W[0, j] + W[i, 1] * W[1, j] + W[i, 2] * W[2, j])
        for i in range(3):
            for j in range(3):
                s = 0.0
                for k in range(3):
                    s += Q[i, k] * (V[k, j] + A[k, j]) + W[i, k] * A[k, j]
                P[i, j] = volumes[e] * s
        for i in range(3):
            p0 = P[i, 0] * R[0, 0] + P[i, 1] * R[3, 0] + P[i, 2] * R[6, 0]
            p1 = P[i, 0] * R[1, 0] + P[i, 1] * R[4, 0] + P[i, 2] * R[7, 0]
            p2 = P[i, 0] * R[2, 0] + P[i, 1] * R[5, 0] + P[i, 2] * R[8, 0]
            for a in range(4):
                out[tets[e, a], i] += p0 * G[0, a] + p1 * G[1, a] + p2 * G[2, a]
