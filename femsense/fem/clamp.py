"""A compliant clamp: springs at its nodes, and a rigid plate that rotates about its centre against a spring.

The plate turns by R = exp[φ]× about the centroid c of the clamped nodes of the declared mesh. Each tied node i, at rest X_i,
has its anchor at c + b_i, b_i = R (X_i − c), and with y_i = x_i − c the clamp's energy is

    E(x) = min over φ of  ½ Σ k |y_i − b_i|² + ½ κ |φ|².

At the minimum κ φ = Σ k b_i × y_i; the force on a node is k (b_i − y_i), and d²E/dx² = k I − P J⁻¹ Pᵀ with P_i = k [b_i]× and
J = κ J_l⁻¹(φ) + Σ k ((b·y) I − b yᵀ), J_l the left Jacobian of the rotation. The part P J⁻¹ Pᵀ has rank three and is kept separate from
the sparse stiffness (Woodbury).

A clamped node without a spring, in the middle of an edge whose ends a and b have some, is tied to (x_a + x_b)/2:
a nearly rigid clamp thus tends to the rigid one.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.pose import rotation_from_vector
from femsense.fem.body import BodyModel
from femsense.fem.linalg.factorization import Factorization
from femsense.fem.mesh import EDGES, TetMesh
from femsense.fem.stencil import Stencil, block_row_numbers

TIE = 1e4
"""Total stiffness of the springs between nodes and plate when only the rotation of the plate is compliant, in units of Young's modulus × reach."""


@dataclass(frozen=True, eq=False, slots=True)
class Ties:
    """The nodes of a compliant clamp that springs hold, and the stiffness of these springs."""

    nodes: IntArray
    """shape (k,)."""
    stiffness: float
    """Of each spring [N/m]."""
    center: FloatArray
    """The plate's centre of rotation [m], shape (3,)."""
    turn_stiffness: float
    """Of the plate [N m/rad]; inf: it does not turn."""


@dataclass(frozen=True, eq=False, slots=True)
class Followers:
    """Clamped mid-edge nodes whose edge ends have springs: they are tied to the midpoint of the edge."""

    nodes: IntArray
    """shape (m, 3): a middle, and the ends of its edge."""
    slots: IntArray
    """Where their blocks are, shape (m, 6): middle, both ends, ends with each other, middle with each end."""
    stiffness: float
    """Of each tie [N/m]."""


@dataclass(frozen=True, eq=False, slots=True)
class Plate:
    """Position and rotation of the rigid plate of a compliant clamp, in equilibrium with given node positions."""

    turn: FloatArray
    """Rotation vector φ [rad], shape (3,)."""
    arms: FloatArray
    """b_i, from the centre to the anchors [m], shape (k, 3)."""
    jacobian: FloatArray
    """J [N m/rad], shape (3, 3)."""


def ties_of(body: BodyModel) -> Ties | None:
    """Return the springs of the clamp of a body; None if the clamp is rigid."""
    if body.clamp_is_rigid:
        return None
    nodes, stiffness = body.clamp_nodes, body.clamp_stiffness
    if np.isinf(stiffness):
        nodes = body.clamped
        stiffness = TIE * float(np.median(body.material.young_modulus)) * body.reach / len(nodes)
    return Ties(nodes, stiffness, body.clamp_center, body.clamp_turn_stiffness)


def followers_of(body: BodyModel) -> Followers | None:
    """Return the clamped nodes that are tied to those with springs; None without any.

    With springs at the corners of quadratic elements only, the mid-edge nodes would bulge, because a uniform traction on a face acts on
    them.
    """
    if np.isinf(body.clamp_stiffness) or body.mesh.tets.shape[1] != 10:
        return None
    nodes, slots = _middles(body.mesh, body.stencil, body.clamped.tobytes(), body.clamp_nodes.tobytes())
    if not len(nodes):
        return None
    return Followers(nodes, slots, TIE * float(np.median(body.material.young_modulus)) * body.reach / len(body.clamped))


@functools.lru_cache(maxsize=4)
def _middles(mesh: TetMesh, stencil: Stencil, clamped: bytes, springs: bytes) -> tuple[IntArray, IntArray]:
    """Return the clamped nodes in the middle of edges whose ends have springs, with these, and the slots of their blocks;
    as `Followers` has them."""
    held, sprung = np.frombuffer(clamped, np.int64), np.frombuffer(springs, np.int64)
    edges = np.column_stack([mesh.tets[:, 4:].ravel(), mesh.tets[:, EDGES].reshape(-1, 2)]).astype(np.int64)
    edges = np.unique(edges, axis=0)
    nodes = edges[np.isin(edges[:, 0], held) & ~np.isin(edges[:, 0], sprung) & np.isin(edges[:, 1:], sprung).all(axis=1)]
    count = len(stencil.block_rows) - 1
    keys = block_row_numbers(stencil) * count + stencil.block_columns[:-1]
    pairs = np.sort(nodes[:, [[0, 0], [1, 1], [2, 2], [1, 2], [0, 1], [0, 2]]], axis=2)
    return nodes, np.searchsorted(keys, pairs[:, :, 0] * count + pairs[:, :, 1])


