"""What a calibration is."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from femsense.core.arrays import FloatArray


@dataclass(frozen=True, eq=False, slots=True)
class Calibration:
    """Poses of the cameras and initial inputs of the cables, with their uncertainty."""

    T_robot_camera: FloatArray
    """Pose of the first camera, shape (4, 4)."""
    poses: tuple[FloatArray, ...]
    """Poses of all cameras, each (4, 4)."""
    camera_names: tuple[str, ...]
    cable_tension_n: dict[str, float]
    """Initial tension of each cable [N]."""
    cable_displacement_m: dict[str, float]
    """Initial shortening of each cable [m]."""
    rms_m: float
    """Root mean square distance between measured and modelled markers [m]; nan where there are none."""
    marker_rms_m: dict[str, float]
    history: tuple[float, ...]
    """rms_m of each iteration [m]."""
    pose_std: FloatArray
    """One standard deviation of the entries of T_robot_camera, shape (4, 4)."""
    pose_covariance: FloatArray
    """Of (rotation about the markers' mean [rad], shift [m]) of the first camera, shape (6, 6)."""
    tension_std_n: dict[str, float | None]
    """[N]; None where the data say nothing."""
    displacement_std_m: dict[str, float | None]
    status: str
    """"converged", or what the data leave open, in words."""
    placements_m: dict[str, list[float]] = field(default_factory=dict)
    """Where rest.csv shows the markers to sit [m], robot frame."""
    frames: tuple[int, ...] = ()
    """Numbers of the frames that were used."""
    normal_rms_m: float = float("nan")
    """Root mean square distance of the points of free frames' clouds from the surface [m]; nan where none were used."""
    noise_m: float = float("nan")
    """What markers repeat to [m], root mean square in space; nan where nothing tells it."""
    joint_covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    """Of (rotation [rad], shift [m]) of all cameras together, shape (6 v, 6 v); not given:
    that of the first camera alone is known."""
    marker_covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    """What markers alone say of undeclared poses (as joint_covariance) and of initial inputs ([N] or [m]) together; empty where
    nothing was fitted to them, without what another law changes. It is not kept in a file."""
    law_step: FloatArray = field(default_factory=lambda: np.zeros(0))
    """By how much another law moves all poses (as joint_covariance, which holds its square) and what markers say of initial inputs, shape (6 v + a,);
    empty where nobody knows."""
    is_corrected: bool = False
    """Whether the robot's empirical correction was used."""

    chamber_pressure_pa: dict[str, float] = field(default_factory=dict)
    """Initial pressure of each chamber, added to the recorded ones [Pa]; empty where their zero is known."""
    pressure_std_pa: dict[str, float | None] = field(default_factory=dict)
    """[Pa]; None where the data say nothing."""

    @property
    def settled(self) -> bool:
        """Whether the fit came to an end; what has not settled is no calibration."""
        return not self.status.startswith("not settled")

    def __repr__(self) -> str:
        fits = [(self.rms_m, "markers"), (self.normal_rms_m, "clouds")]
        said = [f"{1e3 * value:.3g} mm rms of {what}" for value, what in fits if np.isfinite(value)]
        cables = [f"initial inputs of {', '.join(self.cable_tension_n)}"] if self.cable_tension_n else []
        cameras = f"{len(self.poses)} camera{'s' if len(self.poses) != 1 else ''}"
        return f"Calibration({'; '.join([cameras, *said, *cables, self.status])})"

    def __post_init__(self) -> None:
        if self.joint_covariance.size == 0:
            joint = np.zeros((6 * len(self.poses),) * 2)
            joint[:6, :6] = self.pose_covariance
            object.__setattr__(self, "joint_covariance", joint)
