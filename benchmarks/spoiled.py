"""Recordings spoiled on purpose: what calibrate and estimate make of each kind of wrong input, on robots that come along.

    python benchmarks/spoiled.py [--robot finger four-leg …] [--only KIND …] [--seed N] [--given] [--out FOLDER] [--minutes N]

The clean recording comes from the virtual rig: a finer mesh, neo-Hookean, markers with 0.2 mm of noise,
a force in the last sweep. Each kind of error is then written into its files. A row is *told* where a command ends with status 1
or 2; *right* where each force is within 20 % or two standard deviations, and these are at most twice those of the clean
recording; *wrong* elsewhere, *SILENT* where then nothing is said either. *left a file* where a refused calibration leaves one.
With --given the clean recording is calibrated, and only what is estimated is spoiled. Rows that stand in FOLDER/rows.jsonl already are
not measured again, and no row is begun after N minutes, so that it may be run in parts. Prints a table, and the count of each.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import io
import json
import shutil
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from femsense import load_robot, simulate
from femsense.app import cli

FORCE_N = 0.15


@dataclass
class Tables:
    """The tables of a recording as rows of text, to be spoiled."""

    frames: list[dict[str, str]]
    markers: list[dict[str, str]]
    toml: str
    robot: str
    rng: np.random.Generator


XYZ = ("x_m", "y_m", "z_m")
Spoil = Callable[[Tables], None]


def scaled(factor: float) -> Spoil:
    """Markers in another unit."""

    def spoil(t: Tables) -> None:
        for row in t.markers:
            row.update({c: repr(float(row[c]) * factor) for c in XYZ})

    return spoil


def inputs_scaled(factor: float) -> Spoil:
    """Actuation in another unit."""

    def spoil(t: Tables) -> None:
        for row in t.frames:
            row.update({c: repr(float(row[c]) * factor) for c in row if c.startswith(("cable_", "chamber_"))})

    return spoil


def mapped(rows: tuple[str, str, str], signs: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Spoil:
    """Columns exchanged or with another sign."""

    def spoil(t: Tables) -> None:
        for row in t.markers:
            row.update({c: repr(s * float(old)) for c, s, old in zip(XYZ, signs, [row[r] for r in rows])})

    return spoil


def lost(text: str, share: float) -> Spoil:
    """Some markers of some frames are written as `text`; `last`: as where they were before; `gone`: one for ever after."""

    def spoil(t: Tables) -> None:
        names = sorted({row["marker"] for row in t.markers})
        bad = set(t.rng.permutation(names)[: max(1, round(share * len(names)))].tolist())
        before: dict[str, dict[str, str]] = {}
        count = len(t.frames)
        for row in t.markers:
            if row["marker"] in bad and int(row["frame"]) >= count // 2:
                row.update({c: before[row["marker"]][c] if text == "last" and row["marker"] in before else text for c in XYZ})
            before.setdefault(row["marker"], dict(row))
            if int(row["frame"]) < count // 2:
                before[row["marker"]] = dict(row)

    return spoil


def swapped(share: float) -> Spoil:
    """Two labels exchanged in a share of the frames."""

    def spoil(t: Tables) -> None:
        names = sorted({row["marker"] for row in t.markers})
        a, b = (str(n) for n in t.rng.permutation(names)[:2])
        frames = set(t.rng.permutation(len(t.frames))[: max(1, round(share * len(t.frames)))].tolist())
        for row in t.markers:
            if int(row["frame"]) in frames and row["marker"] in (a, b):
                row["marker"] = b if row["marker"] == a else a

    return spoil


def cycled(t: Tables) -> None:
    """All labels moved on by one: the order of another export."""
    names = list(dict.fromkeys(row["marker"] for row in t.markers))
    after = dict(zip(names, [*names[1:], names[0]]))
    for row in t.markers:
        row["marker"] = after[row["marker"]]


def times(how: str) -> Spoil:
    """Time stamps out of order, repeated, or in milliseconds."""

    def spoil(t: Tables) -> None:
        stamps = [float(row["time_s"]) for row in t.frames]
        if how == "order":
            stamps[2], stamps[-2] = stamps[-2], stamps[2]
        elif how == "same":
            stamps[3] = stamps[2]
        elif how == "ms":
            stamps = [1e3 * s for s in stamps]
        for row, stamp in zip(t.frames, stamps):
            row["time_s"] = repr(stamp)

    return spoil


def shifted_inputs(t: Tables) -> None:
    """Inputs lag two frames behind the markers."""
    columns = [c for c in t.frames[0] if c.startswith(("cable_", "chamber_"))]
    old = [[row[c] for c in columns] for row in t.frames]
    for k, row in enumerate(t.frames):
        row.update(dict(zip(columns, old[max(k - 2, 0)])))


def inputs_exchanged(t: Tables) -> None:
    """The columns of the first two cables exchanged."""
    columns = [c for c in t.frames[0] if c.startswith("cable_")]
    if len(columns) < 2:
        raise LookupError
    for row in t.frames:
        row[columns[0]], row[columns[1]] = row[columns[1]], row[columns[0]]


def duplicated_rows(t: Tables) -> None:
    """The rows of a marker stand twice in a frame."""
    t.markers.insert(1, dict(t.markers[0]))


def frozen_all(t: Tables) -> None:
    """From the middle on the tracker repeats its last frame."""
    count = len(t.frames)
    last = {row["marker"]: row for row in t.markers if int(row["frame"]) == count // 2}
    for row in t.markers:
        if int(row["frame"]) > count // 2 and row["marker"] in last:
            row.update({c: last[row["marker"]][c] for c in XYZ})


def spike(t: Tables) -> None:
    """One coordinate of one marker has its decimal point elsewhere."""
    row = t.markers[len(t.markers) // 2]
    row["z_m"] = repr(10 * float(row["z_m"]))


def bumped(t: Tables) -> None:
    """Somebody moves the camera by a centimetre at half time."""
    for row in t.markers:
        if int(row["frame"]) >= len(t.frames) // 2:
            row["x_m"] = repr(float(row["x_m"]) + 0.01)


def turned_input(column: int, factor: float, offset: float = 0.0) -> Spoil:
    """One column of the inputs has another sign, unit, or zero (a share of its largest value)."""

    def spoil(t: Tables) -> None:
        columns = [c for c in t.frames[0] if c.startswith(("cable_", "chamber_"))]
        if len(columns) <= max(column, 1):
            raise LookupError
        largest = max(abs(float(row[columns[column]])) for row in t.frames)
        for row in t.frames:
            row[columns[column]] = repr(factor * float(row[columns[column]]) + offset * largest)

    return spoil


def inputs_moved_on(t: Tables) -> None:
    """The columns of all cables moved on by one."""
    columns = [c for c in t.frames[0] if c.startswith("cable_")]
    if len(columns) < 3:
        raise LookupError
    for row in t.frames:
        row.update(dict(zip(columns, [row[c] for c in [*columns[1:], columns[0]]])))


def marker_twice(t: Tables) -> None:
    """One marker stands under the name of another too."""
    names = list(dict.fromkeys(row["marker"] for row in t.markers))
    there = {row["frame"]: row for row in t.markers if row["marker"] == names[0]}
    for row in t.markers:
        if row["marker"] == names[-1] and row["frame"] in there:
            row.update({c: there[row["frame"]][c] for c in XYZ})


def robot_says(old: str, new: str) -> Spoil:
    """The robot's file says something else."""

    def spoil(t: Tables) -> None:
        if old not in t.robot:
            raise LookupError(old)
        t.robot = t.robot.replace(old, new)

    return spoil


