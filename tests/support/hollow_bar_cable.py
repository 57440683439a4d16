"""A hollow bar with a cable."""

from __future__ import annotations

from collections.abc import Sequence

from hollow import hollow_bar

from femsense.fem.body import BodyModel, make_body, tie_cable
from femsense.fem.cavities import find_chamber

SEED = [0.05, 0.015, 0.015]


def hollow(law: str = "corotational", *, quadratic: bool = False, gravity: Sequence[float] = (0.0, 0.0, -9.81)) -> BodyModel:
    """A hollow bar with a cable on top, clamped at x = 0; the clamp meets the walls but not the cavity."""
    mesh = hollow_bar(quadratic=quadratic)
    cable = tie_cable(mesh, "top", [[0.1, 0.015, 0.03], [0.05, 0.015, 0.03]], [0.0, 0.015, 0.04])
    chamber = find_chamber(mesh, "core", SEED, max_pressure=1e4)
    return make_body(
        mesh,
        young_modulus=150e3,
        poisson_ratio=0.4,
        density=1070.0,
        law=law,
        clamped=mesh.nodes[:, 0] < 1e-9,
        cables=(cable,),
        chambers=(chamber,),
        gravity=gravity,
    )
