"""`kill -9` in the middle of `simulate` and of `estimate`, and run again: is the result the same?

    python benchmarks/killed.py ROBOT SCRIPT [--after SECONDS]

Each command runs once without a break, and once killed again and again after so many seconds of work until it ends. Recordings
are compared byte by byte, runs by their contacts.
"""

from __future__ import annotations

import argparse
import csv
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from femsense.io.files import folder_hash

MOST_KILLS = 40


def killed(words: list[str], after: float) -> int:
    """Run a command until it ends by itself, killed after so many seconds each time; return how often it was."""
    for kills in range(MOST_KILLS):
        run = subprocess.Popen([sys.executable, "-m", "femsense", *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            run.wait(after)
        except subprocess.TimeoutExpired:
            run.send_signal(signal.SIGKILL)
            run.wait()
            continue
        if run.returncode:
            raise SystemExit(f"{' '.join(words)} ended with {run.returncode}")
        return kills
    raise SystemExit(f"{' '.join(words)} was killed {MOST_KILLS} times and is not done")


def contacts(folder: Path) -> np.ndarray:
    """Return frame, place and force of each contact of a run, a row each."""
    names = ("frame", "x_m", "y_m", "z_m", "fx_n", "fy_n", "fz_n")
    with (folder / "contacts.csv").open(encoding="utf-8") as stream:
        return np.array([[float(row[name]) for name in names] for row in csv.DictReader(stream)]).reshape(-1, len(names))


def main() -> None:
    """Print what became of both commands."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot")
    parser.add_argument("script")
    parser.add_argument("--after", type=float, default=25.0)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        began = time.perf_counter()
        for kind, after in (("whole", 1e6), ("killed", given.after)):
            kills = killed(["simulate", given.robot, given.script, "-o", str(root / kind)], after)
            print(f"simulate {kind}: killed {kills} times, {time.perf_counter() - began:.0f} s", flush=True)
        same = folder_hash(root / "whole") == folder_hash(root / "killed")
        print("simulate: the same bytes" if same else "simulate: OTHER bytes", flush=True)
        for kind, after in (("whole", 1e6), ("killed", given.after)):
            kills = killed(["estimate", given.robot, str(root / "whole"), "-o", str(root / f"run-{kind}")], after)
            print(f"estimate {kind}: killed {kills} times, {time.perf_counter() - began:.0f} s", flush=True)
        first, second = contacts(root / "run-whole"), contacts(root / "run-killed")
        alike = first.shape == second.shape
        print(
            f"estimate: {len(first)} and {len(second)} contacts, largest difference "
            f"{np.abs(first - second).max(initial=0.0) if alike else np.nan:.2g}"
        )


if __name__ == "__main__":
    main()