def gravity(vector: str) -> Spoil:
    return robot_says("vector_m_s2 = [0.0, 0.0, -9.81]", f"vector_m_s2 = {vector}")


KINDS: dict[str, Spoil] = {
    "clean": lambda t: None,
    "mm": scaled(1e3),
    "cm": scaled(1e2),
    "inch": scaled(39.37),
    "feet": scaled(3.281),
    "left-handed: x": mapped(XYZ, (-1.0, 1.0, 1.0)),
    "left-handed: z": mapped(XYZ, (1.0, 1.0, -1.0)),
    "columns x and y exchanged": mapped(("y_m", "x_m", "z_m")),
    "columns moved on by one": mapped(("y_m", "z_m", "x_m")),
    "z in mm alone": mapped(XYZ, (1.0, 1.0, 1e3)),
    "one marker lost: 0": lost("0", 0.01),
    "one marker lost: nan": lost("nan", 0.01),
    "one marker lost: empty": lost("", 0.01),
    "one marker lost: -1": lost("-1", 0.01),
    "one marker lost: 9999": lost("9999", 0.01),
    "one marker lost: the last value": lost("last", 0.01),
    "a third lost: 0": lost("0", 0.34),
    "a third lost: the last value": lost("last", 0.34),
    "all frozen": frozen_all,
    "two labels, one frame": swapped(0.01),
    "two labels, a third of the frames": swapped(0.34),
    "two labels, two thirds": swapped(0.67),
    "two labels, all": swapped(1.0),
    "labels moved on by one": cycled,
    "decimal point": spike,
    "row twice": duplicated_rows,
    "time out of order": times("order"),
    "time twice": times("same"),
    "time in ms": times("ms"),
    "inputs two frames late": shifted_inputs,
    "two cables exchanged": inputs_exchanged,
    "inputs in mN or mm": inputs_scaled(1e3),
    "inputs in gram-force": inputs_scaled(101.97),
    "inputs in kgf": inputs_scaled(0.10197),
    "inputs in pounds": inputs_scaled(0.2248),
    "inputs in cm": inputs_scaled(1e2),
    "inputs in kPa": inputs_scaled(1e-3),
    "inputs in bar": inputs_scaled(1e-5),
    "inputs in psi": inputs_scaled(1.45e-4),
    "inputs with another sign": inputs_scaled(-1.0),
    "one input with another sign": turned_input(0, -1.0),
    "one input ten times too large": turned_input(0, 10.0),
    "one input with an offset of half its range": turned_input(0, 1.0, 0.5),
    "columns of inputs moved on by one": inputs_moved_on,
    "camera bumped at half time": bumped,
    "one marker under two names": marker_twice,
    "gravity up": gravity("[0.0, 0.0, 9.81]"),
    "gravity along x": gravity("[9.81, 0.0, 0.0]"),
    "gravity in mm/s²": gravity("[0.0, 0.0, -9810.0]"),
    "gravity in g": gravity("[0.0, 0.0, -1.0]"),
    "density in g/cm³": robot_says("density_kg_m3 = 1070.0", "density_kg_m3 = 1.07"),
    "mesh in mm though m": robot_says('unit = "m"', 'unit = "mm"'),
}
ONLY_CHAMBERS = {"inputs in kPa", "inputs in bar", "inputs in psi"}
ONLY_TENSION = {"inputs in mN or mm", "inputs in gram-force", "inputs in kgf", "inputs in pounds"}


