"""Recovery of every effect on a small arm, and what becomes of the improved robot.

    python benchmarks/effects.py [NAME …]              # the cases of these effects, or all; what is done already is kept
    python benchmarks/effects.py --table [NAME …]      # the tables of what is done
    options: --folder DIR   where results stand (effects-runs); --limit S   seconds a case may take (1500); --again

Truth is made by the virtual rig on a finer mesh than the declared arm,
with its own integrators of friction and creep in small steps, a modulus that is off by up to 20 %, an unknown camera pose, and
markers with noise of 0.1 mm beside errors of 0.2 mm in where they are glued. Of each case: is what is hidden named, how far is
its size off, does the 95 % interval hold the truth, what was it taken for; then the improved robot goes through the other
commands, and `improve` is asked again, on the same recording and on a fresh one of the same arm.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from loop_cases import ARM, EARTH, Case, Made, make_data, on_other_clamp

from femsense import Robot, load_robot, save_recording, save_robot
from femsense.app.cli import run
from femsense.fem.mesh import to_linear
from femsense.io.files import write_toml
from femsense.model.remeshing import robot_on_mesh

SMALL_ARM = replace(ARM, name="small-arm", coarse=(7, 2, 2), fine=(10, 3, 3))
HIDDEN: tuple[tuple[str, dict[str, Any]], ...] = (
    ("tension", {"name": "gravity", "vector_m_s2": list(EARTH)}),
    ("tension", {"name": "stiffness", "scale": 1.3}),
    ("tension", {"name": "poisson", "poisson_ratio": 0.34}),
    ("tension", {"name": "soft_region", "center_m": [0.05, 0.0, 0.0], "radius_m": 0.018, "scale": 0.55}),
    ("tension", {"name": "discretisation", "element": "tet10"}),
    ("tension", {"name": "hyperelastic", "law": "neo_hookean"}),
    ("tension", {"name": "creep", "fraction": 0.15, "time_s": 6.0}),
    ("tension", {"name": "payload", "point_m": [0.075, 0.0, 0.01], "force_n": [0.0, 0.05, -0.08]}),
    ("tension", {"name": "base_compliance", "stiffness_n_m": 150.0}),
    ("tension", {"name": "base_compliance", "rotation_stiffness_nm_rad": 0.5}),
    ("tension", {"name": "cable_friction", "coefficient": 0.2}),
    ("tension", {"name": "cable_friction", "coefficient": {"a": 0.1, "b": 0.1, "c": 0.1, "d": 0.4}}),
    ("displacement", {"name": "cable_friction", "coefficient": 0.3}),
    ("tension", {"name": "cable_offset", "tension_n": {"b": 0.25}}),
    ("displacement", {"name": "cable_offset", "displacement_m": {"b": 7e-4}}),
    ("tension", {"name": "cable_gain", "scale": {"c": 0.85}}),
    ("displacement", {"name": "cable_gain", "scale": {"c": 0.85}}),
    ("displacement", {"name": "cable_stretch", "stiffness_n_m": 1500.0}),
    ("displacement", {"name": "cable_slack", "displacement_m": {"a": 1e-3}}),
    ("tension", {"name": "geometry", "scale": 1.03}),
    ("displacement", {"name": "geometry", "scale": 0.97}),
    ("tension", {"name": "depth_scale", "scale": 1.02}),
    ("tension", {"name": "marker_offset", "offset_m": {"m10": [0.002, -0.001, 0.001]}}),
    ("tension", {"name": "density", "scale": 1.2}),
    ("displacement", {"name": "density", "scale": 0.8}),
    ("tension", {"name": "tip_mass", "point_m": [0.095, 0.0, 0.01], "mass_kg": 0.008}),
    ("tension", {"name": "cable_path", "radius_scale": {"b": 1.22}, "angle_rad": {"b": -0.12}}),
    ("tension", {"name": "cable_path", "angle_rad": {"a": 0.1, "b": 0.1, "c": 0.1, "d": 0.1}}),
    ("tension", {"name": "stiffness_gradient", "axis_m": [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]], "per_m": -6.0}),
    ("tension", {"name": "rest_shape", "axis_m": [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]], "curvature_1_m": [1.0, 0.0]}),
    ("tension", {"name": "cable_coupling", "from": "a", "to": "b", "share": 0.12}),
    ("displacement", {"name": "cable_coupling", "from": "a", "to": "b", "share": 0.12}),
    ("tension", {"name": "softening", "share": 0.25, "energy_j_m3": 300.0}),
)
SEED, FRESH_SEED = 7, 1007
ALWAYS_OFF = ("stiffness",)
"""The modulus of every case is off: naming it is right."""


# --- one case --------------------------------------------------------------------------------------------------------------


def make(number: int) -> tuple[Robot, Made, Made]:
    """Return the declared arm of a case, its recording, and a fresh one of the same truth."""
    control, entry = HIDDEN[number]
    name = entry["name"]
    hidden = () if name in ("discretisation", "hyperelastic") else (entry,)
    case = Case(
        number,
        "single",
        SMALL_ARM,
        control,
        1e-4,
        hidden,
        hyperelastic=name == "hyperelastic",
        declared_gravity=name != "gravity",
    )
    made = make_data(case, SEED)
    fresh = make_data(replace(case, modulus_scale=made.modulus_scale), FRESH_SEED)
    declared = made.declared
    if name == "hyperelastic":
        declared = declared.with_body(
            declared.body.with_material(replace(declared.body.material, law="corotational", stretch_limit=np.inf))
        )
    if name == "discretisation":
        declared = robot_on_mesh(declared, to_linear(declared.body.mesh))
    return declared, made, fresh


def command(*words: Any) -> tuple[dict[str, Any] | None, str]:
    """Run a command of femsense; return what it says with --json, and what went wrong ("" for nothing)."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(io.StringIO()):
        status = run([*(str(w) for w in words), "--json"])
    document = json.loads(said.getvalue())
    return (None, f"{words[0]} ends with {status}: {document['error']}") if "error" in document else (document, "")