def add_followers(followers: Followers, positions: FloatArray, forces: FloatArray, blocks: FloatArray | None) -> float:
    """Add slopes [N] and stiffness of ties of nodes to the middle of their edges; return their energy [J]."""
    middle, a, b = followers.nodes.T
    gap, k = positions[middle] - 0.5 * (positions[a] + positions[b]), followers.stiffness
    for node, share in ((middle, 1.0), (a, -0.5), (b, -0.5)):
        np.add.at(forces, node, share * k * gap)
    if blocks is not None:
        for slot, share in zip(followers.slots.T, (1.0, 0.25, 0.25, 0.25, -0.5, -0.5)):
            for axis in (0, 4, 8):
                np.add.at(blocks[:, axis], slot, share * k)
    return 0.5 * k * float((gap**2).sum())


def plate_at(body: BodyModel, ties: Ties, positions: FloatArray) -> Plate:
    """Return the equilibrium of the plate for node positions [m], shape (n, 3). A plate that cannot rotate has J = inf."""
    rest, y = body.mesh.nodes[ties.nodes] - ties.center, positions[ties.nodes] - ties.center
    turn = np.zeros(3)
    if np.isinf(ties.turn_stiffness):
        return Plate(turn, rest, np.full((3, 3), np.inf))
    k, kappa = ties.stiffness, ties.turn_stiffness
    for _ in range(50):
        arms = rest @ rotation_from_vector(turn).T
        jacobian = kappa * _left_jacobian_inverse(turn) + k * (float((arms * y).sum()) * np.eye(3) - arms.T @ y)
        moment = k * np.cross(arms, y).sum(axis=0) - kappa * turn
        step = np.linalg.solve(jacobian, moment)
        if np.abs(step).max() < 1e-14:
            break
        turn = _vector_of(rotation_from_vector(step) @ rotation_from_vector(turn))
    return Plate(turn, arms, jacobian)


def clamp_energy_and_forces(body: BodyModel, ties: Ties, positions: FloatArray) -> tuple[float, FloatArray]:
    """Return the energy of the springs [J] and its slope dE/dx at the tied nodes [N], shape (k, 3)."""
    plate = plate_at(body, ties, positions)
    stretch = positions[ties.nodes] - ties.center - plate.arms
    energy = 0.5 * ties.stiffness * float((stretch**2).sum())
    if np.isfinite(ties.turn_stiffness):
        energy += 0.5 * ties.turn_stiffness * float(plate.turn @ plate.turn)
    return energy, ties.stiffness * stretch


class TurningFactor:
    """A factorised stiffness with the rank-three part of a turning plate: K⁻¹ of K = K₀ − P J⁻¹ Pᵀ."""

    def __init__(self, plain: Factorization, columns: FloatArray, jacobian: FloatArray) -> None:
        self._plain, self._columns = plain, columns
        self._answers = plain.solve(columns)
        inner = jacobian - columns.T @ self._answers
        self._inner = (inner + inner.T) / 2.0
        self.negative = plain.negative + int((np.linalg.eigvalsh(self._inner) <= 0).sum())
        self.size, self.bytes = plain.size, plain.bytes + self._answers.nbytes

    def solve(self, right: FloatArray) -> FloatArray:
        """Return K⁻¹ right, shape (f,) or (f, k)."""
        answer = self._plain.solve(right)
        return np.asarray(answer + self._answers @ np.linalg.solve(self._inner, self._columns.T @ answer))

    def gram(self, columns: sp.csc_matrix) -> FloatArray:
        """Return BᵀK⁻¹B, shape (k, k), for sparse columns B, shape (f, k)."""
        seen = columns.T @ self._answers
        return np.asarray(self._plain.gram(columns) + seen @ np.linalg.solve(self._inner, seen.T))


def with_turning_plate(body: BodyModel, positions: FloatArray, factor: Factorization | None) -> Factorization | None:
    """Return the factor of the whole stiffness, plate included, from that of its sparse part."""
    ties = ties_of(body)
    if factor is None or ties is None or np.isinf(ties.turn_stiffness):
        return factor
    plate = plate_at(body, ties, positions)
    full = np.zeros((len(positions), 3, 3))
    full[ties.nodes] = ties.stiffness * _cross_matrices(plate.arms)
    columns = full.reshape(-1, 3)[body.free_map.dofs]
    return TurningFactor(factor, columns, plate.jacobian)


