"""Inner loops of the skinning fit, compiled: rigid sweeps over the bones of a frame, weights of single vertices.

Plain loops over small arrays, which compile in a moment and need no linear-algebra library.
"""

# mypy: disable-error-code="untyped-decorator"

from __future__ import annotations

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray, IntArray
from femsense.core.kernels import njit
from femsense.fem.rotation import rotation_of

INFLUENCES = 4
CANDIDATES = 10
"""Bones among which the weights of a vertex are sought."""


# ---- poses ------------------------------------------------------------------------------------------------------------


@njit(cache=True)
def misfit(N: FloatArray, Y: FloatArray, M: FloatArray) -> float:
    """Return Σ |A M − x|² − Σ |x|² of a frame, for stacked transposed transforms M, shape (B, 4, 3)."""
    total = 0.0
    for b in range(len(M)):
        for i in range(4):
            for k in range(3):
                product = -2.0 * Y[b, i, k]
                for c in range(len(M)):
                    for j in range(4):
                        product += N[b, i, c, j] * M[c, j, k]
                total += M[b, i, k] * product
    return total


@njit(cache=True)
def set_bone(M: FloatArray, b: int, sums: FloatArray, moment: FloatArray, weight: float, prior: float, R: FloatArray) -> None:
    """Write the rigid fit of one bone into M[b] = [Rᵀ; tᵀ].

    Arguments:
        M: transposed transforms of all bones, shape (B, 4, 3).
        b: the bone.
        sums: Σ w p qᵀ over Σ w qᵀ, shape (4, 3).
        moment: Σ w p, shape (3,).
        weight: Σ w.
        prior: weight of the current rotation, which determines directions that the vertices leave free.
        R: work, shape (3, 3).
    """
    if weight <= 1e-300:
        return
    covariance = np.empty((3, 3))
    for i in range(3):
        for k in range(3):
            covariance[i, k] = sums[i, k] - moment[i] * sums[3, k] / weight + prior * M[b, i, k]
    rotation_of(covariance, R)
    for k in range(3):
        M[b, 3, k] = sums[3, k] / weight
        for i in range(3):
            M[b, i, k] = R[k, i]
            M[b, 3, k] -= R[k, i] * moment[i] / weight


@njit(cache=True)
def sweep_poses(N: FloatArray, Y: FloatArray, share: FloatArray, start: FloatArray, sweeps: int) -> FloatArray:
    """Return bone poses (B, 4, 4) after sweeps of rigid fits, each bone fitted to the residual of the others.

    Arguments:
        N: normal matrices of all pairs of bones, shape (B, 4, B, 4).
        Y: sums of weighted rest positions times vertices of the frame, shape (B, 4, 3).
        share: Σ w of each bone, shape (B,).
        start: poses to start from where they fit better than separate fits, shape (B, 4, 4), or (0, 4, 4).
        sweeps: number of passes.
    """
    bones = len(N)
    R, sums, moment = np.empty((3, 3)), np.empty((4, 3)), np.empty(3)
    before = np.zeros((bones, 4, 3))
    for b in range(bones):
        for i in range(3):
            before[b, i, i] = 1.0
            if len(start) == bones:
                before[b, 3, i] = start[b, i, 3]
                for k in range(3):
                    before[b, i, k] = start[b, k, i]
    M = separate_fits(N, Y, share, before)
    if len(start) == bones and misfit(N, Y, before) <= misfit(N, Y, M):
        M = before
    for _ in range(sweeps):
        for b in range(bones):
            left_by_others(N, Y, M, b, sums)
            for i in range(3):
                moment[i] = N[b, i, b, 3]
            set_bone(M, b, sums, moment, N[b, 3, b, 3], prior_of(N, b), R)
    poses = np.zeros((bones, 4, 4))
    for b in range(bones):
        poses[b, 3, 3] = 1.0
        for k in range(3):
            poses[b, k, 3] = M[b, 3, k]
            for i in range(3):
                poses[b, k, i] = M[b, i, k]
    return poses


@njit(cache=True)
def separate_fits(N: FloatArray, Y: FloatArray, share: FloatArray, before: FloatArray) -> FloatArray:
    """Return [Rᵀ; tᵀ] of each bone (B, 4, 3), fitted to its vertices with its weights, without regard to the others."""
    M = before.copy()
    R, moment = np.empty((3, 3)), np.empty(3)
    for b in range(len(N)):
        for i in range(3):
            moment[i] = 0.0
            for c in range(len(N)):  # weights sum to 1 at each vertex: Σ_c Σ w_b w_c p = Σ w_b p
                moment[i] += N[b, i, c, 3]
        set_bone(M, b, Y[b], moment, share[b], prior_of(N, b), R)
    return M


