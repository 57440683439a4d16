"""The hanging silicone hammer of data/hammer: one real depth frame, no marker, no colour. Its pose, and what is left along rays.

    python benchmarks/hammer.py [FOLDER] [--young KPA …]

First the camera is sought from nowhere. Then from the pose that its authors wrote down (off by centimetres), for several moduli: pose
and residual along rays, beside the camera's own noise, which is how the points scatter about their smooth part.
Points farther from the surface than 4 % of the body's diagonal (bars) do not count, nor do those on the clamped head: that is the holder.
"""

from __future__ import annotations

import argparse
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from femsense import Calibration, DataError, Recording, Robot, apply_effects, calibrate, load_recording, load_robot
from femsense.calib.cloud_pose_search import View, difference, settle_cloud_pose
from femsense.calib.clouds_alone import START_STD
from femsense.calib.from_clouds import fit_clouds, measured_noises
from femsense.calib.scan import REACH, RayRows, Scan, ray_rows, read_scan
from femsense.core.arrays import FloatArray
from femsense.io.clouds.frame_clouds import read_frame_cloud
from femsense.model.camera import CameraNoise
from femsense.model.contact_patch import body_surface
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.frame_state import solve_frame
from femsense.pointcloud.rays import Surface


def nowhere(robot: Robot, recording: Recording, nominal: FloatArray) -> None:
    """Print what the search from nowhere answers."""
    began = time.process_time()
    try:
        found = calibrate(robot, recording)
        turn, shift = difference(found.poses[0], nominal, Surface(robot.body.mesh.nodes, body_surface(robot.body.mesh).triangles))
        text = f"{found.status}: {np.degrees(turn):.1f}° and {1e3 * shift:.1f} mm from the authors' pose"
    except DataError as error:
        text = f"refused: {error}"
    print(f"from nowhere: {text} ({time.process_time() - began:.0f} s)", flush=True)


def from_nominal(robot: Robot, recording: Recording, nominal: FloatArray) -> tuple[Calibration, RayRows, Surface, float, Scan]:
    """Return the calibration from the authors' pose, the rows of rays, the surface, the standard deviation of the camera's noise there [m],
    and the points."""
    state = solve_frame(DrivenRobot(robot, drive_of(robot, recording)), 0).positions
    surface = Surface(state, body_surface(robot.body.mesh).triangles)
    cloud = read_frame_cloud(recording, 0)
    assert cloud is not None
    ahead = cloud.points[cloud.points[:, 2] > 0]
    near = settle_cloud_pose([View(ahead, np.ones(len(ahead), dtype=bool), surface)], nominal).T_robot_camera
    declared = calibrate(robot, replace(recording, T_robot_camera=(near,), free=None))  # unjudged: it is only a start
    size = float(np.linalg.norm(np.ptp(robot.body.mesh.nodes, axis=0)))
    start = np.diag([START_STD[0] ** 2] * 3 + [(START_STD[1] * size) ** 2] * 3)
    found = fit_clouds(robot, recording, replace(declared, joint_covariance=start), guessed=(0,))
    scan = read_scan(robot, recording, 0, found.poses, state)
    assert scan is not None
    held = np.zeros(len(state), dtype=bool)
    held[robot.body.clamped] = True
    unit = (CameraNoise("stereo", at_1m=1.0),)
    rows = ray_rows(scan, surface, found.poses, unit, reach=REACH * size).off(held)
    noise = measured_noises(robot, recording, found)[0]
    depth = float(np.median(scan.camera_points[rows.hits.index, 2]))
    return found, rows, surface, float(noise.std(np.array([depth]))[0]), scan


AROUND = 6.5
"""Pixels about a point that tell whether it lies near the outline."""


def made_of(rows: RayRows, scan: Scan, rest: FloatArray) -> None:
    """Print what the residual along rays is made of: the outline, what is smooth along the face that is seen, and what neighbours share."""
    ahead, place = scan.camera_points[rows.hits.index], rows.hits.place(rest)
    image = cKDTree(ahead[:, :2] / ahead[:, 2:])
    pixel = float(np.median(np.asarray(image.query(image.data, k=2)[0])[:, 1]))
    around = image.query_ball_point(image.data, AROUND * pixel, return_length=True)
    inner = around >= 0.8 * np.quantile(around, 0.95)
    residual, squares = 1e3 * rows.residual, float((rows.residual**2).sum())
    flat = (place[inner] - place[inner].mean(axis=0)) / place[inner].std(axis=0)
    near = cKDTree(place[inner]).query(place[inner], k=25)[1]
    local = (residual[inner] - residual[inner][near].mean(axis=1)) * np.sqrt(25 / 24)
    print("\n| part | points | rms | mean | share of squares |\n|---|---|---|---|---|")
    for name, some in ((f"within {AROUND:.0f} pixels of the outline", ~inner), ("inside", inner)):
        part = residual[some]
        share = 1e-6 * float((part**2).sum()) / squares
        print(f"| {name} | {len(part)} | {np.sqrt((part**2).mean()):.2f} mm | {part.mean():.2f} mm | {share:.0%} |")
    for degree in (1, 2, 7):
        basis = [flat[:, 0] ** a * flat[:, 2] ** b for a in range(degree + 1) for b in range(degree + 1 - a)]
        left = (
            residual[inner] - np.stack(basis, axis=1) @ np.linalg.lstsq(np.stack(basis, axis=1), residual[inner], rcond=None)[0]
        )
        print(f"| inside, less a polynomial of degree {degree} | | {np.sqrt((left**2).mean()):.2f} mm | | |")
    print(f"| inside, about the mean of 25 neighbours | | {np.sqrt((local**2).mean()):.2f} mm | | |\n", flush=True)


def main() -> None:
    """Print what is found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, default=Path(__file__).parents[1].parent / "shared" / "data" / "hammer")
    parser.add_argument("--young", nargs="*", type=float, default=[200.0, 300.0, 400.0], help="moduli [kPa]")
    parser.add_argument("--near", action="store_true", help="only from the authors' pose")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    robot, recording = load_robot(given.folder / "robot"), load_recording(given.folder / "recording")
    nominal = np.loadtxt(given.folder / "recording" / "T_robot_camera_nominal.txt")
    print(
        "| modulus | from the authors' pose | points | rms | median size | within 3 σ | camera's noise σ |\n|---|---|---|---|---|---|---|"
    )
    seen: dict[float, tuple[RayRows, Scan]] = {}
    for young in given.young:
        soft = apply_effects(
            robot, [{"name": "stiffness", "scale": 1e3 * young / float(np.median(robot.body.material.young_modulus))}]
        )
        found, rows, surface, noise, scan = from_nominal(soft, recording, nominal)
        residual, seen[young] = rows.residual, (rows, scan)
        turn, shift = difference(found.poses[0], nominal, surface)
        print(
            f"| {young:.0f} kPa | {np.degrees(turn):.1f}°, {1e3 * shift:.1f} mm | {len(residual)} | "
            f"{1e3 * np.sqrt((residual**2).mean()):.2f} mm | {1e3 * np.median(np.abs(residual)):.2f} mm | "
            f"{(np.abs(residual) < 3.0 * noise).mean():.0%} | {1e3 * noise:.2f} mm |",
            flush=True,
        )
    made_of(*seen[given.young[len(given.young) // 2]], robot.body.mesh.nodes)
    if not given.near:
        nowhere(robot, recording, nominal)


if __name__ == "__main__":
    main()
