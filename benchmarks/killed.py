"""`kill -9` in the middle of `simulate` and of `estimate`, and run again: is the result the same?

    python benchmarks/killed.py ROBOT SCRIPT [--after SECONDS]
    python benchmarks/killed.py ROBOT --recording RECORDING [--calibration FILE]

First it is printed how long `estimate` works before its first frame. Each command runs once without a break, and once killed again and again
until it ends: `simulate` after so many seconds of work, `estimate` at each moment of MOMENTS, which the files tell that it writes. Recordings
are compared byte by byte, runs by their contacts, frames and states.
"""

from __future__ import annotations

import argparse
import csv
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from femsense.calib.calibrate import calibrate
from femsense.calib.files import read_calibration
from femsense.io.checkpoint import UNFINISHED
from femsense.io.files import PART_PREFIX, folder_hash
from femsense.io.folder_lock import lock_of
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot
from femsense.sensing.contact_free import learn
from femsense.sensing.prepare import make_sensor

MOST_KILLS = 40
PREPARES_S = 0.7
"""So long after the files are read it prepares: free frames are looked at, and no frame is done [s]."""


def started(words: list[str]) -> subprocess.Popen[bytes]:
    """Start a command of femsense."""
    return subprocess.Popen([sys.executable, "-m", "femsense", *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def ended(run: subprocess.Popen[bytes], words: list[str]) -> None:
    """Demand that a command has ended well."""
    if run.wait():
        raise SystemExit(f"{' '.join(words)} ended with {run.returncode}")


def killed(words: list[str], after: float) -> int:
    """Run a command until it ends by itself, killed after so many seconds each time; return how often it was."""
    for kills in range(MOST_KILLS):
        run = started(words)
        try:
            run.wait(after)
        except subprocess.TimeoutExpired:
            run.send_signal(signal.SIGKILL)
            run.wait()
            continue
        ended(run, words)
        return kills
    raise SystemExit(f"{' '.join(words)} was killed {MOST_KILLS} times and is not done")


def _prepares(folder: Path, since: float) -> bool:
    lock = lock_of(folder)
    return lock.is_file() and max(lock.stat().st_mtime, since) + PREPARES_S < time.time()


def _is_between_frames(folder: Path, since: float) -> bool:
    return (folder / UNFINISHED).is_file() and (folder / UNFINISHED).stat().st_mtime > since


def _keeps_a_frame(folder: Path, since: float) -> bool:
    return any(folder.glob(f"{PART_PREFIX}*{UNFINISHED}"))


def _writes_the_run(folder: Path, since: float) -> bool:
    return any(any(folder.parent.glob(f"{PART_PREFIX}*{of}")) for of in (f"-{folder.name}/*.csv", f"-{folder.name}/*.npz"))


MOMENTS: dict[str, Callable[[Path, float], bool]] = {
    "prepares": _prepares,
    "has kept some frames": _is_between_frames,
    "keeps frames": _keeps_a_frame,
    "writes the run": _writes_the_run,
}


def killed_when(words: list[str], folder: Path, moment: Callable[[Path, float], bool]) -> bool:
    """Run a command and kill it at a moment; return whether it came to that before it ended."""
    since, run = time.time(), started(words)
    while run.poll() is None:
        if moment(folder, since):
            run.send_signal(signal.SIGKILL)
            run.wait()
            return True
        time.sleep(0.0)  # a run is written in a few milliseconds
    ended(run, words)
    return False


def numbers(file: Path, names: tuple[str, ...]) -> np.ndarray:
    """Return columns of a table."""
    with file.open(encoding="utf-8") as stream:
        return np.array([[float(row[name] or "nan") for name in names] for row in csv.DictReader(stream)]).reshape(-1, len(names))


def difference(first: np.ndarray, second: np.ndarray) -> float:
    """Return the largest difference; NaN where there are more of one."""
    return float(np.nanmax(np.abs(first - second), initial=0.0)) if first.shape == second.shape else np.nan


def compared(whole: Path, broken: Path) -> str:
    """Return in words how two runs differ."""
    columns = ("frame", "x_m", "y_m", "z_m", "fx_n", "fy_n", "fz_n", "std_n")
    contacts, others = (numbers(run / "contacts.csv", columns) for run in (whole, broken))
    frames = [
        numbers(run / "frames.csv", ("frame", "contacts", "matched", "rms_before_m", "rms_after_m")) for run in (whole, broken)
    ]
    with np.load(whole / "states.npz") as one, np.load(broken / "states.npz") as other:
        nodes = difference(one["nodes_m"], other["nodes_m"])
    return (
        f"{len(contacts)} and {len(others)} contacts in {len(frames[0])} frames; largest difference of contacts {difference(contacts, others):.2g}, "
        f"of frames {difference(*frames):.2g}, of nodes {nodes:.2g} m"
    )


def prepared(robot: str, recording: str, calibration: str | None) -> str:
    """Return in words how long `estimate` works before its first frame, which a run that is killed does again."""
    body, seen = load_robot(robot), load_recording(recording)
    laps = [time.process_time()]
    used = calibrate(body, seen) if calibration is None else read_calibration(calibration)
    laps.append(time.process_time())
    learn(make_sensor(body, seen, used))
    laps.append(time.process_time())
    return (
        f"calibration {laps[1] - laps[0]:.1f} s, free frames {laps[2] - laps[1]:.1f} s of one core, of {seen.frame_count} frames"
    )


def main() -> None:
    """Print what became of both commands."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot")
    parser.add_argument("script", nargs="?")
    parser.add_argument("--after", type=float, default=25.0)
    parser.add_argument("--recording")
    parser.add_argument("--calibration")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        root, began = Path(name), time.perf_counter()
        recording = given.recording or simulated(given.robot, given.script, given.after, root)
        print(f"before the first frame: {prepared(given.robot, recording, given.calibration)}", flush=True)
        words = ["estimate", given.robot, recording, *(["-c", given.calibration] if given.calibration else []), "-o"]
        killed([*words, str(root / "run-whole")], 1e6)
        print(f"estimate whole: {time.perf_counter() - began:.0f} s", flush=True)
        for what, moment in MOMENTS.items():
            caught = killed_when([*words, str(root / "run-killed")], root / "run-killed", moment)
            if not caught:  # the next moment needs a run that is not done
                shutil.rmtree(root / "run-killed")
            print(f"estimate {'killed where it' if caught else 'ended, and never'} {what}", flush=True)
        killed([*words, str(root / "run-killed")], 1e6)
        print(f"estimate: {compared(root / 'run-whole', root / 'run-killed')}; {time.perf_counter() - began:.0f} s")


def simulated(robot: str, script: str, after: float, root: Path) -> str:
    """Return the recording of a script, made once without a break and once killed after so many seconds each time."""
    began = time.perf_counter()
    for kind, seconds in (("whole", 1e6), ("killed", after)):
        kills = killed(["simulate", robot, script, "-o", str(root / kind)], seconds)
        print(f"simulate {kind}: killed {kills} times, {time.perf_counter() - began:.0f} s", flush=True)
    same = folder_hash(root / "whole") == folder_hash(root / "killed")
    print("simulate: the same bytes" if same else "simulate: OTHER bytes", flush=True)
    return str(root / "whole")


if __name__ == "__main__":
    main()
