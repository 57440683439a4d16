"""What other programs record, read in: speed and memory for each format, beside the readers that exist.

    python benchmarks/inputs.py [--frames 120] [--size 640x480] [--formats rosbag1,mcap,…] [--folder DIR]

Seconds are of processor time. Each file is written by the format's own writer, then imported twice in a process of its own: as it
is, and four times as long. The peak memory of both says whether it grows with the length. "Other" is the time in which another
reader decodes the same frames into arrays without writing anything: rosbags for bags, ezc3d for C3D, Open3D for clouds, images
and RealSense .bag, PyAV's packets for .mkv.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "support"))
LONGER = 4


def depth_image(number: int, size: tuple[int, int]) -> np.ndarray:
    """Return a depth image [mm] of a bowl with noise of a millimetre and holes, as a camera gives."""
    rng = np.random.default_rng(number)
    y, x = np.mgrid[-1 : 1 : size[1] * 1j, -1 : 1 : size[0] * 1j]
    image = 600 + 150 * (x * x + y * y) + rng.normal(size=x.shape)
    image[rng.random(x.shape) < 0.03] = 0
    return image.astype(np.uint16)


def write_bag(kind: str, *, clouds: bool = False, packed: bool = False) -> Callable[[Path, int, tuple[int, int]], Path]:
    """Return a writer of bags with depth images or with clouds."""

    def write(folder: Path, frames: int, size: tuple[int, int]) -> Path:
        import cv2
        from ros_writers import START_NS, STEP_NS, BagWriter

        path = folder / ("take.bag" if kind == "1" else "take")
        lens = (0.9 * size[0], 0.9 * size[0], size[0] / 2, size[1] / 2)
        rays = np.dstack(np.meshgrid((np.arange(size[0]) - lens[2]) / lens[0], (np.arange(size[1]) - lens[3]) / lens[1]))
        with BagWriter(path, kind) as bag:
            for k in range(frames):
                at = START_NS + k * STEP_NS
                depth = depth_image(k % 8, size)
                if clouds:
                    z = depth[:, :, None] * 1e-3
                    bag.write("/points", at, bag.cloud(np.concatenate([rays * z, z], axis=2).reshape(-1, 3), None, at))
                    continue
                if packed:
                    png = bytes(12) + cv2.imencode(".png", depth)[1].tobytes()
                    bag.write(
                        "/camera/depth/image_raw/compressedDepth", at, bag.compressed(png, "16UC1; compressedDepth png", at)
                    )
                else:
                    bag.write("/camera/depth/image_raw", at, bag.image(depth, "16UC1", at))
                bag.write("/camera/depth/camera_info", at, bag.info(at, lens=lens, size=size))
        return path

    return write


def write_c3d(folder: Path, frames: int, size: tuple[int, int]) -> Path:
    import ezc3d

    file = ezc3d.c3d()
    points = np.ones((4, 12, 40 * frames))
    points[:3] = np.random.default_rng(0).normal(size=points[:3].shape)
    parameters = file["parameters"]["POINT"]
    parameters["RATE"]["value"], parameters["UNITS"]["value"] = [200.0], ["mm"]
    parameters["LABELS"]["value"] = [f"M{i}" for i in range(12)]
    file["data"]["points"] = points
    file.write(str(folder / "take.c3d"))
    return folder / "take.c3d"


def write_csv(folder: Path, frames: int, size: tuple[int, int]) -> Path:
    rows = np.random.default_rng(0).normal(size=(40 * frames, 36))
    table = np.column_stack([0.005 * np.arange(len(rows)), rows])
    header = ",".join(["time_s", *(f"M{i}_{axis}" for i in range(12) for axis in "xyz")])
    np.savetxt(folder / "take.csv", table, delimiter=",", header=header, comments="", fmt="%.6f")
    return folder / "take.csv"


def write_tum(folder: Path, frames: int, size: tuple[int, int]) -> Path:
    import cv2

    (folder / "depth").mkdir()
    lines = []
    for k in range(frames):
        cv2.imwrite(str(folder / f"depth/{k / 30:.6f}.png"), 5 * depth_image(k % 8, size))
        lines.append(f"{k / 30:.6f} depth/{k / 30:.6f}.png")
    (folder / "depth.txt").write_text("\n".join(lines))
    (folder / "calibration.txt").write_text(f"{0.9 * size[0]} {0.9 * size[0]} {size[0] / 2} {size[1] / 2}")
    return folder


def write_sdk(ending: str) -> Callable[[Path, int, tuple[int, int]], Path]:
    """Return a writer of 64 × 48 images with the RealSense SDK's recorder; its colour images are registered on reading."""

    def write(folder: Path, frames: int, size: tuple[int, int]) -> Path:
        script, path = ROOT / "tests/support/realsense_writer.py", folder / f"take.{ending}"
        environment = dict(os.environ)
        if ending == "bag":  # only SDKs up to 2.57 write it: one goes into a folder of its own
            old = folder.parent / "old-sdk"
            command = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", old, "pyrealsense2==2.57.7.10387"]
            if not old.is_dir():
                subprocess.run(command, check=True, capture_output=True)
            environment["PYTHONPATH"] = str(old)
        subprocess.run([sys.executable, script, path, str(frames)], check=True, capture_output=True, env=environment)
        return path

    return write


