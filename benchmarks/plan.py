"""What the experiment advisor proposes, what that costs, and whether it comes true.

    python benchmarks/plan.py ROBOT …              # proposals for robots (finger, arm, …) as `femsense improve --plan` prints them
    python benchmarks/plan.py --true [NAME …]      # hide effects in what is proposed for a small arm, record it, and ask `improve`
    options: --table   print what is done; --file FILE   where results stand (plan.jsonl)

Each effect is hidden twice: in the least that is worth recording, and in the proposal. Recordings are made by the virtual rig on elements
split into eight. What is predicted is the dBIC of the effect at its usual size, which is near the size that is hidden.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

from loop_cases import ARM, EARTH

from femsense import FemsenseError, Robot, improve, load_recording, load_robot, simulate
from femsense.loop.design.advice import proposal_text
from femsense.loop.design.candidate_experiments import script_of
from femsense.loop.design.planner import Proposal, plan_experiment
from femsense.loop.thresholds import DEFAULTS

TINY_ARM = replace(ARM, name="tiny-arm", coarse=(5, 2, 2))
NOISE_M, FRAMES = 2e-4, 45
HIDDEN: tuple[dict[str, Any], ...] = (
    {"name": "cable_friction", "coefficient": 0.15},
    {"name": "creep", "fraction": 0.1, "time_s": 8.0},
    {"name": "cable_gain", "scale": 0.9},
    {"name": "cable_offset", "tension_n": {"b": 0.25}},
    {"name": "payload", "point_m": [0.075, 0.0, 0.01], "force_n": [0.0, 0.05, -0.06]},
    {"name": "soft_region", "center_m": [0.05, 0.0, 0.0], "radius_m": 0.02, "scale": 0.6},
    {"name": "geometry", "scale": 1.03},
    {"name": "depth_scale", "scale": 1.02},
)


def propose(names: list[str]) -> None:
    """Print what is proposed for robots."""
    for name in names:
        robot = load_robot(name)
        wall, cpu = time.perf_counter(), time.process_time()
        proposal = plan_experiment(robot)
        print(f"\n{name}: {time.perf_counter() - wall:.0f} s, {time.process_time() - cpu:.0f} s of one processor\n")
        print(proposal_text(proposal))


# --- does it come true -----------------------------------------------------------------------------------------------------


def come_true(robot: Robot, script: dict[str, Any], hidden: dict[str, Any]) -> dict[str, Any]:
    """Record a script with an effect hidden and return what `improve` says."""
    truth = {"law": "corotational", "refinements": 1, "substeps": 1}
    with tempfile.TemporaryDirectory() as folder:
        recording = load_recording(simulate(robot, {**script, "truth": truth, "effects": [hidden]}, Path(folder) / "recording"))
        try:
            loop = improve(robot, [recording])
        except FemsenseError as error:
            return {"verdict": f"refused: {error}", "named": [], "set": [], "frames": recording.frame_count}
    named = [e.name for e in loop.effects]
    confounded = sorted({n for p in loop.confounded if set(p.pair) & set(named) for n in p.pair} - set(named))
    return {
        "verdict": loop.verdict,
        "named": named,
        "set": confounded,
        "frames": recording.frame_count,
        "not_testable": [n.name for n in loop.not_testable],
    }


def outcome(hidden: dict[str, Any], result: dict[str, Any]) -> str:
    """Return in words what became of a hidden effect."""
    name = hidden["name"]
    others = [n for n in result["named"] if n not in (name, "stiffness")]
    if name in result["named"]:
        return "named" + (f" with {', '.join(others)}" if others else "")
    said = "in the set" if name in result["set"] else "not testable" if name in result.get("not_testable", []) else "missed"
    return said + (f", named {', '.join(others)}" if others else "")


def print_table(proposal: Proposal, done: dict[str, dict[str, Any]]) -> None:
    """Print prediction and outcome of every effect, before and after."""
    print(f"{'hidden':<16}{'least: usual size':<20}{'improve':<34}{'proposal: usual size':<23}improve")
    for hidden in HIDDEN:
        cells = []
        for which, identifiability in (("least", proposal.before), ("proposal", proposal.after)):
            rows = [r for r in identifiability.rows if r.name == hidden["name"]]
            best = max(rows, key=lambda r: r.dbic)
            said = (
                "not testable"
                if not best.testable
                else f"dBIC {best.dbic:.0f}" + ("" if best.dbic > DEFAULTS.evidence else ", unseen")
            )
            result = done.get(f"{hidden['name']} {which}")
            cells += [said, "–" if result is None else outcome(hidden, result)]
        print(f"{hidden['name']:<16}{cells[0]:<20}{cells[1]:<34}{cells[2]:<23}{cells[3]}")


def check(names: list[str], file: Path, only_table: bool) -> None:
    """Hide each effect in the least that is worth recording and in the proposal,
    and print what is predicted and what is found."""
    robot = TINY_ARM.robot(fine=False, law="corotational", gravity=EARTH, modulus=TINY_ARM.modulus)
    proposal = plan_experiment(robot, noise=NOISE_M, frames=FRAMES)
    print(proposal_text(proposal), "\n")
    scripts = {"least": script_of(proposal.setup, proposal.start, noise=NOISE_M), "proposal": proposal.scripts()[""]}
    lines = file.read_text().splitlines() if file.is_file() else []
    done: dict[str, dict[str, Any]] = {r["job"]: r for r in map(json.loads, lines)}
    for hidden in HIDDEN:
        for which, script in scripts.items():
            job = f"{hidden['name']} {which}"
            if only_table or job in done or (names and hidden["name"] not in names):
                continue
            done[job] = {"job": job, **come_true(robot, script, hidden)}
            with file.open("a") as out:
                out.write(json.dumps(done[job]) + "\n")
    print_table(proposal, done)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--true", action="store_true")
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--file", type=Path, default=Path("plan.jsonl"))
    options = parser.parse_args()
    if options.true or options.table:
        check(options.names, options.file, options.table)
    else:
        propose(options.names or ["finger", "arm"])


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()
