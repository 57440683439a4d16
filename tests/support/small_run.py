"""A run made by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from helpers import write_block_robot, write_small_recording

from femsense.io.clouds.cloud_files import write_cloud
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot
from femsense.model.robot import Robot
from femsense.pointcloud.cloud import PointCloud
from femsense.sensing.run_files import run_inputs, write_run
from femsense.sensing.types import ContactForce, FrameReport, LoadComparison, Run, States

NAN = float("nan")


def make_run(robot: Robot) -> Run:
    nodes = robot.body.mesh.nodes
    rng = np.random.default_rng(5)
    contacts = tuple(
        ContactForce(
            frame, 0.5 * frame, i, rng.normal(size=3), rng.normal(size=3), rng.normal(size=3), rng.random(), std, "cloud"
        )
        for frame, i, std in ((1, 0, 0.1), (1, 1, NAN), (4, 0, 0.3))
    )
    frames = (
        FrameReport(0, 0.0, 'no equilibrium: "stuck", try, again', 0, 0, NAN, NAN, NAN, {"top": NAN, "side": NAN}),
        FrameReport(1, 0.5, "ok", 2, 12, 1e-3, 1e-4, 12.5, {"top": 1.0, "side": 0.25}),
        FrameReport(4, 1.0, "ok", 1, 12, 1 / 3e3, 1e-4, 11.5, {"top": 2.0, "side": 0.5}),
    )
    moved = (nodes[None] + 1e-3 * rng.normal(size=(3, *nodes.shape))).astype(np.float32)
    states = States(np.array([0.0, 0.5, 1.0]), moved, robot.body.mesh.tets, nodes)
    return Run(
        contacts,
        frames,
        states,
        robot,
        Path("somewhere"),
        (LoadComparison(frame=4, declared_n=0.5, sensed_n=0.49, error_percent=-2.0),),
    )


def write_run_with_a_cloud(tmp_path: Path) -> tuple[Path, Run, np.ndarray]:
    """Return a folder with a run of three frames, the run, and the points of its second frame's cloud."""
    robot = load_robot(write_block_robot(tmp_path / "robot"))
    run = make_run(robot)
    folder = write_small_recording(tmp_path / "recording", frames_csv="frame,time_s\n0,0.0\n1,0.5\n4,1.0\n", markers_csv=None)
    (folder / "clouds").mkdir()
    points = np.random.default_rng(0).random((30, 3)).astype(np.float32).astype(float)
    write_cloud(folder / "clouds/000001.ply", PointCloud(points, np.tile([1.0, 0.0, 51 / 255], (30, 1))))
    write_run(run, tmp_path / "run", inputs=run_inputs(robot, load_recording(folder), None))
    return tmp_path / "run", run, points