def write_clouds(ending: str) -> Callable[[Path, int, tuple[int, int]], Path]:
    """Return a writer of clouds of a quarter of an image's pixels."""

    def write(folder: Path, frames: int, size: tuple[int, int]) -> Path:
        import open3d as o3d

        points = np.random.default_rng(0).random((size[0] * size[1] // 4, 3))
        for k in range(frames):
            file, moved = folder / f"{k / 30:.6f}.{ending}", points + 1e-3 * k
            if ending == "npz":
                np.savez(file, points=moved)
            elif ending == "xyz":
                np.savetxt(file, moved, fmt="%.6f")
            else:
                o3d.io.write_point_cloud(str(file), o3d.geometry.PointCloud(o3d.utility.Vector3dVector(moved)))
        return folder

    return write


def write_mkv(folder: Path, frames: int, size: tuple[int, int]) -> Path:
    """Write depth of the binned wide view, 512 × 512, and colours of 1280 × 720 as an Azure Kinect records them."""
    from kinect_writer import write_kinect

    depths = [depth_image(k % 8, (512, 512)) for k in range(8)]
    row, column = np.mgrid[:720, :1280]
    colors = [np.stack([column // 5, row // 3, np.full(row.shape, 20 * k)], axis=2).astype(np.uint8) for k in range(8)]
    return write_kinect(
        folder / "take.mkv", [depths[k % 8] for k in range(frames)], [colors[k % 8] for k in range(frames)], late_ms=1
    )


def write_redwood(folder: Path, frames: int, size: tuple[int, int]) -> Path:
    """Write depth/ and color/ with names that are times in microseconds."""
    import cv2

    rng = np.random.default_rng(0)
    colors = [
        np.kron(rng.integers(0, 255, (size[1] // 8, size[0] // 8, 3)), np.ones((8, 8, 1))).astype(np.uint8) for _ in range(4)
    ]
    for name in ("depth", "color"):
        (folder / name).mkdir()
    for k in range(frames):
        name = f"{k:07d}-{int(1e6 * k / 30):012d}"
        cv2.imwrite(str(folder / f"depth/{name}.png"), depth_image(k % 8, size))
        cv2.imwrite(str(folder / f"color/{name}.jpg"), colors[k % 4])
    lens = {"width": size[0], "height": size[1], "intrinsic_matrix": [500, 0, 0, 0, 500, 0, size[0] / 2, size[1] / 2, 1]}
    (folder / "camera_intrinsic.json").write_text(json.dumps(lens))
    return folder


def write_export(program: str) -> Callable[[Path, int, tuple[int, int]], Path]:
    """Return a writer of exports of twelve markers as Motive and Nexus lay them out."""

    def write(folder: Path, frames: int, size: tuple[int, int]) -> Path:
        rows = np.random.default_rng(0).normal(size=(40 * frames, 36))
        names = [f"M{i}" for i in range(12) for _ in "xyz"]
        axes = ["X", "Y", "Z"] * 12
        if program == "motive":
            about = "Format Version,1.23,Take Name,a,Capture Frame Rate,200,Export Frame Rate,200,Rotation Type,Quaternion,Length Units,Millimeters"
            kinds = [
                ["", *row] for row in (["Type", *["Marker"] * 36], ["Name", *names], ["ID", *names], ["", *["Position"] * 36])
            ]
            head = [about, "", *map(",".join, kinds), ",".join(["Frame", "Time (Seconds)", *axes])]
            begin = [f"{k},{0.005 * k:.6f}" for k in range(len(rows))]
        else:
            spread = [name if j % 3 == 0 else "" for j, name in enumerate(names)]
            head = [
                "Trajectories",
                "200",
                ",".join(["", "", *spread]),
                ",".join(["Frame", "Sub Frame", *axes]),
                ",".join(["", "", *["mm"] * 36]),
            ]
            begin = [f"{k},0" for k in range(len(rows))]
        lines = [f"{start}," + ",".join(f"{value:.6f}" for value in row) for start, row in zip(begin, rows)]
        (folder / "take.csv").write_text("\n".join([*head, *lines]) + "\n")
        return folder / "take.csv"

    return write


def read_rosbags(path: Path) -> int:
    from rosbags.highlevel import AnyReader

    with AnyReader([path]) as reader:
        wanted = [c for c in reader.connections if c.msgtype.endswith(("Image", "PointCloud2"))]
        return sum(len(reader.deserialize(raw, c.msgtype).data) > 0 for c, _, raw in reader.messages(connections=wanted))


def read_ezc3d(path: Path) -> int:
    import ezc3d

    return int(ezc3d.c3d(str(path))["data"]["points"].shape[2])


def read_table(path: Path) -> int:
    return len(np.loadtxt(path, delimiter=",", skiprows=1))


def read_av(path: Path) -> int:
    import av

    with av.open(str(path)) as file:
        return sum(len(bytes(packet)) > 0 for packet in file.demux(file.streams.video[0]) if packet.size)


def read_numpy(path: Path) -> int:
    return sum(len(np.load(file)["points"]) > 0 for file in path.glob("*.npz"))


def read_open3d(path: Path) -> int:
    import open3d as o3d

    images = sorted(path.glob("depth/*.png"))
    clouds = sorted(file for file in path.iterdir() if file.suffix in (".ply", ".pcd", ".xyz"))
    done = sum(len(np.asarray(o3d.io.read_image(str(file)))) > 0 for file in images)
    return done + sum(len(o3d.io.read_point_cloud(str(file)).points) > 0 for file in clouds)


FORMATS: dict[str, tuple[str, Callable[..., Path], Callable[[Path], int] | None, dict[str, str]]] = {
    "rosbag1": ("rosbags", write_bag("1"), read_rosbags, {}),
    "rosbag2 db3": ("rosbags", write_bag("sqlite3"), read_rosbags, {}),
    "mcap": ("rosbags", write_bag("mcap"), read_rosbags, {}),
    "mcap clouds": ("rosbags", write_bag("mcap", clouds=True), read_rosbags, {}),
    "mcap compressedDepth": ("rosbags", write_bag("mcap", packed=True), read_rosbags, {}),
    "realsense bag": ("SDK 2.57", write_sdk("bag"), None, {}),
    "realsense db3": ("SDK 2.58+", write_sdk("db3"), None, {}),
    "kinect mkv": ("PyAV", write_mkv, read_av, {}),
    "tum": ("cv2", write_tum, read_open3d, {}),
    "redwood": ("cv2", write_redwood, read_open3d, {}),
    "ply": ("Open3D", write_clouds("ply"), read_open3d, {"unit": "m"}),
    "pcd": ("Open3D", write_clouds("pcd"), read_open3d, {"unit": "m"}),
    "xyz": ("NumPy", write_clouds("xyz"), read_open3d, {"unit": "m"}),
    "npz": ("NumPy", write_clouds("npz"), read_numpy, {"unit": "m"}),
    "c3d": ("ezc3d", write_c3d, read_ezc3d, {}),
    "optitrack csv": ("its layout", write_export("motive"), None, {}),
    "vicon csv": ("its layout", write_export("nexus"), None, {}),
    "csv": ("NumPy", write_csv, read_table, {"unit": "mm"}),
}
"""Name → writer's name, writer, another reader, options of the import."""


def size_of(path: Path) -> int:
    files = [f for f in path.rglob("*") if f.is_file()] if path.is_dir() else [path]
    return sum(f.stat().st_size for f in files)


def import_alone(path: Path, output: Path, options: dict[str, str]) -> dict[str, float]:
    """Import in a process of its own; return frames,
    seconds of processor time and peak memory [MB] beyond what the imports alone take."""
    command = [sys.executable, __file__, "--import", str(path), str(output), json.dumps(options)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def run_import(path: str, output: str, options: str) -> None:
    from femsense.io.importers.guess import open_source
    from femsense.io.importers.options import Options
    from femsense.io.importers.writer import write_recording

    base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    began = time.process_time()
    found = write_recording(open_source(path, Options(**json.loads(options))), output, identity={})
    seconds = time.process_time() - began
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - base
    print(json.dumps({"frames": found["frames"], "seconds": seconds, "peak_mb": peak / 1024}))


def row_of(name: str, frames: int, size: tuple[int, int], folder: Path) -> str:
    writer, write, other, options = FORMATS[name]
    results, stored, path = [], 0, folder
    for factor in (1, LONGER):
        place = folder / f"{name.replace(' ', '-')}-{factor}"
        place.mkdir(parents=True)
        path = write(place, factor * frames, size)
        stored = size_of(path)
        results.append(import_alone(path, folder / f"out-{name.replace(' ', '-')}-{factor}", options))
    long = results[1]
    beside = "–"
    if other is not None:
        began = time.process_time()
        count = other(path)
        beside = f"{count / (time.process_time() - began):.0f}"
    speed, rate = long["frames"] / long["seconds"], 1e-6 * stored / long["seconds"]
    memory = f"{results[0]['peak_mb']:.0f} / {long['peak_mb']:.0f}"
    return f"| {name} | {writer} | {1e-6 * stored:.1f} | {long['frames']} | {speed:.0f} | {rate:.1f} | {memory} | {beside} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--formats", default=",".join(FORMATS))
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--import", dest="alone", nargs=3, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.alone:
        run_import(*given.alone)
        return
    width, height = map(int, given.size.split("x"))
    print(f"| format | writer | MB | frames | frames/s | MB/s | peak MB, short / {LONGER} times as long | other, frames/s |")
    print("|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory(dir=given.folder) as place:
        for name in given.formats.split(","):
            print(row_of(name, given.frames, (width, height), Path(place)), flush=True)


if __name__ == "__main__":
    main()