def script_of(name: str, actuation: str, seed: int) -> dict:
    """Return sweeps of each input, and one with a force at a marker."""
    robot = load_robot(name)
    cables = {c.name: 0.6 * c.max_tension if actuation == "tension" else 0.004 for c in robot.body.cables}
    chambers = {c.name: 0.6 * c.max_pressure for c in robot.body.chambers}
    kinds = [("cables", c, v) for c, v in cables.items()] + [("chambers", c, v) for c, v in chambers.items()]
    sweeps = [{"label": c, kind: {c: v}, "rest": 1, "up": 2, "down": 1} for kind, c, v in kinds]
    kind, c, v = kinds[0]
    sweeps.append({"label": "pressed", kind: {c: 0.5 * v}, "rest": 0, "up": 1, "hold": 2, "down": 0, "free": False})
    place, force = pressed_at(name)
    middle = robot.body.mesh.nodes.mean(axis=0)
    size = float(np.linalg.norm(np.ptp(robot.body.mesh.nodes, axis=0)))
    return {
        "format": "femsense-script-1",
        "seed": seed,
        "actuation": actuation,
        "sweeps": sweeps,
        "loads": [{"sweep": "pressed", "point_m": place.tolist(), "force_n": (FORCE_N * force).tolist()}],
        "camera": {"eye_m": (middle + size * np.array([0.5, -2.5, 1.5])).tolist(), "target_m": middle.tolist()},
        "markers": {"std_m": 0.0002, "occlusion": False},
    }


