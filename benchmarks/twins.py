"""The same scenes made by two programs: forces in recordings of `femsense simulate` and of the independent generator, graded alike.

    python benchmarks/twins.py OUT --seed S [--case NAME …]

Below OUT, each case has `independent/` and `rig/`: the same robot folder, inputs, camera, noise, objects, places and forces, frame by
frame. Bodies, meshes, elements, patches, rays and noise are each program's own. Both are calibrated, estimated and graded. What the rig has
no key for is done to its files: pixels that are lost anywhere, a table of which clouds hold a part, colours that there are not, markers in free
frames alone. Needs scikit-fem.
"""

from __future__ import annotations

import argparse
import json
import shutil
import time
from pathlib import Path

import numpy as np
from independent.cases import CASES, FREE, Case
from independent.grade import grade, run
from independent.make import TABLE_SHARE, make
from independent.twin import KINDS, apart, inputs_apart, script_of, truth_of

from femsense import load_robot, simulate
from femsense.core.pose import transform_points
from femsense.io.clouds.cloud_files import read_cloud, write_cloud
from femsense.pointcloud.cloud import PointCloud

DIAMOND = Path(__file__).resolve().parents[2] / "shared" / "data" / "diamond"
ASKED = (
    "bar-normal",
    "bar-hidden",
    "bar-tangential",
    "arm-slide",
    "arm-gray",
    "pad-normal",
    "post-two",
    "slab-gray",
    "diamond-normal",
)
FLAT_M = 0.004
"""Points this near to the table's height are the table's."""


def main() -> None:
    """Print two rows a case."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("out", type=Path)
    ask.add_argument("--seed", type=int, default=1)
    ask.add_argument("--case", action="append", default=[], metavar="NAME", help=f"may be repeated; else {', '.join(ASKED)}")
    ask.add_argument(
        "--by-length", action="store_true", help="of cases by lengths of cables, give these to the rig in place of the tensions"
    )
    given = ask.parse_args()
    print(
        "| case | made by | bound | error of force, median | 95th percentile | place | missed (quiet) | false | within 95 % | ok | markers apart |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|", flush=True)
    for case in CASES:
        if case.name in (given.case or ASKED):
            if not {touch.kind for touch in case.touches} <= KINDS:
                ask.error(f"{case.name}: an object that one of them has not")
            _both(case, given.out / case.name, given.seed, given.by_length and case.control == "displacement")


def _both(case: Case, folder: Path, seed: int, by_length: bool) -> None:
    """Make a case twice where it is not there yet, run and grade both, and print their rows."""
    other, rig = folder / "independent", folder / ("rig-by-length" if by_length else "rig")
    if not (other / "truth.json").exists():
        make(case, other, seed, diamond=DIAMOND)
    truth = json.loads((other / "truth.json").read_text(encoding="utf-8"))
    if not (rig / "truth.json").exists():
        _simulated(case, other, rig, by_length)
        (rig / "truth.json").write_text(json.dumps(truth_of(rig, truth)), encoding="utf-8")
    free, touched = apart(truth, json.loads((rig / "truth.json").read_text(encoding="utf-8")))
    assert inputs_apart(other / "recording", rig / "recording") < 1e-6
    for made, name in ((other, "independent"), (rig, "rig, by lengths" if by_length else "rig")):
        note = run(made, timeout=1800.0) if not (made / "run" / "frames.csv").exists() else ""
        row = grade(made / "run", made / "truth.json", note=note)
        bound = f"{100 * np.median(row.bound):.1f} %" if row.bound else "–"
        surfaces = f"{1e3 * free.max():.2f}, {1e3 * touched.max():.2f} mm" if made is rig else ""
        ok = f"{row.status['ok']}/{sum(row.status.values())}"
        print(f"| `{case.name}` | {name} | {bound} | {row.cells()} | {ok} | {surfaces} |", flush=True)


def _simulated(case: Case, other: Path, rig: Path, by_length: bool) -> None:
    """Make the recording of a case by the rig."""
    shutil.rmtree(rig, ignore_errors=True)
    rig.mkdir(parents=True)
    shutil.copytree(other / "robot", rig / "robot")
    script = script_of(case, other, by_length=by_length)
    began = time.perf_counter()
    simulate(load_robot(rig / "robot"), script, rig / "recording")
    (rig / "script.json").write_text(json.dumps(script | {"made_in_s": time.perf_counter() - began}), encoding="utf-8")
    _seen_alike(
        case, other, rig / "recording", np.array(script["camera"]["T_robot_camera"]), script["scene"]["floor_z_m"], script["seed"]
    )


def _seen_alike(case: Case, other: Path, recording: Path, pose: np.ndarray, ground: float, seed: int) -> None:
    """Do to the files of a recording what the rig has no key for."""
    rng, lost = np.random.default_rng([seed, 2]), 0.3 if case.hard else 0.1
    for file in sorted((recording / "clouds").glob("*.ply")):
        cloud = read_cloud(file)
        height = transform_points(pose, cloud.points)[:, 2]
        keep = (rng.random(len(height)) >= lost) & ((np.abs(height - ground) > FLAT_M) | (rng.random(len(height)) < TABLE_SHARE))
        write_cloud(file, PointCloud(cloud.points[keep], cloud.colors[keep] if case.colors else None))
    for file in sorted((recording / "depth").glob("*.png")):
        _with_gaps(file, lost, rng)
    if case.control == "displacement":
        shutil.copy(other / "recording" / "frames.csv", recording)
        text = (recording / "recording.toml").read_text(encoding="utf-8")
        (recording / "recording.toml").write_text(
            text.replace('actuation = "tension"', 'actuation = "displacement"'), encoding="utf-8"
        )
    if not case.colors:
        shutil.rmtree(recording / "color", ignore_errors=True)
    lines = (recording / "markers.csv").read_text(encoding="utf-8").splitlines()
    kept = [lines[0], *(line for line in lines[1:] if int(line.split(",")[0]) < FREE)]
    (recording / "markers.csv").write_text("\n".join(kept) + "\n", encoding="utf-8")


def _with_gaps(file: Path, share: float, rng: np.random.Generator) -> None:
    """Take a share of its depths from an image, drawn at random."""
    import cv2

    image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    image[rng.random(image.shape) < share] = 0
    if not cv2.imwrite(str(file), image):
        raise OSError(f"{file} was not written")


if __name__ == "__main__":
    main()
