"""calibration.json, written and read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from femsense.calib.calibration import Calibration
from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import InputError
from femsense.core.pose import check_pose
from femsense.io.files import check_target, plain, write_json
from femsense.io.own_files import CALIBRATION
from femsense.io.result_folder import number_of, numbers_of, read_document, table_of, value_of

CALIBRATION_FORMAT = "femsense-calibration-1"


# Calibration


def calibration_document(calibration: Calibration) -> dict[str, Any]:
    """Return the content of calibration.json."""
    c = calibration
    document: dict[str, Any] = {
        "format": CALIBRATION_FORMAT,
        "status": c.status,
        "T_robot_camera": c.T_robot_camera,
        "cable_tension_n": c.cable_tension_n,
        "cable_displacement_m": c.cable_displacement_m,
        "chamber_pressure_pa": c.chamber_pressure_pa,
        "rms_m": c.rms_m,
        "marker_rms_m": c.marker_rms_m,
        "history": [{"iteration": i, "rms_m": r} for i, r in enumerate(c.history)],
        "std": {
            "T_robot_camera": c.pose_std,
            "cable_tension_n": c.tension_std_n,
            "cable_displacement_m": c.displacement_std_m,
            **({"chamber_pressure_pa": c.pressure_std_pa} if c.pressure_std_pa else {}),
        },
        "pose_covariance": c.pose_covariance,
        "joint_covariance": c.joint_covariance,
        "law_step": c.law_step,
        "normal_rms_m": c.normal_rms_m,
        "noise_m": c.noise_m,
        "placements_m": c.placements_m,
        "frames": c.frames,
        "corrected": c.is_corrected,
        "cameras": [{"name": name, "T_robot_camera": T} for name, T in zip(c.camera_names, c.poses)],
    }
    checked: dict[str, Any] = plain(document)
    return checked


def write_calibration(calibration: Calibration, path: str | Path) -> Path:
    """Write a calibration to a JSON file.

    Arguments:
        calibration: result of `calibrate`.
        path: the file, by convention calibration.json. An earlier calibration there is replaced.

    Returns:
        the path.

    Raises:
        InputError: a folder, or a file of another kind, exists at that path.
    """
    target = Path(path)
    if target.is_dir():
        raise InputError(
            "a folder exists where the file should be written", where=target, hint=f"-o {target / 'calibration.json'}"
        )
    check_target(target, folder=False, kind=CALIBRATION)
    write_json(target, calibration_document(calibration))
    return target


def read_calibration(path: str | Path) -> Calibration:
    """Read calibration.json: camera poses and initial inputs, as `femsense calibrate` or `write_calibration` wrote them.

    Arguments:
        path: the file, or the folder that contains it.

    Returns:
        the calibration, for `estimate` and `reach`.

    Raises:
        InputError: the file is missing, broken or of another kind. The error names the key, the value found and the value expected.

    Example:
        >>> import tempfile
        >>> import femsense as fs
        >>> recording = fs.load_recording(fs.robot_names()["finger"] / "recordings" / "press")  # installed with femsense
        >>> calibration = fs.calibrate(fs.load_robot("finger"), recording)
        >>> path = fs.write_calibration(calibration, tempfile.mkdtemp() + "/calibration.json")
        >>> fs.read_calibration(path).status
        'converged'
    """
    file = Path(path).expanduser()
    file = file / "calibration.json" if file.is_dir() else file
    document = read_document(file, CALIBRATION_FORMAT)
    std = table_of(document, "std", file)
    T = check_pose(value_of(document, "T_robot_camera", file), f"{file}: T_robot_camera")
    cameras = document.get("cameras") or [{"name": "", "T_robot_camera": T}]
    try:
        return Calibration(
            T_robot_camera=freeze(T),
            poses=tuple(freeze(check_pose(camera["T_robot_camera"], f"{file}: cameras")) for camera in cameras),
            camera_names=tuple(str(camera["name"]) for camera in cameras),
            cable_tension_n=numbers_of(document, "cable_tension_n", file),
            cable_displacement_m=numbers_of(document, "cable_displacement_m", file),
            rms_m=number_of(document.get("rms_m")),
            marker_rms_m=numbers_of(document, "marker_rms_m", file),
            history=tuple(number_of(entry["rms_m"]) for entry in document.get("history", [])),
            pose_std=_matrix(std.get("T_robot_camera"), 4),
            pose_covariance=_matrix(document.get("pose_covariance"), 6),
            tension_std_n=dict(std.get("cable_tension_n", {})),
            displacement_std_m=dict(std.get("cable_displacement_m", {})),
            chamber_pressure_pa={str(n): float(v) for n, v in document.get("chamber_pressure_pa", {}).items()},
            pressure_std_pa=dict(std.get("chamber_pressure_pa", {})),
            status=str(document.get("status", "")),
            placements_m={name: [float(x) for x in point] for name, point in document.get("placements_m", {}).items()},
            frames=tuple(int(frame) for frame in document.get("frames", [])),
            normal_rms_m=number_of(document.get("normal_rms_m")),
            noise_m=number_of(document.get("noise_m")),
            joint_covariance=_matrix(document.get("joint_covariance"), 6 * len(cameras)),
            law_step=freeze(np.array([number_of(x) for x in document.get("law_step", [])])),
            is_corrected=bool(document.get("corrected", False)),
        )
    except (TypeError, ValueError, KeyError, AttributeError) as error:
        raise InputError(
            "a broken calibration",
            where=file,
            found=f"{type(error).__name__}: {error}",
            expected="what femsense calibrate wrote",
            hint="calibrate again",
        ) from None


def _matrix(rows: Any, size: int) -> FloatArray:
    """Return a square matrix, zero where it is not given."""
    return freeze(
        np.zeros((size, size)) if rows is None else np.array([[number_of(x) for x in row] for row in rows]).reshape(size, size)
    )
