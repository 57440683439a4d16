"""Compliance W = H K⁻¹ Hᵀ between directions at points of the body, cables and chambers, from one factorisation.

K is the exact tangent at the equilibrium (geometric stiffness of cables and pressures included). Cables that are pulled with a
given tension are free to move, chambers under a given pressure too; taut held cables keep their length and held chambers their
volume, so that W then holds K⁻¹ − K⁻¹Hᵀ(HK⁻¹Hᵀ + 1/k)⁻¹HK⁻¹ (Zhang et al. 2019, equations 3–5, with the constraint eliminated).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from femsense.core.arrays import FloatArray, as_points
from femsense.core.errors import FemsenseError, InputError
from femsense.fem.assembly import internal, reduced_values
from femsense.fem.body import BodyModel
from femsense.fem.cables import add_cable_stiffness, pull_rows
from femsense.fem.chambers import add_pressure_stiffness, volume_gradient
from femsense.fem.clamp import with_turning_plate
from femsense.fem.equilibrium import Equilibrium
from femsense.fem.linalg.factorization import Factorization, Pattern, factorize
from femsense.fem.mesh import Embedding, embed_points

Solver = Callable[[Pattern, FloatArray], Factorization | None]
"""(pattern, entries in CSC order) → the stiffness factorised, as `factorize` does."""


@dataclass(frozen=True, eq=False, slots=True)
class Tangent:
    """The linearised body at an equilibrium: its displacements under small forces and inputs. n nodes, f free unknowns, h held cables and chambers."""

    factor: Factorization
    dofs: npt.NDArray[np.int64]
    """Free unknowns in factor order, shape (f,)."""
    held_rows: FloatArray
    """dδ/dx of the taut held cables and dV/dx of the held chambers over the free unknowns, shape (h, f)."""
    held_columns: FloatArray
    """K⁻¹ times their force columns, shape (f, h)."""
    held_compliance: FloatArray
    """Their compliance, cable stretch included [m/N] (of chambers [m³/Pa]), shape (h, h)."""
    node_count: int

    def respond(self, forces: FloatArray) -> FloatArray:
        """Return node displacements [m], shape (k, n, 3), under small nodal forces [N], shape (k, n, 3);
        held cables keep their length."""
        right = forces.reshape(len(forces), -1)[:, self.dofs].T
        answer = self.factor.solve(right)
        if self.held_rows.size:
            answer = answer - self.held_columns @ np.linalg.solve(self.held_compliance, self.held_rows @ answer)
        return self._spread(answer)

    def respond_to_held(self) -> FloatArray:
        """Return node displacements for a shortening of each held cable by one metre [1], shape (h, n, 3)."""
        return self._spread(self.held_columns @ np.linalg.inv(self.held_compliance))

    def _spread(self, answer: FloatArray) -> FloatArray:
        full = np.zeros((answer.shape[1], 3 * self.node_count))
        full[:, self.dofs] = answer.T
        return full.reshape(len(full), self.node_count, 3)


def tangent_at(body: BodyModel, equilibrium: Equilibrium, solver: Solver = factorize) -> Tangent:
    """Return the exact linearisation of a body at an equilibrium; `solver` factorises its stiffness.
    Raises FemsenseError if the equilibrium is unstable."""
    return _with_held_drives(body, equilibrium, _factor_at(body, equilibrium, solver))


def tangent_near(body: BodyModel, equilibrium: Equilibrium) -> Tangent:
    """Return the linearisation of a body at an equilibrium with the last factorised stiffness of its solution, at a state close to it; the exact
    linearisation if no factor was kept. Raises FemsenseError if the equilibrium is unstable."""
    factor = equilibrium.factor
    return tangent_at(body, equilibrium) if factor is None else _with_held_drives(body, equilibrium, factor)


def _factor_at(body: BodyModel, equilibrium: Equilibrium, solver: Solver) -> Factorization:
    """Return the factor of the exact stiffness at an equilibrium. Raises FemsenseError where it is unstable there."""
    blocks = internal(body, equilibrium.positions).blocks
    assert blocks is not None
    add_cable_stiffness(body, equilibrium.positions, equilibrium.segment_tensions, blocks)
    add_pressure_stiffness(body, equilibrium.positions, np.array(list(equilibrium.pressure.values())), blocks)
    factor = with_turning_plate(body, equilibrium.positions, solver(body.free_map.pattern, reduced_values(body, blocks)))
    if not body.is_clamped() and (factor is None or factor.negative > 0):
        raise FemsenseError("the stiffness is singular: nothing holds the body (clamp more nodes)")
    if factor is None:
        raise FemsenseError("the stiffness is singular: elements are folded flat or turned inside out")
    return factor


def _with_held_drives(body: BodyModel, equilibrium: Equilibrium, factor: Factorization) -> Tangent:
    """Return the linearisation with a factored stiffness, in which taut held cables keep their length and held chambers their volume."""
    dofs = body.free_map.dofs
    held = np.flatnonzero(equilibrium.held)
    rows = drive_rows(body, equilibrium.positions)[held][:, dofs]
    shares = [t / T if T > 0 else np.ones_like(t) for t, T in zip(equilibrium.segment_tensions, equilibrium.tension.values())]
    forces = drive_rows(body, equilibrium.positions, shares)[held][:, dofs]
    columns = factor.solve(forces.T) if len(held) else np.zeros((len(dofs), 0))
    stretch = np.array([1.0 / c.stretch_stiffness for c in body.cables] + [0.0] * len(body.chambers))[held]
    return Tangent(factor, dofs, rows, columns, rows @ columns + np.diag(stretch), len(body.mesh.nodes))


def compliance(
    body: BodyModel,
    equilibrium: Equilibrium,
    *,
    points: npt.ArrayLike = (),
    directions: npt.ArrayLike = (),
    tangent: Tangent | None = None,
) -> FloatArray:
    """Return the compliance of a body: the small displacement of each of its points and drives under a small force at each other.

    Arguments:
        body: body with a cables and c chambers.
        equilibrium: result of `solve_equilibrium`, the state about which the body is linearised.
        points: k points of the body at rest [m], shape (k, 3). Default: none.
        directions: direction of force and displacement at each point, shape (k, 3); not normalised, so that unit vectors give m/N.
        tangent: result of `femsense.fem.compliance.tangent_at` for this equilibrium. Default: computed here.

    Returns:
        W, symmetric, shape (k + a + c, k + a + c), rows and columns in the order points, cables, chambers. Entry (i, j) is the displacement of
        point i along its direction [m], the shortening of cable i [m] or the increase of volume of chamber i [m³], per newton of force at point j or of
        tension in cable j, or per pascal in chamber j. Every cable and chamber counts as free here, also those that `equilibrium` holds at a
        shortening or volume.

    Raises:
        InputError: points and directions have different shapes.
        FemsenseError: the body is not clamped.

    Example:
        >>> import numpy as np
        >>> import femsense as fs
        >>> body = fs.load_robot("finger").body
        >>> tip = np.array([[0.092, 0.0, 0.007]])
        >>> W = fs.compliance(body, fs.solve_equilibrium(body), points=tip, directions=np.array([[0.0, 0.0, 1.0]]))
        >>> W.shape  # the tip along z, then the cable
        (2, 2)
    """
    P, D = as_points(points, "points"), as_points(directions, "directions")
    if P.shape != D.shape:
        raise InputError("points and directions differ in shape", where="directions", found=D.shape, expected=P.shape)
    at = tangent_at(body, equilibrium) if tangent is None else tangent
    point_rows = (
        direction_rows(embed_points(body.mesh, P), D, len(body.mesh.nodes)) if len(P) else np.zeros((0, 3 * at.node_count))
    )
    rows = np.vstack([point_rows, drive_rows(body, equilibrium.positions)])[:, at.dofs]
    W = at.factor.gram(sp.csc_matrix(rows.T))
    return np.asarray((W + W.T) / 2.0)


def drive_rows(body: BodyModel, positions: FloatArray, shares: list[FloatArray] | None = None) -> FloatArray:
    """Return the nodal forces of each drive: of each cable at a tension of 1 N, then of each chamber at a pressure of 1 Pa.

    By virtual work these are also, without `shares`, the derivatives of cable shortening and of chamber volume by the node positions.

    Arguments:
        body: body with n nodes, a cables and c chambers.
        positions: node positions at which the forces act [m], shape (n, 3).
        shares: tension of each segment of each cable relative to that at the motor [1]: one array per cable, shape (s,) with s segments, far end first.
            It differs from 1 where there is friction. Default: 1 everywhere.

    Returns:
        one row per drive, shape (a + c, 3 n): forces on the nodes (x, y, z of node 0, …) per newton [1] or per pascal [m²].
    """
    chambers = [volume_gradient(c, positions).reshape(1, -1) for c in body.chambers]
    return np.vstack([pull_rows(body, positions, shares), *chambers])


def direction_rows(embedding: Embedding, directions: FloatArray, node_count: int) -> FloatArray:
    """Return the matrix that maps node displacements to displacements of k embedded points along a direction each, shape (k, 3 n)."""
    k = len(embedding)
    rows = np.zeros((k, node_count, 3))
    values = embedding.weights[:, :, None] * directions[:, None, :]
    np.add.at(rows, (np.arange(k)[:, None], embedding.nodes), values)
    return rows.reshape(k, -1)