def first_give(body: BodyModel, forces: FloatArray) -> FloatArray:
    """Return the displacements of all nodes [m], shape (n, 3), if a rigid clamp had the compliance of `body`, to first order.

    Arguments:
        body: body with a compliant clamp whose springs are stiff.
        forces: that the rigid clamp takes up at its nodes [N], shape (n, 3).
            A clamped node that has no spring (in the middle of an edge) follows its neighbours: it gives its force to the nearest
            nodes with springs, and moves as they do.
    """
    ties = ties_of(body)
    moves = np.zeros_like(forces)
    if ties is None:
        return moves
    rest = body.mesh.nodes
    if np.isfinite(body.clamp_stiffness):
        share = _shares(rest[body.clamped], rest[ties.nodes])
        moves[body.clamped] = share @ (share.T @ forces[body.clamped]) / ties.stiffness
    if np.isfinite(ties.turn_stiffness):
        arms = rest[body.clamped] - ties.center
        turn = np.cross(arms, forces[body.clamped]).sum(axis=0) / ties.turn_stiffness
        moves[body.clamped] += np.cross(turn, arms)
    return moves


def rigid_give(body: BodyModel, positions: FloatArray, forces: FloatArray) -> FloatArray | None:
    """Return the node positions [m], shape (n, 3), after a rigid motion of the body with its clamp, which was rigid and now has the
    compliance of `body`; None if the clamp is rigid, cannot carry the moment, or rotates by more than a radian.

    Arguments:
        body: body with the compliant clamp.
        positions: node positions with the rigid clamp [m], shape (n, 3).
        forces: all forces on the body except those of the clamp [N], shape (n, 3), constant in space.
    """
    ties = ties_of(body)
    if ties is None:
        return None
    force, arms = forces.sum(axis=0), body.mesh.nodes[ties.nodes] - ties.center
    moment = np.cross(positions - ties.center, forces).sum(axis=0)
    plate = moment / ties.turn_stiffness
    anchors, turn, shift = arms @ rotation_from_vector(plate).T, plate, np.zeros(3)
    if np.isfinite(body.clamp_stiffness):
        shift = force / (ties.stiffness * len(arms))
        for _ in range(20):
            turned = arms @ rotation_from_vector(turn).T
            jacobian = float((turned * anchors).sum()) * np.eye(3) - turned.T @ anchors
            step = np.linalg.lstsq(jacobian, moment / ties.stiffness - np.cross(anchors, turned).sum(axis=0))[0]
            turn = _vector_of(rotation_from_vector(step) @ rotation_from_vector(turn))
            if np.abs(step).max() < 1e-9:
                break
        else:
            return None
    if np.linalg.norm(turn) > 1.0:
        return None
    return np.asarray((positions - ties.center) @ rotation_from_vector(turn).T + ties.center + shift)


def _shares(points: FloatArray, nodes: FloatArray) -> FloatArray:
    """Return the weights of the nodes (k, 3) for each point (p, 3): 1 for an equal node, one half for both ends of its edge."""
    distance = np.linalg.norm(points[:, None] - nodes[None], axis=2)
    near = np.argsort(distance, axis=1)[:, :2]
    share = np.zeros(distance.shape)
    rows = np.arange(len(points))
    single = distance[rows, near[:, 0]] < 1e-9
    share[rows, near[:, 0]] = np.where(single, 1.0, 0.5)
    share[rows[~single], near[~single, 1]] = 0.5
    return share


def _cross_matrices(vectors: FloatArray) -> FloatArray:
    """Return [v]× of vectors (k, 3), shape (k, 3, 3)."""
    result = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    result[:, 0, 1], result[:, 0, 2], result[:, 1, 2] = -z, y, -x
    result[:, 1, 0], result[:, 2, 0], result[:, 2, 1] = z, -y, x
    return result


def _left_jacobian_inverse(turn: FloatArray) -> FloatArray:
    """Return dφ/dδ for exp[δ]× exp[φ]× (Solà et al. 2018, equation 146)."""
    angle = float(np.linalg.norm(turn))
    cross = _cross_matrices(turn[None])[0]
    if angle < 1e-6:
        return np.asarray(np.eye(3) - cross / 2.0 + cross @ cross / 12.0)
    factor = 1.0 / angle**2 - (1.0 + np.cos(angle)) / (2.0 * angle * np.sin(angle))
    return np.asarray(np.eye(3) - cross / 2.0 + factor * cross @ cross)


def _vector_of(rotation: FloatArray) -> FloatArray:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotation).as_rotvec())
