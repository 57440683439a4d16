"""Inputs that users of neighbouring tools reported: what the commands make of each now, beside what they made of it before.

    python benchmarks/reports.py FOLDER [--only NAME …]

FOLDER holds the inputs (data/reports), one folder a kind. Every row runs the commands that its README names, and prints exit status
and the sentence that matters. Prints the second table of docs/results/trials.md.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from trials import call

SHOWN = 230
"""Characters of what a command says."""


@dataclass(frozen=True)
class Report:
    """One kind of input."""

    name: str
    essence: str
    before: str
    test: str
    commands: tuple[str, ...]
    """Arguments of femsense; OUT is a folder that is free."""
    telling: str
    """What the sentence that matters holds (a regular expression)."""


LENSES = ("infinitam", "elastic", "csvhead", "order", "k33t", "lsd")
REPORTS = (
    Report(
        "aruco-other-dictionary",
        "tags of another dictionary; DICT_4X4_50",
        "no pose was found; inspect: nothing is wrong, calibrate: unknown dictionary",
        "tests/app/test_input_checks.py, tests/io/test_names.py",
        ("calibrate beam_5x5 recording -o OUT/c.json", "calibrate beam_dict_prefix recording -o OUT/d.json"),
        "none of the tags|residual",
    ),
    Report(
        "c3d-model-outputs",
        "angles and forces among the points",
        "one marker TipAngles in metres, six tracks dropped",
        "tests/io/importers/test_what_files_say.py",
        ("import unnamed_outputs.c3d -o OUT/a", "import named_outputs.c3d -o OUT/b"),
        "not positions",
    ),
    Report(
        "c3d-nul-padding",
        "texts padded with NUL",
        "unknown unit mm; names with NUL: did you mean tip?",
        "tests/io/importers/test_what_files_say.py, tests/io/test_names.py",
        ("import nul_unit_and_names.c3d -o OUT/a", "calibrate beam recording_with_nul_names -o OUT/c.json"),
        "^ *markers |residual",
    ),
    Report(
        "csv-clock-goes-back",
        "a counter that wraps; stamps rounded to one; to tenths",
        "21, 1 and 21 of 40 rows, without a word",
        "tests/io/importers/test_clock.py",
        (
            "import micros_wrap.csv -o OUT/a --unit m",
            "import rounded_by_excel.csv -o OUT/b --unit m",
            "import tenths_of_seconds.csv -o OUT/c --unit m",
        ),
        "overflowed|not later|dropped, since",
    ),
    Report(
        "csv-excel-days",
        "serial days, and the fraction of a day",
        "1727119 frames a second",
        "tests/io/importers/test_clock.py",
        ("import excel.csv -o OUT/a --unit m", "import day_fraction.csv -o OUT/b --unit m"),
        "days of a spreadsheet",
    ),
    Report(
        "depth-too-near",
        "depth that counts no 0.2 mm",
        "a scene 0.02 to 0.12 m away, without a word",
        "tests/io/importers/test_intrinsics.py",
        ("import x256 -o OUT/a", "import millimetres -o OUT/b"),
        "the scene is",
    ),
    Report(
        "lens-other-order",
        "six orders of the numbers of a lens",
        "fx 160, fy 79.5, cx 0, distortion 160: nothing is wrong",
        "tests/io/importers/test_intrinsics.py",
        tuple(f"import {name} -o OUT/{name}" for name in LENSES),
        "^ *lens ",
    ),
    Report(
        "lens-refused-then-accepted",
        "4 × 4, 3 × 4, fy < 0",
        "refused, then 'contains this import already'",
        "tests/io/importers/test_intrinsics.py, tests/io/importers/test_refused_import.py",
        ("import scannet -o OUT/a", "import proj34 -o OUT/b", "import iclnuim -o OUT/c", "import iclnuim -o OUT/c"),
        "^ *lens |try:",
    ),
    Report(
        "mesh-crack",
        "faces that lie on each other, not joined",
        "nothing is wrong; 43 mm of sag for 25 mm",
        "tests/model/test_plausibility.py",
        ("inspect cracked", "inspect whole"),
        "corner nodes|no problems",
    ),
    Report(
        "names-decomposed",
        "é in two spellings",
        "did you mean extrémité?; one marker left out",
        "tests/io/test_names.py",
        ("calibrate beam recording_all -o OUT/c.json", "calibrate beam recording_one -o OUT/d.json"),
        "residual",
    ),
    Report(
        "pcd-viewpoint",
        "VIEWPOINT, and clouds in the robot's frame",
        "nothing is wrong; camera at 0, 0, 0",
        "tests/io/importers/test_what_files_say.py, tests/app/test_input_checks.py",
        ("inspect recording",),
        "sensor stood|points lie behind",
    ),
    Report(
        "poisson-near-half",
        "poisson_ratio 0.499999",
        "nothing is wrong; overload after 13 s",
        "tests/model/test_plausibility.py",
        ("inspect robot", "simulate robot script.toml -o OUT/s"),
        "nearly singular",
    ),
    Report(
        "pressure-in-bar",
        "pressures in bar",
        "11 of 11 frames ok",
        "tests/model/test_plausibility.py",
        ("inspect recording", "calibrate robot recording -o OUT/c.json"),
        "is it in",
    ),
    Report(
        "ros-depth-8-bit",
        "depth packed as JPEG or PNG of 8 bits",
        "0.1 … 0.15 m for 0.4 … 0.6 m",
        "tests/io/importers/test_what_files_say.py",
        ("import jpeg -o OUT/a", "import png8 -o OUT/b"),
        "packed as 8 bits",
    ),
    Report(
        "ros-motor-units",
        "ticks, milliampere",
        "millimetres?; 250 N without a word",
        "tests/io/importers/test_what_files_say.py",
        ("import ticks -o OUT/a", "import milliampere -o OUT/b"),
        "try:|reaches",
    ),
    Report(
        "ros-pressure-absolute",
        "absolute pressures",
        "101325 Pa where nothing presses",
        "tests/io/importers/test_what_files_say.py, tests/model/test_plausibility.py",
        ("import bag -o OUT/a", "import bag -o OUT/b --map pressure=chamber_a*Pa_abs"),
        "is it absolute|^ *inputs ",
    ),
    Report(
        "surface-decimal-commas",
        "STL and OBJ with decimal commas",
        "not readable as a surface",
        "tests/io/meshes/test_decimal_commas.py",
        ("inspect comma.stl", "inspect comma.obj"),
        "decimal commas",
    ),
    Report(
        "tetgen-real-attribute",
        "an attribute 1.5; ten nodes in TetGen's order",
        "not readable as a mesh",
        "tests/io/meshes/test_tetgen.py",
        ("inspect real", "inspect second_order"),
        "volume",
    ),
)


def result_of(report: Report, data: Path) -> str:
    """Return exit status of each command and what it says."""
    told: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        for command in report.commands:
            words = [word.replace("OUT", folder, 1) if word.startswith("OUT/") else word for word in command.split()]
            words = [str(data / report.name / word) if (data / report.name / word).exists() else word for word in words]
            status, out, said = call(words)
            lines = [line for line in [*"\n".join(said).splitlines(), *out.splitlines()] if re.search(report.telling, line)]
            text = " ".join((lines[0] if lines else "").replace(f"{data / report.name}/", "").replace(f"{folder}/", "").split())
            told.append(f"rc {status}: {text[:SHOWN]}")
    return "; ".join(dict.fromkeys(told)).replace("|", "/")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--only", nargs="*", default=None, help="names of rows")
    options = parser.parse_args()
    print("| input | what it is | before | now | test |\n|---|---|---|---|---|")
    for report in REPORTS:
        if options.only is None or report.name in options.only:
            now = result_of(report, options.data.absolute())
            tests = ", ".join(f"`{test}`" for test in report.test.split(", "))
            print(f"| `{report.name}` | {report.essence} | {report.before} | {now} | {tests} |", flush=True)


if __name__ == "__main__":
    sys.exit(main())
