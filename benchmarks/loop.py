"""Blind cases for the loop: how often it names what is hidden, stays silent where nothing is, and says that it does not know.

    python benchmarks/loop.py tune                    # the seeds that thresholds may be tuned on
    python benchmarks/loop.py report                  # the sealed ones: figures of README and docs come from these
    python benchmarks/loop.py tune --every 6          # some of each kind
    python benchmarks/loop.py tune --finer 2          # truths on meshes of half the size, instead of 1.3 to 1.5 times as many cells along a side
    python benchmarks/loop.py tune --linear           # declared meshes with linear elements, which `discretisation` mends

Results stand in a file beside the script's working directory (one line a case) and are not computed again; `--table` prints from it.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from collections.abc import Callable, Sequence
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from loop_cases import Case, Made, make_cases, make_data

from femsense import Equilibrium, FemsenseError, Robot, apply_effects, find_effect, improve
from femsense.core.arrays import FloatArray
from femsense.loop.data.trial import Groups
from femsense.loop.fit.marker_placement import placement_turns
from femsense.loop.fit.noise_components import Noise, whiten
from femsense.loop.result.tables import table_of
from femsense.many.engines import open_engine, spread
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.quasi_static_path import solve_path

SEEDS = {"tune": 1, "report": 20301}
COUNTS = {"null": 60, "single": 104, "two": 20, "outside": 21, "poor": 10}
NUISANCE = {"stiffness", "cable_offset"}
SAME_FAMILY = [{"cable_friction", "creep"}, {"poisson", "geometry"}, {"cable_gain", "cable_stretch"}]


# --- one case ----------------------------------------------------------------------------------------------------------------


def run_case(job: tuple[str, Case]) -> dict[str, Any]:
    """Make the data of a case, close the loop on them, and return what came of it."""
    warnings.simplefilter("ignore")
    which, case = job
    record: dict[str, Any] = {
        "number": case.number,
        "kind": case.kind,
        "robot": case.design.name,
        "control": case.control,
        "label": case.label,
        "hidden": list(case.hidden),
        "white_m": case.white_m,
        "placements": case.placements,
        "element": case.element,
    }
    try:
        made = make_data(case, SEEDS[which])
        if case.kind == "single":
            record["d_prime"] = detection_index(made, case.hidden[0])
        if case.kind == "two":
            record["d_primes"] = [detection_index(made, e) for e in case.hidden]
    except FemsenseError as error:  # of d′: the declared mesh does not stand where the true one does
        return {**record, "failed": f"no data: {error}"}
    began, cpu = time.perf_counter(), time.process_time()
    try:
        loop = improve(made.declared, [made.recording])
    except FemsenseError as error:
        return {**record, "failed": f"improve: {error}"}
    spent = time.process_time() - cpu
    floor = np.sqrt(3.0 * sum(v**2 for v in made.noise.values()))
    return {
        **record,
        "modulus_scale": made.modulus_scale,
        "verdict": loop.verdict,
        "sentence": loop.sentence,
        "effects": [{"name": e.name, "parameters": table_of(e.parameters)} for e in loop.effects],
        "confounded": table_of(loop.confounded),
        "not_testable": [n.name for n in loop.not_testable],
        "before_m": loop.before.validation_rms_m,
        "after_m": loop.after.validation_rms_m,
        "floor_m": float(floor),
        "noise_m": loop.noise_m,
        "left": table_of(loop.left.structure),
        "refits": [{k: getattr(c, k) for k in ("name", "dbic", "retained_share", "verdict")} for c in loop.candidates],
        "cpu_s": spent,
        "wall_s": time.perf_counter() - began,
    }


def detection_index(made: Made, hidden: dict[str, Any]) -> dict[str, float]:
    """Return d′ = |P W Δ|: a hidden effect's field on the declared mesh, beside what else is hidden,
    whitened by the true noise; pose, modulus, zeros and the fields of what else is hidden are projected out.
    Linear elements are quadratic there."""
    case = made.case
    robot = (
        made.declared
        if case.element == "tet10"
        else apply_effects(made.declared, [{"name": "discretisation", "element": "tet10"}])
    )
    others = [e for e in case.hidden if e is not hidden]
    scaled = apply_effects(robot, [{"name": "stiffness", "scale": made.modulus_scale}])
    unit = "tension_n" if case.control == "tension" else "displacement_m"
    step = 0.02 if case.control == "tension" else 1e-4
    variants = [apply_effects(scaled, [{"name": "stiffness", "scale": 1.01}])]
    variants += [apply_effects(scaled, [{"name": "cable_offset", unit: {name: step}}]) for name in robot.body.cable_names]
    base = _markers(scaled, made)
    beside = _markers(apply_effects(scaled, others), made)
    field = _markers(apply_effects(scaled, [*others, hidden]), made) - beside
    fields = [_markers(v, made) - base for v in variants]
    if hidden["name"] == "cable_offset":
        fields = fields[:1]
    fields += [base - made.T_robot_camera[:3, 3] if e["name"] == "depth_scale" else beside - base for e in others]
    if hidden["name"] == "depth_scale":
        camera = base - made.T_robot_camera[:3, 3]
        field = (hidden["scale"] - 1.0) * camera
    F, k, _ = base.shape
    x = base.reshape(-1, 3) - base.mean(axis=(0, 1))
    shifts = [np.broadcast_to(axis, x.shape) for axis in np.eye(3)]
    turns = [np.cross(axis, x) for axis in np.eye(3)]
    noise = Noise(made.noise, "")
    sweep = np.unique(made.recording.sweep, return_inverse=True)[1]
    placements = _walked(scaled, made, lambda r, e: placement_turns(r, r.marker_points, e.positions).reshape(-1, 3)).reshape(
        -1, 3, 3
    )
    groups = Groups(np.tile(np.arange(k), F), np.repeat(np.arange(F), k), np.repeat(sweep, k), np.arange(F * k), turns=placements)
    W = noise.whitener(groups)
    Z = np.stack([whiten(W, np.asarray(f).reshape(-1, 3)) for f in (*fields, *shifts, *turns)], axis=1)
    s = whiten(W, field.reshape(-1, 3))
    Q = np.linalg.svd(Z / np.linalg.norm(Z, axis=0), full_matrices=False)[0]
    left = s - Q @ (Q.T @ s)
    q = len(find_effect(hidden["name"]).parameters(robot, case.control)) or 1
    needed = np.sqrt(4.0 * (10.0 + q * np.log(3 * F * k)))
    return {
        "d": float(np.linalg.norm(left)),
        "needed": float(needed),
        "retained": float(np.linalg.norm(left) / np.linalg.norm(s)),
    }


def _markers(robot: Robot, made: Made) -> FloatArray:
    """Return the markers of a robot along the recording [m], shape (F, k, 3)."""
    return _walked(robot, made, lambda r, e: r.markers.positions(e.positions))


def _walked(robot: Robot, made: Made, observe: Callable[[Robot, Equilibrium], FloatArray]) -> FloatArray:
    """Return what is observed of a robot along the recording, shape (F, …)."""
    driven = DrivenRobot(robot, drive_of(robot, made.recording))
    frames = list(range(len(made.recording.time_s)))
    return np.array([observe(robot, state) for _, state, _, _ in solve_path(driven, frames, attrgetter("markers"))])


# --- scores --------------------------------------------------------------------------------------------------------------------


def wilson(hits: int, count: int) -> str:
    """Return a share with its 95 % interval (Wilson 1927)."""
    if not count:
        return "no case"
    z, p = 1.96, hits / count
    centre = (p + z * z / (2 * count)) / (1 + z * z / count)
    half = z * np.sqrt(p * (1 - p) / count + z * z / (4 * count * count)) / (1 + z * z / count)
    return f"{hits:3d} of {count:3d} = {100 * p:5.1f} % [{max(100 * (centre - half), 0.0):4.1f}, {100 * (centre + half):5.1f}]"


def named(record: dict[str, Any]) -> list[str]:
    """Return what was named beside what every case has (unless that is what is hidden)."""
    hidden = {e["name"] for e in record["hidden"]}
    own = NUISANCE | ({"discretisation"} if record.get("element") == "tet4" else set())
    return [e["name"] for e in record["effects"] if e["name"] not in own - hidden - {"cable_offset"}]


def answer_set(record: dict[str, Any]) -> set[str]:
    """Return the named effects with those that are said to be indistinguishable from them."""
    names = set(named(record))
    return names | {n for c in record["confounded"] if set(c["pair"]) & names for n in c["pair"]}


def _surely_false(record: dict[str, Any], hidden: set[str]) -> set[str]:
    """Return what is named, is not hidden, and is not said to be indistinguishable from anything that is."""
    pairs = [set(c["pair"]) for c in record["confounded"]]
    return {n for n in named(record) if n not in hidden | {"cable_offset"} and not any(n in p and p & hidden for p in pairs)}


def detectable(record: dict[str, Any]) -> bool:
    """Return whether the generator calls a hidden effect detectable."""
    return bool(record["d_prime"]["d"] > record["d_prime"]["needed"] and record["d_prime"]["retained"] >= 0.1)


def parameter_errors(record: dict[str, Any]) -> list[tuple[float, list[bool]]]:
    """Return the relative error of each value of a named effect,
    and whether the 95 % interval of each component holds the truth."""
    truth = record["hidden"][0]
    found = next(e for e in record["effects"] if e["name"] == truth["name"])["parameters"]
    result: list[tuple[float, list[bool]]] = []
    for key in (
        "scale",
        "poisson_ratio",
        "fraction",
        "coefficient",
        "stiffness_n_m",
        "tension_n",
        "displacement_m",
        "force_n",
        "vector_m_s2",
        "offset_m",
    ):
        if key not in truth or key not in found or (truth["name"] == "depth_scale" and key == "offset_m"):
            continue
        null = 0.45 if key == "poisson_ratio" else 1.0 if key == "scale" else 0.0
        for t, v, s in _matched(truth[key], found[key]["value"], found[key]["std"], null):
            size = np.linalg.norm(np.atleast_1d(t) - null)
            off = np.abs(np.atleast_1d(v) - np.atleast_1d(t))
            inside = [] if s is None else [bool(d <= 1.96 * w) for d, w in zip(off, np.atleast_1d(s)) if w is not None]
            result.append((float(np.linalg.norm(off) / size), inside))
    return result


def _matched(truth: Any, value: Any, std: Any, null: float) -> list[tuple[Any, Any, Any]]:
    if isinstance(truth, dict):
        value = value if isinstance(value, dict) else {k: value for k in truth}
        std = std if isinstance(std, dict) else {k: std for k in truth}
        return [(t, value.get(k, null), std.get(k)) for k, t in truth.items()]
    if isinstance(value, dict):
        return [(truth, float(np.mean(list(value.values()))), None)]
    return [(truth, value, std)]


def table(records: Sequence[dict[str, Any]]) -> None:
    """Print the scores of the study, with intervals."""
    done = [r for r in records if "failed" not in r]
    for r in records:
        if "failed" in r:
            print(f"case {r['number']} ({r['kind']}, {r['label']}): {r['failed']}")
    null = [r for r in done if r["kind"] == "null"]
    false = [r for r in null if named(r) or r["verdict"] == "unexplained"]
    print(f"{'score':58s}{'measured':42s}pass | ambitious")
    row("false alarm where nothing is hidden", wilson(len(false), len(null)), "<= 5 % | <= 1-2 %")
    single = [r for r in done if r["kind"] == "single"]
    seen = [r for r in single if detectable(r)]
    first = [r for r in seen if named(r)[:1] == [r["label"]]]
    row("first named is right (detectable, one hidden)", wilson(len(first), len(seen)), ">= 85 % | >= 95 %")
    row("truth within the answered set", wilson(sum(r["label"] in answer_set(r) for r in seen), len(seen)), ">= 95 % | >= 99 %")
    wrong = [r for r in single if named(r) and r["label"] not in answer_set(r)]
    row("named wrongly and confidently (all with one hidden)", wilson(len(wrong), len(single)), "<= 5 % | <= 1 %")
    errors = [e for r in first for e in parameter_errors(r)]
    if errors:
        sizes = np.array([e for e, _ in errors])
        row(
            "error of the parameter, median / 90 %",
            f"{100 * np.median(sizes):.1f} % / {100 * np.quantile(sizes, 0.9):.1f} %",
            "10 / 25 % | 5 / 15 %",
        )
        held = [c for _, inside in errors for c in inside]
        row("95 % interval holds the truth", wilson(sum(held), len(held)), "85-99 % | 92-98 %")
    shares = [_recovered(r) for r in first]
    if shares:
        row(
            "recovered share of held-out error, median / 10 %",
            f"{np.median(shares):.2f} / {np.quantile(shares, 0.1):.2f}",
            ">= 0.90 | >= 0.97 / 0.90",
        )
        ratio = [r["after_m"] / r["before_m"] for r in first if r["d_prime"]["d"] > 10]
        row("held-out error after / before, d' > 10, median", f"{np.median(ratio):.2f} (noise included)", "<= 0.5 | <= 0.25")
    outside = [r for r in done if r["kind"] == "outside"]
    for s in (1e-4, 3e-4):
        part = [r for r in outside if r["white_m"] == s]
        right = [r for r in part if r["verdict"] == "unexplained" or not named(r)]
        row(f"outside the list: no confident name, noise {1e3 * s:.1f} mm", wilson(len(right), len(part)), ">= 70 % | >= 90 %")
        row(
            f"  of them called unexplained, noise {1e3 * s:.1f} mm",
            wilson(sum(r["verdict"] == "unexplained" for r in part), len(part)),
            "",
        )
    two = [r for r in done if r["kind"] == "two"]
    hidden = [{e["name"] for e in r["hidden"]} for r in two]
    row("two hidden: both found", wilson(sum(h <= answer_set(r) for r, h in zip(two, hidden)), len(two)), ">= 50 % | >= 75 %")
    seen = [[d["d"] > d["needed"] and d["retained"] >= 0.1 for d in r["d_primes"]] for r in two]
    sure = [(r, h) for r, h, each in zip(two, hidden, seen) if all(each)]
    row(
        "  where each of the two is detectable in addition to the other",
        wilson(sum(h <= answer_set(r) for r, h in sure), len(sure)),
        ">= 50 % | >= 75 %",
    )
    right = [bool(h & answer_set(r)) and set(named(r)) <= h | {"cable_offset"} for r, h in zip(two, hidden)]
    row("two hidden: at least one, and no false one", wilson(sum(right), len(two)), ">= 90 % | >= 97 %")
    some = [ok for ok, each in zip(right, seen) if any(each)]
    row("  where at least one is detectable", wilson(sum(some), len(some)), ">= 90 % | >= 97 %")
    unsure = [ok or (bool(h & answer_set(r)) and not _surely_false(r, h)) for ok, r, h in zip(right, two, hidden)]
    row("  as before, names whose set holds a hidden one not false", wilson(sum(unsure), len(two)), "")
    poor = [r for r in done if r["kind"] == "poor"]
    unsaid = [r for r in poor if r["label"] in named(r) and not r["not_testable"]]
    row("undetectable effects are not named", wilson(len(poor) - len(unsaid), len(poor)), ">= 90 % | 100 %")
    sure = [r for r in unsaid if len(answer_set(r)) == len(set(named(r)))]
    row("  as before, or named as one of a set that is not distinguishable", wilson(len(poor) - len(sure), len(poor)), "")
    times = [r["cpu_s"] for r in done]
    row("time of improve, CPU, median / longest", f"{np.median(times):.0f} s / {np.max(times):.0f} s", "")
    power_curve(single)


def row(what: str, measured: str, goals: str) -> None:
    """Print one line of the table."""
    print(f"{what:58s}{measured:42s}{goals}")


def _recovered(r: dict[str, Any]) -> float:
    before, after, floor = r["before_m"] ** 2, r["after_m"] ** 2, r["floor_m"] ** 2
    return float((before - after) / max(before - floor, 1e-12))


def power_curve(single: Sequence[dict[str, Any]]) -> None:
    """Print how often the hidden effect is named, by its detection index."""
    print("\nd'/needed      cases  named  in the set  silent  another name")
    edges = [0.0, 0.25, 0.5, 1.0, 2.0, 4.0, np.inf]
    for low, high in pairwise(edges):
        part = [r for r in single if low <= r["d_prime"]["d"] / r["d_prime"]["needed"] < high]
        if part:
            right = sum(r["label"] in named(r) for r in part)
            inset = sum(r["label"] in answer_set(r) for r in part)
            silent = sum(not named(r) for r in part)
            print(
                f"{low:4.2f} … {high:4.2f}   {len(part):5d}  {right:5d}  {inset:10d}  {silent:6d}  "
                f"{sum(bool(named(r)) and r['label'] not in answer_set(r) for r in part):12d}"
            )


def failures(records: Sequence[dict[str, Any]]) -> None:
    """Print the cases that went wrong."""
    print("\nwhat went wrong:")
    for r in records:
        if "failed" in r:
            continue
        hidden = {e["name"] for e in r["hidden"]}
        wrong = named(r) and not (hidden & set(named(r)))
        missed = r["kind"] == "single" and detectable(r) and r["label"] not in named(r)
        if wrong or missed or (r["kind"] == "null" and r["verdict"] == "unexplained"):
            names = [(e["name"], {k: v["value"] for k, v in e["parameters"].items()}) for e in r["effects"]]
            d = (
                f"d'/needed {r['d_prime']['d'] / r['d_prime']['needed']:.1f} retained {r['d_prime']['retained']:.2f}"
                if "d_prime" in r
                else ""
            )
            print(
                f"  {r['number']:3d} {r['kind']:7s} {r['robot']:6s} {r['control']:12s} {1e3 * r['white_m']:.1f} mm "
                f"{r['hidden'] or r['label']} {d} -> {r['verdict']}: {names}; {1e3 * r['before_m']:.2f} -> "
                f"{1e3 * r['after_m']:.2f} mm (noise {1e3 * r['floor_m']:.2f})"
            )


def main() -> None:
    """Run the cases that are not yet in the file, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("which", choices=sorted(SEEDS))
    parser.add_argument("--every", type=int, default=1, help="take every so many-th case of each kind")
    parser.add_argument("--finer", type=int, default=None, help="cells of truths along each side, in units of the declared ones")
    parser.add_argument("--linear", action="store_true", help="declare linear elements")
    parser.add_argument("--out", type=Path, default=None)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--dask", help="as of femsense estimate")
    parser.add_argument("--table", action="store_true", help="print from the file, run nothing")
    options = parser.parse_args()
    kind = ("" if options.finer is None else f"-finer-{options.finer}") + ("-linear" if options.linear else "")
    out = options.out or Path(f"loop-{options.which}{kind}.jsonl")
    records = [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []
    known = {r["number"] for r in records}
    counted: dict[str, int] = {}
    jobs = []
    for case in make_cases(SEEDS[options.which], COUNTS, options.finer, "tet4" if options.linear else "tet10"):
        counted[case.kind] = counted.get(case.kind, 0) + 1
        if case.number not in known and (counted[case.kind] - 1) % options.every == 0:
            jobs.append((options.which, case))
    np.random.default_rng(0).shuffle(jobs)  # so that a part of the cases is a fair sample
    if not options.table:
        with open_engine(options.workers, options.dask, None) as engine, out.open("a") as file:
            for record in spread(engine, run_case, ((job,) for job in jobs)):
                records.append(record)
                file.write(json.dumps(record, default=float) + "\n")
                file.flush()
                print(
                    (
                        f"{len(records)} {record['kind']} {record['label']} {record.get('verdict', record.get('failed'))} "
                        f"{[e['name'] for e in record.get('effects', [])]}"
                    ),
                    flush=True,
                )
    table(records)
    failures(records)


if __name__ == "__main__":
    main()
