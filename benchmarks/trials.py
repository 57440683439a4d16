"""Small wrong inputs: the results and messages of the commands, and those of an early version.

    python benchmarks/trials.py FOLDER [--only NAME …] [--page docs/results/trials.md]

FOLDER holds the inputs (data/trials): robots, recordings and files, each of a kind.
Each row runs the commands of a user in a folder of its own, and prints exit status, forces and messages: the first table of docs/results/trials.md.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import io
import json
import sys
import tempfile
import textwrap
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from femsense.app import cli

FELT_N = 0.03
AT = "0.0875,0,0.02"
"""Where the beam is pressed, at rest [m]."""


@dataclass(frozen=True)
class Trial:
    """One input."""

    name: str
    essence: str
    before: str
    """What was made of it, as its own table says."""
    robot: str = "base"
    recording: str = ""
    """A recording for calibrate and estimate; by default the input itself."""
    at: tuple[str, ...] = (AT,)
    only_inspect: bool = False


MARKERS = [
    Trial("recm", "clean, 0.15 N in frames 5 and 6", "0.148 and 0.149 N"),
    Trial("rob_dup22", "every tetrahedron twice", "nothing is wrong; 1.9 times the force", robot="rob_dup22", recording="recm"),
    Trial("v_zeros", "a lost marker written 0,0,0", "0.009 ± 0.009 N, rc 0"),
    Trial("v_zeros_all", "all markers of a frame 0,0,0", "converged, 119 mm"),
    Trial("v_swap2", "two labels swapped in one frame", "0.007 ± 0.007 N"),
    Trial("v_swapall", "two labels swapped in all frames", "something out of sight may touch it"),
    Trial("v_inch", "inches", "converged, residual thirty times the body"),
    Trial("v_ms", "time in milliseconds", "accepted"),
    Trial("v_disp_mm", "displacement in millimetres", "accepted"),
    Trial("v_disp_neg", "displacement with the other sign", "zero tension, no hint"),
    Trial("v_gaps", "frames without markers", "the shape of the frame before"),
]
CLOUDS = [
    Trial("rec", "clean clouds", "0.15 N", at=()),
    Trial("recd", "depth images", "0.388 ± 0.08 N, 41 mm off", at=()),
    Trial("w_diffuse", "colours named diffuse_red …", "3.55 ± 2.1 N invented", at=()),
    Trial("w_nocol", "no colours", "dropped silently", at=()),
    Trial("w_col255f", "colours 0 to 255 as floats", "error without the file", at=()),
    Trial("w_d_c16", "colours of 16 bits", "error without the file", at=()),
    Trial("w_mm", "clouds in millimetres", "nothing is wrong; 0 points in view", at=()),
    Trial("w_cm", "clouds in centimetres", "nothing is wrong; 0 points in view", at=()),
    Trial("w_empty", "empty clouds", "nothing is wrong; 0 points in view", at=()),
    Trial("w_xyz", "clouds as .xyz", "nothing is wrong; 0 points in view", at=()),
]
FINGERS = [
    Trial("frec", "finger, 0.2 N in one step", "0.849 ± 0.24 N, status ok", robot="finger"),
    Trial("frec_ramp", "the same with a ramp", "0.2 N", robot="finger"),
    Trial(
        "slotted-finger/rec-clean-m",
        "slotted finger, 0.3 N on top",
        "0.920 N in every frame",
        robot="slotted-finger/robot",
        at=("0.075,0,0.008",),
    ),
]
FILES = [
    Trial("files/twopieces.vtu", "two pieces in a VTU", "the last piece only", only_inspect=True),
    Trial("files/twoparts.inp", "Abaqus, two parts", "elements on the wrong nodes", only_inspect=True),
    Trial("files/oneinst.inp", "Abaqus, an instance with an offset", "100 mm off", only_inspect=True),
    Trial("files/twonode.inp", "two *NODE blocks", "KeyError", only_inspect=True),
    Trial("files/twonode4.inp", "two *NODE blocks", "KeyError", only_inspect=True),
    Trial("files/saveall41.msh", "Gmsh SaveAll", "Incompatible cell data", only_inspect=True),
    Trial("files/ok22.msh", "Gmsh 2.2", "read", only_inspect=True),
    Trial("files/diffuse.ply", "colours diffuse_red …", "dropped silently", only_inspect=True),
    Trial("files/rgb_names.ply", "colours r, g, b", "dropped silently", only_inspect=True),
    Trial("files/rgb3.pcd", "three columns of colours", "error without the file", only_inspect=True),
]


def call(arguments: Sequence[str]) -> tuple[int, str, list[str]]:
    """Return exit status, output and warnings of a command."""
    out, err = io.StringIO(), io.StringIO()
    with warnings.catch_warnings(record=True) as heard, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        warnings.simplefilter("always")
        status = cli.run(list(arguments))
    said = [line.removeprefix("warning: ").removeprefix("femsense: ") for line in err.getvalue().splitlines() if line.strip()]
    return status, out.getvalue(), said + [str(w.message) for w in heard]


def first_line(said: Sequence[str], folder: Path) -> str:
    lines = [" ".join(text.replace(str(folder) + "/", "").split()) for text in said]
    silent = ("compiling kernels", "is used; the robot", "linear tetrahedra make")
    lines = [line for line in lines if not any(text in line for text in silent)]
    return textwrap.shorten(lines[0], 150, placeholder=" …") if lines else ""


def forces(run: Path) -> str:
    """Return the forces of a run by frame: largest of each frame, or what the frames say."""
    with (run / "contacts.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    with (run / "frames.csv").open() as stream:
        bad = [row for row in csv.DictReader(stream) if row["status"] != "ok"]
    felt = [row for row in rows if float(row["force_n"]) > FELT_N]
    parts = [f"{row['frame']}: {float(row['force_n']):.3f} ± {float(row['std_n']):.3f} N" for row in felt]
    shown = "; ".join(parts[:4]) + (f"; … median {median(float(r['force_n']) for r in felt):.3f} N" if len(parts) > 4 else "")
    return (shown or "no force of 0.03 N") + (f"; {len(bad)} frames not ok" if bad else "")


def result_of(trial: Trial, data: Path, folder: Path) -> str:
    """Return what the commands make of an input."""
    path = data / trial.name
    robot = "finger" if trial.robot == "finger" else str(data / trial.robot)
    if trial.only_inspect:
        status, out, said = call(["inspect", str(path)])
        lines = [" ".join(line.split()) for line in out.replace(f"{data}/", "").splitlines() if line.strip()]
        at = next((i for i, line in enumerate(lines) if " problem" in line or " warning" in line), len(lines) - 1)
        return f"rc {status}: {' '.join(lines[at : at + 2])[:200]}"
    recording = data / (trial.recording or trial.name)
    status, _, said = call(["calibrate", robot, str(recording), "-o", str(folder / "c.json")])
    if status:
        return f"calibrate, rc {status}: {first_line(said[-6:], data)}"
    told = first_line(said, data)
    places = [part for place in trial.at for part in ("--at", place)]
    status, _, said = call(["estimate", robot, str(recording), "-c", str(folder / "c.json"), "-o", str(folder / "run"), *places])
    if status:
        return f"estimate, rc {status}: {first_line(said[-6:], data)}"
    told = told or first_line(said, data)
    return f"rc 0: {forces(folder / 'run')}" + (f" ({told})" if told else "")


def put(row: str, page: Path) -> None:
    """Put a row in the place of that of the same input in a page."""
    begin = row[: row.index("` |") + 3]
    lines = [row if line.startswith(begin) else line for line in page.read_text(encoding="utf-8").splitlines()]
    page.write_text("\n".join(lines) + "\n", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--only", nargs="*", default=None, help="names of rows")
    parser.add_argument("--json", type=Path, help="also write the rows there")
    parser.add_argument("--page", type=Path, help="put the rows in the place of those of the same name in this page")
    options = parser.parse_args()
    print("| input | what it is | before | now |\n|---|---|---|---|")
    rows = []
    for trial in [*MARKERS, *FILES, *FINGERS, *CLOUDS]:
        if options.only is not None and trial.name not in options.only:
            continue
        began = time.process_time()
        with tempfile.TemporaryDirectory() as folder:
            now = result_of(trial, options.data.absolute(), Path(folder)).replace("|", "/")
        rows.append({"name": trial.name, "now": now, "seconds": time.process_time() - began})
        row = f"| `{trial.name}` | {trial.essence} | {trial.before} | {now} |"
        print(row, flush=True)
        if options.page:
            put(row, options.page)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    sys.exit(main())
