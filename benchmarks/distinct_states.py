"""How long `femsense improve` takes, what it counts as work, and what memory, on recordings whose states do not repeat.

    python benchmarks/distinct_states.py                     # every case
    python benchmarks/distinct_states.py arm-1 --limit 900
    python benchmarks/distinct_states.py --elements          # what both kinds of elements leave, calibrated

Cases of ../shared/data/other-program were made by another program: an arm of 24 × 24 × 120 mm, 1536 linear tetrahedra,
four routed cables. The diamonds are made here: `../shared/data/diamond`, 4147 linear tetrahedra declared, with markers on its
arms. Their truth is on those same elements (`diamond`, with a hidden gain `diamond-gain`), or on quadratic ones with another law
(`diamond-quadratic`). Each has 60 fitted and 60 validation frames, all different.

Each case is a process of its own, with threads as they come;
its stages are printed with the time and the processor time at which they began.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from femsense import Recording, Robot

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT.parent / "shared" / "data"
OTHERS = DATA / "other-program"
DIAMONDS = {"diamond": (False, 1.0), "diamond-gain": (False, 0.8), "diamond-quadratic": (True, 1.0)}
"""Whether the truth has quadratic elements and another law, and the gain of its first cable."""
FRAMES, NOISE_M = 60, 2e-4
MOST_N = 0.8


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*")
    parser.add_argument("--limit", type=float, default=900.0, help="seconds after which a case is stopped")
    parser.add_argument("--elements", action="store_true", help="only calibrate, on both kinds of elements")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one is not None:
        (elements if options.elements else one)(options.one)
        return
    others = sorted(p.name for p in OTHERS.iterdir() if p.is_dir()) if OTHERS.is_dir() else []
    for case in options.cases or [*others, *DIAMONDS]:
        print(case, flush=True)
        call = [sys.executable, "-W", "ignore", __file__, "--one", case, *["--elements"] * options.elements]
        try:
            subprocess.run(call, env=os.environ | {"PYTHONPATH": str(ROOT)}, check=True, timeout=options.limit)
        except subprocess.TimeoutExpired:
            print(f"  stopped after {options.limit:.0f} s")


def read(case: str) -> tuple[Robot, Recording, Recording]:
    """Return the declared robot, what is fitted and what is held out."""
    from femsense import load_recording, load_robot

    if case in DIAMONDS:
        return diamond(*DIAMONDS[case])
    folder = OTHERS / case
    recording, validation = (load_recording(folder / name) for name in ("recording", "validation"))
    return load_robot(folder / "robot"), recording, validation


def one(case: str) -> None:
    """Print the stages of a case, and what came out."""
    from femsense import improve
    from femsense.core.work import counting

    robot, recording, validation = read(case)
    begun, cpu = time.monotonic(), time.process_time()

    def say(text: str) -> None:
        print(f"  {time.monotonic() - begun:6.1f} s, {time.process_time() - cpu:6.1f} s  {text}", flush=True)

    with counting() as work:
        loop = improve(robot, [recording], validation=[validation], progress=say)
    say(loop.sentence)
    say(f"named: {', '.join(e.name for e in loop.effects) or 'nothing'}")
    say(f"held out: {1e3 * loop.before.validation_rms_m:.2f} mm before, {1e3 * loop.after.validation_rms_m:.2f} mm after")
    say(f"{work.equilibria} equilibria, {work.responses} responses, {work.refined} states on a finer mesh")
    say(f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.1f} GB")


def elements(case: str) -> None:
    """Print what linear and quadratic elements leave, calibrated, in some of the states."""
    from femsense.loop.data.dataset import prepare
    from femsense.loop.search.element_order import both_calibrated

    robot, recording, validation = read(case)
    linear, quadratic = both_calibrated(prepare(robot, [recording], [validation]))
    print(
        f"  linear {1e3 * linear:.3f} mm, quadratic {1e3 * quadratic:.3f} mm: {(linear / quadratic) ** 2:.2f} of the mean square"
    )


def diamond(quadratic: bool, gain: float) -> tuple[Robot, Recording, Recording]:
    """Return the declared diamond and two recordings of one that is 10 % softer."""
    from femsense import load_robot
    from femsense.core.arrays import freeze
    from femsense.fem.mesh import embed_points
    from femsense.loop.search.element_order import with_quadratic
    from femsense.model.effects import apply_effects

    robot = load_robot(DATA / "diamond")
    nodes = robot.body.mesh.nodes
    points = nodes[np.abs(nodes).max(axis=1) > 0.05]
    chosen = [points[0]]
    while len(chosen) < 16:
        chosen.append(points[np.min([np.linalg.norm(points - c, axis=1) for c in chosen], axis=0).argmax()])
    robot = replace(
        robot,
        marker_names=tuple(f"m{i}" for i in range(len(chosen))),
        marker_points=freeze(np.array(chosen)),
        markers=embed_points(robot.body.mesh, np.array(chosen)),
    )
    truth = with_quadratic(robot) if quadratic else robot
    hidden = [{"name": "stiffness", "scale": 0.9}, {"name": "cable_gain", "scale": {robot.body.cable_names[0]: gain}}]
    hidden += [{"name": "hyperelastic", "law": "neo_hookean"}] * quadratic
    truth = apply_effects(truth, hidden)
    return robot, record(truth, 1), record(truth, 2)


def record(truth: Robot, seed: int) -> Recording:
    """Return markers of a robot in frames no two of which are alike, as a camera sees them."""
    from femsense.core.pose import invert_pose, make_pose, rotation_from_vector, transform_points
    from femsense.model.drive import DrivenRobot, drive_of
    from femsense.model.quasi_static_path import solve_path
    from femsense.model.recording import make_recording
    from femsense.model.recording_parts import Drives, MarkerRows, Timeline

    rng, count = np.random.default_rng(seed), len(truth.body.cables)
    inputs = MOST_N * rng.uniform(0.1, 1.0, (FRAMES, count)) * (rng.random((FRAMES, count)) < 0.6)
    time_line = Timeline(np.arange(FRAMES) * 1.0)
    drives = Drives(actuation="tension", cable_names=truth.body.cable_names, inputs=inputs)
    driven = DrivenRobot(truth, drive_of(truth, make_recording(time_line, drives=drives)))
    seen = [p for _, _, p, _ in solve_path(driven, range(FRAMES), lambda r: r.markers)]
    to_camera = invert_pose(make_pose(rotation_from_vector([2.4, 0.0, 0.0]), [0.05, 0.25, 0.5]))
    measured = transform_points(to_camera, np.concatenate(seen)) + NOISE_M * rng.normal(size=(FRAMES * len(seen[0]), 3))
    rows = MarkerRows(
        truth.marker_names, np.repeat(np.arange(FRAMES), len(seen[0])), np.tile(np.arange(len(seen[0])), FRAMES), measured
    )
    return make_recording(time_line, drives=drives, markers=rows)


if __name__ == "__main__":
    main()
