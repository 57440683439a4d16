"""Quasi-static finite deformation of a compressible rubber body with quadratic elements of scikit-fem.

Energy density W = mu/2 (tr C - 3) - mu ln J + lambda/2 (ln J)^2 (neo-Hookean: Bonet & Wood, Nonlinear Continuum Mechanics, eq. 6.27); with a limit Jm of the
stretch the first term is -mu Jm/2 ln(1 - (tr C - 3)/Jm) (Gent, Rubber Chem. Technol. 69, 1996), which has the same small-strain moduli.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import scipy.sparse as sp
import skfem
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

Array = NDArray[np.float64]


class Diverged(RuntimeError):
    """Newton found no equilibrium."""


@cache
def _pardiso() -> Any:
    """One Pardiso for all matrices, for each costs a search of the disk; None where it is not installed."""
    try:
        from pypardiso import PyPardisoSolver
    except ImportError:
        return None
    return PyPardisoSolver()


class Factor:
    """One factorisation of a sparse matrix: Pardiso where it is installed, else SuperLU."""

    def __init__(self, matrix: sp.csr_matrix) -> None:
        solver = _pardiso()
        if solver is None:
            self._solve = splu(matrix.tocsc()).solve
            return
        solver.factorize(matrix)
        self._solve = lambda right: solver.solve(matrix, right)

    def __call__(self, right: Array) -> Array:
        return np.asarray(self._solve(np.ascontiguousarray(right)))


@dataclass(frozen=True, eq=False)
class Cable:
    """A frictionless cable through points of the body; the last piece goes to a point fixed in space."""

    name: str
    rows: sp.csr_matrix
    """Interpolation of its points from the nodes, far end first, (m, n)."""
    pull: Array
    """[m], (3,)."""

    def _points(self, x: Array) -> Array:
        return np.vstack([self.rows @ x, self.pull])

    def length(self, x: Array) -> float:
        return float(np.linalg.norm(np.diff(self._points(x), axis=0), axis=1).sum())

    def gradient(self, x: Array) -> Array:
        """Derivative of the length by the nodes, (n, 3)."""
        step = np.diff(self._points(x), axis=0)
        unit = step / np.linalg.norm(step, axis=1, keepdims=True)
        by_point = -unit
        by_point[1:] += unit[:-1]
        return np.asarray(self.rows.T @ by_point)

    def hessian(self, x: Array) -> sp.csr_matrix:
        """Second derivative of the length by the nodes, (3n, 3n)."""
        step = np.diff(self._points(x), axis=0)
        far = np.linalg.norm(step, axis=1)
        m = len(step)
        block = np.zeros((m + 1, 3, m + 1, 3))
        for k in range(m):
            unit = step[k] / far[k]
            across = (np.eye(3) - np.outer(unit, unit)) / far[k]
            block[k, :, k, :] += across
            block[k + 1, :, k + 1, :] += across
            block[k, :, k + 1, :] -= across
            block[k + 1, :, k, :] -= across
        small = block[:m, :, :m, :].reshape(3 * m, 3 * m)
        wide = sp.kron(self.rows, sp.eye(3), format="csr")
        return (wide.T @ sp.csr_matrix(small) @ wide).tocsr()


@dataclass(frozen=True, eq=False)
class Load:
    """What acts on the body."""

    gravity: float
    """Share of the declared gravity, 0 to 1."""
    tension: Array
    """[N], (c,); of cables that are not held."""
    shortening: Array
    """[m], (c,); of cables that are held."""
    held: NDArray[np.bool_]
    """(c,)."""
    force: Array
    """[N] on the nodes, (n, 3)."""


@dataclass(frozen=True, eq=False)
class State:
    """An equilibrium."""

    x: Array
    """[m], (n, 3)."""
    tension: Array
    """[N], (c,)."""
    load: Load
    residual_n: float
    iterations: int


class Solid:
    """A clamped body of scikit-fem cells (P2 tetrahedra or 27-node hexahedra)."""

    def __init__(
        self,
        mesh: skfem.Mesh,
        young: float,
        poisson: float,
        density: float,
        gravity: Array,
        fixed: Array,
        stretch_limit: float = np.inf,
    ) -> None:
        tetra = isinstance(mesh, skfem.MeshTet1)
        self.element = skfem.ElementTetP2() if tetra else skfem.ElementHex2()
        self.mesh, self.tetra = mesh, tetra
        basis = skfem.Basis(mesh, self.element, intorder=2 if tetra else 5)
        count = basis.Nbfun
        self.rest: Array = np.ascontiguousarray(basis.doflocs.T)
        self.cells = basis.element_dofs.T
        self.slopes = np.stack([np.moveaxis(np.asarray(basis.basis[a][0].grad), 0, -1) for a in range(count)], axis=2)
        self.weight = np.asarray(basis.dx)
        self.mu, self.stretch_limit = young / (2 * (1 + poisson)), stretch_limit
        self.lam = young * poisson / ((1 + poisson) * (1 - 2 * poisson))
        shape = np.stack([np.broadcast_to(np.asarray(basis.basis[a][0]), self.weight.shape) for a in range(count)], axis=-1)
        lumps = np.zeros(len(self.rest))
        np.add.at(lumps, self.cells, np.einsum("eqa,eq->ea", shape, self.weight) * density)
        self.pull_down = lumps[:, None] * gravity
        self.clamped = np.all((self.rest >= fixed[0] - 1e-9) & (self.rest <= fixed[1] + 1e-9), axis=1)
        self.free = np.repeat(~self.clamped, 3)
        self._pattern()
        self.mapping = mesh._mapping()
        corners = np.moveaxis(mesh.p[:, mesh.t], -1, 0)
        reference = np.vstack([np.asarray(self.element.refdom.p, float), np.ones(mesh.t.shape[0])])
        forward = corners @ np.linalg.pinv(reference)
        inverse = np.linalg.inv(forward[:, :, :3])
        self._affine = np.concatenate([inverse, -inverse @ forward[:, :, 3:]], axis=2)

    def _pattern(self) -> None:
        dofs = (3 * self.cells[:, :, None] + np.arange(3)).reshape(len(self.cells), -1)
        number = np.full(3 * len(self.rest), -1)
        number[self.free] = np.arange(self.free.sum())
        local = number[dofs]
        rows = np.repeat(local, local.shape[1], axis=1).ravel()
        cols = np.tile(local, (1, local.shape[1])).ravel()
        self._keep = np.flatnonzero((rows >= 0) & (cols >= 0))
        key = rows[self._keep].astype(np.int64) * self.free.sum() + cols[self._keep]
        self._order = np.argsort(key, kind="stable")
        unique, self._starts = np.unique(key[self._order], return_index=True)
        n = int(self.free.sum())
        self._indices = (unique % n).astype(np.int32)
        self._indptr = np.searchsorted(unique // n, np.arange(n + 1)).astype(np.int32)

    def _gradient(self, x: Array) -> tuple[Array, Array, Array]:
        deformation = np.swapaxes(x[self.cells], 1, 2)[:, None] @ self.slopes
        j = np.linalg.det(deformation)
        if not np.all(j > 1e-3):
            raise Diverged("an element turned inside out")
        return deformation, j, np.linalg.inv(deformation)

    def _stiffening(self, f: Array) -> Array:
        """Derivative of the first term by (tr C - 3)/2, relative to mu: 1 of the neo-Hookean law, (e, q)."""
        if not np.isfinite(self.stretch_limit):
            return np.ones(f.shape[:2])
        left = 1 - (np.sum(f * f, axis=(2, 3)) - 3) / self.stretch_limit
        if not np.all(left > 1e-3):
            raise Diverged("an element is stretched to its limit")
        return 1 / left

    def strain_energy(self, x: Array) -> float:
        """[J]."""
        f, j, _ = self._gradient(x)
        log = np.log(j)
        stretch = np.sum(f * f, axis=(2, 3)) - 3
        if np.isfinite(self.stretch_limit):
            self._stiffening(f)
            stretch = -self.stretch_limit * np.log1p(-stretch / self.stretch_limit)
        density = self.mu / 2 * stretch - self.mu * log + self.lam / 2 * log**2
        return float(np.sum(density * self.weight))

    def inner_forces(self, x: Array) -> Array:
        """Derivative of the strain energy by the nodes [N], (n, 3)."""
        f, j, inverse = self._gradient(x)
        turned = np.swapaxes(inverse, 2, 3)
        stress = self.mu * (self._stiffening(f)[..., None, None] * f - turned) + (self.lam * np.log(j))[..., None, None] * turned
        at_cell = np.sum((self.slopes @ np.swapaxes(stress, 2, 3)) * self.weight[..., None, None], axis=1)
        out = np.zeros_like(x)
        np.add.at(out, self.cells, at_cell)
        return out

    def stiffness(self, x: Array) -> sp.csr_matrix:
        """Second derivative of the strain energy by the free degrees of freedom [N/m]."""
        f, j, inverse = self._gradient(x)
        stiffening = self._stiffening(f)
        cells, points, count, _ = self.slopes.shape
        pushed = self.slopes @ inverse
        flat = pushed.reshape(cells, points, 3 * count)

        def outer(by: Array) -> Array:
            return (np.swapaxes(flat * by[..., None], 1, 2) @ flat).reshape(cells, count, 3, count, 3)

        blocks = outer(self.lam * self.weight)
        blocks += np.swapaxes(outer((self.mu - self.lam * np.log(j)) * self.weight), 2, 4)
        wide = np.swapaxes(self.slopes, 1, 2).reshape(cells, count, -1)
        scaled = np.swapaxes(self.slopes * (self.mu * stiffening * self.weight)[..., None, None], 1, 2).reshape(cells, count, -1)
        plain = scaled @ np.swapaxes(wide, 1, 2)
        for axis in range(3):
            blocks[:, :, axis, :, axis] += plain
        if np.isfinite(self.stretch_limit):
            along = (self.slopes @ np.swapaxes(f, 2, 3)).reshape(cells, points, 3 * count)
            more = 2 * self.mu * stiffening**2 / self.stretch_limit * self.weight
            blocks += (np.swapaxes(along * more[..., None], 1, 2) @ along).reshape(cells, count, 3, count, 3)
        data = np.add.reduceat(blocks.reshape(-1)[self._keep][self._order], self._starts)
        n = len(self._indptr) - 1
        return sp.csr_matrix((data, self._indices, self._indptr), shape=(n, n))

    def rows(self, points: Array) -> sp.csr_matrix:
        """Interpolation of points [m, at rest] from the nodes by the shape functions of the cell that holds them, (p, n)."""
        chosen = []
        for point in points:
            place = self._place(np.tile(point, (self.mesh.nelements, 1)), np.arange(self.mesh.nelements))
            out = np.maximum(-place.min(axis=0), (place.sum(axis=0) if self.tetra else place.max(axis=0)) - 1)
            chosen.append(int(np.argmin(out)))
        return self.rows_in(points, np.asarray(chosen))

    def _place(self, points: Array, cells: NDArray[np.int64]) -> Array:
        """Reference coordinates (3, p) of points (p, 3) in cells that are affine images (tetrahedra and parallelepipeds)."""
        return np.einsum("pij,pj->ip", self._affine[cells, :, :3], points) + self._affine[cells, :, 3].T

    def rows_in(self, points: Array, cells: NDArray[np.int64]) -> sp.csr_matrix:
        """The same in given cells."""
        place = self._place(points, cells)[:, :, None]
        count = self.cells.shape[1]
        value = [
            np.broadcast_to(np.asarray(self.element.gbasis(self.mapping, place, a, tind=cells)[0]), (len(points), 1))
            for a in range(count)
        ]
        matrix = np.hstack(value)
        where = (np.repeat(np.arange(len(points)), count), self.cells[cells].ravel())
        return sp.csr_matrix((matrix.ravel(), where), shape=(len(points), len(self.rest)))
