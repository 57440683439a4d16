"""Robots that others built and recorded: what calibration leaves, what the loop names, and how far it is on runs that were not fitted.

    python benchmarks/real.py OUT [--data FOLDER] [--only tentacle …] [--ways 1 2 …] [--minutes M] [--calibrated]

Robots and recordings are made below OUT from the files of `shared/data`; nothing of these is copied. A row that stands in OUT already is
read, not computed again, and one that takes longer than M minutes says so. `--calibrated` leaves the loop out. docs/real-robots.md tells
what the rows mean; it prints rms of distances [mm], where the authors of the tentacle print means.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from real import tentacle

from femsense.calib.calibrate import calibrate
from femsense.core.errors import FemsenseError
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
HEADING = (
    "way of asking",
    "verdict",
    "named",
    "fitted [mm]",
    "held out [mm]",
    "handed back: fitted, held out",
    "noise, model error [mm]",
    "CPU min",
)


@dataclass(frozen=True)
class Asked:
    """One row: a robot, what is fitted and what is held out."""

    name: str
    robot: Path
    train: list[Path]
    held: list[Path]
    options: list[str] = field(default_factory=list)
    """Of `femsense improve`."""


def tentacle_rows(out: Path, data: Path, ways: list[int]) -> list[Asked]:
    """Return the ways of asking about the tentacle, by their numbers from 1."""
    chosen = [(i, way) for i, way in enumerate(tentacle.WAYS, 1) if not ways or i in ways]
    return [Asked(way.name, *tentacle.make(out / f"way-{i}", data, way)) for i, way in chosen]


SETS: Mapping[str, tuple[Callable[[Path, Path, list[int]], list[Asked]], str]] = {
    "tentacle": (
        tentacle_rows,
        "authors, mean marker error: prior 36.8 mm, fitted 15.8, a residual fitted to each pose 6.1. By hand with this model, mean marker error of single | "
        "two tendons: prior 26.5 | 32.2, modulus 10.8 | 11.8, markers and a pose a session 7.4 | 10.2, gain and zero a session 5.9 | 9.0",
    ),
}


def calibrated_rms(robot: Path, recordings: list[Path]) -> str:
    """Return the rms of what calibration leaves in recordings, each with its own pose [mm]."""
    body = load_robot(robot)
    found = []
    for recording in recordings:
        try:
            found.append(f"{1e3 * calibrate(body, load_recording(recording)).rms_m:.1f}")
        except FemsenseError as error:
            found.append(f"none ({error.args[0][:60] if error.args else error})")
    return " ".join(found) or "–"


def improved(asked: Asked, minutes: float) -> dict[str, Any] | str:
    """Return loop.json of a row, computed where it is missing; a text where it did not end."""
    folder = asked.robot.parent / "loop"
    if not (folder / "loop.json").is_file():
        command = [sys.executable, "-m", "femsense", "improve", str(asked.robot), *map(str, asked.train), "-o", str(folder)]
        command += ["--validation", *map(str, asked.held)] if asked.held else []
        began = time.perf_counter()
        try:
            done = subprocess.run(
                [*command, *asked.options, "--json"], capture_output=True, text=True, timeout=60 * minutes, check=False
            )
        except subprocess.TimeoutExpired:
            return f"not ended after {minutes:g} min"
        if not (folder / "loop.json").is_file():
            return " ".join(done.stderr.split())[:200]
        import resource

        spent = resource.getrusage(resource.RUSAGE_CHILDREN)
        taken = {"cpu_s": spent.ru_utime + spent.ru_stime, "wall_s": time.perf_counter() - began}
        (asked.robot.parent / "time.json").write_text(json.dumps(taken))
    document: dict[str, Any] = json.loads((folder / "loop.json").read_text(encoding="utf-8"))
    return document


def named(document: Mapping[str, Any]) -> str:
    """Return the effects of loop.json with their values."""
    parts = []
    for effect in document["effects"]:
        values = [f"{key} {_value(p)}" for key, p in effect["parameters"].items()]
        parts.append(f"{effect['name']} ({'; '.join(values)})")
    return ", ".join(parts) or "nothing"


def _value(parameter: Any) -> str:
    value, std = (parameter.get("value"), parameter.get("std")) if isinstance(parameter, dict) else (parameter, None)
    if isinstance(value, dict):
        return ", ".join(f"{k} {_value({'value': v, 'std': (std or {}).get(k)})}" for k, v in value.items())
    if isinstance(value, list) and value and isinstance(value[0], int | float):
        return "[" + ", ".join(f"{v:.3g}" for v in value) + "]" + (f" ± {np.max(std):.2g}" if std else "")
    if isinstance(value, int | float):
        return f"{value:.4g}" + (f" ± {std:.2g}" if isinstance(std, int | float) else "")
    return str(value)


def row(asked: Asked, minutes: float, loop: bool) -> list[str]:
    """Return the cells of a row."""
    own = asked.robot.parent
    if not loop:
        return [
            asked.name,
            "calibrated",
            "–",
            calibrated_rms(asked.robot, asked.train),
            calibrated_rms(asked.robot, asked.held),
            "",
            "",
            "",
        ]
    document = improved(asked, minutes)
    if isinstance(document, str):
        return [asked.name, document, *[""] * (len(HEADING) - 2)]
    before, after = document["before"], document["after"]
    back = own / "loop" / "robot.toml"
    spent = json.loads((own / "time.json").read_text())["cpu_s"] / 60 if (own / "time.json").is_file() else np.nan
    error = document.get("model_error_m")
    return [
        asked.name,
        document["verdict"],
        named(document),
        f"{1e3 * before['train_rms_m']:.1f} → {1e3 * after['train_rms_m']:.1f}",
        f"{1e3 * before['validation_rms_m']:.1f} → {1e3 * after['validation_rms_m']:.1f}",
        f"{calibrated_rms(back, asked.train)}; {calibrated_rms(back, asked.held)}",
        f"{1e3 * document['noise_m']:.2f}, {'–' if error is None else f'{1e3 * error:.1f}'}",
        f"{spent:.1f}",
    ]


def main() -> None:
    """Print the table of the data sets that were asked for."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("out", type=Path)
    ask.add_argument("--data", type=Path, default=DATA)
    ask.add_argument("--only", nargs="*", default=list(SETS), choices=list(SETS))
    ask.add_argument("--ways", nargs="*", type=int, default=[])
    ask.add_argument("--minutes", type=float, default=60.0)
    ask.add_argument("--calibrated", action="store_true")
    given = ask.parse_args()
    for name in given.only:
        make, note = SETS[name]
        print(f"\n## {name}\n\n{note}\n")
        print("| " + " | ".join(HEADING) + " |\n" + "|---" * len(HEADING) + "|", flush=True)
        for asked in make(given.out / name, given.data / name, given.ways):
            print("| " + " | ".join(row(asked, given.minutes, not given.calibrated)) + " |", flush=True)


if __name__ == "__main__":
    main()
