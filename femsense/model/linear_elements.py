"""How much too stiff linear tetrahedra make a body: the same forces at rest on quadratic elements of the same mesh."""

from __future__ import annotations

import warnings

import numpy as np

from femsense.core.errors import FemsenseError
from femsense.fem.body import BodyModel
from femsense.fem.compliance import tangent_at
from femsense.fem.equilibrium import solve_equilibrium
from femsense.fem.mesh import surface_triangles, to_quadratic, vertex_normals
from femsense.model.remeshing import body_on_mesh
from femsense.model.robot import spread_features

PLACES = 8
"""Forces that are tried, spread over the surface."""
MOST_TETS = 24_000
"""A quadratic mesh of more elements takes too long for a remark, and in every state of a recording."""
LARGE = 0.1
"""Smallest share that is reported: below it, the force error is no larger than the uncertainty of a modulus in practice."""


def excess_stiffness(body: BodyModel) -> float:
    """Return by which share quadratic elements on the same mesh are more compliant, median over places [1].

    To first order at rest. 0 on quadratic elements. The quadratic mesh has an error of its own, so that the whole is larger.

    Raises:
        FemsenseError: nothing holds the body.
    """
    if body.mesh.is_quadratic:
        return 0.0
    nodes = spread_features(body, PLACES)
    normals = vertex_normals(body.mesh.nodes, surface_triangles(body.mesh))[nodes]
    moves = []
    for one in (body, body_on_mesh(body, to_quadratic(body.mesh))):
        plain = one.with_gravity(np.zeros(3))
        forces = np.zeros((len(nodes), len(one.mesh.nodes), 3))
        forces[np.arange(len(nodes)), nodes] = -normals  # corners come first in a quadratic mesh
        answer = tangent_at(plain, solve_equilibrium(plain)).respond(forces)
        moves.append(answer[:, : len(body.mesh.nodes)].reshape(len(nodes), -1))
    coarse, fine = moves
    return float(np.median((coarse * fine).sum(axis=1) / (coarse**2).sum(axis=1))) - 1.0


def warn_of_linear_elements(body: BodyModel, *, where: object) -> None:
    """Warn where linear elements make a body so stiff that forces are not to be trusted."""
    if len(body.mesh.tets) > MOST_TETS:
        return
    try:
        excess = excess_stiffness(body)
    except FemsenseError:
        return
    if excess > LARGE:
        warnings.warn(
            f"{where}: linear tetrahedra make this body too stiff: with quadratic ones the same forces move it "
            f"{100 * excess:.0f} % farther. Unless its modulus was fitted to known forces on this very mesh, forces come out "
            'about as much too large, and std_n does not say so. What to try: element = "tet10" in [mesh]',
            stacklevel=3,
        )