def run_case(number: int, folder: Path) -> dict[str, Any]:
    """Close the loop on a case, use the improved robot, and ask again."""
    control, entry = HIDDEN[number]
    declared, made, fresh = make(number)
    robot, first, other, out = folder / "robot", folder / "recording", folder / "fresh", folder / "improved"
    save_robot(declared, robot)
    for recording, where in ((made.recording, first), (fresh.recording, other)):
        save_recording(recording, where)
    truth = on_other_clamp(dict(entry), declared, load_robot(robot))
    if entry["name"] == "stiffness":
        truth["scale"] = entry["scale"] * made.modulus_scale
    began = time.process_time()
    loop, error = command("improve", robot, first, "-o", out, "--again")
    record: dict[str, Any] = {
        "number": number,
        "control": control,
        "truth": truth,
        "modulus_scale": made.modulus_scale,
        "improve_cpu_s": time.process_time() - began,
        "error": error,
    }
    if loop is None:
        return record
    record |= {key: loop[key] for key in ("verdict", "sentence", "effects", "confounded", "noise_m")}
    record["not_testable"] = [n["name"] for n in loop["not_testable"]]
    record["refits"] = [
        {k: r.get(k) for k in ("name", "dbic", "verdict", "step")} for c in loop["candidates"] for r in c["refits"]
    ]
    record["before_m"], record["after_m"] = loop["before"]["validation_rms_m"], loop["after"]["validation_rms_m"]
    record["commands"] = use(out, other, folder, control)
    for key, where in (("second", first), ("second_fresh", other)):
        again, error = command("improve", out, where, "-o", folder / key, "--again")
        record[key] = error or [again["verdict"], *(e["name"] for e in again["effects"])]  # type: ignore[index]
    record["cpu_s"] = time.process_time()
    return record


def use(robot: Path, recording: Path, folder: Path, control: str) -> list[str]:
    """Take an improved robot through the other commands; return what went wrong."""
    script = folder / "script.toml"
    top = SMALL_ARM.tension if control == "tension" else 4e-3
    write_toml(
        script,
        {
            "format": "femsense-script-1",
            "actuation": control,
            "sweeps": [{"label": label, "cables": {"a": top}, "rest": 1, "up": 1, "down": 1} for label in ("free", "s")],
            "truth": {"refinements": 0, "law": "corotational", "substeps": 1},
            "camera": {"eye_m": [0.05, 0.25, 0.3], "target_m": [0.05, 0.0, 0.0]},
            "contacts": [{"sweep": "s", "point_m": [0.08, 0.0, 0.01], "force_n": 0.1}],
            "markers": {"std_m": 1e-4},
        },
    )
    made, run, calibration = folder / "simulated", folder / "run", folder / "calibration.json"
    jobs: tuple[tuple[Any, ...], ...] = (
        ("inspect", robot),
        ("calibrate", robot, recording, "-o", calibration),
        ("simulate", robot, script, "-o", made),
        ("estimate", robot, made, "-o", run, "--at", "0.08,0,0.01", "--again"),
        ("export", run, "-o", folder / "robot.glb"),
        ("report", robot),
    )
    return [error for job in jobs for error in [command(*job)[1]] if error]


# --- tables ----------------------------------------------------------------------------------------------------------------


def outcome(record: dict[str, Any]) -> str:
    """Return whether what is hidden is named, or what was said in its place."""
    name = record["truth"]["name"]
    names = [e["name"] for e in record["effects"]]
    others = [n for n in names if n != name and n not in ALWAYS_OFF]
    if name in names:
        return "named" + (f" with {', '.join(others)}" if others else "")
    confounded = {n for pair in record["confounded"] if set(pair["pair"]) & set(names) for n in pair["pair"]}
    said = "in the set" if name in confounded else "not testable" if name in record["not_testable"] else "MISSED"
    return said + (f", named {', '.join(others)}" if others else f" ({record['verdict']})")


