"""Robots that others built and recorded: what calibration leaves, what the loop names, and how far it is on runs that were not fitted.

    python benchmarks/real.py OUT [--data FOLDER] [--only tentacle …] [--ways 1 2 …] [--minutes M]
                              [--calibrated | --weights | --by-hand | --fitted | --states]

Robots and recordings are made below OUT from the files of `shared/data`; nothing of these is copied. A row that stands in OUT already is
read, not computed again, and one that takes longer than M minutes says so. `--calibrated` leaves the loop out. docs/studies/real-robots.md tells
what the rows mean; it prints rms of distances [mm], where the authors of the tentacle print means.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from real import arm, tentacle, trunk
from real.weights import fitted_by_weights

from femsense import FemsenseError, calibrate, estimate, load_recording, load_robot, solve_equilibrium
from femsense.core.pose import transform_points

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
HEADING = (
    "variant",
    "verdict",
    "effects",
    "fitted [mm]",
    "held out [mm]",
    "returned robot: fitted, held out",
    "with the correction, held out [mm]",
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
    return [Asked(way.name, *tentacle.make(out / f"way-{i}", data, way), list(way.options)) for i, way in chosen]


def trunk_rows(out: Path, data: Path, ways: list[int]) -> list[Asked]:
    """Return the trunk without a weight and with one; then each with the run without it as its reference, without it half a second later; at last
    the same on the robot that the first row returns, where that is there."""
    robot, made = trunk.make(out, data)
    free = ["cable_gain", "cable_offset", "cable_stretch", "density", "stiffness"]
    loads = ["payload", "tip_mass"]
    twin = ["--reference", str(made["none"]), str(made["none-held"])]
    rows = [
        ("nothing hung on", "none", free, []),
        ("100 g hung on", "load", [*free, *loads], []),
        ("nothing hung on, payload offered", "none", [*free, *loads], []),
        ("100 g hung on, the run without as the reference", "load", loads, twin),
        ("nothing hung on, half a second later, the run without as the reference", "later", loads, twin),
        ("100 g hung on, the same reference, the robot of the first row", "load", loads, twin),
    ]
    improved_robot = out / "way-1" / "loop"
    asked = []
    for i, (name, run, effects, options) in enumerate(rows, 1):
        if ways and i not in ways:
            continue
        if i == len(rows) and not (improved_robot / "robot.toml").is_file():
            continue
        own = out / f"way-{i}" / "robot"
        shutil.copytree(improved_robot if i == len(rows) else robot, own, dirs_exist_ok=True)
        asked.append(Asked(name, own, [made[run]], [made[f"{run}-held"]], ["--effects", *effects, *options]))
    return asked


def beam_rows(out: Path, data: Path, ways: list[int]) -> list[Asked]:
    """Return the beam without and with declared gravity, fitted on 0 and 0.51 N, judged on 1.00 N."""
    train, held = [data / "recordings" / n for n in ("gravity_a", "load52_a")], [data / "recordings" / "load101_a"]
    rows = []
    for i, (name, robot) in enumerate((("weightless", "robot"), ("gravity declared", "robot_gravity")), 1):
        if not ways or i in ways:
            own = out / f"way-{i}" / "robot"
            shutil.copytree(data / robot, own, dirs_exist_ok=True)
            rows.append(Asked(name, own, train, held))
    return rows


def arm_rows(out: Path, data: Path, ways: list[int]) -> list[Asked]:
    """Return the two days of the arm, without other laws of the material, and then with them: under these its chambers blow up,
    and each state takes many steps."""
    asked = [(day, options) for options in (["--without", "hyperelastic"], []) for day in arm.MIDDLES_MM]
    chosen = [(i, *one) for i, one in enumerate(asked, 1) if not ways or i in ways]
    return [
        Asked(day + (", the declared law" if options else ""), *arm.make(out / f"way-{i}", data, day), options)
        for i, day, options in chosen
    ]


SETS: Mapping[str, tuple[Callable[[Path, Path, list[int]], list[Asked]], str]] = {
    "tentacle": (
        tentacle_rows,
        "authors, mean marker error: prior 36.8 mm, fitted 15.8, a residual fitted to each pose 6.1. By hand with this "
        "model, mean marker error of single | "
        "two tendons: prior 26.5 | 32.2, modulus 10.8 | 11.8, markers and a pose a session 7.4 | 10.2, gain and zero a "
        "session 5.9 | 9.0",
    ),
    "trunk": (
        trunk_rows,
        "a linear map of the motor angles to the tip leaves 18.4 mm rms; the weight of 0.98 N shifts it by 10.6 mm rms",
    ),
    "beam": (
        beam_rows,
        "a repeat of the run at 1.00 N differs by 0.59 mm rms; an independent solver leaves 0.83 mm there (docs/studies/beam-study.md)",
    ),
    "arm": (
        arm_rows,
        (
            "linear maps leave 5.4 mm (encoders) and 36.8 mm (pressures) of the tip; see docs/studies/real-robots.md for what stops "
            "the model"
        ),
    ),
}


def print_by_hand(out: Path, data: Path) -> None:
    """Print the mean marker error of the tentacle with the authors' pose and a modulus that is given:
    the base marker is left out."""
    runs = tentacle.read_runs(data)
    poses = {s: tentacle.declared_pose([r for r in runs if r.session == s]) for s in "AB"}
    print("| density [kg/m³] | modulus [kPa] | one tendon [mm] | two tendons [mm] |\n|---|---|---|---|")
    for density, modulus in ((1500.0, 505e3), (1100.0, 505e3), (1100.0, 424e3), (1100.0, 384e3), (1100.0, 349e3)):
        robot = load_robot(tentacle.make_robot(out / f"by-hand-{density:g}", density))
        body = robot.body.with_stiffness_scale(modulus / tentacle.MODULUS_PA)
        errors: dict[bool, list[float]] = {False: [], True: []}
        for run in runs:
            state = solve_equilibrium(body, tension=dict(zip(body.cable_names, run.tensions)))
            measured = transform_points(poses[run.session], run.parts.mean(axis=0))
            off = np.linalg.norm(robot.markers.positions(state.positions) - measured, axis=1)[1:]
            errors[bool(run.tensions.all())] += off.tolist()
        print(
            f"| {density:g} | {modulus / 1e3:.0f} | {1e3 * np.mean(errors[False]):.1f} | {1e3 * np.mean(errors[True]):.1f} |",
            flush=True,
        )


def print_states(data: Path) -> None:
    """Print the states of the arm that are fitted or held out: where its tip is under the pressures of chambers 1 to 3 of each segment."""
    print("| recording | time [s] | pressures [psi] | tip aside, below the base [mm] |\n|---|---|---|---|")
    for name in ("apr_4_1", "apr_4_2", "apr_5_1"):
        for state in arm.read_states(data, name):
            psi = ", ".join(f"{p / arm.PSI_PA:.1f}" for p in state.pressures)
            aside, _, height = 1e3 * (state.markers[4] - state.markers[0])
            print(f"| {name} | {state.time_s:.0f} | {psi} | {aside:.1f}, {-height:.1f} |")


def print_weights(out: Path, data: Path) -> None:
    """Print the force at the tip of the trunk that markers show, with and without the weight."""
    robot, made = trunk.make(out, data)
    better = out / "way-1" / "loop"
    for name, body in (("as declared", robot), ("as the run without the weight taught it", better)):
        if not (body / "robot.toml").is_file():
            continue
        model = load_robot(body)
        known = calibrate(model, load_recording(made["none"]))
        for recording in ("none-held", "load-held"):
            run = estimate(model, load_recording(made[recording]), known, at=[[0.0, 0.0, -1e-3 * trunk.DISCS_MM[-1]]])
            force = np.array([c.force_n_xyz for c in run.contacts])
            std = np.array([c.force_std_n_xyz for c in run.contacts])
            seen = ", ".join(f"{m:+.2f}" for m in force.mean(axis=0))
            spread = ", ".join(f"{s:.2f}" for s in force.std(axis=0))
            print(
                f"| {name} | {recording} | [{seen}] N | over frames [{spread}] N | stated "
                f"{np.median(std, axis=0).round(2).tolist()} N | "
                f"true [0, 0, {-trunk.WEIGHT_N if recording.startswith('load') else 0:.2f}] N |",
                flush=True,
            )


def print_pairs(out: Path, data: Path) -> None:
    """Print the force at the tip of the trunk by pairs: two moments at the same command,
    and what distinguishes them but the inputs.

    In the pair with the weight it is looked for; in a pair of two runs without it (the same frames,
    the second half a second later) nothing is.
    """
    robot, _ = trunk.make(out, data)
    model = load_robot(robot)
    bare, heavy = (trunk.read_run(data, loaded=loaded) for loaded in (False, True))
    frames = trunk.still_frames([bare, heavy], 48)[1::2]
    pairs = ("with the weight", heavy, -trunk.WEIGHT_N), ("half a second later", trunk.later(bare), 0.0)
    parts = {"all": (slice(None), slice(None)), "sideways": (slice(None), slice(2)), "along the hose": (slice(None), slice(2, 3))}
    parts |= {f"disc {i + 1}": (slice(i, i + 1), slice(None)) for i in range(len(trunk.DISCS_MM))}
    for name, other, true in pairs:
        responses, differences = trunk.shifts_between(model, bare, other, frames)
        for part, (discs, axes) in parts.items():
            force, std, frame_std = trunk.force_of(responses[:, discs, axes], differences[:, discs, axes])
            seen = ", ".join(f"{f:+.2f} ± {s:.2f}" for f, s in zip(force, std))
            print(
                f"| difference of pairs | {name} | {part} | [{seen}] N | over frames {frame_std.round(2).tolist()} N | true [0, 0, {true:.2f}] N |",
                flush=True,
            )


def print_fitted(rows: list[Asked]) -> None:
    """Print what calibration within the loop leaves by both weights (docs/reference/closing-the-loop-rules.md, section 4)."""
    print(
        "| variant | declared, held out [mm] | fitted; held out [mm] | modulus | weights with the model error: fitted; held out | modulus | corrected |"
    )
    print("|---" * 7 + "|")
    for asked in rows:
        print(f"| {asked.name} | " + " | ".join(fitted_by_weights(asked.robot, asked.train, asked.held)) + " |", flush=True)


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
        command += ["--correct", *(["--validation", *map(str, asked.held)] if asked.held else [])]
        began, spent = time.perf_counter(), children_s()
        try:
            done = subprocess.run(
                [*command, *asked.options, "--json"], capture_output=True, text=True, timeout=60 * minutes, check=False
            )
        except subprocess.TimeoutExpired:
            return f"not ended after {minutes:g} min"
        if not (folder / "loop.json").is_file():
            return " ".join(done.stderr.split())[:200]
        taken = {"cpu_s": children_s() - spent, "wall_s": time.perf_counter() - began}
        (asked.robot.parent / "time.json").write_text(json.dumps(taken))
    document: dict[str, Any] = json.loads((folder / "loop.json").read_text(encoding="utf-8"))
    return document


def children_s() -> float:
    """Return the processor time of all commands that have ended [s]."""
    import resource

    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def named(document: Mapping[str, Any]) -> str:
    """Return the effects of loop.json with their values, and what was fitted along with them."""
    parts = [_with_values(effect["name"], effect["parameters"]) for effect in document["effects"]]
    along = [_with_values(*item) for item in document.get("fitted_along", {}).items()]
    return (", ".join(parts) or "nothing") + (f"; fitted along: {', '.join(along)}" if along else "")


def _with_values(name: str, parameters: Mapping[str, Any]) -> str:
    return f"{name} ({'; '.join(f'{key} {_value(p)}' for key, p in parameters.items())})"


def _value(parameter: Any) -> str:
    value, std = (parameter.get("value"), parameter.get("std")) if isinstance(parameter, dict) else (parameter, None)
    if isinstance(value, dict):
        return ", ".join(f"{k} {_value({'value': v, 'std': (std or {}).get(k)})}" for k, v in value.items())
    if isinstance(value, list) and value and isinstance(value[0], int | float):
        return "[" + ", ".join(f"{v:.3g}" for v in value) + "]" + (f" ± {np.max(std):.2g}" if std else "")
    if isinstance(value, int | float):
        return f"{value:.4g}" + (f" ± {std:.2g}" if isinstance(std, int | float) else "")
    return str(value)


def corrected(correction: Mapping[str, Any]) -> str:
    """Return what an empirical correction leaves of held-out markers [mm], and whether it is returned."""
    after = correction.get("validation_rms_after_m")
    return "–" if after is None else f"{1e3 * after:.1f} ({'returned' if correction['accepted'] else 'rejected'})"


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
            "",
        ]
    document = improved(asked, minutes)
    if isinstance(document, str):
        return [asked.name, document, *[""] * (len(HEADING) - 2)]
    before, after = document["before"], document["after"]
    back = own / "loop" / "robot.toml"
    spent = json.loads((own / "time.json").read_text())["cpu_s"] / 60 if (own / "time.json").is_file() else np.nan
    error = (document.get("model_error") or {}).get("held_out_m")
    return [
        asked.name,
        document["verdict"],
        named(document),
        f"{1e3 * before['train_rms_m']:.1f} → {1e3 * after['train_rms_m']:.1f}",
        f"{1e3 * before['validation_rms_m']:.1f} → {1e3 * after['validation_rms_m']:.1f}",
        f"{calibrated_rms(back, asked.train)}; {calibrated_rms(back, asked.held)}",
        corrected(document.get("correction") or {}),
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
    ask.add_argument("--weights", action="store_true", help="the force at the tip of the trunk, instead")
    ask.add_argument("--by-hand", action="store_true", help="the tentacle with the authors' pose and given moduli, instead")
    ask.add_argument("--fitted", action="store_true", help="what calibration leaves by the loop's weights, instead")
    ask.add_argument("--states", action="store_true", help="where the tip of the arm was measured, instead")
    given = ask.parse_args()
    if given.states:
        print_states(given.data / "arm")
        return
    if given.weights:
        print_pairs(given.out / "trunk", given.data / "trunk")
        print_weights(given.out / "trunk", given.data / "trunk")
        return
    if given.by_hand:
        print_by_hand(given.out / "tentacle", given.data / "tentacle")
        return
    for name in given.only if given.fitted else ():
        print_fitted(SETS[name][0](given.out / name, given.data / name, given.ways))
    for name in () if given.fitted else given.only:
        make, note = SETS[name]
        print(f"\n## {name}\n\n{note}\n")
        print("| " + " | ".join(HEADING) + " |\n" + "|---" * len(HEADING) + "|", flush=True)
        for asked in make(given.out / name, given.data / name, given.ways):
            print("| " + " | ".join(row(asked, given.minutes, not given.calibrated)) + " |", flush=True)


if __name__ == "__main__":
    main()
