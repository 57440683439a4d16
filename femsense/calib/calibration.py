"""What a calibration is."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from femsense.core.arrays import FloatArray


@dataclass(frozen=True, eq=False, slots=True)
class Calibration:
    """The result of `calibrate`: camera poses and initial inputs of cables and chambers, with their covariance."""

    T_robot_camera: FloatArray
    """Pose of the first camera, shape (4, 4), from camera to robot coordinates [m]."""
    poses: tuple[FloatArray, ...]
    """Pose of each camera, shape (4, 4), from camera to robot coordinates [m]."""
    camera_names: tuple[str, ...]
    """Name of each camera."""
    cable_tension_n: dict[str, float]
    """Initial tension of each cable [N]."""
    cable_displacement_m: dict[str, float]
    """Initial shortening of each cable [m]."""
    rms_m: float
    """Root mean square distance between measured and modelled markers [m]; nan without markers."""
    marker_rms_m: dict[str, float]
    """Root mean square distance of each marker [m]."""
    history: tuple[float, ...]
    """Value of `rms_m` after each iteration [m]."""
    pose_std: FloatArray
    """Standard deviation of the entries of T_robot_camera, shape (4, 4)."""
    pose_covariance: FloatArray
    """Covariance of the pose of the first camera: (rotation about the mean of the markers [rad], shift [m]), shape (6, 6)."""
    tension_std_n: dict[str, float | None]
    """Standard deviation of each initial tension [N]; None: not determined by the data."""
    displacement_std_m: dict[str, float | None]
    """Standard deviation of each initial shortening [m]; None: not determined by the data."""
    status: str
    """"converged", or a text that states what the data do not determine."""
    placements_m: dict[str, list[float]] = field(default_factory=dict)
    """Marker positions measured in rest.csv, robot frame [m]."""
    frames: tuple[int, ...] = ()
    """Numbers of the frames that were used."""
    normal_rms_m: float = float("nan")
    """Root mean square distance of cloud points of contact-free frames from the surface, along its normal [m]; nan without clouds."""
    noise_m: float = float("nan")
    """Repeatability of the markers, root mean square in space [m]; nan if it cannot be estimated."""
    joint_covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    """Joint covariance of the poses of all cameras, (rotation [rad], shift [m]) each, shape (6 v, 6 v); empty: only that of the first
    camera is known."""
    marker_covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    """Joint covariance of undeclared poses (as joint_covariance) and initial inputs [N or m] from markers alone, without the term of the
    constitutive law; empty if nothing was fitted to markers. Not written to the file."""
    law_step: FloatArray = field(default_factory=lambda: np.zeros(0))
    """Change of all poses (as joint_covariance, which contains its square) and of the initial inputs under another constitutive law, shape
    (6 v + a,); empty if unknown."""
    is_corrected: bool = False
    """Whether the robot's empirical correction was used."""

    chamber_pressure_pa: dict[str, float] = field(default_factory=dict)
    """Initial pressure of each chamber, added to the recorded ones [Pa]; empty if their zero is known."""
    pressure_std_pa: dict[str, float | None] = field(default_factory=dict)
    """Standard deviation of each initial pressure [Pa]; None: not determined by the data."""

    @property
    def settled(self) -> bool:
        """Whether the fit converged; a calibration that did not must not be used."""
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
