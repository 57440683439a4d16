"""Sensors in a body of the rig: what they read of motions that are known."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from helpers import block_mesh, changed, write_block_robot
from rig_scripts import SCRIPT

from femsense.core.errors import InputError
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot
from femsense.rig.sensors import SensorTable, sensor_readings, write_sensors
from femsense.rig.simulate import simulate
from femsense.xr.proprioception.files import read_sensors

MESH = block_mesh((4, 2, 2), (0.1, 0.03, 0.03))
ALONG = {"from_m": [0.0, 0.015, 0.02], "to_m": [0.1, 0.015, 0.02]}
TIME = 0.1 * np.arange(6)


def read(states: list[np.ndarray], *, seed: int = 0, **table: object) -> np.ndarray:
    sensor = SensorTable.model_validate({"name": "s", **ALONG, **table})
    return sensor_readings([sensor], MESH, states, TIME[: len(states)], rng=np.random.default_rng(seed))


def test_strain_is_the_stretch_along_the_line_whatever_the_rest_does() -> None:
    stretched = MESH.nodes * [1.02, 1.1, 0.9]
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    readings = read([MESH.nodes, stretched, MESH.nodes @ turn.T + 0.3], gain=5.0, zero=1.0)
    np.testing.assert_allclose(readings[:, 0], [1.0, 1.0 + 5.0 * 0.02, 1.0], atol=1e-9)


def test_colours_come_one_after_the_other_as_the_pattern_shifts() -> None:
    shifts = np.linspace(0.0, 0.009, 4)
    states = [MESH.nodes + np.outer(MESH.nodes[:, 0] / 0.1, [0, 0, u]) for u in shifts]
    readings = read(states, kind="colour", period_m=0.009)
    np.testing.assert_allclose(readings[0], [1.0, 0.25, 0.25], atol=1e-9)
    assert readings.argmax(axis=1).tolist() == [0, 1, 2, 0]
    np.testing.assert_allclose(readings[3], readings[0], atol=1e-9)


def test_lag_noise_and_drift_are_the_sensors_own() -> None:
    stretched = MESH.nodes * [1.1, 1, 1]
    late = read([MESH.nodes, *[stretched] * 5], lag_s=0.2)[:, 0]
    np.testing.assert_allclose(late, 0.1 * (1.0 - np.exp(-TIME / 0.2)), atol=1e-9)
    drifting = read([MESH.nodes] * 6, drift_per_s=0.5)[:, 0]
    np.testing.assert_allclose(drifting, 0.5 * TIME, atol=1e-9)
    noisy = np.concatenate([read([MESH.nodes] * 6, noise_std=0.01, seed=seed) for seed in range(100)])
    assert noisy.std() == pytest.approx(0.01, rel=0.1) and abs(noisy.mean()) < 0.002


def test_the_file_is_what_learn_reads(tmp_path: Path) -> None:
    sensors = [
        SensorTable.model_validate({"name": "a", **ALONG}),
        SensorTable.model_validate({"name": "b", "kind": "colour", **ALONG}),
    ]
    readings = sensor_readings(sensors, MESH, [MESH.nodes] * 2, TIME[:2], rng=np.random.default_rng(0))
    write_sensors(tmp_path / "sensors.csv", sensors, TIME[:2], readings)
    rows = list(csv.reader((tmp_path / "sensors.csv").open()))
    assert rows[0] == ["frame", "time_s", "a", "b_red", "b_green", "b_blue"] and [float(x) for x in rows[2][:2]] == [1, 0.1]


def test_a_recording_of_the_rig_has_them_beside_its_markers(tmp_path: Path) -> None:
    robot = load_robot(write_block_robot(tmp_path / "robot"))
    table = {"name": "back", "from_m": [0.01, 0.015, 0.03], "to_m": [0.09, 0.015, 0.03], "noise_std": 1e-5}
    script = changed(SCRIPT, {"markers__occlusion": False})
    plain, with_sensors = (
        simulate(robot, script | more, tmp_path / name) for name, more in (("a", {}), ("b", {"sensors": [table]}))
    )
    assert not (plain / "sensors.csv").exists()
    assert (plain / "markers.csv").read_bytes() == (with_sensors / "markers.csv").read_bytes()
    frames, time, channels, readings = read_sensors(with_sensors / "sensors.csv")
    assert channels == ("back",) and len(frames) == 9 and time[6] == 4.5
    assert np.abs(readings[3] - readings[0]).max() > 1e-4  # where the cable pulls most
    load_recording(with_sensors)


def test_markers_stand_in_the_order_in_which_a_script_names_them(tmp_path: Path) -> None:
    robot = load_robot(write_block_robot(tmp_path / "robot"))
    names = list(reversed(robot.marker_names))[:2]
    assert len(names) == 2
    script = changed(SCRIPT, {"markers__occlusion": False, "markers__names": names})
    with (simulate(robot, script, tmp_path / "a") / "markers.csv").open() as file:
        rows = [(row["frame"], row["marker"]) for row in csv.DictReader(file)]
    assert rows[:4] == [("0", names[0]), ("0", names[1]), ("1", names[0]), ("1", names[1])]


def test_a_line_without_length_is_refused() -> None:
    with pytest.raises(InputError, match="the two points of a sensor coincide"):
        read([MESH.nodes], to_m=ALONG["from_m"])
