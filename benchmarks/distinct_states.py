"""How long `femsense improve` takes, and what memory, on recordings that another program made and whose states do not repeat.

    python benchmarks/distinct_states.py                     # every case of ../shared/data/other-program
    python benchmarks/distinct_states.py arm-1 --limit 900

An arm of 24 × 24 × 120 mm, 1536 linear tetrahedra, four routed cables; 60 fitted and 60 validation frames, all different. Each case is a process of its
own, with threads as they come; its stages are printed with the processor time at which they began.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT.parent / "shared" / "data" / "other-program"


def one(folder: Path) -> None:
    """Print the stages of a case, and what came out."""
    from femsense import improve, load_recording, load_robot

    robot = load_robot(folder / "robot")
    recordings = [load_recording(folder / name) for name in ("recording", "validation")]

    def say(text: str) -> None:
        print(f"  {time.process_time():7.1f} s  {text}", flush=True)

    loop = improve(robot, recordings[:1], validation=recordings[1:], progress=say)
    say(loop.sentence)
    say(f"named: {', '.join(e.name for e in loop.effects) or 'nothing'}")
    say(f"held out: {1e3 * loop.before.validation_rms_m:.2f} mm before, {1e3 * loop.after.validation_rms_m:.2f} mm after")
    say(f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.1f} GB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*")
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--limit", type=float, default=900.0, help="seconds after which a case is stopped")
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one is not None:
        one(options.one)
        return
    for case in options.cases or sorted(p.name for p in options.data.iterdir() if p.is_dir()):
        print(case, flush=True)
        began = time.monotonic()
        call = [sys.executable, "-W", "ignore", __file__, "--one", str(options.data / case)]
        try:
            subprocess.run(call, env=os.environ | {"PYTHONPATH": str(ROOT)}, check=True, timeout=options.limit)
            print(f"  {time.monotonic() - began:.0f} s of the wall")
        except subprocess.TimeoutExpired:
            print(f"  stopped after {options.limit:.0f} s")


if __name__ == "__main__":
    main()