@njit(cache=True)
def prior_of(N: FloatArray, b: int) -> float:
    """Return the small weight of a bone's current rotation, which determines directions that its vertices leave free."""
    return 1e-9 * float(N[b, 0, b, 0] + N[b, 1, b, 1] + N[b, 2, b, 2])


@njit(cache=True)
def left_by_others(N: FloatArray, Y: FloatArray, M: FloatArray, b: int, sums: FloatArray) -> None:
    """Write the target of bone b: its sums of the frame minus the contributions of the other bones, shape (4, 3)."""
    for i in range(4):
        for k in range(3):
            rest = Y[b, i, k]
            for c in range(len(M)):
                if c != b:
                    for j in range(4):
                        rest -= N[b, i, c, j] * M[c, j, k]
            sums[i, k] = rest


# ---- weights ----------------------------------------------------------------------------------------------------------


@njit(cache=True)
def weights_of_vertices(
    rest: FloatArray, states: FloatArray, origins: FloatArray, poses: FloatArray, smooth: FloatArray, tiny: float, pull: float
) -> tuple[IntArray, FloatArray]:
    """Return joints (V, 4) and weights (V, 4) that fit the frames by least squares, independently for each vertex.

    Minimises (1/F) Σ_f |Σ_b w_b (R_b p + t_b) − x|² + λ |w − smooth|² with λ = tiny + pull · (smallest error of a single bone).

    Arguments:
        rest: vertices at rest [m], shape (V, 3).
        states: vertices of all frames [m], shape (V, F, 3).
        origins: bone origins at rest [m], shape (B, 3).
        poses: T_robot_bone, shape (F, B, 4, 4).
        smooth: weights in the absence of motion, shape (V, B).
        tiny: squared motion without information [m²].
        pull: share of a single bone's squared error.
    """
    vertices, frames, bones = len(rest), len(poses), len(origins)
    count = min(CANDIDATES, bones)
    few = min(INFLUENCES, bones)
    joints = np.zeros((vertices, INFLUENCES), dtype=np.int64)
    weights = np.zeros((vertices, INFLUENCES))
    D = np.empty((bones, 3 * frames))
    rank = np.empty(bones)
    G, g = np.empty((count, count)), np.empty(count)
    G4, g4 = np.empty((few, few)), np.empty(few)
    for v in range(vertices):
        least, mean = misses_of_bones(rest[v], states[v], origins, poses, D, rank)
        size = tiny + pull * least
        for b in range(bones):
            rank[b] -= (1e-3 * mean + tiny) * smooth[v, b]
        chosen = smallest(rank, count)
        for i in range(count):
            for j in range(i + 1):
                G[i, j] = G[j, i] = dot(D[chosen[i]], D[chosen[j]]) / frames
            G[i, i] += size
            g[i] = size * smooth[v, chosen[i]]
        kept = smallest(-simplex_least_squares(G, g), few)
        for i in range(few):
            g4[i] = g[kept[i]]
            for j in range(few):
                G4[i, j] = G[kept[i], kept[j]]
        w = simplex_least_squares(G4, g4)
        order = smallest(-w, few)
        total = 0.0
        for k in range(few):
            if w[order[k]] > 1e-6:
                joints[v, k] = chosen[kept[order[k]]]
                weights[v, k] = w[order[k]]
                total += w[order[k]]
        for k in range(few):
            weights[v, k] /= total
    return joints, weights


@njit(cache=True)
def misses_of_bones(
    rest: FloatArray, states: FloatArray, origins: FloatArray, poses: FloatArray, D: FloatArray, error: FloatArray
) -> tuple[float, float]:
    """Write the error of each vertex for each single bone, (B, 3 F), and its mean square (B,);
    return the smallest and the mean of these."""
    frames = len(poses)
    p = np.empty(3)
    least, mean = np.inf, 0.0
    for b in range(len(origins)):
        for i in range(3):
            p[i] = rest[i] - origins[b, i]
        total = 0.0
        for f in range(frames):
            for i in range(3):
                d = poses[f, b, i, 3] - states[f, i]
                for j in range(3):
                    d += poses[f, b, i, j] * p[j]
                D[b, 3 * f + i] = d
                total += d * d
        error[b] = total / frames
        mean += error[b] / len(origins)
        least = min(least, error[b])
    return least, mean