def confused(record: dict[str, Any]) -> str:
    """Return what these data cannot tell from what is hidden, as the loop says."""
    name = record["truth"]["name"]
    return ", ".join(sorted({n for pair in record["confounded"] if name in pair["pair"] for n in pair["pair"]} - {name})) or "–"


def sizes(record: dict[str, Any]) -> Iterator[tuple[str, float, float, float | None, bool | None]]:
    """Yield label, true value, found value, its standard deviation, and whether the 95 % interval holds the truth."""
    truth = record["truth"]
    found = next((e["parameters"] for e in record["effects"] if e["name"] == truth["name"]), {})
    for key, true in truth.items():
        if key == "name" or key not in found or isinstance(true, str):
            continue
        value, std = found[key]["value"], found[key]["std"]
        for label, t, v, s in _numbers(key, true, value, std):
            yield label, t, v, s, None if s is None else bool(abs(v - t) <= 1.96 * s)


def _numbers(label: str, true: Any, value: Any, std: Any) -> Iterator[tuple[str, float, float, float | None]]:
    if isinstance(true, dict):
        for k, t in true.items():
            v, s = (value.get(k), (std or {}).get(k)) if isinstance(value, dict) else (value, std)
            if v is not None:
                yield from _numbers(f"{label}[{k}]", t, v, s)
    elif isinstance(true, list):
        for i, (t, v) in enumerate(zip(true, value)):
            yield from _numbers(f"{label}[{i}]", t, v, std[i] if isinstance(std, list) else None)
    elif not isinstance(value, dict):
        yield label, true, value, std


def size_text(record: dict[str, Any]) -> str:
    """Return found ± std (true), and whether the interval holds it, for each number that is hidden."""
    parts = []
    for label, true, value, std, holds in sizes(record):
        spread = "" if std is None else f" ± {std:.2g}"
        parts.append(f"{label} {value:.4g}{spread} (true {true:.4g}{'' if holds is None else ', in' if holds else ', OUT'})")
    return "; ".join(parts)


def print_tables(records: list[dict[str, Any]]) -> None:
    """Print recovery, then what becomes of the improved robots."""
    wide = max([len(outcome(r)) for r in records if not r["error"]] + [10]) + 2
    print(
        f"{'control':<13}{'hidden':<17}{'outcome':<{wide}}{'held-out [mm]':<17}{'CPU [s]':<9}{'not distinguishable from':<30}size"
    )
    held = count = named = 0
    for r in records:
        name = r["truth"]["name"]
        if r["error"]:
            print(f"{r['control']:<13}{name:<17}{r['error']}")
            continue
        error = f"{1e3 * r['before_m']:.3f} → {1e3 * r['after_m']:.3f}"
        print(
            f"{r['control']:<13}{name:<17}{outcome(r):<{wide}}{error:<17}{r['improve_cpu_s']:<9.0f}{confused(r):<30}{size_text(r)}"
        )
        named += outcome(r).startswith("named")
        inside = [holds for *_, holds in sizes(r) if holds is not None]
        held, count = held + sum(inside), count + len(inside)
    print(f"\nnamed: {named} of {len(records)}; 95 % intervals that hold the truth: {held} of {count}\n")
    print(f"{'control':<13}{'hidden':<17}{'improve again':<26}{'on a fresh recording':<34}other commands")
    for r in (r for r in records if not r["error"]):
        again, fresh = (" ".join(r[k]) if isinstance(r[k], list) else r[k] for k in ("second", "second_fresh"))
        print(f"{r['control']:<13}{r['truth']['name']:<17}{again:<26}{fresh:<34}{'; '.join(r['commands']) or 'all run'}")


# --- all cases -------------------------------------------------------------------------------------------------------------


def main() -> None:
    """Run what is not done yet, each case in a process of its own, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--folder", type=Path, default=Path("effects-runs"))
    parser.add_argument("--limit", type=float, default=1500.0)
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--again", action="store_true")
    parser.add_argument("--case", type=int)
    options = parser.parse_args()
    if options.case is not None:
        folder = options.folder / f"{options.case:02d}"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "result.json").write_text(json.dumps(run_case(options.case, folder), indent=1))
        return
    chosen = [i for i, (_, e) in enumerate(HIDDEN) if not options.names or e["name"] in options.names]
    for i in chosen:
        file = options.folder / f"{i:02d}" / "result.json"
        if options.table or (file.is_file() and not options.again):
            continue
        try:
            subprocess.run(
                [sys.executable, __file__, "--case", str(i), "--folder", str(options.folder)], timeout=options.limit, check=False
            )
        except subprocess.TimeoutExpired:
            print(f"{HIDDEN[i][1]['name']}: not done within {options.limit:g} s", file=sys.stderr)
    files = [options.folder / f"{i:02d}" / "result.json" for i in chosen]
    print_tables([json.loads(f.read_text()) for f in files if f.is_file()])


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()
