"""Learning from readings: laws of the training, errors that hold on new data, and what is said of bad channels and other days."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from results import make_calibration
from scipy.spatial.transform import Rotation

from femsense.calib.files import write_calibration
from femsense.core.errors import DataError, InputError
from femsense.core.pose import invert_pose, transform_points
from femsense.xr.armature import ArmatureOptions
from femsense.xr.proprioception.bayes import train_bayesian
from femsense.xr.proprioception.corrections import LINEAR, Frames, explain, is_better
from femsense.xr.proprioception.drift import adapt, drift
from femsense.xr.proprioception.files import read_labelled
from femsense.xr.proprioception.labelled import Labelled, joined, labelled
from femsense.xr.proprioception.learn import LearnOptions, error_interval, learn
from femsense.xr.proprioception.linear import train_radial, train_ridge
from femsense.xr.proprioception.selection import folds, marker_rms, rows_kept

CHANNELS = ("left", "right", "noise", "stuck", "clipped")
LENGTH = 0.1


def bent(curvature: np.ndarray, lean: np.ndarray) -> np.ndarray:
    """Return four markers on an arm of constant curvature [1/m] that also leans [rad], shape (n, 4, 3)."""
    s = np.linspace(0.25, 1.0, 4) * LENGTH
    turn = curvature[:, None] * s + 1e-9
    x, z = s * (1.0 - np.cos(turn)) / turn, s * np.sin(turn) / turn
    return np.stack([x * np.cos(lean)[:, None], x * np.sin(lean)[:, None], z], axis=2)


def session(seed: int, *, rows: int = 900, lag_s: float = 0.0, zero: float = 0.0) -> Labelled:
    """Return a recording of an arm that bends as it likes: two curved and noisy sensors, and three that say little."""
    rng = np.random.default_rng(seed)
    time = 0.05 * np.arange(rows)
    smooth = np.exp(-0.5 * (np.arange(-40, 41) / 12) ** 2)
    a, b = (np.convolve(rng.normal(size=rows + 80), smooth, mode="valid") for _ in range(2))
    a, b = (2.0 * (x - x.mean()) / np.abs(x - x.mean()).max() for x in (a, b))
    seen_a, seen_b = (_delayed(x, time, lag_s) for x in (a, b))
    readings = np.stack(
        [np.tanh(0.6 * a) + zero, b + 0.2 * b**2, rng.normal(size=rows), np.full(rows, 3.0), np.minimum(a + b, 0.5)], axis=1
    )
    readings[:, :2] += 0.003 * rng.normal(size=(rows, 2))
    markers = bent(10.0 + 6.0 * seen_a, 0.4 * seen_b) + 2e-4 * rng.normal(size=(rows, 4, 3))
    return labelled(time, readings, markers, channels=CHANNELS)


def _delayed(x: np.ndarray, time: np.ndarray, tau: float) -> np.ndarray:
    if not tau:
        return x
    y = x.copy()
    for i in range(1, len(x)):
        y[i] = y[i - 1] + (1.0 - np.exp(-(time[i] - time[i - 1]) / tau)) * (x[i] - y[i - 1])
    return y


def test_the_papers_network_finds_a_curved_map_and_is_not_misled_by_noise() -> None:
    rng = np.random.default_rng(0)
    x = rng.uniform(-2, 2, size=(300, 3))
    clean = lambda x: np.stack([np.sin(x[:, 0]), x[:, 0] * x[:, 1]], axis=1)  # noqa: E731
    network = train_bayesian(x, clean(x) + 0.1 * rng.normal(size=(300, 2)), seed=1)
    fresh = rng.uniform(-2, 2, size=(500, 3))
    assert np.sqrt(((network(fresh) - clean(fresh)) ** 2).mean()) < 0.06
    # of pure noise almost nothing is learnt, where least squares with 62 weights would follow it
    noise = train_bayesian(x, rng.normal(size=(300, 1)), seed=1)
    assert noise(fresh).std() < 0.25


def test_training_does_not_care_for_units() -> None:
    rng = np.random.default_rng(1)
    x, fresh = rng.normal(size=(2, 150, 2))
    y = np.stack([np.tanh(x[:, 0]), x[:, 1]], axis=1)
    scale, shift = np.array([1e3, 1e-3]), np.array([7.0, -2.0])
    for train in (
        lambda x, y: train_bayesian(x, y, seed=5, steps=30),
        lambda x, y: train_ridge(x, y, penalty=1e-3),
        lambda x, y: train_radial(x, y, penalty=1e-3, length=1.0, noise=1e-2),
    ):
        plain, other = train(x, y), train(scale * x + shift, 0.001 * y + 5.0)
        np.testing.assert_allclose(other(scale * fresh + shift), 0.001 * plain(fresh) + 5.0, atol=2e-6)


def test_held_out_blocks_are_blocks_in_time_and_cover_everything_once() -> None:
    held = rows_kept(400)
    assert held.sum() == 60 and np.abs(np.diff(held.astype(int))).sum() == 6  # 15 %, in three blocks
    masks = np.array(list(folds(90)))
    assert (masks.sum(axis=0) == 1).all() and all(np.abs(np.diff(mask.astype(int))).sum() <= 2 for mask in masks)


@pytest.fixture(scope="module")
def model():
    return learn(session(1), options=LearnOptions(kinds=("ridge", "radial"), end_to_end=True, bones=ArmatureOptions(bones=3)))


def test_the_stated_error_holds_on_a_fresh_recording(model) -> None:
    fresh = session(2)
    inside = model.domain.inside(fresh.readings)
    error = 1e3 * marker_rms((model.network(fresh.inputs(model.memory_s)) - fresh.targets)[inside])
    low, high = model.report["error_ci_mm"]
    assert 0.3 < model.report["error_mm"] < 1.0  # the noise of the markers alone is 0.35 mm
    assert low < model.report["error_mm"] < high and error < 1.5 * high
    assert model.report["kind"] != "ridge" and model.report["compared"]["ridge"]["error_mm"] > 2 * model.report["error_mm"]


def test_bones_from_the_end_to_end_network_are_those_of_the_markers(model) -> None:
    row = session(2).readings[200]
    direct, through = model.armature(row), model.chain(model.markers(row))
    assert np.abs(direct.positions - through.positions).max() < 2e-3
    assert np.abs(direct.T_robot_bone - through.T_robot_bone).max() < 0.1
    assert model.report["bones_mm"] < 1.0


def test_channels_that_say_little_are_named(model) -> None:
    report = model.report
    assert report["dead"] == ["stuck"] and report["saturated"] == ["clipped"]
    importance = report["importance_mm"]
    assert max(importance, key=importance.get) in ("left", "right") and importance["stuck"] == 0.0
    assert abs(importance["noise"]) < 0.1 * importance["left"]


def test_a_lag_is_met_by_a_memory() -> None:
    data = session(3, lag_s=0.4)
    late = learn(data, options=LearnOptions(kinds=("radial",)))
    blind = learn(data, options=LearnOptions(kinds=("radial",), memories=((),)))
    assert late.memory_s and blind.memory_s == ()
    assert late.report["error_mm"] < 0.4 * blind.report["error_mm"]
    assert learn(session(3), options=LearnOptions(kinds=("radial",))).memory_s == ()


def seldom_seen(data: Labelled, every: int) -> Labelled:
    """Return a recording whose sensors are read as often as before, and whose markers are seen in every so many rows."""
    places = np.where((np.arange(len(data)) % every == 0)[:, None, None], data.markers, np.nan)
    with pytest.warns(UserWarning, match="rows are left out"):
        return labelled(data.time_s, data.readings, places, channels=data.channels)


def test_filters_run_over_rows_without_markers_too() -> None:
    data, taus = session(3, rows=200), (0.4,)
    some = seldom_seen(data, 5)
    assert len(some) == 40
    np.testing.assert_allclose(some.inputs(taus), data.inputs(taus)[::5])
    np.testing.assert_allclose(some.select(np.arange(40) > 9).inputs(taus), data.inputs(taus)[50::5])
    np.testing.assert_allclose(joined([data, some]).inputs(taus), np.concatenate([data.inputs(taus), some.inputs(taus)]))


def test_markers_that_are_seen_seldom_teach_as_much_as_often_ones() -> None:
    data, fresh, options = session(3, lag_s=0.4), session(6, lag_s=0.4), LearnOptions(kinds=("radial",))
    model, often = learn(seldom_seen(data, 3), options=options), learn(data, options=options)
    off, off_often = (marker_rms(one.network(fresh.inputs(one.memory_s)) - fresh.targets) for one in (model, often))
    assert model.memory_s and off < 1.1 * off_often and 1e3 * off < 1.3 * model.report["error_mm"]
    assert drift(model, seldom_seen(fresh, 20)).verdict == "holds"
    alone = fresh.select(np.arange(0, len(fresh), 20))  # readings as seldom as markers: their filters would be guesses
    with pytest.raises(DataError, match="readings are 1 s apart"):
        drift(model, labelled(alone.time_s, alone.readings, alone.markers, channels=alone.channels))


def test_markers_in_millimetres_are_refused_also_against_a_model(model) -> None:
    data = session(3)
    wrong = replace(data, markers=1e3 * data.markers)
    with pytest.raises(DataError, match=r"are they in millimetres \(0\.1\d* m\)"):
        learn(wrong, options=LearnOptions(kinds=("ridge",), memories=((),)))
    for use in (drift, adapt):
        with pytest.raises(DataError, match=r"do not fit the model: .* are they in millimetres"):
            use(model, wrong)


def test_another_day_is_recognised_and_a_few_frames_correct_it(model) -> None:
    same = session(5)
    assert drift(model, same).verdict == "holds"
    T, shift = Rotation.from_rotvec([0.0, 0.1, 0.2]).as_matrix(), np.array([0.004, -0.003, 0.0])
    moved = labelled(same.time_s, same.readings, same.markers @ T.T + shift, channels=CHANNELS)
    found = drift(model, moved)
    assert found.verdict == "base moved" and "base moved" in found.text
    assert found.turn_deg == pytest.approx(np.degrees(np.hypot(0.1, 0.2)), abs=0.7)
    zeroed = session(5, zero=0.15)
    assert drift(model, zeroed).verdict == "one channel shifted"
    few = np.zeros(len(same), dtype=bool)
    few[::15] = True
    for day, by in ((same, "none"), (moved, "base"), (zeroed, "channel")):
        mended = adapt(model, day.select(few))
        rest = day.select(~few & mended.domain.inside(day.readings))
        error = 1e3 * marker_rms(mended.network(rest.inputs(mended.memory_s)) - rest.targets)
        assert mended.report["adapted"]["by"] == by and error < 2.0 * model.report["error_mm"]


@pytest.mark.parametrize(("channel", "by"), [("left", 0.15), ("left", -0.05), ("right", 0.3), ("right", 0.1)])
def test_a_channel_that_shifted_is_named_with_how_much(model, channel: str, by: float) -> None:
    same = session(5)
    readings = same.readings + by * (np.array(CHANNELS) == channel)
    few, rest = np.arange(0, len(same), 15), np.arange(7, len(same), 15)
    day = labelled(same.time_s, readings, same.markers, channels=CHANNELS)
    found = drift(model, day.select(few))
    assert found.verdict == "one channel shifted" and list(found.shifts) == [channel]
    assert found.shifts[channel] == pytest.approx(by, abs=0.02) and found.left_mm < 0.8 * found.rigid_mm
    assert f"{channel} reads {abs(found.shifts[channel]):.4g} too {'high' if by > 0 else 'low'}" in found.text
    mended = adapt(model, day.select(few))
    left = day.select(rest)
    assert mended.report["adapted"]["by"] == "channel"
    assert 1e3 * marker_rms(mended.network(left.inputs(())) - left.targets) < 2.0 * model.report["error_mm"]
    assert mended.domain.inside(left.readings).mean() > 0.9


def test_a_channel_that_shifted_on_a_base_that_moved_and_a_map_that_changed_are_told_apart(model) -> None:
    same = session(7)
    few = np.arange(0, len(same), 15)
    T, shift = Rotation.from_rotvec([0.0, 0.1, 0.2]).as_matrix(), np.array([0.004, -0.003, 0.0])
    offset, gain = np.array([0.15, 0, 0, 0, 0]), np.array([1.2, 1, 1, 1, 1])
    both = labelled(same.time_s, same.readings + offset, same.markers @ T.T + shift, channels=CHANNELS)
    found = drift(model, both.select(few))
    assert found.verdict == "one channel shifted and base moved" and list(found.shifts) == ["left"]
    assert found.shifts["left"] == pytest.approx(0.15, abs=0.02)
    two = np.array([0.1, -0.2, 0, 0, 0])
    for readings, by in ((same.readings * gain, "base, line 0.01"), (same.readings + two, "zeros")):
        day = labelled(same.time_s, readings, same.markers, channels=CHANNELS)
        found = drift(model, day.select(few))
        assert found.verdict == "map changed" and found.shifts == {}
        mended, rest = adapt(model, day.select(few)), day.select(few[:-1] + 7)
        assert mended.report["adapted"]["by"] == by
        error = 1e3 * marker_rms(mended.network(rest.inputs(())) - rest.targets)
        assert error < 0.6 * 1e3 * marker_rms(model.network(rest.inputs(())) - rest.targets)


def test_channels_that_explain_a_day_alike_are_all_named(model) -> None:
    twin = np.array([[1.0, 0.0], [0.0, 0.0]])  # two channels that read the same
    rng = np.random.default_rng(3)
    bend = np.sin(0.11 * np.arange(200)) * np.sin(0.023 * np.arange(200) + 1)
    readings = np.stack([bend, bend], axis=1) + 0.002 * rng.normal(size=(200, 2))
    markers = bent(10.0 + 6.0 * bend, 0.0 * bend) + 2e-4 * rng.normal(size=(200, 4, 3))
    time = 0.05 * np.arange(200)
    simple = learn(labelled(time, readings, markers), options=LearnOptions(kinds=("ridge",), memories=((),)))
    found = drift(simple, labelled(time, readings + 0.3 * twin[0], markers).select(np.arange(0, 200, 5)))
    assert set(found.shifts) == {"channel_0", "channel_1"} and ", or " in found.text


def test_chance_alone_makes_no_correction_better() -> None:
    rng = np.random.default_rng(0)
    small, large = 1e-3 * rng.normal(size=(2, 24, 6)) * np.array([1.0, 1.5])[:, None, None]
    assert is_better(small, large) and not is_better(large, small) and not is_better(small, 1.05 * small)
    burst = small.copy()
    burst[:2] *= 8.0  # one moment that was bad
    assert marker_rms(small) < 0.9 * marker_rms(burst) and not is_better(small, burst)


def test_an_interval_of_an_error_covers_it_and_knows_that_neighbours_are_alike() -> None:
    rng = np.random.default_rng(0)
    alone = 1e-3 * rng.normal(size=(600, 3))
    low, high = error_interval(alone)
    assert low < 1e-3 * np.sqrt(3) < high and high - low < 0.2e-3
    alike = np.repeat(1e-3 * rng.normal(size=(12, 3)), 50, axis=0)
    low, high = error_interval(alike)
    assert high - low > 0.5e-3


def test_recordings_are_joined_and_their_filters_start_anew() -> None:
    one, two = session(1, rows=60), session(2, rows=70)
    both = joined([one, two])
    np.testing.assert_allclose(both.inputs((0.5,))[60:], two.inputs((0.5,)))
    assert len(both) == 130 and both.select(np.arange(60, 130)).part.tolist() == [1] * 70
    other = labelled(two.time_s, two.readings[:, :2], two.markers)
    with pytest.raises(InputError, match="other channels or markers"):
        joined([one, other])


def test_what_cannot_be_learnt_is_said() -> None:
    with pytest.raises(DataError, match="40 rows"):
        learn(session(1, rows=40))
    with pytest.raises(InputError, match="unknown kind of map"):
        learn(session(1), options=LearnOptions(kinds=("forest",)))
    still = session(1)
    with pytest.raises(DataError, match="no channel ever changes"):
        learn(labelled(still.time_s, np.ones((len(still), 2)), still.markers))
    with pytest.raises(InputError, match="do not belong together"):
        labelled([0.0, 1.0], np.zeros((2, 3)), np.zeros((3, 1, 3)))
    with pytest.raises(InputError, match="time runs backwards"):
        labelled([0.0, -1.0], np.zeros((2, 3)), np.zeros((2, 1, 3)))


def write_session(folder: Path, data: Labelled) -> tuple[Path, Path]:
    """Write SENSORS.csv and MARKERS.csv of a session and return their paths."""
    sensors, markers = folder / "sensors.csv", folder / "markers.csv"
    rows = [f"{7 + i},{t:.4f}," + ",".join(f"{x:.8g}" for x in row) for i, (t, row) in enumerate(zip(data.time_s, data.readings))]
    sensors.write_text("\n".join(["frame,time_s," + ",".join(data.channels), *rows]) + "\n")
    places = [
        f"{7 + i},{name},{p[0]:.9g},{p[1]:.9g},{p[2]:.9g}"
        for i, x in enumerate(data.markers)
        for name, p in zip(data.marker_names, x)
    ]
    markers.write_text("\n".join(["frame,marker,x_m,y_m,z_m", *places]) + "\n")
    return sensors, markers


def test_files_are_read_and_rows_with_hidden_markers_are_left_out(tmp_path: Path) -> None:
    data = session(1, rows=20)
    sensors, markers = write_session(tmp_path, data)
    back = read_labelled(sensors, markers)
    np.testing.assert_allclose(back.readings, data.readings, rtol=1e-7)
    np.testing.assert_allclose(back.markers, data.markers, atol=1e-9)
    assert (back.channels, back.marker_names) == (CHANNELS, data.marker_names)
    lines = markers.read_text().splitlines()
    markers.write_text("\n".join(lines[:5] + lines[6:]))
    with pytest.warns(UserWarning, match="1 of 20 rows are left out: a marker is hidden there"):
        assert len(read_labelled(sensors, markers)) == 19
    first, *rows = sensors.read_text().splitlines()
    sensors.write_text("\n".join([first, rows[0].rpartition(",")[0] + ",", *rows[1:]]))
    with pytest.warns(UserWarning, match=f"2 of 20 rows are left out: {CHANNELS[-1]} has no number in 1"):
        assert len(read_labelled(sensors, markers)) == 18


def test_a_camera_s_markers_come_into_the_robot_s_frame_and_what_is_not_known_is_not_claimed(tmp_path: Path) -> None:
    data, calibration = session(1, rows=20), make_calibration()
    T = calibration.T_robot_camera
    seen = labelled(
        data.time_s,
        data.readings,
        transform_points(invert_pose(T), data.markers.reshape(-1, 3)).reshape(data.markers.shape),
        channels=CHANNELS,
    )
    sensors, markers = write_session(tmp_path, seen)
    assert read_labelled(sensors, markers).frame == "markers"
    assert read_labelled(sensors, markers, in_robot_frame=True).frame == "robot"
    file = write_calibration(
        replace(calibration, poses=(T,), camera_names=("",), joint_covariance=np.eye(6)), tmp_path / "c.json"
    )
    declared = (
        f'format = "femsense-recording-1"\nactuation = "tension"\nactuation_zero = "absolute"\nT_robot_camera = {T.tolist()}\n'
    )
    (tmp_path / "other").mkdir()
    beside = write_session(tmp_path / "other", seen)
    (tmp_path / "other" / "recording.toml").write_text(declared)
    for back in (read_labelled(sensors, markers, calibration=file), read_labelled(*beside)):
        assert back.frame == "robot"
        np.testing.assert_allclose(back.markers, data.markers, atol=1e-8)
    with pytest.raises(InputError, match="need no calibration"):
        read_labelled(sensors, markers, calibration=file, in_robot_frame=True)
    two = write_calibration(replace(calibration, poses=(T, np.eye(4))), tmp_path / "two.json")
    with pytest.raises(InputError, match="a camera without a pose"):
        read_labelled(sensors, markers, calibration=two)
    rows = [line.split(",", 2) for line in markers.read_text().splitlines()[1:]]
    cameras = [f"{frame},{name},left,{xyz}" for frame, name, xyz in rows]
    straight = [
        f"{7 + i},{name},right," + ",".join(f"{x + 2e-3:.9g}" for x in place)
        for i, places in enumerate(data.markers)
        for name, place in zip(data.marker_names, places)
    ]
    markers.write_text("\n".join(["frame,marker,camera,x_m,y_m,z_m", *cameras, *straight]) + "\n")
    np.testing.assert_allclose(read_labelled(sensors, markers, calibration=two).markers, data.markers + 1e-3, atol=1e-8)
    with pytest.raises(InputError, match="several cameras without their poses"):
        read_labelled(sensors, markers)


def test_frames_of_reference_are_not_mixed(model) -> None:
    here, robot = session(5), replace(session(5), frame="robot")
    with pytest.raises(InputError, match=r"another frame of reference[\s\S]*--robot-frame"):
        joined([here, robot])
    with pytest.raises(InputError, match="another frame of reference"):
        drift(model, robot)
    with pytest.raises(InputError, match="another frame of reference"):
        learn(here, test=robot, options=LearnOptions(kinds=("ridge",)))
    with pytest.raises(InputError, match="unknown frame of reference"):
        labelled([0.0], [[1.0]], [[[0.0, 0.0, 0.0]]], frame="base")
    assert learn(robot, options=LearnOptions(kinds=("ridge",), memories=((),))).frame == "robot" and model.frame == "markers"


@pytest.mark.parametrize(
    ("sensors", "markers", "message"),
    [
        ("time_s\n0\n", "frame,marker,x_m,y_m,z_m\n0,a,0,0,0\n", "no channel"),
        ("time_s,red\n0,1\n", "frame,marker,x_m,y_m,z_m\n5,a,0,0,0\n", "no frame is in both files"),
        ("time_s,red\n0,1\n", "frame,marker,x_m,y_m,z_m\n0,,0,0,0\n", "a marker without a name"),
        ("frame,time_s,red\n0,0,1\n0,1,2\n", "frame,marker,x_m,y_m,z_m\n0,a,0,0,0\n", "a frame appears twice"),
        ("time_s,red\n0,x\n", "frame,marker,x_m,y_m,z_m\n0,a,0,0,0\n", "not a number"),
    ],
)
def test_files_that_do_not_fit_are_refused(sensors: str, markers: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "s.csv").write_text(sensors)
    (tmp_path / "m.csv").write_text(markers)
    with pytest.raises(InputError, match=message):
        read_labelled(tmp_path / "s.csv", tmp_path / "m.csv")


def test_two_frames_beyond_the_others_do_not_select_the_stiffest_map() -> None:
    """38 frames are a linear map; the errors of the two saturated ones dominate every mean square, and are least with a stiff map."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (40, 2))
    x[[5, 22]] = [[2.5, 0.2], [-2.5, -0.3]]
    bent = np.column_stack([np.where(np.abs(x[:, 0]) > 1, 0.2 * np.sign(x[:, 0]), x[:, 0]), x[:, 1]])
    y = bent @ np.array([[0.03, 0.0, 0.01], [0.01, 0.02, 0.0]]) + 2e-4 * rng.normal(size=(40, 3))
    other_day = train_ridge(rng.uniform(-1, 1, (50, 2)), 0.05 * rng.normal(size=(50, 3)), penalty=1.0)
    chosen, errors = explain(Frames(other_day, x, y, np.full(2, 2.0)))
    assert chosen == "afresh 0.0001" and min(LINEAR, key=lambda name: marker_rms(errors[name])) == "base, line 1.0"
