"""Effects of the shape: a mesh that is not fine enough, and a body made or swollen to another size."""

from __future__ import annotations

import numpy as np

from femsense.core.errors import InputError
from femsense.model.effects.base import Effect, Entry, Parameter, no_parameters, number
from femsense.model.remeshing import finer_mesh, robot_on_mesh
from femsense.model.robot import Robot

MOST_REFINEMENTS = 3
"""Each refinement makes eight elements of one."""
MOST_TETS = 60000
"""A finer mesh than this is not tried by itself."""


def _size_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    return (Parameter("scale", None, "1", 0.0, float(np.log(0.8)), float(np.log(1.25)), 1e-6, "log", plausible=0.02),)


def _apply_size(robot: Robot, entry: Entry) -> Robot:
    scale = number(entry, "scale", "geometry", low=0.2, high=5.0)
    body = robot.body.scaled(scale)
    center = robot.body.clamp_center
    return robot.with_body(body).with_marker_points(center + scale * (robot.marker_points - center))


def _mesh_seeds(robot: Robot) -> tuple[Entry, ...]:
    """Quadratic elements and a finer mesh, if the mesh is linear and the result is not too large to compute."""
    mesh = robot.body.mesh
    if mesh.is_quadratic:
        return ()
    finer: tuple[Entry, ...] = ({"refinements": 1},) if 8 * len(mesh.tets) <= MOST_TETS else ()
    return ({"element": "tet10"}, *finer)


def _apply_mesh(robot: Robot, entry: Entry) -> Robot:
    element, refinements = entry.get("element"), entry.get("refinements", 0)
    if element is None and "refinements" not in entry:
        raise InputError(
            "neither element nor refinements", where="discretisation", expected='element = "tet10", or refinements = 1'
        )
    if element not in (None, "tet4", "tet10"):
        raise InputError("unknown element", where="discretisation.element", found=element, expected="tet4 | tet10")
    if isinstance(refinements, bool) or not isinstance(refinements, int) or not 0 <= refinements <= MOST_REFINEMENTS:
        raise InputError(
            "not a whole number in range",
            where="discretisation.refinements",
            found=refinements,
            expected=f"0 … {MOST_REFINEMENTS}",
        )
    mesh = finer_mesh(robot.body.mesh, element, refinements)
    return robot if mesh is robot.body.mesh else robot_on_mesh(robot, mesh)


DISCRETISATION = Effect(
    "discretisation",
    "a mesh fine enough",
    no_parameters,
    _apply_mesh,
    _mesh_seeds,
    keys=("element", "refinements"),
    discrete=True,
    remeshes=True,
)
GEOMETRY = Effect(
    "geometry",
    "a body made or swollen to another size",
    _size_parameters,
    _apply_size,
    keys=("scale",),
    moves_rest=True,
)
