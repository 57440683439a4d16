# mypy: allow-untyped-decorators
"""Cable kinematics: length, its derivatives, the bends, and the forces of tensions that may differ from segment to segment.

Points of a path are numbered from the far end; segment j joins point j and j + 1, the last one ends at the pull point.
A cable of length ℓ has shortened by δ = ℓ(rest) − ℓ(x). Tensions t_j along the segments load the nodes with
−Σ_j t_j ∂ℓ_j/∂x; equal tensions T give T ∂δ/∂x, the row of H_a.
"""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray, IntArray, freeze, read_only
from femsense.core.kernels import njit
from femsense.fem.body import BodyModel
from femsense.fem.body_parts import Cable


def segments(cable: Cable, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return unit vectors from far end to pull point, shape (s, 3), and lengths [m], shape (s,), of the segments."""
    directions, lengths = _segments(cable.path.nodes, cable.path.weights, cable.pull_point, read_only(positions))
    return directions, lengths


@njit(cache=True)
def _segments(nodes: IntArray, weights: FloatArray, end: FloatArray, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
    count, k = nodes.shape
    points = np.zeros((count + 1, 3))
    for c in range(3):
        points[count, c] = end[c]
    for s in range(count):
        for a in range(k):
            for c in range(3):
                points[s, c] += weights[s, a] * positions[nodes[s, a], c]
    directions, lengths = np.empty((count, 3)), np.empty(count)
    for s in range(count):
        for c in range(3):
            directions[s, c] = points[s + 1, c] - points[s, c]
        lengths[s] = np.sqrt(directions[s, 0] ** 2 + directions[s, 1] ** 2 + directions[s, 2] ** 2)
        for c in range(3):
            directions[s, c] /= max(lengths[s], 1e-12)
    return directions, lengths


def cable_length(cable: Cable, positions: FloatArray) -> float:
    """Return the length of a cable [m]."""
    return float(segments(cable, positions)[1].sum())


def shortening(body: BodyModel, positions: FloatArray) -> FloatArray:
    """Return the shortening of each cable against rest [m], shape (a,)."""
    rest = body.mesh.nodes
    return np.array([cable_length(c, rest) - cable_length(c, positions) for c in body.cables])


def cable_forces(cable: Cable, positions: FloatArray, tensions: FloatArray, node_count: int) -> FloatArray:
    """Return the nodal forces of a cable [N], shape (n, 3), for the tensions of its segments [N], shape (s,)."""
    x = read_only(positions)
    return np.asarray(_pull(cable.path.nodes, cable.path.weights, cable.pull_point, x, tensions, node_count))


@njit(cache=True)
def _pull(
    nodes: IntArray, weights: FloatArray, end: FloatArray, positions: FloatArray, tensions: FloatArray, node_count: int
) -> FloatArray:
    directions, _ = _segments(nodes, weights, end, positions)
    forces = np.zeros((node_count, 3))
    for s in range(nodes.shape[0]):
        for c in range(3):
            at_point = tensions[s] * directions[s, c] - (tensions[s - 1] * directions[s - 1, c] if s > 0 else 0.0)
            for a in range(nodes.shape[1]):
                forces[nodes[s, a], c] += weights[s, a] * at_point
    return forces


def pull_rows(body: BodyModel, positions: FloatArray, shares: list[FloatArray] | None = None) -> FloatArray:
    """Return the forces on the n nodes of each of a cables at a tension of 1 N [1], shape (a, 3 n); `shares` as for `drive_rows`."""
    n = len(body.mesh.nodes)
    rows = np.zeros((len(body.cables), 3 * n))
    for i, cable in enumerate(body.cables):
        share = np.ones(len(cable.path)) if shares is None else shares[i]
        rows[i] = cable_forces(cable, positions, share, n).ravel()
    return rows


def add_cable_stiffness(body: BodyModel, positions: FloatArray, tensions: tuple[FloatArray, ...], blocks: FloatArray) -> None:
    """Add the geometric stiffness of the cables to stiffness blocks [N/m], shape (nb, 9), for tensions [N] of their segments.

    Each segment adds t (I − d dᵀ)/ℓ between its two ends: positive semi-definite for a pulling cable.
    """
    for cable, slots, tension in zip(body.cables, body.cable_slots, tensions):
        if tension.any():
            d, length = segments(cable, positions)
            _add_segments(cable.path.weights, d, tension / np.maximum(length, 1e-12), slots, blocks)


@njit(cache=True)
def _add_segments(weights: FloatArray, d: FloatArray, stiffness: FloatArray, slots: IntArray, blocks: FloatArray) -> None:
    count, k = weights.shape
    ends = np.empty(2 * k)  # weights of the nodes in the difference of the ends of a segment, ordered as by `segment_nodes`
    for s in range(count):
        for a in range(k):
            ends[a] = -weights[s, a]
            ends[k + a] = weights[s + 1, a] if s + 1 < count else 0.0
        for a in range(2 * k):
            for b in range(2 * k):
                share = ends[a] * ends[b] * stiffness[s]
                for i in range(3):
                    for j in range(3):
                        blocks[slots[s, a, b], 3 * i + j] += share * ((1.0 if i == j else 0.0) - d[s, i] * d[s, j])


def bend_angles(cable: Cable, positions: FloatArray) -> FloatArray:
    """Return the bend before each segment [rad], shape (s,), going outwards from the motor: entry j is the bend between
    segment j + 1 and segment j; the last is the bend at the pull point (0 without an exit direction)."""
    leaves = np.zeros(3) if cable.exit_direction is None else cable.exit_direction
    path = cable.path
    return np.asarray(_bends(path.nodes, path.weights, cable.pull_point, freeze(leaves), read_only(positions)))


@njit(cache=True)
def _bends(nodes: IntArray, weights: FloatArray, end: FloatArray, leaves: FloatArray, positions: FloatArray) -> FloatArray:
    """Return the angles between successive unit vectors of segments [rad], the last one with the exit direction if there is one
    (Kahan's formula: accurate for small and for large angles)."""
    directions, _ = _segments(nodes, weights, end, positions)
    angles = np.zeros(len(directions))
    for s in range(len(directions)):
        ahead = directions[s + 1] if s + 1 < len(directions) else leaves
        apart = along = size = 0.0
        for c in range(3):
            apart += (directions[s, c] - ahead[c]) ** 2
            along += (directions[s, c] + ahead[c]) ** 2
            size += ahead[c] ** 2
        if size > 0.0:
            angles[s] = 2.0 * np.arctan2(np.sqrt(apart), np.sqrt(along))
    return angles
