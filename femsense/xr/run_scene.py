"""The scene of a run for other viewers: the body's surface, force arrows, clouds, the camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from femsense.calib.files import read_calibration
from femsense.core.arrays import FloatArray, IntArray
from femsense.fem.mesh import TetMesh, surface_triangles
from femsense.model.recording import Recording
from femsense.pointcloud.cloud import PointCloud
from femsense.sensing.types import ContactForce, Run

METRES_PER_NEWTON = 0.05
"""Length of a force's arrow."""
BODY = (0.35, 0.55, 0.85, 0.9)
"""Red, green, blue and opacity, 0 … 1."""
FORCE = (0.9, 0.25, 0.15, 1.0)


def camera_pose(folder: str | Path) -> FloatArray | None:
    """Return the T_robot_camera that a run was made with, shape (4, 4); None where its folder has no calibration."""
    calibration = Path(folder).expanduser() / "calibration.json"
    return np.asarray(read_calibration(calibration).T_robot_camera, dtype=float) if calibration.is_file() else None


def recording_of(run: Run) -> Recording | None:
    """Return the recording of a run, or None if it no longer exists."""
    from femsense.io.recording_folder import load_recording

    folder = run.recording_folder
    return load_recording(folder) if folder is not None and (folder / "recording.toml").is_file() else None


def cloud_of(recording: Recording | None, frame: int) -> PointCloud | None:
    """Return the cloud of a frame [m, camera frame], or None if there is none."""
    from femsense.io.clouds.frame_clouds import read_frame_cloud

    at = np.flatnonzero(recording.frame_numbers == frame) if recording is not None else np.zeros(0, dtype=np.int64)
    return read_frame_cloud(recording, int(at[0])) if recording is not None and len(at) else None


def body_surface(run: Run, index: int) -> tuple[FloatArray, IntArray]:
    """Return the nodes of the deformed surface [m], shape (n, 3), and its triangles, shape (t, 3)."""
    triangles = surface_triangles(TetMesh(run.states.rest_nodes_m, run.states.tets))
    used, corners = np.unique(triangles, return_inverse=True)
    return np.asarray(run.states.nodes_m[index], dtype=float)[used], corners.reshape(-1, 3)


def arrow_of(contact: ContactForce) -> tuple[FloatArray, FloatArray]:
    """Return start and vector [m] of an arrow that ends at the contact point, each of shape (3,)."""
    size = float(np.linalg.norm(contact.force_n_xyz))
    length = max(METRES_PER_NEWTON * size, 1e-4)
    along = contact.force_n_xyz / max(size, 1e-12) * length
    return contact.position_m - along, along
