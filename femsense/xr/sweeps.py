"""Inner loops of the skinning fit, compiled: rigid sweeps over the bones of a frame, weights of single vertices."""

# mypy: disable-error-code="untyped-decorator"

from __future__ import annotations

import numpy as np
from numba import njit

from femsense.arrays import BoolArray, FloatArray, IntArray

INFLUENCES = 4
CANDIDATES = 10
"""Bones among which the weights of a vertex are sought."""


# ---- poses ------------------------------------------------------------------------------------------------------------


@njit(cache=True)
def rotation_of(covariance: FloatArray) -> FloatArray:
    """Return the rotation R (3, 3) with the largest trace(R C), for C = Σ w p qᵀ (Kabsch 1976, det R = +1)."""
    U, _, Vt = np.linalg.svd(covariance)
    V = Vt.T
    R = V @ U.T
    if np.linalg.det(R) < 0.0:
        V = V.copy()
        V[:, 2] = -V[:, 2]
        return np.asarray(V @ U.T)
    return np.asarray(R)


@njit(cache=True)
def misfit(N: FloatArray, Y: FloatArray, M: FloatArray) -> float:
    """Return Σ |A M − x|² − Σ |x|² of a frame, for stacked transposed transforms M, shape (B, 4, 3)."""
    size = 4 * len(M)
    flat = M.reshape(size, 3)
    return float(np.sum(flat * (N.reshape(size, size) @ flat)) - 2.0 * np.sum(flat * Y.reshape(size, 3)))


@njit(cache=True)
def separate_fits(N: FloatArray, Y: FloatArray, share: FloatArray) -> FloatArray:
    """Return [Rᵀ; tᵀ] of each bone (B, 4, 3), fitted to its vertices with its weights, without regard to the others."""
    M = np.zeros((len(N), 4, 3))
    for b in range(len(N)):
        # Σ_i w p over all bones' weights is what the last column of the sums over bones holds: weights sum to 1 at a vertex
        moment = np.zeros(3)
        for c in range(len(N)):
            moment += N[b, :3, c, 3]
        scale = max(share[b], 1e-300)
        middle, target = moment / scale, Y[b, 3] / scale
        R = rotation_of(Y[b, :3] - np.outer(moment, target))
        M[b, :3] = R.T
        M[b, 3] = target - R @ middle
    return M


@njit(cache=True)
def sweep_poses(N: FloatArray, Y: FloatArray, share: FloatArray, start: FloatArray, sweeps: int) -> FloatArray:
    """Return bone poses (B, 4, 4) after sweeps of rigid fits, each bone against what the others leave.

    Arguments:
        N: normal matrices of all pairs of bones, shape (B, 4, B, 4).
        Y: sums of weighted rest positions times vertices of the frame, shape (B, 4, 3).
        share: Σ w of each bone, shape (B,).
        start: poses to start from where they fit better than separate fits, shape (B, 4, 4), or (0, 4, 4).
        sweeps: how many.
    """
    bones = len(N)
    M = separate_fits(N, Y, share)
    if len(start) == bones:
        before = np.empty((bones, 4, 3))
        for b in range(bones):
            before[b, :3] = start[b, :3, :3].T
            before[b, 3] = start[b, :3, 3]
        if misfit(N, Y, before) <= misfit(N, Y, M):
            M = before
    flat = M.reshape(4 * bones, 3)
    for _ in range(sweeps):
        for b in range(bones):
            own = np.ascontiguousarray(N[b, :, b, :])
            left = Y[b] - N[b].reshape(4, 4 * bones) @ flat + own @ M[b]
            weight = own[3, 3]
            if weight <= 1e-300:
                continue
            moment, target = own[:3, 3] / weight, left[3] / weight
            covariance = left[:3] - np.outer(moment, left[3])
            # a trace of the present rotation decides what the vertices leave open
            spread = own[0, 0] + own[1, 1] + own[2, 2]
            covariance += 1e-9 * spread * M[b, :3]
            R = rotation_of(covariance)
            M[b, :3] = R.T
            M[b, 3] = target - R @ moment
    poses = np.zeros((bones, 4, 4))
    for b in range(bones):
        poses[b, :3, :3] = M[b, :3].T
        poses[b, :3, 3] = M[b, 3]
        poses[b, 3, 3] = 1.0
    return poses


# ---- weights ----------------------------------------------------------------------------------------------------------


