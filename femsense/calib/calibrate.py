"""Calibration of camera pose and initial cable inputs from markers.

Algorithm 1 of Zhang et al. 2019 gives the start: a rigid fit by SVD, then the inputs by a bounded QP on the compliance, then a
new equilibrium, in turns. Its fixed point is not the joint optimum where the pose can absorb the inputs, so a bounded
Gauss–Newton over pose and inputs together finishes, and its normal matrix gives the standard deviations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from femsense.calib.calibration import Calibration
from femsense.calib.checks import relabelled
from femsense.calib.clouds_alone import placed_by_clouds, views_without_markers
from femsense.calib.declared_by_clouds import check_declared_by_clouds, views_to_check
from femsense.calib.first_poses import first_poses
from femsense.calib.from_clouds import fit_clouds
from femsense.calib.from_images import has_image_markers, with_image_markers
from femsense.calib.inputs import first_inputs, input_bounds, input_tables, largest_input, weak_inputs
from femsense.calib.joint import PLACEMENT_STD_FLOOR, fit_joint, moved_by_law
from femsense.calib.marker_assignment import name_markers
from femsense.calib.marker_fit import MarkerFit, root_mean_square
from femsense.calib.marker_readings import UNNAMED
from femsense.calib.other_readings import OF_LARGE_ERRORS, OF_MARKERS, OF_SMALL_ERRORS
from femsense.calib.pressure_zeros import find_pressure_zeros, has_unknown_zeros, weak_zeros, with_initial_pressures
from femsense.calib.readings import compare_readings, is_suspicious, rigid_misfit
from femsense.calib.rigid import fit_rigid
from femsense.calib.without_fit import as_declared, from_rest
from femsense.core.arrays import FloatArray, IntArray, freeze
from femsense.core.errors import DataError
from femsense.core.least_squares import FitResult
from femsense.core.parallel import one_blas_thread
from femsense.core.pose import std_of_entries
from femsense.fem.equilibrium import Equilibrium
from femsense.model.camera_frame import in_robot_frame
from femsense.model.marker_correction import corrected
from femsense.model.observation import Hypothesis, Scene, SceneJet, evaluate_scene, make_scene
from femsense.model.path_solver import PathSolver, look_at
from femsense.model.recording import Recording
from femsense.model.recording_checks import check_against, how_to_free
from femsense.model.repeats import marker_repeatability
from femsense.model.robot import Robot

TURNS = 3
"""Largest number of turns of Algorithm 1, which only finds the start of the joint fit."""
MAX_FRAMES = 16
"""More frames than this are thinned out evenly; they would add time and hardly any accuracy."""
START_FRAMES = 5
"""Frames that Algorithm 1 uses for the start."""
HOPELESS = 0.5
"""A misfit above this share of the markers' spread is no fit, whatever the reason."""


def usable_frames(recording: Recording) -> IntArray:
    """Return the frames in which every load is known: free ones, and those with declared loads; all where nothing is said."""
    every = np.arange(len(recording.time_s))
    if recording.free is None:
        return every
    known = recording.free.copy()
    known[recording.load_frame] = True
    return every[known]


@one_blas_thread()
def calibrate(robot: Robot, recording: Recording, *, frames: Sequence[int] | None = None, correct: bool = False) -> Calibration:
    """Estimate the pose of each camera and, if the recording declares an unknown zero, the initial inputs of cables and chambers.

    The poses and inputs minimise the distance between measured and modelled markers (and clouds, the surface points of depth images) in
    contact-free frames. The normal matrix of this least-squares problem gives their covariance.

    Arguments:
        robot: the declared robot, result of `load_robot`.
        recording: markers, clouds or images, and inputs, result of `load_recording`.
        frames: indices of the frames to use. Default: at most 16 contact-free frames, evenly spaced.
        correct: whether to subtract the robot's empirical correction (`femsense improve --correct`) from the markers first. Default: no.

    Returns:
        the calibration: `poses`, one (4, 4) matrix per camera from camera to robot coordinates [m]; initial tensions [N] and shortenings [m]; their standard
        deviations. `status` is "converged", or names the inputs that the data do not determine.

    Raises:
        InputError: `correct` for a robot without a correction.
        DataError: no contact-free frame, too few markers, or no equilibrium.

    Example:
        >>> import femsense as fs
        >>> robot = fs.load_robot("finger")
        >>> recording = fs.load_recording(fs.robot_names()["finger"] / "recordings" / "press")  # installed with femsense
        >>> calibration = fs.calibrate(robot, recording)
        >>> calibration.status, round(1e3 * calibration.rms_m, 1)  # mm; the declared finger lacks friction
        ('converged', 1.8)
    """
    found = _calibrated(robot, recording, frames)
    if not correct:
        return found
    moved = corrected(check_against(robot, recording), robot.require_correction(), found.poses)
    return replace(_calibrated(robot, moved, frames), is_corrected=True)


