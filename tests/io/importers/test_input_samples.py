"""Inputs at other times than the frames: known between neighbours, never over a hole or beyond an end."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from imported import imported

from femsense.core.errors import InputError
from femsense.io.importers.frames import Frame, Source
from femsense.io.importers.options import Options
from femsense.io.importers.tables.input_samples import samples_of
from femsense.io.importers.writer import write_recording
from femsense.io.recording_folder import load_recording

HEAD = "time,tip_x_m,tip_y_m,tip_z_m"


def test_values_are_known_between_neighbours_and_not_in_holes() -> None:
    times = np.array([1.0, 1.2, 1.4, 1.8, 3.0, 3.2, 3.4])
    values = np.stack([2 * times, np.where(times == 1.4, np.nan, times)], axis=1)
    wanted = np.array([0.9, 0.96, 1.3, 1.5, 1.84, 2.4, 3.1, 3.44, 3.5])
    found = samples_of(times[::-1], values[::-1]).at(wanted)
    np.testing.assert_allclose(found[:, 0], [np.nan, 2.0, 2.6, 3.0, 3.68, np.nan, 6.2, 6.8, np.nan])
    np.testing.assert_allclose(found[:, 1], [np.nan, 1.0, 1.3, 1.5, 1.84, np.nan, 3.1, 3.4, np.nan])
    assert np.isnan(samples_of(times, np.full((7, 1), np.nan)).at(wanted)).all()


def test_a_log_as_slow_as_it_is_everywhere_has_no_holes() -> None:
    times = np.arange(0.0, 12.1, 1.2)
    wanted = np.arange(0.0, 12.0, 0.1)
    np.testing.assert_allclose(samples_of(times, times[:, None]).at(wanted)[:, 0], wanted)


def markers(path: Path, count: int, *, step: float = 0.1, inputs: list[str] | None = None) -> Path:
    rows = [f"{step * k:.3f},0,0,{1 + 0.001 * k}" + (f",{inputs[k]}" if inputs else "") for k in range(count)]
    path.write_text("\n".join([HEAD + (",cable_a" if inputs else ""), *rows]) + "\n")
    return path


def test_empty_cells_are_filled_between_neighbours_and_left_out_in_a_hole(tmp_path: Path) -> None:
    cells = ["", "", "2", "", "4", "5", "NA", "7", *[""] * 10, "18"]
    with pytest.warns(UserWarning, match=r"12 of 19 frames.*cable_a.*frames 0–1 at 0\.000 … 0\.100 s, frames 8–17 at 0\.800"):
        recording, found = imported(markers(tmp_path / "take.csv", 19, inputs=cells), tmp_path, actuation="tension")
    np.testing.assert_allclose(recording.inputs[:, 0], [2, 3, 4, 5, 6, 7, 18])
    np.testing.assert_allclose(recording.time_s, [0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 1.8])
    assert found["frames"] == 7 and found["frames_left_out"] == 12


def test_a_log_with_a_hole_that_ends_early(tmp_path: Path) -> None:
    from femsense.io.importers.tables.actuation import read_actuation_log

    times = [t for t in np.arange(0.0, 2.01, 0.1) if not 0.55 < t < 1.45]
    (tmp_path / "log.csv").write_text("\n".join(["time,cable_a", *(f"{t:.2f},{2 * t:.2f}" for t in times)]) + "\n")
    log = read_actuation_log(tmp_path / "log.csv", Options())
    with pytest.warns(UserWarning, match=r"18 of 30 frames are left out.*frames 6–14 .*frames 21–29"):
        recording, _ = imported(markers(tmp_path / "take.csv", 30), tmp_path, Options(), log=log, offset=0.0, actuation="tension")
    np.testing.assert_allclose(recording.inputs[:, 0], 2 * np.asarray(recording.time_s), atol=1e-9)
    assert recording.frame_numbers.tolist() == [*range(6), *range(15, 21)]


def test_frames_without_inputs_leave_no_markers_and_pictures(tmp_path: Path) -> None:
    values = [{}, {"cable_a": 1.0}, {}, {"cable_a": 3.0}]
    items = [Frame(0.1 * k, inputs=v, markers={"tip": (0, 0, 1 + k)}) for k, v in enumerate(values)]
    made = Source(Path("x"), lambda: iter(items), actuation="tension")
    with pytest.warns(UserWarning, match="2 of 4 frames are left out"):
        write_recording(made, tmp_path / "out", identity={})
    recording = load_recording(tmp_path / "out")
    assert recording.inputs[:, 0].tolist() == [1.0, 3.0]
    assert [line.split(",")[0] for line in (tmp_path / "out/markers.csv").read_text().splitlines()[1:]] == ["1", "3"]


def test_no_frame_with_inputs_is_an_error(tmp_path: Path) -> None:
    items = [Frame(0.0, inputs={"cable_a": 1.0}), Frame(0.1, inputs={"cable_b": 1.0})]
    made = Source(Path("x"), lambda: iter(items), actuation="tension")
    with pytest.raises(InputError, match="no frame whose inputs are known"):
        write_recording(made, tmp_path / "out", identity={})


def test_slow_inputs_and_loads_of_a_bag_lie_between_their_neighbours(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    from ros_writers import START_NS, BagWriter

    with BagWriter(tmp_path / "take", "mcap") as bag:
        for k in range(40):
            at = START_NS + k * 10**8
            bag.write("/cloud", at, bag.cloud(np.array([[0.0, 0.0, 1.0 + 0.001 * k]]), None, at))
            if k % 12 == 0:
                bag.write("/joint_states", at, bag.joints(["m"], at, effort=[1.0 + 0.1 * k]))
            if k >= 5:
                bag.write("/ft", at, bag.wrench((0.0, 0.0, 0.1 * k), at))
    with pytest.warns(UserWarning, match=r"8 of 40 frames .*cable_m, known loads are not known.*frames 0–4 .*frames 37–39"):
        recording, _ = imported(tmp_path / "take", tmp_path, Options(columns={"/ft": "load@0,0,0.1"}))
    np.testing.assert_allclose(recording.inputs[:, 0], 1 + np.asarray(recording.time_s), atol=1e-5)
    np.testing.assert_allclose(recording.load_forces[:, 2], recording.time_s, atol=1e-5)
    assert sorted(int(file.stem) for file in (tmp_path / "recording/clouds").iterdir()) == list(range(5, 37))
