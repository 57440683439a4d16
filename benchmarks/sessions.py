"""Recordings of two sessions, and robots with chambers: what the loop makes of values that differ, and of none that does.

    python benchmarks/sessions.py [CASE …]        # those cases, or all; one line each

Truth is made on another mesh and by another law than the estimator's, with markers that repeat to 0.2 mm. Cables:
the arm of the tests, two recordings, sessions A and B. Chambers: the bar of `tests/end_to_end/test_pneumatic.py` by the virtual
rig on a finer mesh of quadratic elements.
"""

from __future__ import annotations

import sys
import tempfile
import time
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

from femsense import LoopResult, improve, load_recording, load_robot, simulate

TESTS = Path(__file__).parents[1] / "tests"
Entries = list[dict[str, Any]]
CABLES: dict[str, tuple[Entries, Entries]] = {
    "none": ([], []),
    "gain of all in B": ([], [{"name": "cable_gain", "scale": 1.2}]),
    "gain of one in B": ([], [{"name": "cable_gain", "scale": {"up": 0.8}}]),
    "offsets differ": (
        [{"name": "cable_offset", "tension_n": {"up": 0.3}}],
        [{"name": "cable_offset", "tension_n": {"left": 0.4, "up": -0.2}}],
    ),
    "depth in B": ([], [{"name": "depth_scale", "scale": 1.02}]),
    "same gain in both": ([{"name": "cable_gain", "scale": {"up": 0.8}}], [{"name": "cable_gain", "scale": {"up": 0.8}}]),
}
CHAMBERS: dict[str, Entries] = {
    "chambers, none": [],
    "chambers, offset": [{"name": "chamber_offset", "pressure_pa": 800.0}],
    "chambers, gain": [{"name": "chamber_gain", "scale": 0.8}],
}


def of_cables(name: str) -> LoopResult:
    """Close the loop on two sessions of the arm."""
    from arm import arm, record, sweeps

    inputs, labels = sweeps()
    lifted = inputs + (0.5 if name == "offsets differ" else 0.0)
    made = [record(lifted, effects=e, labels=labels, seed=i, noise=2e-4)[0] for i, e in enumerate(CABLES[name])]
    return improve(arm(law="neo_hookean"), [replace(r, session=s) for r, s in zip(made, "AB")])


def of_chambers(name: str) -> LoopResult:
    """Close the loop on a bar with a chamber."""
    from test_pneumatic import SCRIPT, write_pneumatic

    sweep = {"chambers": {"core": 10e3}, "rest": 1, "up": 3, "hold": 1, "down": 3}
    script = {
        **SCRIPT,
        "sweeps": [
            {**sweep, "label": label, "chambers": {"core": top}}
            for label, top in (("a", 10e3), ("b", 6e3), ("c", 11e3), ("d", 8e3))
        ],
        "contacts": [],
        "loads": [{"sweep": "c", "point_m": [0.1, 0.015, 0.0], "force_n": [0.0, 0.0, -0.15]}],
        "truth": {"refinements": 1, "element": "tet10", "law": "corotational", "substeps": 1},
        "effects": CHAMBERS[name],
        "markers": {"std_m": 5e-5, "occlusion": False},
    }
    with tempfile.TemporaryDirectory() as folder:
        robot = load_robot(write_pneumatic(Path(folder) / "robot"))
        return improve(robot, [load_recording(simulate(robot, script, Path(folder) / "recording"))])


def main() -> None:
    """Print one line a case: verdict, what is named with its values, and what these data do not distinguish from it."""
    warnings.simplefilter("ignore")
    sys.path[:0] = [str(TESTS / part) for part in ("support", "end_to_end")]
    for name in sys.argv[1:] or [*CABLES, *CHAMBERS]:
        began = time.process_time()
        loop = of_cables(name) if name in CABLES else of_chambers(name)
        found = "; ".join(
            f"{e.name} " + ", ".join(f"{k} {_short(v.value)}" for k, v in e.parameters.items()) for e in loop.effects
        )
        own = {e.name for e in loop.effects}
        pairs = sorted({" ~ ".join(p.pair) for p in loop.confounded if own & set(p.pair)})
        print(
            f"{name:<20}{loop.verdict:<13}{time.process_time() - began:5.0f} s  {found or '–'}  [{', '.join(pairs)}]", flush=True
        )


def _short(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _short(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_short(v) for v in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value


if __name__ == "__main__":
    main()
