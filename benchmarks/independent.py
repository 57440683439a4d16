"""Recordings of touched soft robots by an independent generator, and how far the program's forces are from their truth.

    python benchmarks/independent.py OUT --seed S [--case NAME …] [--run] [--method NAME …] [--law] [--diamond FOLDER] [--workers N]
    python benchmarks/independent.py --list

Below OUT, each case has `robot/`, `recording/` and `truth.json`; with `--run` the installed `femsense` calibrates and estimates
every case and a table follows. Everything that is drawn comes from the seed. Needs scikit-fem;
pypardiso (of the MKL), if it is installed, factorises the large meshes of the diamond.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path

from independent.cases import CASES, Case
from independent.declared import declare_law
from independent.grade import Row, grade, heading, results_of, run, summary
from independent.make import make

from femsense.many.engines import open_engine, spread

DIAMOND = Path(__file__).resolve().parents[2] / "shared" / "data" / "diamond"


def asked(given: argparse.Namespace, case: Case) -> tuple[str, dict[str, Row]]:
    """Make a case unless it is there, and run and grade it where that is asked for; return how it was made, and the grade by method."""
    folder, note = given.out / case.name, f"{case.name}:"
    if case.robot == "diamond" and not (given.diamond / "diamond.vtu").exists():
        return f"{note} left out, no diamond.vtu in {given.diamond}", {}
    if not (folder / "truth.json").exists():
        truth = make(case, folder, given.seed, diamond=given.diamond, plain=given.plain, stretch_limit=given.gent)
        note += f" made in {truth['made_in_s']} s, {truth['mesh']}, residual {truth['certificate']['worst_residual_n']:.1e} N"
    if not given.run:
        return note, {}
    place, graded = declare_law(folder, folder / "law") if given.law else folder, dict[str, Row]()
    for method in given.method or ["rays"]:
        said = run(place, at=given.at, method=method, timeout=given.timeout)
        graded[method] = grade(results_of(place, at=given.at, method=method), folder / "truth.json", note=f"{method}, {said}")
    return note, graded


def main() -> int:
    """Make, run and grade the cases that were asked for."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("out", nargs="?", type=Path)
    ask.add_argument("--seed", type=int, default=1)
    ask.add_argument(
        "--case",
        action="append",
        default=[],
        metavar="NAME",
        help="one of the cases; may be repeated; else all but the calm ones and those near the clamp",
    )
    ask.add_argument("--diamond", type=Path, default=DIAMOND, help="folder with diamond.vtu")
    ask.add_argument("--plain", action="store_true", help="declare neither noise nor tools in recording.toml")
    ask.add_argument(
        "--gent",
        type=float,
        default=float("inf"),
        metavar="JM",
        help="the truth stiffens when stretched, by Gent's law; 2 is strong",
    )
    ask.add_argument("--run", action="store_true", help="run femsense on each case and grade it")
    ask.add_argument("--at", action="store_true", help="with --run: give the true places at rest, whose forces push")
    ask.add_argument(
        "--method", action="append", metavar="NAME", help="of femsense estimate; may be repeated: one run, all tables"
    )
    ask.add_argument("--law", action="store_true", help="with --run: the robot declares the law of the truth")
    ask.add_argument("--timeout", type=float, default=900.0, help="of one femsense command [s]")
    ask.add_argument(
        "--workers", type=int, default=0, help="cases at a time, in processes of their own; 0: one after the other, here"
    )
    ask.add_argument("--dask", help="as of femsense estimate")
    ask.add_argument("--list", action="store_true", help="name the cases")
    given = ask.parse_args()
    if given.list or given.out is None:
        print("\n".join(f"{c.name:16s} {c.robot}, {c.control}, {c.camera} at {c.distance_m} m" for c in CASES))
        return 0
    unknown = set(given.case) - {c.name for c in CASES}
    if unknown:
        ask.error(f"no such case: {', '.join(sorted(unknown))}")
    usual = [c for c in CASES if not (c.calm or c.near_clamp or c.nudges)]
    chosen = [c for c in CASES if c.name in given.case] if given.case else usual
    rows: dict[str, list[Row]] = defaultdict(list)
    print(heading() if given.run else "", end="\n" * given.run)
    with open_engine(given.workers, given.dask, None) as engine:
        for note, graded in spread(engine, asked, ((given, case) for case in chosen)):
            print("\n".join([note, *(row.line() for row in graded.values())]), flush=True)
            for method, row in graded.items():
                rows[method].append(row)
    for method, graded in rows.items():
        print(f"{method}:\n{summary(graded)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