def _calibrated(robot: Robot, recording: Recording, frames: Sequence[int] | None) -> Calibration:
    recording = check_against(robot, recording)
    robot = robot.in_recording(recording.label)
    chosen = usable_frames(recording) if frames is None else np.asarray(frames, dtype=np.int64)
    if recording.rest is not None and not np.isin(recording.marker_frame, chosen).any():
        return from_rest(robot, recording)
    if not len(chosen):
        raise DataError(
            f"no frame is free of undeclared contact: mark free frames {how_to_free(recording)}, or declare the loads (loads.csv)"
        )
    allowed = None
    if has_image_markers(robot, recording):
        recording, allowed = with_image_markers(robot, recording, _thinned(chosen))
    by_clouds = views_without_markers(recording, chosen)
    seen = _as_declared(recording, by_clouds)
    seen = name_markers(robot, seen, _thinned(np.intersect1d(chosen, seen.unnamed_frame)), allowed=allowed)
    if len(seen.marker_frame):
        by_markers = _by_markers(robot, seen, chosen)
        robot = with_initial_pressures(robot, by_markers.chamber_pressure_pa)
    elif has_unknown_zeros(robot, recording):
        raise DataError('zeros of pressures need markers with names: record those, or declare actuation_zero = "absolute"')
    else:
        by_markers = as_declared(robot, seen, chosen)
    if by_clouds:
        found = placed_by_clouds(robot, recording, by_markers, by_clouds)
    elif len(seen.marker_frame) or recording.actuation_zero == "unknown":
        found = fit_clouds(robot, recording, by_markers)
    else:
        found = by_markers
    check_declared_by_clouds(robot, recording, found, views_to_check(recording, seen.marker_view))
    return found


def _by_markers(robot: Robot, recording: Recording, chosen: IntArray) -> Calibration:
    """Return the calibration by markers, zeros of pressures included where they are unknown."""
    history: list[float] = []
    if not has_unknown_zeros(robot, recording):
        return _result(_fitted(robot, recording, chosen, history), history)
    zeros = find_pressure_zeros(robot, recording, lambda shifted: _fitted_as_named(shifted, recording, chosen, history))
    shifted = with_initial_pressures(robot, zeros.pressure)
    found = _result(_fitted(shifted, recording, chosen, history), history)
    weak = weak_zeros(recording, zeros)
    status = f"{found.status}, but these data hardly determine the initial pressure of {weak}" if weak else found.status
    return replace(found, chamber_pressure_pa=zeros.pressure, pressure_std_pa=zeros.std, status=status)


def _as_declared(recording: Recording, views: Sequence[int]) -> Recording:
    """Return the recording with some pose for cameras whose pose is found later; no marker is seen by them."""
    poses = tuple(np.eye(4) if v in views else T for v, T in enumerate(recording.T_robot_camera))
    rows = ~np.isin(recording.marker_view, views)
    return replace(
        recording,
        T_robot_camera=poses,
        marker_frame=freeze(recording.marker_frame[rows], np.int64),
        marker_index=freeze(recording.marker_index[rows], np.int64),
        marker_view=freeze(recording.marker_view[rows], np.int64),
        marker_xyz=freeze(recording.marker_xyz[rows]),
    )


