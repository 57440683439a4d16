"""Recovery of every effect on a small arm: is it named, and is its parameter within what the loop states?

    python benchmarks/effects.py [NAME …]

Truth is made by the virtual rig on a finer mesh than the declared arm, with its own integrators of friction and creep in small steps,
a modulus that is off, an unknown camera pose, and markers with noise of 0.1 mm beside errors of 0.2 mm in where they are glued.
"""

from __future__ import annotations

import sys
import time
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
from loop_cases import ARM, EARTH, Case, make_data

from femsense.effects.shape import robot_on_mesh
from femsense.fem.mesh import to_linear
from femsense.loop import LoopResult, improve

HIDDEN: tuple[tuple[str, dict[str, Any]], ...] = (
    ("tension", {"name": "gravity", "vector_m_s2": list(EARTH)}),
    ("tension", {"name": "stiffness", "scale": 1.15}),
    ("tension", {"name": "poisson", "poisson_ratio": 0.36}),
    ("tension", {"name": "soft_region", "center_m": [0.05, 0.0, 0.0], "radius_m": 0.018, "scale": 0.55}),
    ("tension", {"name": "discretisation", "element": "tet10"}),
    ("tension", {"name": "hyperelastic", "law": "neo_hookean"}),
    ("tension", {"name": "creep", "fraction": 0.15, "time_s": 6.0}),
    ("tension", {"name": "payload", "point_m": [0.075, 0.0, 0.01], "force_n": [0.0, 0.05, -0.08]}),
    ("tension", {"name": "base_compliance", "stiffness_n_m": 150.0}),
    ("tension", {"name": "base_compliance", "stiffness_n_m": np.inf, "rotation_stiffness_nm_rad": 0.5}),
    ("tension", {"name": "cable_friction", "coefficient": 0.2}),
    ("tension", {"name": "cable_friction", "coefficient": {"a": 0.1, "b": 0.1, "c": 0.1, "d": 0.4}}),
    ("displacement", {"name": "cable_friction", "coefficient": 0.25}),
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
)  # fmt: skip
STATED = 3.0
"""A parameter is found where its truth lies within so many standard deviations, or within 10 %."""


def recover(number: int, control: str, entry: dict[str, Any]) -> tuple[LoopResult, float, dict[str, Any]]:
    """Close the loop on data with one hidden effect; return the result, its time [s], and what was hidden as the loop would say it."""
    name = entry["name"]
    mesh_hidden, law_hidden = name == "discretisation", name == "hyperelastic"
    gravity = {"declared_gravity": name != "gravity"}
    hidden = () if mesh_hidden or law_hidden else (entry,)
    case = Case(number, "single", ARM, control, 1e-4, hidden, hyperelastic=law_hidden, **gravity)
    made = make_data(case, 7)
    declared = made.declared
    if law_hidden:
        declared = declared.with_body(
            declared.body.with_material(replace(declared.body.material, law="corotational", stretch_limit=np.inf))
        )
    if mesh_hidden:
        declared = robot_on_mesh(declared, to_linear(declared.body.mesh))
    began = time.process_time()
    loop = improve(declared, [made.recording])
    truth = dict(entry)
    if name == "stiffness":
        truth["scale"] = entry["scale"] * made.modulus_scale
    return loop, time.process_time() - began, truth


def row(loop: LoopResult, truth: dict[str, Any]) -> tuple[str, str]:
    """Return the outcome (named, in a set, missed) and value ± std for each parameter that is hidden."""
    name = truth["name"]
    effect = next((e for e in loop.effects if e["name"] == name), None)
    others = [e["name"] for e in loop.effects if e["name"] not in (name, "stiffness")]
    rivals = {n for pair in loop.confounded for n in pair["pair"]}
    if effect is None:
        untestable = name in {r["name"] for r in loop.not_testable}
        seen = "in set" if name in rivals else "not testable" if untestable else "MISSED"
        return seen, f"{loop.verdict}: " + ", ".join(others)
    outcome = "named" + (f" with {', '.join(others)}" if others else "")
    return outcome, "; ".join(
        _compared(key, effect["parameters"].get(key), value) for key, value in truth.items() if key != "name"
    )


def _compared(key: str, found: dict[str, Any] | None, truth: Any) -> str:
    if found is None:
        return f"{key} missing"
    if isinstance(truth, dict):
        value, std = found["value"], found["std"]
        if not isinstance(value, dict):
            value, std = {k: value for k in truth}, {k: std for k in truth}
        return ", ".join(
            _compared(f"{key}[{k}]", {"value": value.get(k), "std": (std or {}).get(k)}, v) for k, v in truth.items()
        )
    if isinstance(truth, str) or found["value"] is None or found["std"] is None:
        return f"{key} {_text(found['value'])} (true {_text(truth)})"
    value, std, true = (np.atleast_1d(np.asarray(v, dtype=float)) for v in (found["value"], found["std"], truth))
    if value.shape != true.shape:
        return f"{key} {_text(found['value'])} (true {_text(truth)})"
    good = bool((np.abs(value - true) <= np.maximum(STATED * std, 0.1 * np.linalg.norm(true))).all())
    return f"{key} {_text(found['value'])} ± {_text(found['std'])} (true {_text(truth)}){'' if good else ' OFF'}"


def _text(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_text(v) for v in value) + "]"
    return f"{value:.3g}" if isinstance(value, (int, float)) else str(value)


def main(names: list[str]) -> None:
    """Print one line for each hidden effect."""
    print(f"{'control':<13}{'hidden':<17}{'outcome':<26}{'held-out [mm]':<17}{'CPU [s]':<9}parameters")
    for number, (control, entry) in enumerate(HIDDEN):
        if names and entry["name"] not in names:
            continue
        loop, seconds, truth = recover(number, control, entry)
        outcome, values = row(loop, truth)
        error = f"{1e3 * loop.before['validation_rms_m']:.3f} → {1e3 * loop.after['validation_rms_m']:.3f}"
        print(f"{control:<13}{entry['name']:<17}{outcome:<26}{error:<17}{seconds:<9.0f}{values}", flush=True)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main(sys.argv[1:])
