"""A recording from arrays, and short words for what a notebook shows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers import marker_grid, write_block_robot

import femsense as fs
from femsense.core.errors import DataError, InputError

TIME = np.array([0.0, 0.5, 1.0])
PLACES = {"tip": np.arange(9.0).reshape(3, 3), "back": np.array([[1.0, 2, 3], [np.nan] * 3, [4, 5, 6]])}


def test_arrays_become_a_recording_that_a_folder_gives_back(tmp_path: Path) -> None:
    made = fs.Recording.from_arrays(
        TIME, inputs={"top": [0.0, 1.0, 2.0]}, pressures={"air": [0.0, 5.0, 9.0]}, markers=PLACES, T_robot_camera=np.eye(4)
    )
    fs.save_recording(made, tmp_path / "out")
    for recording in (made, fs.load_recording(tmp_path / "out")):
        assert (recording.cable_names, recording.chamber_names, recording.actuation) == (("top",), ("air",), "tension")
        np.testing.assert_array_equal(recording.inputs[:, 0], [0.0, 1.0, 2.0])
        np.testing.assert_array_equal(recording.pressures[:, 0], [0.0, 5.0, 9.0])
        np.testing.assert_array_equal(marker_grid(recording), np.stack([PLACES["tip"], PLACES["back"]], axis=1))
        np.testing.assert_array_equal(recording.T_robot_camera[0], np.eye(4))
    assert repr(made) == "Recording(3 frames, 1 s; top [tension]; chambers air; 2 markers)"


def test_arrays_that_do_not_fit_are_refused() -> None:
    with pytest.raises(InputError, match="a series of another length"):
        fs.Recording.from_arrays(TIME, inputs={"top": [1.0, 2.0]})
    with pytest.raises(InputError, match="places of another shape"):
        fs.Recording.from_arrays(TIME, markers={"tip": np.zeros((3, 2))})
    with pytest.raises(
        InputError, match=r"inputs\['top'\]: not numbers\n  found:    \['x', 1, 2\]\n  expected: a number for each"
    ):
        fs.Recording.from_arrays(TIME, inputs={"top": ["x", 1, 2]})
    with pytest.raises(InputError, match=r"pressures\['air'\]: not finite\n  found:    nan in frame 1"):
        fs.Recording.from_arrays(TIME, pressures={"air": [0.0, np.nan, 1.0]})
    for hidden in (np.inf, np.nan):  # of a marker that is hidden nothing is known
        with pytest.raises(InputError, match=r"markers\['tip'\]: not a place\n  found:    \[0.0, (inf|nan), 2.0\] in frame 0"):
            fs.Recording.from_arrays(TIME, markers={"tip": np.where(PLACES["tip"] == 1.0, hidden, PLACES["tip"])})
    with pytest.raises(InputError, match=r"inputs: no names\n  found:    a list\n  expected: inputs="):
        fs.Recording.from_arrays(TIME, inputs=[1.0, 2.0])  # type: ignore[arg-type]
    with pytest.raises(InputError, match="time_s: no frame"):
        fs.Recording.from_arrays([])
    with pytest.raises(InputError, match=r"time_s: time does not increase\n  found:    \[2.0, 1.0\] s from position 1 on"):
        fs.Recording.from_arrays([0.0, 2.0, 1.0])


def test_what_does_not_fit_the_robot_is_said_of_arguments_where_there_are_no_files(tmp_path: Path) -> None:
    robot = fs.load_robot(write_block_robot(tmp_path))
    names = robot.body.cable_names
    assert len(names) > 1
    lacking = fs.Recording.from_arrays(TIME, inputs={names[0]: [0.0, 1.0, 2.0]}, markers=PLACES)
    with pytest.raises(InputError) as said:
        fs.calibrate(robot, lacking)
    text = str(said.value)
    assert text.startswith("Recording.from_arrays, inputs: other cables than those of the robot")
    assert f"found:    {names[0]}\n" in text and f"expected: {', '.join(names)}\n" in text
    assert ".csv" not in text and "column" not in text and "femsense import" not in text
    inputs = {name: [0.0, 0.1, 0.2] for name in names}
    strange = fs.Recording.from_arrays(TIME, inputs=inputs, markers={"nose": PLACES["tip"]})
    with pytest.raises(InputError, match=r"^Recording\.from_arrays, markers: no marker that the robot"):
        fs.calibrate(robot, strange)
    seen = {name: np.tile(robot.marker_points[i], (3, 1)) for i, name in enumerate(robot.marker_names)}
    touched = fs.Recording.from_arrays(TIME, inputs=inputs, markers=seen, free=[False] * 3)
    with pytest.raises(DataError, match=r"mark free frames with True in free of Recording\.from_arrays"):
        fs.calibrate(robot, touched)


def test_a_robot_and_a_state_say_what_they_are_in_one_line(tmp_path: Path) -> None:
    robot = fs.load_robot(write_block_robot(tmp_path))
    state = fs.solve_equilibrium(robot.body)
    assert repr(robot).startswith(f"Robot({robot.name}: ") and f"{len(robot.body.mesh.tets)} tetrahedra" in repr(robot)
    assert repr(state).startswith("Equilibrium(converged") and len(repr(state)) < 200
