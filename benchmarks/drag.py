"""How often a dragged point is answered, and how near it comes on a robot that is not the model.

    python benchmarks/drag.py [--robots NAME …]

The first table drags a marker of the robots that come along, to and fro for five seconds with 30 wishes a second, partly
out of reach; then the hand rests.

In the second the model is a bar of few elements; the robot has another mesh, a neo-Hookean law and a modulus 15 % higher.
The target is where two tensions bring the robot. Measurements are noisy by 0.1 mm along each axis.
"""

# ruff: noqa: E402
from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / "tests" / "support")]
from analytic import bar_body
from hand import Hand
from helpers import block_mesh
from obedient import ObedientRobot

from femsense.control.reach import reach
from femsense.fem.mesh import embed_points, surface_triangles, to_quadratic
from femsense.io.robot_toml import load_robot
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
ROBOTS = {"finger": "tip", "arm": "end-east", "four-leg": "south-foot", "gripper": "right-tip", "pneu-finger": "back-5"}
SWING = np.array([0.10, 0.05, 0.06])
"""How far the hand goes, as a share of the body's size."""
MOVES, RESTS = 5.0, 4.0
"""How long it moves and rests [s]."""


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
    hand = Hand(hub)
    end = time.monotonic() + SECONDS
    while time.monotonic() < end:
        hand.drag(wanted)
        time.sleep(0.03)
        if measured:
            real.report(("tip", "side"))
    missed = float(np.linalg.norm(real.place(0) - wanted))
    server.close()
    return float(np.linalg.norm(wanted - start)), missed, real.pushed_n


class Answers:
    """A sink that keeps what was answered, and when."""

    def __init__(self) -> None:
        self.told: list[tuple[float, dict]] = []

    def send(self, messages: tuple[Message, ...]) -> None:
        now = time.monotonic()
        self.told += [(now, json.loads(m.payload)) for m in messages if m.topic.endswith("/reach")]

    def close(self) -> None:
        pass


def answered(name: str, marker: str) -> str:
    """Drag a marker to and fro; return a row of the table."""
    robot, hub, answers = load_robot(name), Hub(), Answers()
    mesh = robot.body.mesh
    nodes = mesh.nodes[np.unique(surface_triangles(mesh))]
    server = DragServer(hub, robot, fit_skin(nodes, nodes[None], bones=12), name=name)
    rest = np.array(robot.marker_points[robot.marker_names.index(marker)])
    swing = SWING * np.linalg.norm(np.ptp(mesh.nodes, axis=0))

    hand = Hand(hub, robot=name)

    def drag(seconds: float, path: float) -> None:
        begun = time.monotonic()
        while (now := time.monotonic() - begun) < seconds:
            place = rest + swing * np.sin(path * now + 1.0)
            hand.drag(place, armed=False, handle=marker)
            time.sleep(1.0 / 30.0)

    hub.attach(answers)
    while len(answers.told) < 5:
        drag(1.0, 0.5)  # until kernels are loaded
    busy, begun = time.process_time(), time.monotonic()
    drag(MOVES, 2.0)
    ended, busy = time.monotonic(), time.process_time() - busy
    moving = [told for when, told in answers.told if begun <= when < ended]
    drag(RESTS, 0.0)
    rests = next((when for when, told in answers.told if when >= ended and told["status"] != "converging"), np.inf)
    last = answers.told[-1][1]
    server.close()
    limits = {one.name: (one.low, one.high) for one in drive_inputs(robot)}
    best = reach(robot, {marker: rest + swing * np.sin(1.0)}, limits=limits)
    p50, p95 = np.percentile([told["ms"] for told in moving], [50, 95])
    return (
        f"| {name}, {len(mesh.nodes)} nodes | {len(moving) / (ended - begun):.0f} | {p50:.0f} | {p95:.0f} "
        f"| {1e3 * busy / max(len(moving), 1):.0f} | {rests - ended:.2f} | {1e3 * last['error_m']:.2f} | {1e3 * best.error_m:.2f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="*", choices=ROBOTS, help="the first table alone, of these")
    chosen = parser.parse_args().robots
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    print(
        "| robot | answers a second | p50 [ms] | p95 [ms] | processor time an answer [ms] | rests after [s] | off [mm] |", end=""
    )
    print(" off by reach [mm] |\n|---|---|---|---|---|---|---|---|")
    for name in ROBOTS if chosen is None else chosen:
        print(answered(name, ROBOTS[name]), flush=True)
    if chosen is not None:
        return
    print("| in the way | measured | target away [mm] | tip ends off [mm] | force of the post [N] |\n|---|---|---|---|---|")
    for name, post in (("nothing", None), ("a post at the middle", POST)):
        for measured in (False, True):
            away, missed, force = dragged(post, measured=measured)
            print(f"| {name} | {'yes' if measured else 'no'} | {1e3 * away:.1f} | {1e3 * missed:.2f} | {force:.2f} |", flush=True)


if __name__ == "__main__":
    main()
