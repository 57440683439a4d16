"""How near a dragged tip comes on a robot that is not the model: with and without what is measured, and with a post in its way.

    python benchmarks/drag.py

The model is a bar of few elements; the robot has another mesh, a neo-Hookean law and a modulus 15 % higher.
The target is where two tensions bring the robot. Measurements are noisy by 0.1 mm along each axis.
"""

# ruff: noqa: E402
from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / "tests" / "support")]
from analytic import bar_body
from helpers import block_mesh
from obedient import ObedientRobot

from femsense.fem.mesh import embed_points, surface_triangles, to_quadratic
from femsense.model.effects import apply_effects
from femsense.model.robot import Observation, Robot, plain_actuation
from femsense.xr.skinning import fit_skin
from femsense.xr.stream.command_gate import GateOptions
from femsense.xr.stream.drag_server import DragOptions, DragServer, drive_inputs
from femsense.xr.stream.hub import Hub, Message

TIP = np.array([[0.1, 0.015, 0.03], [0.1, 0.0, 0.015]])
WANTED_N = (1.5, 0.6)
POST = (np.array([0.05, 0.015, 0.03]), 0.0325)
SECONDS = 4.0


def bar(cells: tuple[int, int, int]) -> Robot:
    body = bar_body(to_quadratic(block_mesh(cells)))
    none = np.zeros(0, np.int64)
    return Robot("bar", body, ("tip", "side"), TIP, embed_points(body.mesh, TIP), none, None, plain_actuation(2), Observation())


def dragged(post: tuple[np.ndarray, float] | None, *, measured: bool) -> tuple[float, float, float]:
    """Return how far the target is, how far off the tip ends [m], and the force of the post [N]."""
    hub, model = Hub(), bar((4, 1, 1))
    used = np.unique(surface_triangles(model.body.mesh))
    nodes = model.body.mesh.nodes[used]
    gate = GateOptions(allowed=True, range_per_s=1.0, hold_s=0.5)
    server = DragServer(hub, model, fit_skin(nodes, nodes[None], bones=4), name="bar", options=DragOptions(gate=gate))
    other = apply_effects(bar((6, 2, 2)), [{"name": "hyperelastic", "law": "neo_hookean"}, {"name": "stiffness", "scale": 1.15}])
    real = ObedientRobot(hub, other, "bar", drive_inputs(model), post=post)
    start = real.place(0)
    real.inputs = dict(zip(model.body.cable_names, WANTED_N))
    wanted = real.place(0)
    real.inputs = dict.fromkeys(model.body.cable_names, 0.0)
    wish = {"handle": "tip", "target_m": dict(zip("xyz", map(float, wanted))), "held": True, "armed": True}
    end = time.monotonic() + SECONDS
    while time.monotonic() < end:
        hub.received(Message("femsense/bar/drag", json.dumps(wish).encode()), "me")
        time.sleep(0.03)
        if measured:
            real.report(("tip", "side"))
    missed = float(np.linalg.norm(real.place(0) - wanted))
    server.close()
    return float(np.linalg.norm(wanted - start)), missed, real.pushed_n


def main() -> None:
    print("| in the way | measured | target away [mm] | tip ends off [mm] | force of the post [N] |\n|---|---|---|---|---|")
    for name, post in (("nothing", None), ("a post at the middle", POST)):
        for measured in (False, True):
            away, missed, force = dragged(post, measured=measured)
            print(f"| {name} | {'yes' if measured else 'no'} | {1e3 * away:.1f} | {1e3 * missed:.2f} | {force:.2f} |", flush=True)


if __name__ == "__main__":
    main()