@njit(cache=True)
def weights_of_vertices(
    rest: FloatArray, states: FloatArray, origins: FloatArray, poses: FloatArray, smooth: FloatArray, tiny: float, pull: float
) -> tuple[IntArray, FloatArray]:
    """Return joints (V, 4) and weights (V, 4) of least squares over the frames, each vertex for itself.

    Minimises (1/F) Σ_f |Σ_b w_b (R_b p + t_b) − x|² + λ |w − smooth|² with λ = tiny + pull · (smallest error of a single bone).

    Arguments:
        rest: vertices at rest [m], shape (V, 3).
        states: vertices of all frames [m], shape (V, F, 3).
        origins: bone origins at rest [m], shape (B, 3).
        poses: T_robot_bone, shape (F, B, 4, 4).
        smooth: weights where motion says nothing, shape (V, B).
        tiny: squared motion that says nothing [m²].
        pull: share of a single bone's squared error.
    """
    vertices, frames, bones = len(rest), len(poses), len(origins)
    count = min(CANDIDATES, bones)
    joints = np.zeros((vertices, INFLUENCES), dtype=np.int64)
    weights = np.zeros((vertices, INFLUENCES))
    D = np.empty((bones, 3 * frames))
    error = np.empty(bones)
    for v in range(vertices):
        for b in range(bones):
            p = rest[v] - origins[b]
            total = 0.0
            for f in range(frames):
                T = poses[f, b]
                for i in range(3):
                    d = T[i, 0] * p[0] + T[i, 1] * p[1] + T[i, 2] * p[2] + T[i, 3] - states[v, f, i]
                    D[b, 3 * f + i] = d
                    total += d * d
            error[b] = total / frames
        size = tiny + pull * error.min()
        chosen = np.argsort(error - (error.mean() * 1e-3 + tiny) * smooth[v])[:count]
        G = np.empty((count, count))
        g = np.empty(count)
        for i in range(count):
            for j in range(i + 1):
                G[i, j] = G[j, i] = np.dot(D[chosen[i]], D[chosen[j]]) / frames
        for i in range(count):
            G[i, i] += size
            g[i] = size * smooth[v, chosen[i]]
        w = simplex_least_squares(G, g)
        kept = np.argsort(-w)[:INFLUENCES]
        w4 = simplex_least_squares(np.ascontiguousarray(G[kept][:, kept]), g[kept])
        order = np.argsort(-w4)
        for k in range(len(order)):
            if w4[order[k]] > 1e-6:
                joints[v, k] = chosen[kept[order[k]]]
                weights[v, k] = w4[order[k]]
        weights[v] /= weights[v].sum()
    return joints, weights


@njit(cache=True)
def simplex_least_squares(G: FloatArray, g: FloatArray) -> FloatArray:
    """Return w ≥ 0 with Σ w = 1 that minimises wᵀ G w / 2 − g w, shape (k,), for positive definite G.

    Active set in the manner of Lawson and Hanson (1974): begin with the best single entry, let in the entry that gains most,
    step back to the border where an entry would turn negative.
    """
    k = len(g)
    single = np.empty(k)
    for i in range(k):
        single[i] = 0.5 * G[i, i] - g[i]
    w = np.zeros(k)
    first = int(np.argmin(single))
    w[first] = 1.0
    free = np.zeros(k, dtype=np.bool_)
    free[first] = True
    for _ in range(3 * k):
        gradient = G @ w - g
        level = np.dot(w, gradient)
        gain = np.where(free, np.inf, gradient - level)
        entering = int(np.argmin(gain))
        if gain[entering] >= -1e-10 * G[first, first]:
            break
        free[entering] = True
        for _ in range(k):
            target = equality_least_squares(G, g, free)
            step = 1.0
            for i in range(k):
                if free[i] and target[i] < 0.0:
                    step = min(step, w[i] / (w[i] - target[i]))
            w = w + step * (target - w)
            if step >= 1.0:
                break
            for i in range(k):
                if free[i] and target[i] < 0.0 and w[i] <= 1e-12:
                    free[i] = False
                    w[i] = 0.0
    return w


@njit(cache=True)
def equality_least_squares(G: FloatArray, g: FloatArray, free: BoolArray) -> FloatArray:
    """Return the minimiser of wᵀ G w / 2 − g w with Σ w = 1 over the free entries, zero elsewhere, shape (k,)."""
    index = np.flatnonzero(free)
    inner = np.empty((len(index), len(index)))
    right = np.ones((len(index), 2))
    for a in range(len(index)):
        right[a, 0] = g[index[a]]
        for b in range(len(index)):
            inner[a, b] = G[index[a], index[b]]
    both = np.linalg.solve(inner, right)
    multiplier = (1.0 - both[:, 0].sum()) / both[:, 1].sum()
    w = np.zeros(len(g))
    for a in range(len(index)):
        w[index[a]] = both[a, 0] + multiplier * both[a, 1]
    return w
