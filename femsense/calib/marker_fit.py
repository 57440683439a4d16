"""A fit of poses and initial inputs to markers, as later steps look at it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray
from femsense.core.least_squares import FitResult
from femsense.model.camera_frame import in_robot_frame
from femsense.model.observation import Scene, SceneJet
from femsense.model.robot import Robot


@dataclass(frozen=True, eq=False, slots=True)
class MarkerFit:
    """Poses and initial inputs fitted to the markers of some frames; rows are those of the scene."""

    robot: Robot
    scene: Scene
    result: FitResult
    poses: tuple[FloatArray, ...]
    """T_robot_camera of each camera, shape (4, 4)."""
    initial: FloatArray | None
    """Initial inputs [N] or [m], shape (a,); None where they are known."""
    jet: SceneJet
    """Residuals at the end of the fit, with derivatives."""

    @property
    def measured(self) -> FloatArray:
        """Measured markers in the robot frame [m], shape (k, 3)."""
        return in_robot_frame(self.scene.points, self.scene.view, self.poses, self.robot.observation)

    @property
    def modelled(self) -> FloatArray:
        """Markers of the model, robot frame [m], shape (k, 3)."""
        return self.measured - self.jet.residual

    def rows_of(self, view: int) -> BoolArray:
        """Return which rows one camera saw, shape (k,)."""
        return np.asarray(self.scene.view == view)

    def misfit_of(self, view: int) -> float:
        """Return the root mean square residual of a camera's markers [m]; 0 without markers."""
        mine = self.jet.residual[self.rows_of(view)]
        return root_mean_square(mine) if len(mine) else 0.0

    def spread_of(self, view: int) -> float:
        """Return the root mean square distance of a camera's modelled markers from their middle [m]; 0 without markers."""
        mine = self.modelled[self.rows_of(view)]
        return root_mean_square(mine - mine.mean(axis=0)) if len(mine) else 0.0


def root_mean_square(rows: FloatArray) -> float:
    """Return the root mean square length of rows (k, c)."""
    return float(np.sqrt((rows**2).sum(axis=1).mean()))