def calibrated_start(
    robot: Robot, recording: Recording, frames: IntArray, *, strict: bool = False
) -> tuple[tuple[FloatArray, ...], FloatArray | None, dict[int, Equilibrium]]:
    """Return poses, initial inputs (None where they are known) and states of frames by which further fits begin;
    frames need markers. `strict` refuses all that `calibrate` refuses (DataError)."""
    fit = _fitted(robot, recording, frames, [], strict=strict)
    return fit.poses, fit.initial, fit.jet.states


def _fitted(robot: Robot, recording: Recording, chosen: IntArray, history: list[float], *, strict: bool = True) -> MarkerFit:
    """Return the fit to the frames that are used; labels put right, outliers left out.

    Raises:
        DataError: markers or inputs that cannot be the robot's as they are written.
    """
    fit = _fitted_as_named(robot, recording, chosen, history)
    if is_suspicious(fit):
        compare_readings(fit, OF_MARKERS, _looked_at, rivals=OF_LARGE_ERRORS if strict else ())
    better = relabelled(fit, strict=strict)
    if better is not None:
        fit = _fitted_as_named(robot, better, chosen, history)
    if strict:
        compare_readings(fit, (*OF_SMALL_ERRORS, *(OF_LARGE_ERRORS if is_suspicious(fit) else ())), _looked_at)
        _require_fit(fit)
    return fit


def _looked_at(robot: Robot, recording: Recording, frames: IntArray) -> MarkerFit:
    """Return the fit of an alternative reading; a frame that Newton does not reach has no equilibrium."""
    return _fitted_as_named(robot, recording, frames, [], PathSolver(look_at))


def _require_fit(fit: MarkerFit) -> None:
    """Refuse markers that leave a large share of their spread for an unknown reason (DataError)."""
    view, names = fit.scene.view, fit.scene.recording.camera_names
    for v, name in enumerate(names):
        mine, spread = view == v, fit.spread_of(v)
        if len(np.unique(fit.scene.marker[mine])) < 4:
            continue
        left = rigid_misfit(view[mine], fit.modelled[mine], fit.measured[mine])
        if left > HOPELESS * spread > 0.0:
            which = f" of camera {name}" if len(names) > 1 else ""
            raise DataError(
                f"the markers{which} do not fit the robot: the residual is {100 * left / spread:.0f} % of their spread of "
                f"{1e3 * spread:.3g} mm. Are these the markers of {fit.robot.name!r}, in metres, under their names? {UNNAMED}"
            )


def _fitted_as_named(
    robot: Robot, recording: Recording, chosen: IntArray, history: list[float], solver: PathSolver | None = None
) -> MarkerFit:
    seen = _thinned(chosen[np.isin(chosen, recording.marker_frame)])
    scene = make_scene(robot, recording, seen)
    poses = first_poses(robot, scene)
    initial = first_inputs(robot, recording)
    if recording.actuation_zero == "unknown" and robot.body.cables:
        few = seen[np.unique(np.linspace(0, len(seen) - 1, START_FRAMES).round().astype(int))]
        poses, initial = _alternate(robot, make_scene(robot, recording, few), poses, initial, history)
    return fit_joint(robot, scene, poses, initial, history, solver=solver)


def _thinned(frames: IntArray) -> IntArray:
    """Return at most MAX_FRAMES of the frames, spread evenly."""
    if len(frames) <= MAX_FRAMES:
        return frames
    return np.asarray(frames[np.unique(np.linspace(0, len(frames) - 1, MAX_FRAMES).round().astype(int))])


