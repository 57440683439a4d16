"""How long `femsense improve` takes, and what memory: 100 frames, 20 effects, 1536 tetrahedra.

    python benchmarks/improve.py                        # everything that can be hidden, and tet4, three runs each
    python benchmarks/improve.py --case tet10/friction --case tet10/gain --runs 1
    python benchmarks/improve.py --case tet4/friction --without discretisation

A bar of 120 × 24 × 24 mm with four cables (16 × 4 × 4 cells, six tetrahedra each) goes through ten sweeps of ten frames:
up, held, down. Truth has a mesh of its own (14 × 5 × 5 cells, ten nodes each), the rig's integrators of friction,
a modulus that is off, an unknown camera pose, and noise of markers, frames, sweeps and places. All 17 effects of the list in all
their forms are tried, and three of a user's own. Each run is a process of its own, from starting Python to loop.json and the page
of `femsense report`, with threads and BLAS as they come.

The recordings are kept (--data), so that running it again only times.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from loop_cases import EARTH, Case, Design, _around, _measure

from femsense import apply_effects, load_robot, save_recording, save_robot
from femsense.core.arrays import FloatArray, freeze
from femsense.fem.assembly import internal, reduced_values
from femsense.fem.linalg import factorization
from femsense.io.files import write_text
from femsense.rig.plan import Plan
from femsense.rig.true_path import true_path

STAGES = (
    ("reading", "start, reading, calibrating"),
    ("fitting", "fit of what calibration may move"),
    ("asking what", "error of the mesh"),
    ("screening", "screening and noise"),
    ("refitting", "joint refits"),
    ("looking", "seeds near by"),
    ("polishing", "polishing"),
    ("trying", "richer forms"),
    ("asking whether", "pruning"),
    ("testing", "verdict and evidence"),
    ("report", "report"),
)
HIDDEN: dict[str, tuple[dict[str, Any], ...]] = {
    "nothing": (),
    "gravity": (),  # it is the declared robot that has none
    "clamp": ({"name": "base_compliance", "stiffness_n_m": 60.0},),
    "friction": ({"name": "cable_friction", "coefficient": 0.15},),
    "gain": ({"name": "cable_gain", "scale": {"b": 0.88}},),
    "creep": ({"name": "creep", "fraction": 0.12, "time_s": 8.0},),
    "payload": ({"name": "payload", "point_m": [0.09, 0.0, 0.012], "force_n": [0.03, -0.05, -0.08]},),
    "soft": ({"name": "soft_region", "center_m": [0.045, 0.0, 0.0], "radius_m": 0.02, "scale": 0.6},),
    "depth": ({"name": "depth_scale", "scale": 1.015, "offset_m": 0.0},),
    "two": ({"name": "cable_friction", "coefficient": 0.15}, {"name": "creep", "fraction": 0.12, "time_s": 8.0}),
}
OWN = {
    "magnet": '''"""A magnet beside the tip."""
import numpy as np

name = "magnet"
parameters = {"force_n": {"unit": "N", "low": -0.5, "high": 0.5, "size": 3}}
seeds = [{"center_m": [0.115, 0.0, 0.0]}, {"center_m": [0.06, 0.0, 0.0]}]


def forces(nodes_m, force_n, center_m):
    weight = np.exp(-(((nodes_m - center_m) / 0.02) ** 2).sum(axis=1))
    return np.outer(weight / weight.sum(), force_n)
''',
    "taper": '''"""A modulus that grows from the clamp to the tip."""

name = "taper"
parameters = {"slope": {"low": -0.8, "high": 0.8}}


def change(robot, slope):
    body = robot.body
    along = body.mesh.nodes[body.mesh.tets[:, :4]].mean(axis=1)[:, 0]
    return robot.with_body(body.with_stiffness_scale(1.0 + slope * (along / 0.12 - 0.5)))
''',
    "lens": '''"""A lens with radial distortion."""

name = "lens"
parameters = {"k1": {"low": -0.2, "high": 0.2}}


def correct(points_m, k1):
    slope = points_m[:, :2] / points_m[:, 2:]
    bent = points_m.copy()
    bent[:, :2] *= 1.0 + k1 * (slope**2).sum(axis=1, keepdims=True)
    return bent
''',
}


def _bar(p: FloatArray) -> FloatArray:
    return np.column_stack([0.12 * p[:, 0], 0.012 * p[:, 1:]])


BAR = Design(
    "bar",
    (16, 4, 4),
    (14, 5, 5),
    _bar,
    {
        n: ([[0.115, *_around(0.008, a)], [0.075, *_around(0.008, a)], [0.035, *_around(0.008, a)]], [-0.012, *_around(0.012, a)])
        for n, a in (("a", 0.1), ("b", np.pi / 2), ("c", np.pi), ("d", -np.pi / 2))
    },
    (0.02, 0.27, 0.5, 0.74, 0.98),
    300e3,
    3.0,
)


def make(hidden: str, folder: Path) -> None:
    """Write robot, recording and a user's own effects into a folder."""
    case = Case(1, "single", BAR, "tension", 1e-4, HIDDEN[hidden], placements=True, hyperelastic=False)
    gravity = np.zeros(3) if hidden == "gravity" else EARTH
    declared = BAR.robot(fine=False, law="corotational", gravity=gravity, modulus=BAR.modulus)
    true = BAR.robot(fine=True, law="corotational", gravity=EARTH, modulus=0.9 * BAR.modulus)
    true = apply_effects(true, [_on_clamp(e, len(declared.body.clamped), len(true.body.clamped)) for e in case.hidden])
    mixes = np.array(
        [
            [1, 0, 0, 0],
            [0, 1, 0, 0],
            [0, 0, 1, 0],
            [0, 0, 0, 1],
            [0.7, 0.7, 0, 0],
            [0, 0.7, 0.6, 0],
            [0, 0, 0.8, 0.5],
            [0.5, 0, 0, 0.8],
            [0.5, 0.5, 0.5, 0.5],
            [1, 0, 0.4, 0],
        ]
    )
    order = np.random.default_rng(3).permutation(len(mixes))
    levels = np.array([0.0, 0.35, 0.7, 1.0, 1.0, 1.0, 0.8, 0.5, 0.2, 0.0])
    pace = np.array([1.0, 1.0, 1.0, 1.0, 4.0, 8.0, 1.0, 1.0, 1.0, 1.0])
    recorded = BAR.tension * np.concatenate([np.outer(levels, mixes[m]) for m in order])
    labels = tuple(f"s{i}" for i in range(len(mixes)) for _ in levels)
    time_s = np.cumsum(np.tile(pace, len(mixes))) - 1.0
    F, loaded = len(recorded), np.flatnonzero([label == "s1" for label in labels])
    plan = Plan(
        control="tension",
        time_s=freeze(time_s),
        sweep=labels,
        free=freeze(np.ones(F), bool),
        commanded=freeze(recorded),
        initial=freeze(np.zeros(4)),
        pressures=freeze(np.zeros((F, 0))),
        gravity=None,
        load_frame=freeze(loaded, np.int64),
        load_points=freeze(np.tile([0.117, 0.0, 0.012], (len(loaded), 1))),
        load_forces=freeze(np.tile([0.0, 0.0, -0.08], (len(loaded), 1))),
        contacts=(),
    )
    states = [f.state for f in true_path(true, plan, substeps=2)]
    recording = _measure(case, declared, true, plan, recorded, states, np.random.default_rng(7))[0]
    for kind in ("tet10", "tet4"):
        save_robot(declared, folder / f"robot-{kind}")
        file = folder / f"robot-{kind}" / "robot.toml"
        write_text(file, file.read_text(encoding="utf-8").replace('"tet10"', f'"{kind}"'))
    for name, text in OWN.items():
        write_text(folder / f"{name}.py", text)
    save_recording(recording, folder / "recording")


