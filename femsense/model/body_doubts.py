"""Implausible properties of a body, by the ranges of `plausibility`."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray, diagonal
from femsense.core.units import Quantity
from femsense.fem.body import BodyModel
from femsense.model.plausibility import RANGES, likely_meant


def doubts_of_body(body: BodyModel) -> list[str]:
    """Return implausible properties of a body: material, cracks, cables that double back, limits."""
    return [*_doubts_of_material(body), *_doubts_of_cracks(body), *_doubts_of_cables(body), *_doubts_of_limits(body)]


def _doubts_of_limits(body: BodyModel) -> list[str]:
    """Return limits of chambers and cables in another unit."""
    (low, high), found = RANGES.pressure_pa, []
    for chamber in body.chambers:
        if not low <= chamber.max_pressure <= high:
            units = likely_meant(chamber.max_pressure, 2e3, high, Quantity.PRESSURE)
            found.append(f"chamber {chamber.name!r}: max_pressure_pa of {chamber.max_pressure:.4g} Pa; is it in {units}?")
    for cable in body.cables:
        if np.isfinite(cable.max_tension) and cable.max_tension > 10.0 * RANGES.tension_n[1]:
            units = likely_meant(cable.max_tension, 0.05, RANGES.tension_n[1], Quantity.FORCE)
            found.append(f"cable {cable.name!r}: max_tension_n of {cable.max_tension:.4g} N; is it in {units}?")
    return found


def _doubts_of_material(body: BodyModel) -> list[str]:
    """Return a modulus or a density that no soft robot has, and a Poisson ratio near 1/2."""
    modulus, density, (soft, stiff) = np.asarray(body.material.young_modulus), body.material.density, RANGES.young_modulus_pa
    found = []
    if modulus.min() < soft:
        found.append(f"material.young_modulus_pa: {modulus.min():.4g} Pa is softer than any silicone; is it in kPa or MPa?")
    if modulus.max() > stiff:
        text = "is stiffer than any soft robot; is it in another unit than pascals?"
        found.append(f"material.young_modulus_pa: {modulus.max():.4g} Pa {text}")
    if 0.0 < density < RANGES.density_kg_m3:
        text = "kg/m³ is lighter than any foam; is it in g/cm³? Silicone has 1070 kg/m³"
        found.append(f"material.density_kg_m3: {density:.4g} {text}")
    return [*found, *_doubts_of_ratio(body)]


def _doubts_of_ratio(body: BodyModel) -> list[str]:
    ratio = float(np.max(body.material.poisson_ratio))
    if ratio <= RANGES.poisson_ratio:
        return []
    return [
        f"material.poisson_ratio: {ratio:.7g} makes the equations nearly singular, and solves may fail; 0.49 and 0.4999 differ by "
        "a few per cent for a body of rubber"
    ]


def _doubts_of_cracks(body: BodyModel) -> list[str]:
    """Return coincident surface nodes that are not joined."""
    from scipy.spatial import cKDTree

    mesh = body.mesh
    corners = np.unique(mesh.tets[:, :4])
    counts = []
    for nodes in (corners, np.arange(len(mesh.nodes))):
        points = mesh.nodes[nodes]
        near = RANGES.coincident * diagonal(points)
        pairs = cKDTree(points).query_pairs(near, output_type="ndarray")
        counts.append(len(np.unique(pairs[:, 1])) if len(pairs) else 0)
    if not counts[1]:
        return []
    all_nodes = f" ({counts[1]} nodes of the quadratic mesh)" if counts[1] > counts[0] else ""
    return [
        f"mesh: {counts[0]} corner nodes{all_nodes} stand at the places of others without being joined to them: a crack, which makes the "
        "body softer; merge duplicate nodes where the mesh is made"
    ]


def _doubts_of_cables(body: BodyModel) -> list[str]:
    found = []
    for cable in body.cables:
        path = cable.path.positions(body.mesh.nodes)
        points = np.vstack([path, cable.pull_point])
        turns = _turns(points)
        if not len(turns) or turns.max() <= RANGES.doubling_rad:
            continue
        k = int(turns.argmax())
        other = _turns(np.vstack([path[::-1], cable.pull_point]))
        hint = "is its far end first?" if other.max(initial=0.0) < RANGES.doubling_rad else "are two points exchanged?"
        found.append(
            f"cable {cable.name!r} doubles back: it turns by {np.degrees(turns[k]):.0f}° at point {k + 1} of path_m; {hint}"
        )
    return found


def _turns(points: FloatArray) -> FloatArray:
    """Return the angles [rad] between the legs of a path (n, 3), shape (n − 2,) less legs without length."""
    legs = np.diff(points, axis=0)
    length = np.linalg.norm(legs, axis=1)
    units = legs[length > 0] / length[length > 0, None]
    return np.asarray(np.arccos(np.clip(np.einsum("ic,ic->i", units[:-1], units[1:]), -1.0, 1.0)))
