"""Is the verdict the same however the experiment is told, and is a wrong log blamed on no effect?

    python benchmarks/invariance.py               # what is not done yet, then the tables
    python benchmarks/invariance.py --table       # the tables of what is done
    python benchmarks/invariance.py control       # the permuted logs alone ("same": the ways to tell alone)
    options: --draws N   permuted logs (20); --file FILE   where results stand (invariance.jsonl); --jobs N   not more this time

A small arm of 24 quadratic tetrahedra with one effect hidden; every effect of the list is tried.
The order of sweeps is shuffled in the recording where the past of a sweep does not matter (nothing, or friction and cables that
end slack), and in the experiment where it does (creep). The negative control gives each frame the inputs of another frame: then
nothing that cables do explains what was seen.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "support")]

from arm import arm, record, sweeps  # noqa: E402 (the tests hold the arm and the ways to tell)
from changed import in_unit, log_permuted, renumbered, reordered, sweeps_shuffled, turned_world  # noqa: E402

from femsense import FemsenseError, Recording, Robot, improve  # noqa: E402
from femsense.core.pose import make_pose, rotation_from_vector, transform_points  # noqa: E402
from femsense.loop.result.tables import table_of  # noqa: E402

WORLD = make_pose(rotation_from_vector([0.7, -1.9, 0.4]), [0.3, -0.2, 0.5])
HIDDEN: dict[str, list[dict[str, Any]]] = {
    "nothing": [],
    "cable_gain": [{"name": "cable_gain", "scale": {"left": 0.8}}],
    "payload": [{"name": "payload", "point_m": [0.08, 0.0, 0.01], "force_n": [0.0, 0.06, -0.08]}],
    "cable_friction": [{"name": "cable_friction", "coefficient": 0.25}],
    "creep": [{"name": "creep", "fraction": 0.2, "time_s": 4.0}],
}
WAYS = ("as it is", "sweeps shuffled", "mesh in mm", "mesh in cm", "world turned", "mesh renumbered", "reordered")
CONTROL = ("nothing", "cable_gain", "cable_friction")


def experiment(hidden: str, *, shuffled: bool = False) -> tuple[Robot, Recording]:
    """Return the arm and its recording; `shuffled`: made with its sweeps in another order."""
    inputs, labels = sweeps(each=2)
    if shuffled:
        order = sorted(range(len(labels)), key=lambda k: "".join(reversed(labels[k])))  # stable: sweeps stay whole
        inputs, labels = inputs[order], [labels[k] for k in order]
    robot = arm((4, 1, 1))
    return robot, record(inputs, effects=HIDDEN[hidden], labels=labels, truth=robot)[0]


def told(hidden: str, way: str, folder: Path) -> tuple[Robot, Recording]:
    """Return the experiment in one of the ways to tell it."""
    if way == "sweeps shuffled" and hidden == "creep":
        return experiment(hidden, shuffled=True)
    robot, recording = experiment(hidden)
    rng = np.random.default_rng(2)
    if way == "sweeps shuffled":
        return robot, sweeps_shuffled(recording, rng)
    if way.startswith("mesh in"):
        return in_unit(robot, way.split()[-1], folder), recording
    if way == "world turned":
        return turned_world(robot, recording, WORLD)
    if way == "mesh renumbered":
        return renumbered(robot, rng), recording
    return reordered(robot, recording, rng) if way == "reordered" else (robot, recording)


def closed(robot: Robot, recording: Recording) -> dict[str, Any]:
    """Return verdict, names and numbers."""
    began = time.process_time()
    try:
        loop = improve(robot, [recording])
    except FemsenseError as error:
        return {"verdict": f"refused: {error}", "effects": []}
    effects = [{"name": e.name, "parameters": table_of(e.parameters)} for e in loop.effects]
    return {"verdict": loop.verdict, "effects": effects, "cpu_s": time.process_time() - began}


def numbers(result: dict[str, Any], way: str) -> dict[str, tuple[float, float]]:
    """Return every number that was named with its standard deviation, in the frame in which the experiment was made."""
    found: dict[str, tuple[float, float]] = {}
    for effect in result["effects"]:
        for key, p in effect["parameters"].items():
            value, std = p["value"], p["std"]
            if isinstance(value, list) and len(value) == 3 and way == "world turned":
                back = np.linalg.inv(WORLD)
                value = (transform_points(back, np.array([value]))[0] if key.endswith("_m") else back[:3, :3] @ value).tolist()
                std = None if std is None else [float(np.mean(std))] * 3
            values, stds = (
                v if isinstance(v, dict) else dict(enumerate(v)) if isinstance(v, list) else {"": v} for v in (value, std)
            )
            found |= {f"{effect['name']}.{key}.{k}": (v, stds.get(k) or 0.0) for k, v in values.items() if isinstance(v, float)}
    return found


def apart(result: dict[str, Any], plain: dict[str, Any], way: str) -> float:
    """Return by how many standard deviations the numbers differ, at most; what has none may differ by a thousandth."""
    ours, theirs = numbers(result, way), numbers(plain, "as it is")
    return max((abs(ours[k][0] - v) / (s or 1e-3 * abs(v) + 1e-9) for k, (v, s) in theirs.items() if k in ours), default=0.0)


def jobs(draws: int) -> list[tuple[str, str, str, int]]:
    """Return (table, hidden, way, draw)."""
    same = [("same", hidden, way, 0) for hidden in HIDDEN for way in WAYS]
    return same + [("control", CONTROL[d % len(CONTROL)], "log permuted", d) for d in range(draws)]


def run_job(job: tuple[str, str, str, int]) -> dict[str, Any]:
    """Return what the loop says of one job."""
    table, hidden, way, draw = job
    with tempfile.TemporaryDirectory() as folder:
        if table == "same":
            return closed(*told(hidden, way, Path(folder)))
        robot, recording = experiment(hidden)
        return closed(robot, log_permuted(recording, np.random.default_rng(draw)))


def print_tables(done: dict[str, dict[str, Any]]) -> None:
    """Print how the verdicts compare, and what permuted logs are blamed on."""
    print(f"{'hidden':<16}{'told':<20}{'verdict':<13}{'named':<44}{'apart [std]':<13}same")
    for hidden in HIDDEN:
        plain = done.get(str(("same", hidden, "as it is", 0)))
        for way in WAYS:
            result = done.get(str(("same", hidden, way, 0)))
            if result is None or plain is None:
                continue
            names, wanted = ([e["name"] for e in r["effects"]] for r in (result, plain))
            far = apart(result, plain, way)
            same = names == wanted and result["verdict"] == plain["verdict"] and far < 1.0
            print(
                f"{hidden:<16}{way:<20}{result['verdict']:<13}{', '.join(names) or '–':<44}{far:<13.2g}{'yes' if same else 'NO'}"
            )
    control = [r for key, r in done.items() if key.startswith("('control'")]
    verdicts = Counter(r["verdict"].split(":")[0] for r in control)
    names = Counter(e["name"] for r in control for e in r["effects"])
    confident = sum(r["verdict"] == "effects" for r in control)
    print(f"\n{len(control)} permuted logs: " + ", ".join(f"{v} {n}" for v, n in verdicts.most_common()))
    print(f"confident names: {confident}; named at all (also beside 'unexplained'): {dict(names) or 'none'}")
    print(f"cable_friction or creep: {names['cable_friction'] + names['creep']}")


def main() -> None:
    """Run what is not done yet and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("only", nargs="?", choices=("same", "control"))
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--jobs", type=int, default=10**6)
    parser.add_argument("--file", type=Path, default=Path("invariance.jsonl"))
    parser.add_argument("--table", action="store_true")
    options = parser.parse_args()
    lines = options.file.read_text().splitlines() if options.file.is_file() else []
    done = {r["job"]: r for r in map(json.loads, lines)}
    todo = [j for j in jobs(options.draws) if str(j) not in done and options.only in (None, j[0])]
    for job in todo[: 0 if options.table else options.jobs]:
        done[str(job)] = {"job": str(job), **run_job(job)}
        with options.file.open("a") as file:
            file.write(json.dumps(done[str(job)]) + "\n")
    print_tables(done)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()
