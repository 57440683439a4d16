"""Whether a scale of the markers is found, and whether right recordings are accused of one.

    python benchmarks/marker_scale.py [--robots NAME …] [--seeds N] [--real] [--data FOLDER] [--out FOLDER]

Robots that come along: recordings of `calibration_robots.py` (one camera, named markers, a finer mesh with another law), right, with
a robot whose modulus is off, and with markers scaled about the camera. `--real`: robots that others built and recorded (`shared/data`), as
they are and scaled. Recordings are kept below OUT. Prints the tables "A scale of the markers" of docs/results/calibration.md.
"""

from __future__ import annotations

import argparse
import re
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from calibration_robots import one_camera, recorded, without_clouds
from real import arm, tentacle, trunk

from femsense import FemsenseError, Recording, Robot, calibrate, load_recording, load_robot
from femsense.calib.marker_readings import scaled

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
SCALES = (1.01, 1.03, 0.97)
MODULI = (0.6, 1.67)
SAID = re.compile(r"are ([\d.]+) ± ([\d.]+) times too large")


def told(robot: Robot, recording: Recording) -> str:
    """Return the scale that calibrate names, – where it names none."""
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        try:
            calibrate(robot, recording)
        except FemsenseError as error:
            return f"refused: {str(error).splitlines()[0][:70]}"
    found = [match for w in heard for match in [SAID.search(str(w.message))] if match]
    return " ".join(f"{m[1]} ± {m[2]}" for m in found) or "–"


def softer(robot: Robot, factor: float) -> Robot:
    return replace(robot, body=robot.body.with_stiffness_scale(factor))


def every_camera(recording: Recording, scale: float) -> Recording:
    return scaled(recording, range(len(recording.camera_names)), scale)


def real_recordings(out: Path, data: Path) -> Iterator[tuple[str, Path, Sequence[Path]]]:
    """Yield name, robot and recordings."""
    for robot in ("robot", "robot_gravity"):
        yield f"beam, {robot}", data / "beam" / robot, sorted((data / "beam" / "recordings").iterdir())
    for i, way in enumerate(tentacle.WAYS[:5], 1):
        where, train, held = tentacle.make(out / f"tentacle-{i}", data / "tentacle", way)
        yield f"tentacle: {way.name}", where, [*train, *held]
    where, made = trunk.make(out / "trunk", data / "trunk")
    yield "trunk", where, list(made.values())
    for day in arm.MIDDLES_MM:
        where, train, held = arm.make(out / f"arm-{day}", data / "arm", day)
        yield f"arm, {day}", where, [*train, *held]


def print_table(rows: Iterator[tuple[str, Robot, Recording]], moduli: Sequence[float], scales: Sequence[float]) -> None:
    """Print what is told of recordings: right, with moduli that are off, and scaled."""
    heading = ["recording", "as it is", *(f"modulus × {m:g}" for m in moduli), *(f"markers × {s:g}" for s in scales)]
    print("| " + " | ".join(heading) + " |\n" + "|---" * len(heading) + "|")
    for name, robot, recording in rows:
        off = [told(softer(robot, factor), recording) for factor in moduli]
        larger = [told(robot, every_camera(recording, scale)) for scale in scales]
        print("| " + " | ".join([name, told(robot, recording), *off, *larger]) + " |", flush=True)


def rig_rows(robots: Sequence[str], seeds: int, out: Path) -> Iterator[tuple[str, Robot, Recording]]:
    for name in robots:
        for seed in range(1, seeds + 1):
            robot = load_robot(name)
            recording = load_recording(recorded(robot, seed, out))
            yield f"{name}, seed {seed}", robot, without_clouds(one_camera(recording))


def real_rows(out: Path, data: Path) -> Iterator[tuple[str, Robot, Recording]]:
    for name, robot, recordings in real_recordings(out, data):
        for folder in recordings:
            yield f"{name}, {folder.name}", load_robot(robot), load_recording(folder)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", nargs="*", default=["finger", "arm", "gripper", "four-leg", "pneu-finger"])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--real", action="store_true", help="recordings of shared/data")
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--out", type=Path, help="keep recordings here")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        out = options.out or Path(temporary)
        if options.real:
            print_table(real_rows(out, options.data), (), SCALES[1:])
        else:
            print_table(rig_rows(options.robots, options.seeds, out), MODULI, SCALES)


if __name__ == "__main__":
    main()
