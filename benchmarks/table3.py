"""Known weights at the tip of the four-leg robot, sensed by a depth camera: Table III of the paper, on the virtual rig.

    python benchmarks/table3.py [--folder DIR] [--seeds N]

The robot is that of the paper (`data/diamond`: linear tetrahedra, corotational, 180 kPa declared). The truth has half the element
size, quadratic elements, the neo-Hookean law and another modulus. As in the paper, the modulus comes from known weights (three,
none of them asked for), cables are not pulled and the place of the weight is known. The robot hangs, so that a weight pulls its tip
away from the base; one that pressed on it would buckle the legs. Clouds are those of a D415 at 0.46 m.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from femsense import load_robot, read_run
from femsense.fem.mesh import surface_triangles

DIAMOND = Path(__file__).resolve().parents[2] / "shared" / "data" / "diamond"
PAPER = {260: 230, 460: 434, 660: 634, 760: 756, 860: 873, 1060: 1045}
"""Weight and what the paper computed [mN] (Table III)."""
KNOWN = (360, 560, 960)
TRUE_STIFFNESS = 0.92
TIP = (0.0, 0.0, 0.125)

HEAD = """format = "femsense-script-1"
seed = {seed}

[camera]
eye_m = [-0.20, -0.26, 0.36]
target_m = [0.0, 0.0, 0.05]

[camera.noise]
like = "D415"

[clouds]
kind = "depth"

[markers]
std_m = 0.2e-3

[[effects]]
name = "stiffness"
scale = {stiffness}

[[sweeps]]
label = "free"
levels = [0, 0, 0, 0, 0, 0]
"""
KNOWN_SWEEP = """
[[sweeps]]
label = "known{mn}"
levels = [1, 1]

[[loads]]
sweep = "known{mn}"
point_m = [{x}, {y}, {z}]
force_n = [0.0, 0.0, {n}]
"""
ASKED_SWEEP = """
[[sweeps]]
label = "asked{mn}"
levels = [1, 1, 1]

[[contacts]]
sweep = "asked{mn}"
point_m = [{x}, {y}, {z}]
direction = [0.0, 0.0, 1.0]
force_n = {n}
probe_radius_m = 0.004
"""


def femsense(*arguments: object) -> None:
    """Run a command; its output is shown where it fails."""
    done = subprocess.run([sys.executable, "-m", "femsense", *map(str, arguments)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(
            f"femsense {' '.join(map(str, arguments))}: exit {done.returncode}\n{done.stdout[-2000:]}{done.stderr[-2000:]}"
        )


def robot_of(folder: Path, element: str) -> Path:
    """Return the robot's folder with nine markers, spread over its surface as in the paper."""
    shutil.copytree(DIAMOND, folder)
    toml = folder / "robot.toml"
    toml.write_text(toml.read_text(encoding="utf-8").replace('"tet4"', f'"{element}"'), encoding="utf-8")
    mesh = load_robot(folder).body.mesh
    skin = mesh.nodes[np.unique(surface_triangles(mesh))]
    picked = [np.array(TIP)]
    while len(picked) < 9:
        away = np.min([np.linalg.norm(skin - p, axis=1) for p in picked], axis=0)
        picked.append(skin[away.argmax()])
    with toml.open("a", encoding="utf-8") as file:
        for number, place in enumerate(picked[1:]):
            file.write(f'\n[[markers]]\nname = "m{number}"\nposition_m = {[round(float(x), 6) for x in place]}\n')
    return folder


def script(sweep: str, weights: tuple[int, ...], seed: int) -> str:
    """Return the script of a recording in which these weights [mN] hang at the tip, one after the other."""
    x, y, z = TIP
    parts = [sweep.format(mn=mn, n=1e-3 * mn, x=x, y=y, z=z) for mn in weights]
    return HEAD.format(seed=seed, stiffness=TRUE_STIFFNESS) + "".join(parts)


def sensed(folder: Path, seed: int, element: str) -> dict[int, list[tuple[float, float, bool]]]:
    """Return force and deviation [N] of each frame and whether it is `ok`, by weight [mN]."""
    folder.mkdir(parents=True)
    robot = robot_of(folder / "robot", element)
    for name, sweep, weights in (("known", KNOWN_SWEEP, KNOWN), ("asked", ASKED_SWEEP, tuple(PAPER))):
        (folder / f"{name}.toml").write_text(script(sweep, weights, seed), encoding="utf-8")
        femsense("simulate", robot, folder / f"{name}.toml", "-o", folder / name)
        seed += 1
    femsense("improve", robot, folder / "known", "--effects", "stiffness", "-o", folder / "improved")
    femsense("calibrate", folder / "improved", folder / "asked", "-o", folder / "asked.json")
    at = ",".join(map(str, TIP))
    femsense("estimate", folder / "improved", folder / "asked", "-c", folder / "asked.json", "--at", at, "-o", folder / "run")
    run = read_run(folder / "run")
    found: dict[int, list[tuple[float, float, bool]]] = {mn: [] for mn in PAPER}
    frames = [(mn, 6 + 3 * i + j) for i, mn in enumerate(PAPER) for j in range(3)]
    for mn, frame in frames:
        for contact in run.contacts:
            if contact.frame == frame:
                found[mn].append((contact.force_n, contact.std_n, run.frames[frame].status == "ok"))
    return found


def main() -> None:
    """Print the paper's table beside ours."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--element", choices=["tet4", "tet10"], default="tet10", help="of the estimator")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.folder or Path(scratch)
        runs = [sensed(folder / f"seed{seed}", 10 * seed + 1, options.element) for seed in range(options.seeds)]
    print("| weight [mN] | paper: found, error | here: median, error | ± (one deviation) | frames that are ok |")
    print("|---|---|---|---|---|")
    for mn, theirs in PAPER.items():
        here = [frame for run in runs for frame in run[mn]]
        force = float(np.median([f for f, _, _ in here]))
        std = float(np.median([s for _, s, _ in here]))
        ok = sum(fine for _, _, fine in here)
        print(
            f"| {mn} | {theirs}, {abs(theirs / mn - 1):.1%} | {1e3 * force:.0f}, {abs(1e3 * force / mn - 1):.1%} "
            f"| {1e3 * std:.0f} | {ok}/{3 * len(runs)} |"
        )


if __name__ == "__main__":
    main()
