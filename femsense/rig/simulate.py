"""`simulate`: from a script to a recording, with its truth."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.arrays import freeze
from femsense.core.errors import DataError, InputError
from femsense.core.pose import transform_points
from femsense.io.checkpoint import Checkpoint
from femsense.io.clouds.ply import write_ply
from femsense.io.recording_folder import save_recording
from femsense.model.robot import Robot
from femsense.rig.camera import DepthImage, Shape, cloud_of, render, thinned, visible_points, write_images
from femsense.rig.experiment import Experiment, View, cloud_frames, rng_of, views_of
from femsense.rig.plan import Plan, plan_script
from femsense.rig.recorded import chosen_markers, recording_of, with_placement
from femsense.rig.scene import frame_shapes
from femsense.rig.scene_checks import warn_of_experiment, warn_of_script
from femsense.rig.script import ScriptTable, check_script, read_script
from femsense.rig.sensors import sensor_readings, write_sensors
from femsense.rig.true_path import Course, true_course
from femsense.rig.truth import true_robot
from femsense.rig.truth_files import check_place, write_truth

Progress = Callable[[int, int], None]
Keep = tuple[str | Path, Mapping[str, Any]]
CHECKPOINT_S = 10.0
"""Maximum work that an interrupted simulation loses [s]."""


def simulate(
    robot: Robot,
    script: ScriptTable | Mapping[str, Any] | str | Path,
    out_folder: str | Path,
    *,
    progress: Progress | None = None,
    keep: Keep | None = None,
) -> Path:
    """Simulate an experiment and write its recording, with the ground truth in the folder `truth/` inside.

    A frame that does not converge is left out of the recording, with a warning that names it.

    Arguments:
        robot: the declared robot, with which an estimate would be made. The recording is simulated with another model (a finer mesh, the
            neo-Hookean law, and the effects of the script), so that an estimate meets a realistic model error.
        script: a script, its plain tables, or the path of a TOML file (docs/formats/scripts.md).
        out_folder: the recording; an earlier simulated one is replaced when the new one is complete.
        progress: called with (frames done, number of frames).
        keep: (path, inputs) of a checkpoint. An interrupted simulation resumes from it if the stored inputs are the same. It is removed at the
            end.

    Returns:
        the folder of the recording.

    Raises:
        InputError: the script does not fit the robot, or `out_folder` contains other files.
        DataError: no frame has an equilibrium.

    Example:
        >>> import tempfile
        >>> import femsense as fs
        >>> bend = {"label": "bend", "cables": {"flexor": 1.0}}  # to 1 N and back, in six frames
        >>> script = {"format": "femsense-script-1", "sweeps": [bend], "truth": {"refinements": 0}, "scene": {"floor_z_m": -0.1}}
        >>> script["camera"] = {"eye_m": [0.05, -0.25, 0.1], "target_m": [0.05, 0.0, 0.0]}
        >>> folder = fs.simulate(fs.load_robot("finger"), script, tempfile.mkdtemp() + "/bend")
        >>> fs.load_recording(folder).frame_count
        6
    """
    check_place(out_folder)
    where = Path(script) if isinstance(script, str | Path) else Path("script")
    with Checkpoint(keep) as checkpoint:
        experiment = run_experiment(robot, _script(script), where, progress=progress, checkpoint=checkpoint)
        return write_experiment(experiment, out_folder)


def run_experiment(
    robot: Robot,
    script: ScriptTable,
    where: Path = Path("script"),
    *,
    progress: Progress | None = None,
    checkpoint: Checkpoint | None = None,
) -> Experiment:
    """Return the true states of a script, with the visibility of its markers, not yet written.

    Arguments:
        robot, script, progress: as of `simulate`.
        where: for messages; its folder contains the object meshes.
        checkpoint: keeps the completed frames.

    Raises:
        InputError, DataError: as `simulate`.
    """
    plan = plan_script(script, robot, where)
    views = views_of(script, robot)
    warn_of_script(script, robot, where)
    real = with_placement(true_robot(robot, script.truth, script.effects), script)
    course = _course(real, plan, script, where.parent, progress, checkpoint or Checkpoint(None))
    numbers = np.array([k for k, _ in course.frames], dtype=np.int64)
    plan, frames = (plan if not course.skipped else plan.pick(numbers)), tuple(frame for _, frame in course.frames)
    chosen = chosen_markers(real, script)
    positions = np.array([real.markers.positions(frame.state.positions) for frame in frames])
    visible = np.zeros((len(views), *positions.shape[:2]), dtype=bool)
    draft = Experiment(
        script, plan, numbers, course.skipped, robot, real, views, frames, freeze(positions), visible, where.parent
    )
    for k in range(len(frames)):
        shapes = frame_shapes(draft, k)
        for v, view in enumerate(views):
            seen = visible_points(view.camera, view.T_robot_camera, shapes, positions[k]) if script.markers.occlusion else True
            visible[v, k] = chosen & seen
    if not visible.any() and chosen.any() and script.clouds.kind == "none":
        raise InputError(
            "no marker is visible in any frame",
            where=f"{where}: camera",
            expected="markers, or [clouds]",
            hint="another eye_m; scene.floor_z_m below the robot; or markers.occlusion = false",
        )
    warn_of_experiment(draft, where)
    return draft


def write_experiment(experiment: Experiment, out_folder: str | Path) -> Path:
    """Write the recording of an experiment and its truth, and return the folder. Raises InputError: as `check_place`."""
    check_place(out_folder)

    def fill(folder: Path) -> None:
        _write_clouds(experiment, folder)
        if experiment.script.sensors:
            _write_sensors(experiment, folder)
        write_truth(experiment, folder / "truth")

    return save_recording(recording_of(experiment), out_folder, fill=fill)


def _course(
    robot: Robot, plan: Plan, script: ScriptTable, folder: Path, progress: Progress | None, checkpoint: Checkpoint
) -> Course:
    """Return the true path, resumed from the checkpoint. Raises DataError if no frame converges."""
    course, count = checkpoint.kept(Course) or Course(), len(plan.time_s)
    for now in true_course(robot, plan, substeps=script.truth.substeps, folder=folder, kept=course):
        course = now
        if progress is not None:
            progress(course.done, count)
        checkpoint.keep(course, every=CHECKPOINT_S)
    if not course.frames:
        raise DataError(f"none of {count} frames converges; frame {course.skipped[0][0]}: {course.skipped[0][1]}")
    if course.skipped:
        named = ", ".join(str(k) for k, _ in course.skipped)
        warnings.warn(
            f"{len(course.skipped)} of {count} frames do not converge and are left out: {named}; the first: {course.skipped[0][1]}",
            stacklevel=2,
        )
    return course


def _script(script: ScriptTable | Mapping[str, Any] | str | Path) -> ScriptTable:
    if isinstance(script, ScriptTable):
        return script
    return read_script(script) if isinstance(script, str | Path) else check_script(dict(script))


# Clouds


def _write_clouds(experiment: Experiment, folder: Path) -> None:
    script = experiment.script
    write = _write_ply if script.clouds.kind == "ply" else _write_images
    wanted = set(cloud_frames(script, experiment.plan))
    extra = set(script.clouds.extra_frames) if script.clouds.kind != "none" else set()
    for k, number in enumerate(experiment.numbers.tolist()):
        if k not in wanted and number not in extra:
            continue
        shapes = frame_shapes(experiment, k)
        for v, view in enumerate(experiment.views):
            write(experiment, view, _image(experiment, v, shapes, number), number, folder)


def _write_ply(experiment: Experiment, view: View, image: DepthImage, number: int, folder: Path) -> None:
    clouds = experiment.script.clouds
    cloud = cloud_of(image, view.camera)
    if clouds.crop_m is not None:
        low, high = np.asarray(clouds.crop_m)
        x = transform_points(view.T_robot_camera, cloud.points)
        cloud = cloud.select(((x >= low) & (x <= high)).all(axis=1))
    if clouds.voxel_m:
        cloud = thinned(cloud, clouds.voxel_m)
    target = folder / "clouds" / view.name
    target.mkdir(exist_ok=True, parents=True)
    write_ply(target / f"{number:06d}.ply", cloud)


def _write_images(experiment: Experiment, view: View, image: DepthImage, number: int, folder: Path) -> None:
    depth, color = folder / "depth" / view.name, folder / "color" / view.name
    for target in (depth, color):
        target.mkdir(exist_ok=True, parents=True)
    write_images(depth / f"{number:06d}.png", color / f"{number:06d}.png", image, view.camera)


def _image(experiment: Experiment, v: int, shapes: list[Shape], number: int) -> DepthImage:
    view = experiment.views[v]
    return render(
        view.camera,
        view.T_robot_camera,
        shapes,
        noise=view.table.noise,
        observation=experiment.robot.observation,
        rng=rng_of(experiment.script, "clouds", number, *([v] if v else [])),
    )


def _write_sensors(experiment: Experiment, folder: Path) -> None:
    script, time_s = experiment.script, experiment.plan.time_s
    states = [frame.state.positions for frame in experiment.frames]
    readings = sensor_readings(script.sensors, experiment.robot.body.mesh, states, time_s, rng=rng_of(script, "sensors"))
    write_sensors(folder / "sensors.csv", script.sensors, time_s, readings)
