"""How far a run's contacts are from the truth, and running the program."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

MATCH_M = 0.030
"""A reported contact farther than this from a true one is another contact."""
RESOLVED = 0.2
"""Forces are graded where the bound is below this share: five times the resolution."""
WRONG = 0.3
"""A force that is off by more than this share is a wrong one."""


@dataclass(eq=False)
class Row:
    """The grade of one case; errors are of forces that the camera can resolve."""

    case: str
    true: int = 0
    resolvable: int = 0
    size_error: list[float] = field(default_factory=list)
    vector_error: list[float] = field(default_factory=list)
    place_m: list[float] = field(default_factory=list)
    covered: list[bool] = field(default_factory=list)
    over_std: list[float] = field(default_factory=list)
    """Error of the size over its standard deviation."""
    place_over_std: list[float] = field(default_factory=list)
    """Distance from the true place over the root of the sum of its variances along the axes."""
    over_bound: list[float] = field(default_factory=list)
    """|error| over the bound's standard deviation."""
    bound: list[float] = field(default_factory=list)
    missed: int = 0
    missed_quietly: int = 0
    """Of these, in a frame whose status is ok."""
    wrong_quietly: int = 0
    """Off by more than WRONG and two standard deviations, in a frame whose status is ok."""
    extra: int = 0
    """Reported beside the true ones in touched frames."""
    false: int = 0
    calm: int = 0
    """Frames without a touch."""
    largest_false_n: float = 0.0
    status: Counter[str] = field(default_factory=Counter)
    note: str = ""

    def line(self) -> str:
        """One row of the table."""
        size, vector, place = self.size_error, self.vector_error, self.place_m
        cells = [
            f"{self.case:15s}",
            f"{self.true:4d} {self.resolvable:4d}",
            f"{_percent(np.median, self.bound)}",
            f"{_percent(np.median, size)} {_percent(_p95, size)} {_percent(np.median, vector)}",
            f"{_mm(np.median, place)} {_mm(_p95, place)}",
            f"{self.missed:4d} {self.missed_quietly:4d} {self.extra:4d}",
            f"{self.false:3d}/{self.calm:<3d} {self.largest_false_n:5.2f}",
            f"{_percent(np.mean, self.covered)}",
            f"{np.sqrt(np.mean(np.square(self.over_bound))) if self.over_bound else float('nan'):5.1f}",
            " ".join(f"{k}:{v}" for k, v in self.status.most_common(3)) + (f" {self.note}" if self.note else ""),
        ]
        return " | ".join(cells)

    def deviations(self) -> str:
        """How errors keep to what is said of them."""
        sizes, places = np.abs(self.over_std), np.array(self.place_over_std)
        if not len(sizes):
            return "no force was matched"
        told = f"{len(sizes)} forces: errors over their deviations {np.sqrt(np.mean(sizes**2)):.2f} (rms), {np.mean(sizes <= 1.96):.0%} within 1.96"
        if not len(places):
            return told
        within = f"{np.mean(places <= 2.0):.0%} within 2, {np.mean(places <= 3.0):.0%} within 3"
        return f"{told}; places {np.sqrt(np.mean(places**2)):.2f} (rms), {within}"

    def cells(self) -> str:
        """Error of force (median, 95th percentile), place, missed (quietly), false frames and coverage, as cells of a table in docs."""
        errors = f"{_percent(np.median, self.size_error).strip()} % | {_percent(_p95, self.size_error).strip()} %"
        missed = f"{self.missed}/{self.resolvable} ({self.missed_quietly}) | {self.false}/{self.calm}"
        return f"{errors} | {_mm(np.median, self.place_m).strip()} mm | {missed} | {_percent(np.mean, self.covered).strip()} %"


def heading() -> str:
    """What the columns are."""
    return (
        "forces where the bound on |f| is below 20 % (of `true` contacts, `res` are); matched within 30 mm;\n"
        "quiet: missed with status ok; N: largest false force; /bound: rms error over the bound\n"
        "case            | true  res | bound | |f| med   p95   vec | place mm p95 | miss quiet xtra"
        " | false/calm N | cover | /bound | status"
    )


def _p95(values: list[float]) -> float:
    return float(np.percentile(values, 95))


def _percent(of, values) -> str:  # type: ignore[no-untyped-def]
    return f"{100 * of(values):5.1f}" if len(values) else "    -"


def _mm(of, values) -> str:  # type: ignore[no-untyped-def]
    return f"{1e3 * of(values):5.1f}" if len(values) else "    -"


def _rows(path: Path) -> list[dict[str, str]]:
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def statuses_of(run_folder: Path) -> dict[int, str]:
    """Status of each frame of a run."""
    return {int(f["frame"]): f["status"] for f in _rows(run_folder / "frames.csv")}


def contacts_of(run_folder: Path) -> list[int]:
    """Frame of each contact that a run reports."""
    return [int(c["frame"]) for c in _rows(run_folder / "contacts.csv") if float(c["force_n"]) > 0]


def _vector(row: dict[str, str], *names: str) -> np.ndarray:
    return np.array([float(row[n]) for n in names])


