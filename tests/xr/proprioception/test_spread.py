"""Intervals of a learnt model: how often they hold, where they widen, and what is said where they do not."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from femsense.core.errors import DataError, InputError
from femsense.xr.proprioception.drift import adapt, drift
from femsense.xr.proprioception.files import read_labelled
from femsense.xr.proprioception.labelled import Labelled, joined, labelled
from femsense.xr.proprioception.learn import LearnOptions, errors_on, learn
from femsense.xr.proprioception.linear import train_ridge
from femsense.xr.proprioception.model import ProprioceptiveModel
from femsense.xr.proprioception.model_file import load_model, save_model
from femsense.xr.proprioception.selection import marker_rms, train_mlp
from femsense.xr.proprioception.spread import BETWEEN, HeldOut, growth, likeliest_kappa, make_spread, splits

RIDGE = LearnOptions(kinds=("ridge",), memories=((),))


def session(seed: int, *, rows: int = 600, mixing: float = 1.0, zero: float = 0.0, noise: float = 5e-4) -> Labelled:
    """Return a recording of two sensors and two markers that follow them linearly, with noise."""
    rng = np.random.default_rng(seed)
    smooth = np.exp(-0.5 * (np.arange(-40, 41) / 12) ** 2)
    x = np.stack([np.convolve(rng.normal(size=rows + 80), smooth, mode="valid") for _ in range(2)], axis=1)
    x /= x.std(axis=0)
    map_ = np.array([[0.01, 0.002], [mixing * -0.003, 0.008], [0.001, 0.001]])
    low = x @ map_.T + noise * rng.normal(size=(rows, 3))
    high = 2.0 * x @ map_.T + [0.0, 0.0, 0.05] + noise * rng.normal(size=(rows, 3))
    return labelled(0.05 * np.arange(rows), x + zero, np.stack([low, high], axis=1))


@pytest.fixture(scope="module")
def model() -> ProprioceptiveModel:
    return learn(session(1), options=RIDGE)


def test_intervals_hold_on_other_sessions_as_often_as_they_say(model: ProprioceptiveModel) -> None:
    for seed in (2, 3):
        found = errors_on(model, session(seed), model.report["error_mm"])
        assert 0.90 < found["coverage"] < 0.99 and found["growth"] == pytest.approx(1.0, rel=0.15)
    assert 0.90 < model.report["interval"]["coverage"] < 0.99
    # three normal coordinates of 0.5 mm: 95 % lie within 2.8 of them
    np.testing.assert_allclose(list(model.report["interval"]["radius_mm"].values()), 0.5 * 2.795, rtol=0.12)


def test_a_further_error_lies_within_the_interval_of_few_as_often_as_it_says() -> None:
    rng = np.random.default_rng(5)
    network = train_ridge(rng.normal(size=(60, 2)), rng.normal(size=(60, 3)), penalty=1e-3)
    some, every = rng.normal(size=(40, 2)), np.full(40, BETWEEN)
    drawn = [
        make_spread(network, some, HeldOut(np.abs(rng.normal(size=(40, 1))), np.zeros(40), every)).quantile[0] for _ in range(400)
    ]
    # the 39th of 40 is above a further one with a probability of 39 / 41
    assert np.mean(rng.normal(size=20_000)[:, None] ** 2 <= np.square(drawn)) == pytest.approx(39 / 41, abs=0.006)


def test_intervals_widen_where_nothing_was_learnt(model: ProprioceptiveModel) -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(60, 6))  # few rows for many channels: the map itself is uncertain
    y = x @ rng.normal(size=(6, 3)) * 1e-2 + 1e-3 * rng.normal(size=(60, 3))
    few = learn(labelled(np.arange(60) * 0.1, x, y[:, None]), options=RIDGE)
    near, far = few.interval(np.zeros(6)), few.interval(np.full(6, 20.0))
    assert near.shape == (1,) and far[0] > 1.5 * near[0] > 0
    rows = few.interval(np.zeros((4, 6)))
    assert rows.shape == (4, 1) and few.live().step(np.zeros(6), 0.0).interval == pytest.approx(near)


def test_intervals_stand_in_the_file(model: ProprioceptiveModel, tmp_path: Path) -> None:
    back = load_model(save_model(model, tmp_path / "m.onnx"))
    np.testing.assert_allclose(back.interval([0.3, -1.0]), model.interval([0.3, -1.0]), rtol=1e-5)
    old = load_model(save_model(replace(model, spread=None), tmp_path / "old.onnx"))
    with pytest.raises(InputError, match="learn it again"):
        old.interval([0.3, -1.0])
    assert old.live().step([0.3, -1.0], 0.0).interval is None


def test_a_test_recording_does_not_replace_the_held_out_error(model: ProprioceptiveModel) -> None:
    elsewhere = replace(session(4), markers=session(4).markers + 0.5)
    with_test = learn(session(1), test=elsewhere, options=RIDGE)
    assert with_test.report["error_mm"] == model.report["error_mm"]
    assert with_test.report["test"]["error_mm"] == pytest.approx(866, rel=0.01)
    assert with_test.report["test"]["coverage"] == 0.0 and with_test.report["test"]["growth"] > 100
    assert drift(with_test, elsewhere).verdict == "base moved"
    # a model whose own error is as large as that says nothing of these markers, and does not hold
    worthless = replace(model, report={**model.report, "error_mm": 866.0})
    assert "holds" not in drift(worthless, elsewhere).verdict


def test_several_recordings_are_predicted_from_each_other() -> None:
    one, two = session(5), session(6, zero=1.0)  # the zero of a sensor differs between sessions
    both = learn(joined([one, two]), options=RIDGE)
    alone = learn(one, options=RIDGE)
    assert both.report["sessions"] == 2 and alone.report["sessions"] == 1
    assert errors_on(alone, two, alone.report["error_mm"])["coverage"] < 0.5
    assert errors_on(both, session(7, zero=0.5), both.report["error_mm"])["coverage"] > 0.9
    part = joined([one, two]).part
    groups = [group for _, _, group in splits(part)]
    assert groups == [0, 1] and len(part) == 1200


def test_blocks_at_the_end_are_predicted_from_what_came_before() -> None:
    for trained, predicted, group in splits(np.zeros(60, dtype=np.int64)):
        assert not (trained & predicted).any()
        assert group < 0 or np.flatnonzero(trained).max() < np.flatnonzero(predicted).min()
    held = HeldOut(np.r_[np.ones(50), 2.0 * np.ones(50)][:, None], np.zeros(100), np.r_[np.full(50, -1), np.zeros(50, int)])
    assert growth(held) == pytest.approx(2.0)


def test_the_likeliest_kappa_is_that_of_the_errors() -> None:
    rng = np.random.default_rng(1)
    leverage = rng.uniform(0.0, 3.0, size=4000)
    for kappa in (0.0, 3.0):
        errors = np.linalg.norm(rng.normal(size=(4000, 1, 3)) * np.sqrt(1 + kappa * leverage)[:, None, None], axis=2)
        assert likeliest_kappa(HeldOut(errors, leverage, np.full(4000, -1))) in (kappa, *((0.03,) * (kappa == 0.0)))


def test_a_map_is_learnt_afresh_where_that_predicts_best() -> None:
    """What a curved map was learnt from says nothing of another day on which the sensors are straight."""
    day, wavy = session(8, rows=400), session(9)
    bent = replace(wavy, markers=wavy.markers + 0.02 * np.sin(3.0 * wavy.readings[:, :1, None]))
    curved = learn(bent, options=LearnOptions(kinds=("radial",), memories=((),)))
    few = day.select(np.linspace(0, 399, 40).astype(int))
    assert drift(curved, few).verdict.endswith("map changed")
    mended = adapt(curved, few)
    plain = train_ridge(few.readings, few.targets, penalty=1e-4)
    error, ridge = (marker_rms(net(day.readings) - day.targets) for net in (mended.network, plain))
    assert mended.report["adapted"]["by"].startswith("afresh") and error < 1.1 * ridge
    assert errors_on(mended, day, 1.0)["coverage"] > 0.85


def test_other_channels_are_named(model: ProprioceptiveModel) -> None:
    other = replace(session(2), channels=("channel_0", "pressure"))
    with pytest.raises(DataError, match="without channel_1, and with pressure, which it does not know"):
        drift(model, other)
    with pytest.raises(DataError, match="another order"):
        drift(model, replace(session(2), channels=("channel_1", "channel_0")))


def test_a_committee_of_small_networks_finds_a_curved_map() -> None:
    rng = np.random.default_rng(4)
    x, fresh = rng.uniform(-2, 2, size=(2, 400, 3))
    curve = lambda x: np.stack([np.sin(x[:, 0]), x[:, 0] * x[:, 1], x[:, 2]], axis=1)  # noqa: E731
    network, line = train_mlp(x, curve(x), seed=0), train_ridge(x, curve(x), penalty=1e-4)
    error, straight = (np.sqrt(((net(fresh) - curve(fresh)) ** 2).mean()) for net in (network, line))
    assert len(network.b) == 50 and error < 0.25 * straight
    single = train_mlp(x, curve(x)[:, :1], seed=0)
    assert single(fresh).shape == (400, 1)


def write_bodies(folder: Path, bend: np.ndarray, *, quaternions: bool = True) -> tuple[Path, Path]:
    """Write readings and rigid bodies on a circular arc of 0.1 m that begins along z; return the two files."""
    sensors, markers = folder / "s.csv", folder / "m.csv"
    s = np.array([0.0, 0.05, 0.1])
    with sensors.open("w") as file, markers.open("w", newline="") as rows:
        file.write("frame,time_s,bend\n")
        out = csv.writer(rows)
        out.writerow(["frame", "marker", "x_m", "y_m", "z_m", *(["qw", "qx", "qy", "qz"] if quaternions else [])])
        for i, total in enumerate(bend):
            file.write(f"{i},{0.1 * i},{total}\n")
            angle = total * s / s[-1]
            x, z = (0.1 * (1 - np.cos(angle)) / (total + 1e-12), 0.1 * np.sin(angle) / (total + 1e-12)) if total else (0 * s, s)
            for name, px, pz, turn in zip(("base", "middle", "tip"), x, z, angle):
                q = Rotation.from_euler("y", turn) * Rotation.from_euler("x", 0.3)  # as the body was glued on
                qx, qy, qz, qw = q.as_quat()
                out.writerow([i, name, px, 0.0, pz, *([qw, qx, qy, qz] if quaternions else [])])
    return sensors, markers


def test_rigid_bodies_tell_the_direction_of_the_body(tmp_path: Path) -> None:
    data = read_labelled(*write_bodies(tmp_path, np.linspace(0.0, 1.5, 20)))
    assert data.marker_names == ("base", "base+", "middle-", "middle", "middle+", "tip-", "tip")
    np.testing.assert_allclose(data.markers[0, :, 2], [0, 0.0125, 0.0375, 0.05, 0.0625, 0.0875, 0.1], atol=1e-9)
    last = data.markers[-1]
    ends = last[6] - last[5]  # along the tangent at the tip, which has turned by 1.5 rad
    np.testing.assert_allclose(ends / np.linalg.norm(ends), [np.sin(1.5), 0, np.cos(1.5)], atol=1e-9)
    np.testing.assert_allclose(last[1] - last[0], [0, 0, 0.0125], atol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ((",qz", ""), "not a whole quaternion"),
        (("qw", "qw"), "not a unit quaternion"),
    ],
)
def test_quaternions_that_are_none_are_refused(change: tuple[str, str], message: str, tmp_path: Path) -> None:
    sensors, markers = write_bodies(tmp_path, np.linspace(0.0, 1.0, 3))
    head, *rows = markers.read_text(encoding="utf-8").splitlines()
    numbers = [row.split(",") for row in rows]
    doubled = [",".join([*n[:5], *(str(2 * float(v)) for v in n[5:])]) for n in numbers]
    kept = [",".join(n[: len(head.replace(*change).split(","))]) for n in (row.split(",") for row in doubled)]
    markers.write_text("\n".join([head.replace(*change), *kept]) + "\n", encoding="utf-8")
    with pytest.raises(InputError, match=message):
        read_labelled(sensors, markers)


def test_one_rigid_body_has_no_direction(tmp_path: Path) -> None:
    sensors, markers = write_bodies(tmp_path, np.linspace(0.0, 1.0, 3))
    head, *rows = markers.read_text(encoding="utf-8").splitlines()
    markers.write_text("\n".join([head, *(row for row in rows if ",tip," in row)]) + "\n", encoding="utf-8")
    with pytest.raises(InputError, match="two rigid bodies"):
        read_labelled(sensors, markers)
