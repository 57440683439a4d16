"""Processor time of a new installation's first commands, and of a process to its first equilibrium.

    python benchmarks/first_minute.py              # as it was installed (new only once), kernels compiled into a folder of their own, warm
    python benchmarks/first_minute.py --kernels    # which kernels are compiled, the costliest first

Each command is a process of its own with one thread; user and system time, median of the runs (compiling: one run).
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT.parent / "shared" / "data"
DEMO = ROOT / "meshes" / "four-leg" / "recordings" / "demo"
RUNS = 3
EQUILIBRIUM = """
import sys
from femsense.io.robot_toml import load_robot
from femsense.fem.equilibrium import solve_equilibrium
body = load_robot(sys.argv[1]).body
assert solve_equilibrium(body, tension=dict.fromkeys(body.cable_names, 1.0)).converged
"""
KERNELS = """
import sys, time
from numba.core import event
from femsense.app.cli import run
class Recorder(event.Listener):
    def __init__(self):
        self.began, self.found = [], []
    def on_start(self, event):
        self.began.append([time.process_time(), 0.0])
    def on_end(self, event):
        start, inner = self.began.pop()
        whole = time.process_time() - start
        if self.began:
            self.began[-1][1] += whole
        function = event.data["dispatcher"].py_func
        self.found.append((whole - inner, whole, f"{function.__module__}.{function.__qualname__}"))
recorder = Recorder()
with event.install_listener("numba:compile", recorder):
    run(sys.argv[1:])
for own, whole, name in sorted(recorder.found, reverse=True)[:30]:
    print(f"{own:6.2f} {whole:6.2f} s  {name}", file=sys.stderr)
print(f"{sum(row[0] for row in recorder.found):6.2f} s in {len(recorder.found)} kernels", file=sys.stderr)
"""


def seconds(command: list[str], cache: Path | None = None, *, shown: bool = False) -> float:
    """Return user and system time of a command [s]."""
    one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "FEMSENSE_WORKERS"), "1")
    kept = {"PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": ""}  # modules are compiled once, as in use
    environment = os.environ | one | kept | ({"NUMBA_CACHE_DIR": str(cache)} if cache else {})
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [sys.executable, *command],
        env=environment,
        check=True,
        stderr=None if shown else subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--kernels", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        calibrate = ["calibrate", "four-leg", str(DEMO), "-o", str(work / "calibration.json")]
        estimate = ["estimate", "four-leg", str(DEMO), "-c", str(work / "calibration.json"), "-o", str(work / "run"), "--again"]
        if options.kernels:
            for words in (calibrate, estimate):
                print(words[0])
                seconds(["-c", KERNELS, *words], work / words[0], shown=True)
            return
        print("| processor time [s] | first run as installed | kernels compiled | warm |\n|---|---|---|---|")
        rows = {words[0]: ["-m", "femsense", *words] for words in (calibrate, estimate)}
        rows["equilibrium of data/diamond"] = ["-c", EQUILIBRIUM, str(options.data / "diamond")]
        for name, command in rows.items():
            cache = work / f"caches of {name}"
            installed, compiled = seconds(command), seconds(command, cache)
            print(
                f"| {name} | {installed:.1f} | {compiled:.1f} | {median(seconds(command, cache) for _ in range(RUNS)):.2f} |",
                flush=True,
            )
        print(f"| femsense --help | | | {median(seconds(['-m', 'femsense', '--help']) for _ in range(RUNS)):.2f} |")


if __name__ == "__main__":
    main()
