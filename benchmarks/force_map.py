"""Does `simulate --plan` say right which forces a camera resolves? Its map beside the scatter of `estimate --at` over repeats.

    python benchmarks/force_map.py [ROBOT] [--places N] [--repeats R] [--seed S] [--noise PX]

At places of small and of large bounds a force of ten standard deviations presses (at most 0.5 N),
in R frames that differ by the noise of the depth alone; the truth has the declared mesh and law. What is compared is the scatter
of the force along the normal over these frames.
"""

from __future__ import annotations

import argparse
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from femsense.calib.calibrate import calibrate
from femsense.fem.mesh import vertex_normals
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot
from femsense.model.contact_patch import body_surface
from femsense.model.robot import Robot
from femsense.rig.force_map import ForceMap, force_map
from femsense.rig.script import check_script
from femsense.rig.simulate import simulate
from femsense.sensing.pipeline import estimate

FREE = 6
MOST_N = 0.5


def script_of(robot: Robot, seed: int, noise_px: float) -> dict[str, Any]:
    """Return a script with a free sweep, seen from the side and above."""
    low, high = robot.body.mesh.nodes.min(axis=0), robot.body.mesh.nodes.max(axis=0)
    middle, size = 0.5 * (low + high), float(np.linalg.norm(high - low))
    eye = middle + 1.6 * max(size, 0.15) * np.array([-0.45, -0.75, 0.5])
    return {
        "format": "femsense-script-1",
        "seed": seed,
        "sweeps": [{"label": "free", "levels": [0.0] * FREE}],
        "truth": {
            "refinements": 0,
            "element": "tet10" if robot.body.mesh.is_quadratic else "tet4",
            "law": "corotational",
            "substeps": 1,
        },
        "camera": {"eye_m": eye.tolist(), "target_m": middle.tolist(), "declare_noise": True, "noise": {"subpixel_px": noise_px}},
        "markers": {"std_m": 1e-4, "occlusion": False},
        "clouds": {"kind": "ply"},
        "scene": {"floor_z_m": float(low[2]) - 0.05},
    }


def chosen(found: ForceMap, count: int) -> list[int]:
    """Return places from well to badly resolved ones, of which a force of at most 0.5 N is five standard deviations."""
    usable = np.flatnonzero(found.normal_std < MOST_N / 5)
    order = usable[np.argsort(found.normal_std[usable])]
    return [int(order[i]) for i in np.linspace(0, len(order) - 1, count).round().astype(int)]


def scatter(robot: Robot, found: ForceMap, place: int, script: dict[str, Any], repeats: int) -> tuple[float, float, float, int]:
    """Return force, its mean and its scatter along the normal [N] over the repeats, and in how many there is an answer."""
    normal = vertex_normals(robot.body.mesh.nodes, body_surface(robot.body.mesh).triangles)[found.nodes[place]]
    force = min(10 * float(found.normal_std[place]), MOST_N)
    point = found.rest[place]
    touched = {"label": "touch", "levels": [0.0] * repeats}
    size = float(np.linalg.norm(np.ptp(robot.body.mesh.nodes, axis=0)))
    contact = {
        "sweep": "touch",
        "point_m": point.tolist(),
        "force_n": force,
        "direction": (-normal).tolist(),
        "radius_m": 0.02 * size,
        "shown": False,
    }
    whole = {**script, "sweeps": [*script["sweeps"], touched], "contacts": [contact]}
    with tempfile.TemporaryDirectory() as folder:
        recording = load_recording(simulate(robot, whole, Path(folder) / "recording"))
        run = estimate(robot, recording, calibrate(robot, recording), at=[point])
    along = [-float(c.force_n_xyz @ normal) for c in run.contacts if c.frame >= FREE]
    return force, float(np.mean(along)), float(np.std(along, ddof=1)), len(along)


def main() -> None:
    """Print a row a place."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot", nargs="?", default="finger")
    parser.add_argument("--places", type=int, default=5)
    parser.add_argument("--repeats", type=int, default=16)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--noise", type=float, default=0.08, help="error of the disparity [px]")
    given = parser.parse_args()
    robot = load_robot(given.robot)
    script = script_of(robot, given.seed, given.noise)
    found = force_map(robot, check_script(script))
    print(f"{robot.name}: {found.points} points a frame, {found.visible.mean():.0%} of the places seen")
    print("| place at rest [mm] | seen | force | map: one std | scatter of estimates | scatter / map | mean / force |")
    print("|---|---|---|---|---|---|---|", flush=True)
    for place in chosen(found, given.places):
        force, mean, std, count = scatter(robot, found, place, script, given.repeats)
        where = ", ".join(f"{1e3 * x:.0f}" for x in found.rest[place])
        seen = "yes" if found.visible[place] else "no"
        bound = found.normal_std[place]
        print(
            (
                f"| {where} | {seen} | {force:.3f} N | {1e3 * bound:.2f} mN | {1e3 * std:.2f} mN ({count}) | "
                f"{std / bound:.2f} | {mean / force:.3f} |"
            ),
            flush=True,
        )


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()
