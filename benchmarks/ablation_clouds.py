"""What the numbers of the rows of clouds are worth: recordings of a depth camera, asked with each number switched.

    python benchmarks/ablation_clouds.py FOLDER [--cases null,gain,gravity] [--only SURFACE_POINTS,… | --few 0,1,2,3]

The cases are those of `benchmarks/clouds.py` on the four-leg robot, seen as clouds alone; FOLDER holds their recordings. The tuning set of
`benchmarks/ablation.py` has no clouds. `--few` takes the markers too, with clouds in so many frames beside
them. Lines that stand in FOLDER/switches.jsonl already are read, not computed again.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from ablation import BASE, Switch
from clouds import declared_robot, recording_of

from femsense import Recording, improve
from femsense.core.errors import FemsenseError
from femsense.loop.fit.joint_fit import DECLARED_POSE_STD

INF = float("inf")
SWITCHED: dict[str, Any] = {
    "SURFACE_POINTS": 70,
    "VOXEL": 0.015,
    "RADIUS": 5.0,
    "SPACING": 0.9,
    "ROUNDS": INF,
    "STEEPEST": 0.3,
    "AROUND": 8,
    "LOPSIDED": INF,
    "REACH": 0.2,
    "FACING": 0.0,
    "SMOOTH": 0.12,
    "STANDS_OUT": INF,
    "FEWEST_ROWS": 4,
}
"""Number of `femsense.loop.data.surface_rows` → what it is switched to: half or twice as much, or no rule at all."""
SWITCHES = (
    BASE,
    *(Switch(name, {}, {}, {f"data.surface_rows.{name}": value}) for name, value in SWITCHED.items()),
    Switch("matchings", {}, {"matchings": 1}),
    Switch("DECLARED_POSE_STD", {}, {}, {"fit.joint_fit.DECLARED_POSE_STD": 10.0 * DECLARED_POSE_STD}),
)


def with_few_clouds(recording: Recording, count: int) -> Recording:
    """Return a recording with clouds in so many of its frames, evenly spread."""
    n = recording.frame_count
    kept = set(np.round(np.linspace(0, n - 1, count + 2)[1:-1]).astype(int).tolist())
    files = tuple(one if k in kept else (None,) * len(one) for k, one in enumerate(recording.cloud_files))
    return replace(recording, cloud_files=files)


def asked(folder: Path, case: str, switch: Switch, few: int | None = None) -> dict[str, Any]:
    """Return what the loop says of a case under a switch, by clouds alone, or by markers beside few clouds."""
    recording = recording_of(folder, "four-leg", case, 20, 1.0)
    measured = "clouds"
    if few is not None:
        recording, measured = with_few_clouds(recording, few), "both" if few else "markers"
    began = time.process_time()
    about = {"case": case, "switch": switch.name}
    try:
        with switch.in_force():
            loop = improve(declared_robot("four-leg", case), [recording], options=replace(switch.options(), measured=measured))
    except FemsenseError as error:
        return {**about, "failed": str(error)}
    return {
        **about,
        "verdict": loop.verdict,
        "named": [e.name for e in loop.effects],
        "held_mm": [1e3 * loop.before.validation_rms_m, 1e3 * loop.after.validation_rms_m],
        "cpu_s": time.process_time() - began,
    }


def in_words(record: dict[str, Any]) -> str:
    """Return a cell of the table."""
    if "failed" in record:
        return str(record["failed"])[:40]
    before, after = record["held_mm"]
    return f"{record['verdict']}: {', '.join(record['named']) or '–'}; {before:.3f} → {after:.3f} mm; {record['cpu_s']:.0f} s"


def main() -> None:
    """Ask what is not in the file yet, and print a line for each switch."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--cases", default="null,gain,gravity")
    parser.add_argument("--only", default=None)
    parser.add_argument("--few", default="", help="frames with clouds beside markers")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    options.folder.mkdir(parents=True, exist_ok=True)
    file = options.folder / "switches.jsonl"
    known = {(r["case"], r["switch"]): r for r in map(json.loads, file.read_text().splitlines())} if file.exists() else {}
    cases = options.cases.split(",")
    print("| switched | " + " | ".join(cases) + " |\n" + "|---" * (1 + len(cases)) + "|", flush=True)
    few = {f"markers and {count} clouds": int(count) for count in options.few.split(",") if count}
    for switch in [Switch(name, {}, {}) for name in few] or SWITCHES:
        if options.only is not None and switch.name not in options.only.split(","):
            continue
        cells = []
        for case in cases:
            if (case, switch.name) not in known:
                known[case, switch.name] = asked(options.folder, case, switch, few.get(switch.name))
                with file.open("a") as lines:
                    lines.write(json.dumps(known[case, switch.name]) + "\n")
            cells.append(in_words(known[case, switch.name]))
        value = SWITCHED.get(switch.name)
        print(f"| {switch.name}{'' if value is None else f' = {value}'} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