def _on_clamp(entry: dict[str, Any], declared: int, true: int) -> dict[str, Any]:
    """Return an entry whose springs, one a node of the declared mesh, are spread over the nodes of the true one."""
    return {**entry, "stiffness_n_m": entry["stiffness_n_m"] * declared / true} if "stiffness_n_m" in entry else entry


def one_run(folder: Path, element: str, without: list[str]) -> None:
    """Close the loop as the command does, and print what each stage took."""
    from femsense.app.commands import improve_into
    from femsense.loop.improve import ImproveOptions
    from femsense.report import write_report

    warnings.simplefilter("ignore")
    factors = _count_factors()
    marks = [("reading", float(os.environ["FEMSENSE_BEGAN"]), 0.0)]

    def mark(text: str) -> None:
        own = resource.getrusage(resource.RUSAGE_SELF)
        marks.append((text, time.time(), own.ru_utime + own.ru_stime))

    with tempfile.TemporaryDirectory() as out:
        document = improve_into(
            Path(out) / "loop",
            folder / f"robot-{element}",
            [folder / "recording"],
            without=without or None,
            options=ImproveOptions(user_effects=[folder / f"{n}.py" for n in OWN]),
            say=lambda text: None,
            progress=mark,
        )
        mark("report")
        write_report(Path(out) / "loop")
        mark("end")
    spent: dict[str, list[float]] = {}
    for (text, wall, cpu), (_, then, cpu_then) in pairwise(marks):
        name = next(long for short, long in STAGES if text.startswith(short))
        entry = spent.setdefault(name, [0.0, 0.0])
        entry[0] += then - wall
        entry[1] += cpu_then - cpu
    print(
        json.dumps(
            {
                "stages": spent,
                "verdict": document["verdict"],
                "sentence": document["sentence"],
                "steps": [m[0] for m in marks],
                "factors": len(factors),
                "memory_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
            }
        )
    )