@njit(cache=True, fastmath=True)
def dot(a: FloatArray, b: FloatArray) -> float:
    """Return a · b."""
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@njit(cache=True)
def smallest(values: FloatArray, count: int) -> IntArray:
    """Return the indices of the smallest values in their order, shape (count,); the first of equal ones first."""
    taken = np.zeros(len(values), dtype=np.bool_)
    result = np.empty(count, dtype=np.int64)
    for k in range(count):
        best = -1
        for i in range(len(values)):
            if not taken[i] and (best < 0 or values[i] < values[best]):
                best = i
        taken[best] = True
        result[k] = best
    return result


@njit(cache=True)
def simplex_least_squares(G: FloatArray, g: FloatArray) -> FloatArray:
    """Return w ≥ 0 with Σ w = 1 that minimises wᵀ G w / 2 − g w, shape (k,), for positive definite G.

    Active set in the manner of Lawson and Hanson (1974): begin with the best single entry, add the entry with the largest gain,
    and step back to the boundary where an entry would become negative.
    """
    k = len(g)
    first = 0
    for i in range(1, k):
        if 0.5 * G[i, i] - g[i] < 0.5 * G[first, first] - g[first]:
            first = i
    w, free, gradient = np.zeros(k), np.zeros(k, dtype=np.bool_), np.empty(k)
    w[first], free[first] = 1.0, True
    for _ in range(3 * k):
        level = 0.0
        for i in range(k):
            gradient[i] = -g[i]
            for j in range(k):
                gradient[i] += G[i, j] * w[j]
            level += w[i] * gradient[i]
        entering = -1
        for i in range(k):
            if not free[i] and (entering < 0 or gradient[i] < gradient[entering]):
                entering = i
        if entering < 0 or gradient[entering] - level >= -1e-10 * G[first, first]:
            break
        free[entering] = True
        settle(G, g, free, w)
    return w


@njit(cache=True)
def settle(G: FloatArray, g: FloatArray, free: BoolArray, w: FloatArray) -> None:
    """Move w to the minimum over the free entries; entries that would turn negative stop at zero and are free no more."""
    for _ in range(len(g)):
        target = equality_least_squares(G, g, free)
        step = 1.0
        for i in range(len(g)):
            if free[i] and target[i] < 0.0:
                step = min(step, w[i] / (w[i] - target[i]))
        for i in range(len(g)):
            w[i] += step * (target[i] - w[i])
        if step >= 1.0:
            return
        for i in range(len(g)):
            if free[i] and target[i] < 0.0 and w[i] <= 1e-12:
                free[i] = False
                w[i] = 0.0


@njit(cache=True)
def equality_least_squares(G: FloatArray, g: FloatArray, free: BoolArray) -> FloatArray:
    """Return the minimiser of wᵀ G w / 2 − g w with Σ w = 1 over the free entries, zero elsewhere, shape (k,).

    Gauss elimination of the free part with right-hand sides g and 1; the second carries the constraint's multiplier.
    """
    k = len(g)
    index = np.empty(k, dtype=np.int64)
    n = 0
    for i in range(k):
        if free[i]:
            index[n] = i
            n += 1
    A = np.empty((n, n + 2))
    for a in range(n):
        for b in range(n):
            A[a, b] = G[index[a], index[b]]
        A[a, n] = g[index[a]]
        A[a, n + 1] = 1.0
    for a in range(n):  # positive definite: no pivoting needed
        for b in range(a + 1, n):
            factor = A[b, a] / A[a, a]
            for c in range(a, n + 2):
                A[b, c] -= factor * A[a, c]
    plain, ones = 0.0, 0.0
    for back in range(n):
        a = n - 1 - back
        for right in (n, n + 1):
            for c in range(a + 1, n):
                A[a, right] -= A[a, c] * A[c, right]
            A[a, right] /= A[a, a]
        plain += A[a, n]
        ones += A[a, n + 1]
    w = np.zeros(k)
    for a in range(n):
        w[index[a]] = A[a, n] + (1.0 - plain) / ones * A[a, n + 1]
    return w