def _alternate(
    robot: Robot, scene: Scene, poses: list[FloatArray], initial: FloatArray | None, history: list[float]
) -> tuple[list[FloatArray], FloatArray]:
    """Algorithm 1: rigid pose and bounded inputs in turns."""
    from scipy.optimize import lsq_linear

    assert initial is not None
    low, high = input_bounds(robot, scene.recording)
    plain, starts = Hypothesis(robot), dict[int, Equilibrium]()
    empty, pivot = np.zeros(0), robot.marker_points.mean(axis=0)
    for _ in range(TURNS):
        jet = evaluate_scene(plain, scene, empty, poses, initial, derivative=True, vary_initial=True, pivot=pivot, starts=starts)
        history.append(root_mean_square(jet.residual))
        W_ea = -jet.by_initial.reshape(-1, len(initial))  # residual = measured − modelled
        ridge = (
            PLACEMENT_STD_FLOOR / largest_input(robot, scene.recording.actuation) * np.eye(len(initial))
        )  # what no marker feels stays
        right = np.concatenate([jet.residual.ravel(), np.zeros(len(initial))])
        step = lsq_linear(np.vstack([W_ea, ridge]), right, bounds=(low - initial - 1e-12, high - initial + 1e-12)).x
        initial = np.clip(initial + step, low, high)
        jet = evaluate_scene(
            plain, scene, empty, poses, initial, derivative=False, vary_initial=False, pivot=pivot, starts=starts
        )
        if not any(T is not None for T in scene.recording.T_robot_camera) and not len(scene.rest_marker):
            poses = _rigid_again(robot, scene, jet)
        if np.abs(step).max() < 1e-6 * max(np.abs(initial).max(), 1e-6):
            break
    return poses, initial


def _rigid_again(robot: Robot, scene: Scene, jet: SceneJet) -> list[FloatArray]:
    model = {k: robot.markers.positions(s.positions) for k, s in jet.states.items()}
    predicted = np.array([model[int(f)][m] for f, m in zip(scene.frame, scene.marker)])
    return [
        fit_rigid(predicted[scene.view == v], scene.points[scene.view == v]) for v in range(len(scene.recording.camera_names))
    ]


def _result(found: MarkerFit, history: list[float]) -> Calibration:
    robot, scene, fit, poses, initial, jet = found.robot, found.scene, found.result, found.poses, found.initial, found.jet
    recording, moved = scene.recording, moved_by_law(found)
    covariance = fit.covariance + np.outer(moved, moved)
    moving = [v for v, T in enumerate(recording.T_robot_camera) if T is None]
    joint = np.zeros((6 * len(poses),) * 2)
    free = [c for v in moving for c in range(6 * v, 6 * v + 6)]
    joint[np.ix_(free, free)] = covariance[: len(free), : len(free)]
    law_step = np.append(np.zeros(6 * len(poses)), moved[len(free) :])
    law_step[free] = moved[: len(free)]
    pose_covariance = joint[:6, :6]
    pose_std = std_of_entries(poses[0], pose_covariance, robot.marker_points.mean(axis=0))
    a = len(robot.body.cables) if initial is not None else 0
    input_covariance = covariance[len(free) :, len(free) :] if a else np.zeros((0, 0))
    tables = input_tables(robot, recording, initial, input_covariance)
    own = tables.tension_std if recording.actuation == "tension" else tables.displacement_std
    per_marker = {
        name: root_mean_square(jet.residual[scene.marker == i])
        for i, name in enumerate(robot.marker_names)
        if (scene.marker == i).any()
    }
    places = in_robot_frame(scene.rest_points, scene.rest_view, poses, robot.observation)
    return Calibration(
        T_robot_camera=poses[0],
        poses=poses,
        camera_names=recording.camera_names,
        cable_tension_n=tables.tension,
        cable_displacement_m=tables.displacement,
        rms_m=root_mean_square(jet.residual),
        marker_rms_m=per_marker,
        history=tuple(history),
        pose_std=pose_std,
        pose_covariance=pose_covariance,
        tension_std_n=tables.tension_std,
        displacement_std_m=tables.displacement_std,
        status=_status(fit, own, recording),
        placements_m={robot.marker_names[m]: p.tolist() for m, p in zip(scene.rest_marker, places)},
        frames=tuple(int(recording.frame_numbers[k]) for k in scene.frames),
        noise_m=float(np.sqrt(3.0)) * marker_repeatability(recording),
        joint_covariance=joint,
        marker_covariance=fit.covariance,
        law_step=law_step,
    )


def _status(fit: FitResult, own: dict[str, float | None], recording: Recording) -> str:
    if fit.status != "converged":
        return "not settled after the last iteration: are cables or markers exchanged, or inputs in another unit? `history` has the residual"
    if recording.actuation_zero == "absolute":
        return "converged"
    weak = weak_inputs(recording, own)
    return f"converged, but these data hardly determine the initial input of {weak}" if weak else "converged"
