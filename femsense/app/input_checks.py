"""Whether a recording can be one of a robot, before anything is computed: colours, extents and units of its clouds."""

from __future__ import annotations

import warnings

from femsense.calib.from_images import find_tags
from femsense.core.arrays import FloatArray, spread_evenly
from femsense.io.clouds.cloud_checks import CLOUDS_READ, cloud_doubts, cloud_problems, doubts_of_cloud_poses, some_clouds
from femsense.io.clouds.images import read_color
from femsense.io.robot_tables import DICTIONARIES
from femsense.model.recording import Recording
from femsense.model.robot import Robot


def warn_of_pictures(robot: Robot, recording: Recording) -> None:
    """Warn of clouds that cannot show the robot, of missing colours, and of tags of another dictionary."""
    warn_of_tags(robot, recording)
    for text in [*cloud_problems(recording, robot=robot), *cloud_doubts(recording), *doubts_of_cloud_poses(robot, recording)]:
        warnings.warn(text, stacklevel=3)
    clouds = some_clouds(recording)
    if robot.color_rgb is not None and clouds and all(cloud.colors is None for _, _, cloud in clouds):
        where = recording.folder or "the recording"
        text = "the robot declares a colour, but the clouds have none: robot and objects are separated by geometry only"
        warnings.warn(f"{where}: {text}, and contacts found by clouds are doubtful", stacklevel=3)


def warn_of_tags(robot: Robot, recording: Recording) -> None:
    """Warn where some colour images hold none of the robot's tags, with the dictionary whose tags they hold."""
    numbers = {look.aruco_id for look in robot.marker_looks} - {None}
    images = _some_colors(recording) if numbers else []
    if not images or any(numbers & _tags(image, robot.aruco_dictionary) for image in images):
        return
    listed = ", ".join(str(number) for number in sorted(number for number in numbers if number is not None))
    text = f"none of the tags {listed} of {robot.aruco_dictionary} is in the {len(images)} colour images that were looked at"
    best = max(DICTIONARIES, key=lambda name: sum(len(numbers & _tags(image, name)) for image in images))
    found = set().union(*(numbers & _tags(image, best) for image in images))
    other = f"; tags of {best} with {len(found)} of these numbers are: appearance.aruco_dictionary?" if found else ""
    warnings.warn(f"{recording.folder or 'the recording'}: {text}{other}", stacklevel=3)


def _some_colors(recording: Recording) -> list[FloatArray]:
    """Return some colour images, shape (H, W, 3) in 0 … 1."""
    files = [file for files in recording.color_files for file in files if file is not None]
    return [read_color(files[i]) for i in spread_evenly(len(files), CLOUDS_READ)]


def _tags(image: FloatArray, dictionary: str) -> set[int | None]:
    return {number for number, _ in find_tags(image, dictionary)}


def warn_of_markers(robot: Robot, recording: Recording) -> None:
    """Warn of markers of the robot that are visible in no frame."""
    seen = {recording.marker_names[i] for i in recording.marker_index if i >= 0} - {""}
    unseen = [name for name in robot.marker_names if name not in seen]
    if seen and unseen:
        warnings.warn(f"markers of the robot that are seen in no frame: {', '.join(unseen)}", stacklevel=3)
