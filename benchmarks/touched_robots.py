"""Forces on the robots that come along, touched in sight of a depth camera: the virtual rig's truth beside what is sensed.

    python benchmarks/touched_robots.py [--robots NAME …] [--seed S] [--law NAME] [--out FOLDER]

Each robot pulls its inputs one after the other (free frames), then a ball presses on it, harder from frame to frame, leaves and hovers. The seed draws the
camera, 2.5 to 3 sizes of the robot away, and the place among those that it sees and that yield. The truth has elements of half the size and the law
--law, which the robot does not declare; markers of the free frames tell the pose. Recordings are kept below OUT.
"""

from __future__ import annotations

import argparse
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from femsense import Robot, calibrate, compare, estimate, load_recording, load_robot, simulate, solve_equilibrium
from femsense.core.arrays import FloatArray
from femsense.fem.mesh import surface_triangles, vertex_normals

ROBOTS = ("arm", "finger", "four-leg", "gripper", "pneu-finger")
HEIGHT = 0.4
"""Of the largest tension or pressure."""
DEFLECTED = 0.025
"""How far the largest force moves its place, in sizes of the robot."""
TOUCHED, AFTER = 8, 4


def drawn(robot: Robot, seed: int) -> tuple[FloatArray, FloatArray, float]:
    """Return a camera's place, a place on the surface that it sees and that yields, and a force that moves it by DEFLECTED [N]."""
    rng = np.random.default_rng([seed, 7])
    nodes = robot.body.mesh.nodes
    middle, size = nodes.mean(axis=0), float(np.linalg.norm(np.ptp(nodes, axis=0)))
    around, up = rng.uniform(0.0, 2.0 * np.pi), np.radians(rng.uniform(20.0, 50.0))
    eye = middle + rng.uniform(2.5, 3.0) * size * np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
    normals = vertex_normals(nodes, surface_triangles(robot.body.mesh))
    rest = solve_equilibrium(robot.body).positions
    yields = []
    for node in rng.permutation(robot.features):
        look = (eye - nodes[node]) / np.linalg.norm(eye - nodes[node])
        if normals[node] @ look < 0.5:
            continue
        force = np.zeros_like(nodes)
        force[node] = -0.02 * normals[node]
        moved = np.linalg.norm(solve_equilibrium(robot.body, nodal_forces=force).positions[node] - rest[node])
        yields.append((moved / 0.02, nodes[node]))
        if len(yields) == 6:
            break
    most, place = max(yields, key=lambda one: one[0])
    return eye, place, DEFLECTED * size / most


def script_of(robot: Robot, seed: int, law: str) -> dict[str, Any]:
    """Return the script of one recording."""
    eye, place, force = drawn(robot, seed)
    nodes = robot.body.mesh.nodes
    size = float(np.linalg.norm(np.ptp(nodes, axis=0)))
    inputs = [("cables", c.name, HEIGHT * c.max_tension) for c in robot.body.cables]
    inputs += [("chambers", c.name, HEIGHT * c.max_pressure) for c in robot.body.chambers]
    kind, name, value = inputs[0]
    held = {kind: {name: [0.5 * value] * (TOUCHED + AFTER)}}
    return {
        "format": "femsense-script-1",
        "seed": seed,
        "actuation": "tension",
        "objects": [{"name": "ball", "kind": "ball", "radius_m": 0.06 * size}],
        "sweeps": [
            {"label": c, k: {c: v}, "rest": int(i == 0), "up": 2, "down": 1, "free": True} for i, (k, c, v) in enumerate(inputs)
        ]
        + [{"label": "touch", **held, "up": 0, "hold": TOUCHED + AFTER, "down": 0}],
        "contacts": [
            {
                "sweep": "touch",
                "object": "ball",
                "point_m": place.tolist(),
                "force_n": [*np.linspace(0.2 * force, force, TOUCHED).tolist(), *[0.0] * AFTER],
            }
        ],
        "truth": {"law": law, "substeps": 1},
        "camera": {
            "eye_m": eye.tolist(),
            "target_m": nodes.mean(axis=0).tolist(),
            "width": 848,
            "height": 480,
            "fx": 612.0,
            "noise": {"like": "D415"},
        },
        "markers": {"std_m": 0.0002},
        "clouds": {"kind": "depth"},
        "scene": {"floor_z_m": float(nodes[:, 2].min() - 0.3 * size)},
    }


def row(name: str, seed: int, law: str, folder: Path) -> str:
    """Return a line of the table."""
    robot, place = load_robot(name), folder / f"{name}-{seed}{'-linear' * (law == 'corotational')}"
    if not (place / "recording.toml").is_file():
        simulate(robot, script_of(robot, seed, law), place)
    recording = load_recording(place)
    began = time.process_time()
    calibration = calibrate(robot, recording)
    if not calibration.settled:
        return f"| {name} | calibration: {calibration.status} |"
    run = estimate(robot, recording, calibration)
    spent = 1e3 * (time.process_time() - began) / recording.frame_count
    found = compare(run, place)
    ok = {frame.frame for frame in run.frames if frame.status == "ok"}
    size = np.array([abs(c.force_n / float(np.linalg.norm(t.force_n_xyz)) - 1.0) for t, c in found.pairs])
    within = [abs(c.force_n - float(np.linalg.norm(t.force_n_xyz))) < 1.96 * c.std_n for t, c in found.pairs]
    if not len(size):
        return f"| {name} | – | – | – | 0/{found.contacts_true} | {found.contacts_false} | – | {len(ok)}/{recording.frame_count} | {spent:.0f} |"
    errors = f"{np.median(size):.1%} | {np.quantile(size, 0.95):.1%} | {1e3 * np.median(found.place_errors_m):.1f} mm"
    share = f"{found.contacts_true - found.contacts_found}/{found.contacts_true} | {found.contacts_false}"
    return f"| {name} | {errors} | {share} | {np.mean(within):.0%} | {len(ok)}/{recording.frame_count} | {spent:.0f} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="*", default=list(ROBOTS), choices=ROBOTS)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--law", default="neo_hookean", choices=["neo_hookean", "corotational"], help="of the truth")
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    warnings.simplefilter("ignore")
    folder = asked.out or Path(tempfile.mkdtemp(prefix="touched-robots-"))
    print(
        "| robot | error of force, median | 95th percentile | place | missed | false | within 95 % | frames that are ok | ms a frame |"
    )
    print("|---|---|---|---|---|---|---|---|---|", flush=True)
    for name in asked.robots:
        print(row(name, asked.seed, asked.law, folder), flush=True)


if __name__ == "__main__":
    main()