def _count_factors() -> list[int]:
    """Return a list that grows by the size of each stiffness that is factorised from now on:
    time depends on the machine and the hour, this does not."""
    sizes, plain = list[int](), vars(factorization)["cholesky"]

    def counted(analysis: Any, *given: Any, **named: Any) -> Any:
        sizes.append(analysis.size)
        return plain(analysis, *given, **named)

    vars(factorization)["cholesky"] = counted
    return sizes


def timed(folder: Path, element: str, without: list[str]) -> dict[str, Any]:
    """Run the loop once in a process of its own; return its stages with wall and CPU seconds."""
    environment = {**os.environ, "FEMSENSE_BEGAN": repr(time.time())}
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    answer = subprocess.run(
        [sys.executable, __file__, "--one", str(folder), "--element", element, *(f"--without={name}" for name in without)],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    if answer.returncode:
        raise SystemExit(answer.stderr)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {**json.loads(answer.stdout.splitlines()[-1]), "wall_s": wall, "cpu_s": cpu}


def show(name: str, runs: list[dict[str, Any]]) -> None:
    """Print the medians of one case by stage."""
    print(f"\n{name}: {runs[0]['sentence']}")
    print(f"  {'stage':36s}{'wall s':>8s}{'CPU s':>8s}")
    for _, stage in STAGES:
        rows = [r["stages"].get(stage, [0.0, 0.0]) for r in runs]
        if any(row[0] > 0 for row in rows):
            print(f"  {stage:36s}{np.median([r[0] for r in rows]):8.1f}{np.median([r[1] for r in rows]):8.1f}")
    print(f"  {'all':36s}{np.median([r['wall_s'] for r in runs]):8.1f}{np.median([r['cpu_s'] for r in runs]):8.1f}")
    print(f"  {runs[0]['factors']} stiffnesses factorised, {max(r['memory_gb'] for r in runs):.1f} GB at most", flush=True)


def measure_factor(folder: Path) -> tuple[float, float]:
    """Return how long a stiffness of the quadratic bar takes to factorise in single precision on this machine now [s],
    alone and with a second thread at the same: what the seconds of this table are made of, whatever the machine."""
    body = load_robot(folder / "robot-tet10").body
    blocks = internal(body, body.mesh.nodes).blocks
    assert blocks is not None
    pattern, values = body.free_map.pattern, reduced_values(body, blocks)

    def median(_: int) -> float:
        times = []
        for _ in range(20):
            began = time.perf_counter()
            factorization.factorize_definite(pattern, values, single=True, tries=0)
            times.append(time.perf_counter() - began)
        return float(np.median(times))

    median(0)
    with ThreadPoolExecutor(2) as pool:
        return median(0), max(pool.map(median, range(2)))


def main() -> None:
    """Time the cases and print their tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--case",
        action="append",
        help=f"ELEMENT/HIDDEN, of tet10 | tet4 and {' | '.join(HIDDEN)}; several by repeating",
    )
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument(
        "--without", action="append", default=[], metavar="EFFECT", help="leave an effect out; several by repeating"
    )
    parser.add_argument("--data", type=Path, default=Path(tempfile.gettempdir()) / "femsense-improve")
    parser.add_argument("--steps", action="store_true", help="list what was done")
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--element", default="tet10", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.one is not None:
        one_run(given.one, given.element, given.without)
        return
    for name in given.case or [*(f"tet10/{hidden}" for hidden in HIDDEN), "tet4/nothing", "tet4/friction"]:
        element, hidden = name.split("/")
        folder = given.data / hidden
        if not (folder / "recording" / "recording.toml").is_file():
            print(f"making the recording of {hidden} …", flush=True)
            make(hidden, folder)
        alone, both = measure_factor(folder)
        runs = [timed(folder, element, given.without) for _ in range(given.runs)]
        show(name + "".join(f" without {effect}" for effect in given.without), runs)
        print(
            f"  one such factor of the quadratic bar: {1e3 * alone:.0f} ms alone, {1e3 * both:.0f} ms beside a second one",
            flush=True,
        )
        if given.steps:
            print("  " + "; ".join(runs[0]["steps"]))


if __name__ == "__main__":
    main()