def grade(run_folder: Path, truth_file: Path, *, note: str = "") -> Row:
    """Compare contacts.csv and frames.csv of a run with truth.json, in all its frames or those of its list `numbers`."""
    truth = json.loads(Path(truth_file).read_text(encoding="utf-8"))
    row = Row(truth["case"], note=note)
    frames = _rows(Path(run_folder) / "frames.csv")
    contacts = [c for c in _rows(Path(run_folder) / "contacts.csv") if float(c["force_n"]) > 0]
    status = {int(f["frame"]): f["status"] for f in frames}
    row.status = Counter(status.values())
    for frame in truth.get("numbers", range(truth["frames"])):
        true = [c for c in truth["contacts"] if c["frame"] == frame]
        found = [c for c in contacts if int(c["frame"]) == frame]
        if not true:
            row.calm += 1
            row.false += bool(found)
            row.largest_false_n = max([row.largest_false_n, *(float(c["force_n"]) for c in found)])
            continue
        _frame(row, true, found, status.get(frame, "none"))
    return row


def _frame(row: Row, true: list[dict], found: list[dict[str, str]], status: str) -> None:
    far = np.array([[np.linalg.norm(_vector(f, "x_m", "y_m", "z_m") - t["point"]) for f in found] for t in true]).reshape(
        len(true), -1
    )
    pairs = {i: j for i, j in zip(*linear_sum_assignment(far)) if far[i, j] <= MATCH_M}
    row.extra += len(found) - len(pairs)
    for i, one in enumerate(true):
        row.true += 1
        resolvable = one["bound_rel"] < RESOLVED
        row.resolvable += resolvable
        if not resolvable:
            continue
        row.bound.append(one["bound_rel"])
        if i not in pairs:
            row.missed += 1
            row.missed_quietly += status == "ok"
            continue
        answer = found[pairs[i]]
        size = float(np.linalg.norm(one["force"]))
        error = float(answer["force_n"]) - size
        row.size_error.append(abs(error) / size)
        row.vector_error.append(float(np.linalg.norm(_vector(answer, "fx_n", "fy_n", "fz_n") - one["force"])) / size)
        row.place_m.append(float(far[i, pairs[i]]))
        row.over_bound.append(abs(error) / size / one["bound_rel"])
        std = float(answer.get("std_n") or 0.0)
        if std > 0.0:  # none is said where it is not known
            row.covered.append(abs(error) <= 1.96 * std)
            row.over_std.append(error / std)
            spread = float(np.linalg.norm([float(answer.get(name) or 0.0) for name in ("x_std_m", "y_std_m", "z_std_m")]))
            if spread > 0.0:  # a given place has none
                row.place_over_std.append(float(far[i, pairs[i]]) / spread)
            row.wrong_quietly += abs(error) > WRONG * size and not row.covered[-1] and status == "ok"


def results_of(folder: Path, *, at: bool = False, method: str = "rays") -> Path:
    """Folder of a run."""
    return folder / f"run{'-at' * at}{'' if method == 'rays' else f'-{method}'}"


def run(folder: Path, *, at: bool = False, method: str = "rays", timeout: float = 900.0) -> str:
    """Run `femsense calibrate` and `estimate` on a case; what went wrong and how long it took, in words."""
    robot, recording, results = str(folder / "robot"), str(folder / "recording"), str(results_of(folder, at=at, method=method))
    calibration = str(folder / "calibration.json")
    places: list[str] = []
    if at:
        truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
        last = {c["contact"]: c["rest"] for c in truth["contacts"]}
        places = ["--push", *(word for rest in last.values() for word in ("--at", ",".join(f"{v:.6f}" for v in rest)))]
    begin = time.perf_counter()
    for words in (
        ["calibrate", robot, recording, "-o", calibration, "--json"],
        ["estimate", robot, recording, "-c", calibration, "-o", results, "--json", "--method", method, *places],
    ):
        try:
            done = subprocess.run(
                [sys.executable, "-m", "femsense", *words], capture_output=True, text=True, timeout=timeout, check=False
            )
        except subprocess.TimeoutExpired:
            return f"{words[0]} took more than {timeout:.0f} s"
        (folder / f"{words[0]}{'-at' if at and words[0] == 'estimate' else ''}.log").write_text(
            done.stdout + done.stderr, encoding="utf-8"
        )
        if done.returncode:
            return f"{words[0]} ended with {done.returncode}: {(done.stdout + done.stderr).strip()[-160:]!r}"
    pose = np.asarray(json.loads(Path(calibration).read_text(encoding="utf-8"))["T_robot_camera"])
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    true = np.asarray(truth["T_robot_camera"])
    points = [p["point"] for p in truth["contacts"]] or list(truth["markers_m"].values())
    off = np.linalg.norm(_moved(pose, true, np.asarray(points)), axis=1).mean()
    return f"pose {1e3 * off:.2f} mm off, {time.perf_counter() - begin:.0f} s"


def _moved(pose: np.ndarray, true: np.ndarray, points: np.ndarray) -> np.ndarray:
    """By how much a wrong pose moves points of the robot [m]."""
    local = (points - true[:3, 3]) @ true[:3, :3]
    return np.asarray(local @ pose[:3, :3].T + pose[:3, 3] - points)


def summed(rows: list[Row]) -> Row:
    """All cases as one."""
    total = Row("all")
    for row in rows:
        for name in ("true", "resolvable", "missed", "missed_quietly", "wrong_quietly", "extra", "false", "calm"):
            setattr(total, name, getattr(total, name) + getattr(row, name))
        for name in ("size_error", "vector_error", "place_m", "covered", "over_std", "place_over_std", "over_bound", "bound"):
            getattr(total, name).extend(getattr(row, name))
        total.status.update(row.status)
        total.largest_false_n = max(total.largest_false_n, row.largest_false_n)
    return total


def summary(rows: list[Row]) -> str:
    """All cases in one row."""
    total = summed(rows)
    return f"{total.line()}\n{total.deviations()}"