def pressed_at(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the place of the force, at a marker far from the clamp, and its direction, across the way from clamp to marker."""
    robot = load_robot(name)
    held = robot.body.mesh.nodes[robot.body.clamped].mean(axis=0)
    place = robot.marker_points[np.linalg.norm(robot.marker_points - held, axis=1).argmax()]
    across = np.cross(place - held, [0.0, 1.0, 0.0] if name != "arm" else [1.0, 0.0, 0.0])
    return place, across / np.linalg.norm(across)


def call(arguments: list[str]) -> tuple[int, list[str]]:
    """Return exit status, and what a command says."""
    out, err = io.StringIO(), io.StringIO()
    with warnings.catch_warnings(record=True) as heard, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        warnings.simplefilter("always")
        status = cli.run(arguments)
    said = [line for line in err.getvalue().splitlines() if line.strip()] + [str(w.message) for w in heard]
    return status, [s for s in said if "is used; the robot" not in s and "compiling" not in s]


def read(path: Path) -> list[dict[str, str]]:
    with path.open() as stream:
        return list(csv.DictReader(stream))


def write(path: Path, rows: list[dict[str, str]]) -> None:
    with path.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


@dataclass
class Trial:
    """A clean recording, and what is done with it."""

    clean: Path
    robot: Path
    place: np.ndarray
    seed: int
    given: Path | None
    """A calibration of the clean recording; None: the spoiled one is calibrated."""
    widest: float = np.inf
    """Largest standard deviation of a right force [N]."""


def try_kind(trial: Trial, spoil: Spoil, work: Path) -> tuple[str, str, list[str], float]:
    """Return the outcome, the forces, what is said, and the largest standard deviation [N]."""
    clean, robot, place, seed = trial.clean, trial.robot, trial.place, trial.seed
    recording, model = work / "recording", work / "robot"
    shutil.copytree(clean, recording, ignore=shutil.ignore_patterns("truth", "loads.csv"))
    shutil.copytree(robot, model)
    toml = (model / "robot.toml").read_text()
    t = Tables(read(recording / "frames.csv"), read(recording / "markers.csv"), "", toml, np.random.default_rng(seed))
    spoil(t)
    write(recording / "frames.csv", t.frames)
    write(recording / "markers.csv", t.markers)
    (model / "robot.toml").write_text(t.robot)
    calibration, said = trial.given or work / "c.json", list[str]()
    if trial.given is None:
        status, said = call(["calibrate", str(model), str(recording), "-o", str(calibration)])
        if status:
            return f"told ({status})" + (", left a file" if calibration.exists() else ""), "-", said, 0.0
    at = ",".join(f"{x:.6g}" for x in place)
    arguments = ["estimate", str(model), str(recording), "-c", str(calibration), "-o", str(work / "run"), "--at", at]
    status, more = call(arguments)
    said += more
    if status:
        return f"told ({status})", "-", said, 0.0
    felt = {int(row["frame"]): row for row in read(work / "run" / "contacts.csv")}
    states = read(work / "run" / "frames.csv")
    last = [int(row["frame"]) for row in t.frames][-3:]
    off, texts, widest = [], [], 0.0
    for k in last:
        force = np.array([float(felt[k][c]) for c in ("fx_n", "fy_n", "fz_n")]) if k in felt else np.zeros(3)
        std = float(felt[k]["std_n"]) if k in felt else 0.0
        texts.append(f"{np.linalg.norm(force):.3f}±{std:.3f}")
        widest = max(widest, std)
        off.append(abs(np.linalg.norm(force) - FORCE_N) > max(2.0 * std, 0.2 * FORCE_N) or std > trial.widest)
    bad = sum(row["status"] != "ok" for row in states)
    stray = [float(row["force_n"]) for k, row in felt.items() if k < last[0] and float(row["force_n"]) > 3 * float(row["std_n"])]
    right = not any(off) and len(stray) <= 0.25 * len(states)
    text = f"{' '.join(texts)} N; {bad} of {len(states)} not ok; {len(stray)} strays"
    notable = bool(said) or bad > 0.5 * len(states)
    outcome = ("right, said" if said else "right") if right else ("wrong, said" if notable else "SILENT")
    return outcome, text, said, widest


@dataclass
class Rows:
    """What is measured already, a line of JSON each."""

    path: Path

    def __post_init__(self) -> None:
        lines = self.path.read_text(encoding="utf-8").splitlines() if self.path.is_file() else []
        self.done = {tuple(row["key"]): row for row in map(json.loads, lines)}

    def add(self, key: tuple[str, ...], outcome: str, force: str, said: list[str], widest: float) -> None:
        row = {"key": key, "outcome": outcome, "force": force, "said": said, "widest": widest}
        self.done[key] = row
        with self.path.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(row) + "\n")

    def show(self, key: tuple[str, ...]) -> None:
        row = self.done[key]
        print(f"| {key[0]} | {key[1]} | {row['outcome']} | {row['force']} | {' / '.join(row['said'])} |", flush=True)


def kinds_of(name: str, actuation: str, only: list[str] | None) -> list[str]:
    """Return the kinds that can befall a robot, the clean recording first."""
    kinds = [kind for kind in KINDS if only is None or kind in ("clean", *only)]
    chambers, pulled = name == "pneu-finger", name != "pneu-finger" and actuation == "tension"
    return [kind for kind in kinds if (chambers or kind not in ONLY_CHAMBERS) and (pulled or kind not in ONLY_TENSION)]


def trial_of(name: str, folder: Path, options: argparse.Namespace) -> Trial:
    """Return the clean recording of a robot, simulated where the folder has none, and its calibration where one is to be given."""
    clean = folder / f"{name}-{options.actuation}-{options.seed}"
    if not (clean / "recording.toml").is_file():
        simulate(load_robot(name), script_of(name, options.actuation, options.seed), clean)
    source = Path(__file__).parents[1] / "meshes" / name
    trial = Trial(clean, source, pressed_at(name)[0], options.seed, None)
    if options.given:
        trial.given = clean.with_suffix(".json")
        if not trial.given.is_file():
            call(["calibrate", str(source), str(clean), "-o", str(trial.given)])
    return trial


def measure(name: str, folder: Path, rows: Rows, options: argparse.Namespace, until: float) -> None:
    """Measure the rows of a robot that are not there yet, and print all."""
    trial = trial_of(name, folder, options)
    for kind in kinds_of(name, options.actuation, options.only):
        key = (name, kind, options.actuation, str(options.seed), "given" if options.given else "")
        if key not in rows.done:
            if time.monotonic() > until:
                continue
            try:
                with tempfile.TemporaryDirectory() as work:
                    outcome, force, said, widest = try_kind(trial, KINDS[kind], Path(work))
                    told = [" ".join(s.replace(f"{work}/", "").split())[:160] for s in dict.fromkeys(said)]
            except LookupError:
                continue
            rows.add(key, outcome, force, told[:2], widest)
        trial.widest = 2.0 * rows.done[key]["widest"] if kind == "clean" else trial.widest
        rows.show(key)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robot", nargs="*", default=["finger", "arm", "pneu-finger"])
    parser.add_argument("--actuation", choices=["tension", "displacement"], default="tension")
    parser.add_argument("--only", nargs="*", help="kinds")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--given", action="store_true", help="calibrate the clean recording")
    parser.add_argument("--out", type=Path, help="keep recordings and rows here")
    parser.add_argument("--minutes", type=float, default=np.inf, help="begin no row after so long")
    options = parser.parse_args()
    until = time.monotonic() + 60.0 * options.minutes
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.out or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        rows = Rows(folder / "rows.jsonl")
        print("| robot | kind | outcome | force, true 0.15 N | said |\n|---|---|---|---|---|")
        for name in options.robot:
            measure(name, folder, rows, options, until)
        counts = Counter(row["outcome"] for row in rows.done.values())
        print("\n" + ", ".join(f"{k}: {v}" for k, v in sorted(counts.items())))


if __name__ == "__main__":
    main()
