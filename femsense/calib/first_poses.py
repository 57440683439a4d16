"""Where the fit of the camera poses begins: declared, from markers at rest, or from those of one frame."""

from __future__ import annotations

from femsense.calib.inputs import first_inputs
from femsense.calib.rigid import fit_rigid, fit_rigid_robust
from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError
from femsense.fem.equilibrium import SolveOptions
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.frame_state import solve_frame
from femsense.model.observation import Scene
from femsense.model.robot import Robot


def first_poses(robot: Robot, scene: Scene) -> list[FloatArray]:
    """Return a start for the pose of each camera: declared, from the markers at rest, or from those of the first frame.

    Raises:
        DataError: a camera sees fewer than three markers.
    """
    poses: list[FloatArray] = []
    for v, name in enumerate(scene.recording.camera_names):
        declared = scene.recording.T_robot_camera[v]
        resting = scene.rest_view == v
        if declared is not None:
            poses.append(declared)
        elif resting.sum() >= 3:
            poses.append(fit_rigid_robust(robot.marker_points[scene.rest_marker[resting]], scene.rest_points[resting])[0])
        else:
            poses.append(_pose_from_frame(robot, scene, v, name))
    return poses


def _pose_from_frame(robot: Robot, scene: Scene, view: int, name: str) -> FloatArray:
    """Fit the first frame in which a camera sees enough markers to the model of that frame."""
    driven = DrivenRobot(robot, drive_of(robot, scene.recording, initial=first_inputs(robot, scene.recording)))
    most = 0
    for k in scene.frames:
        rows = (scene.frame == k) & (scene.view == view)
        most = max(most, int(rows.sum()))
        if rows.sum() >= 3:
            state = solve_frame(driven, int(k), options=SolveOptions(single=True))
            shape = state.positions if state.converged else robot.body.mesh.nodes
            return fit_rigid(robot.markers.positions(shape)[scene.marker[rows]], scene.points[rows])
    raise DataError(
        f"camera {name or '(only one)'} needs a frame with three markers for its pose; the most in one frame is {most}. "
        f"Give T_robot_camera, or show more markers"
    )
