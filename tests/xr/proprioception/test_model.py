"""A model, its file, and what it says of readings that it never saw."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest

from femsense.core.errors import InputError
from femsense.xr.armature import ArmatureOptions, make_armature
from femsense.xr.proprioception.domain import learn_domain
from femsense.xr.proprioception.memory import with_memory
from femsense.xr.proprioception.model import ProprioceptiveModel, bone_numbers, bones_from_numbers
from femsense.xr.proprioception.model_file import load_model, save_model
from femsense.xr.proprioception.network import Network, Units

CHANNELS = ("red", "green", "blue")
REST = np.outer(np.linspace(0, 0.1, 4), [0, 0, 1.0])


def some_network(kind: str, inputs: int, outputs: int, rng: np.random.Generator) -> Network:
    hidden = 0 if kind == "linear" else 7
    numbers = [(hidden, inputs), (hidden,), (outputs, hidden), (outputs, inputs), (outputs,)]
    return Network(kind, rng.normal(size=inputs), rng.uniform(0.5, 2.0, inputs), *(0.3 * rng.normal(size=n) for n in numbers))


def some_model(kind: str, *, memory: tuple[float, ...] = (), end_to_end: bool = False) -> ProprioceptiveModel:
    rng = np.random.default_rng(4)
    inputs = 3 * (1 + len(memory))
    network = some_network(kind, inputs, 12, rng).followed_by(0.05 * np.eye(12), REST.ravel())
    chain = make_armature(REST, ArmatureOptions(bones=5))
    bones = some_network("sigmoid", inputs, 45, rng) if end_to_end else None
    domain = learn_domain(rng.normal(size=(400, 3)) @ [[1, 0.9, 0], [0, 0.3, 0], [0, 0, 2.0]])
    return ProprioceptiveModel(CHANNELS, tuple("abcd"), network, memory, domain, chain, bones, {"error_mm": 1.5})


@pytest.mark.parametrize("kind", Units)
@pytest.mark.parametrize("memory", [(), (0.1, 1.0)])
def test_a_model_comes_back_from_its_file(kind: str, memory: tuple[float, ...], tmp_path: Path) -> None:
    model = some_model(kind, memory=memory, end_to_end=True)
    back = load_model(save_model(model, tmp_path / "model.onnx"))
    row = np.array([0.3, -0.8, 1.1])
    np.testing.assert_allclose(back.markers(row), model.markers(row), atol=1e-6)
    np.testing.assert_allclose(back.armature(row).T_robot_bone, model.armature(row).T_robot_bone, atol=1e-5)
    assert (back.channels, back.marker_names, back.memory_s, back.bone_names) == (
        CHANNELS,
        tuple("abcd"),
        memory,
        model.bone_names,
    )
    assert back.report == {"error_mm": 1.5} and "3 channels → 4 markers" in repr(back) and "1.5 mm" in repr(back)
    np.testing.assert_array_equal(back.domain.low, model.domain.low)
    assert (back.frame, load_model(save_model(replace(model, frame="robot"), tmp_path / "r.onnx")).frame) == ("markers", "robot")


@pytest.mark.parametrize("kind", Units)
def test_another_runtime_computes_the_same(kind: str, tmp_path: Path) -> None:
    runtime = pytest.importorskip("onnxruntime")
    model = some_model(kind, memory=(0.5,), end_to_end=True)
    path = save_model(model, tmp_path / "model.onnx")
    onnx.checker.check_model(onnx.load(path), full_check=True)
    rng = np.random.default_rng(1)
    rows, past = rng.normal(size=(2, 5, 3)).astype(np.float32)
    markers, bones = runtime.InferenceSession(path).run(["markers", "bones"], {"readings": rows, "filtered": past})
    inputs = np.concatenate([rows, past], axis=1).astype(float)
    np.testing.assert_allclose(markers, model.network(inputs), atol=1e-5)
    np.testing.assert_allclose(bones, model.bones(inputs), atol=1e-5)


@pytest.mark.parametrize("kind", Units)
@pytest.mark.parametrize("end_to_end", [False, True])
def test_a_channel_that_no_map_takes_may_have_no_number(kind: str, end_to_end: bool, tmp_path: Path) -> None:
    model = some_model(kind, memory=(0.5,), end_to_end=end_to_end)
    green = np.tile([True, False, True], 2)
    networks = [replace(n, scale=n.scale * green) if n is not None else None for n in (model.network, model.bones)]
    without = replace(model, network=networks[0], bones=networks[1])
    without = load_model(save_model(without, tmp_path / "m.onnx"))
    row, lost = np.array([0.3, -0.2, 1.1]), np.array([0.3, np.nan, 1.1])
    assert without.needed.tolist() == [True, False, True] and model.needed.all()
    np.testing.assert_array_equal(without.markers(lost), without.markers(row))
    np.testing.assert_array_equal(without.armature(lost).T_robot_bone, without.armature(row).T_robot_bone)
    assert without.check(lost) == () and without.live().step(lost, 0.0).outside == ()
    np.testing.assert_array_equal(without.live().step(lost, 0.0).markers, without.markers(row))
    assert [item.channel for item in without.check([9.0, np.nan, 1.1])] == ["red"]
    assert (
        np.isnan(without.markers([np.nan, 0.0, 1.0])).all() and without.check([np.nan, np.nan, 1.0])[0].text == "red: no number"
    )
    half = replace(model, network=networks[0]) if end_to_end else model
    assert half.needed.all()  # the other map takes it


def test_others_are_judged_without_a_channel_that_has_no_number() -> None:
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=(2, 2000))
    rows = np.stack([a, b, a + b + 0.01 * rng.normal(size=2000)], axis=1)
    domain, needed = learn_domain(rows), np.array([True, False, True])
    row = np.array([1.0, np.nan, 1.5])
    both = (rows - domain.centre) * domain.scale
    z = (domain.filled(row) - domain.centre) * domain.scale
    kept = np.linalg.solve(np.cov(both[:, [0, 2]].T), z[[0, 2]])  # of those two alone
    np.testing.assert_allclose((domain.precision @ z)[[0, 2]], kept, rtol=0.05)
    assert abs((domain.precision @ z)[1]) < 1e-9
    assert domain.check(row, CHANNELS, needed) == ()
    assert domain.check(np.array([1.0, -1.5, 1.5]), CHANNELS, needed)[0].kind == "joint"


def test_a_stream_gives_what_the_whole_series_gives() -> None:
    model = some_model("sigmoid", memory=(0.05, 2.0))
    rng = np.random.default_rng(2)
    time, rows = np.cumsum(rng.uniform(0.01, 0.03, 30)), rng.normal(size=(30, 3))
    live = model.live()
    poses = [live.step(row, t) for row, t in zip(rows, time)]
    np.testing.assert_allclose([pose.markers for pose in poses], model.markers(rows, time), atol=1e-12)
    np.testing.assert_allclose(poses[0].markers, model.markers(rows[0]), atol=1e-12)
    np.testing.assert_allclose(poses[7].bones.T_robot_bone, model.chain(poses[7].markers).T_robot_bone, atol=1e-12)
    lost = live.step([0.0, np.nan, 1.0], time[-1] + 0.01)
    assert lost.bones is None and np.isnan(lost.markers).all() and lost.outside[0].text == "green: no number"
    assert np.isfinite(live.step(rows[0], time[-1] + 0.02).markers).all()


def test_filters_follow_lines_between_rows_with_their_time_constant() -> None:
    time, tau = np.array([0.0, 0.1, 0.4, 1.0]), 0.5
    inputs = with_memory(time, np.array([[0.0], [1.0], [1.0], [1.0]]), (tau,))
    risen = 1.0 - tau / 0.1 * (np.exp(-(time[1:] - 0.1) / tau) - np.exp(-time[1:] / tau))
    np.testing.assert_allclose(inputs[:, 1], [0.0, *risen], atol=1e-12)


def test_filters_hardly_depend_on_how_often_sensors_are_read() -> None:
    time = np.arange(0.0, 10.0, 0.02)
    readings = np.sin(2.0 * time)[:, None]
    often, seldom = with_memory(time, readings, (0.1, 1.0)), with_memory(time[::5], readings[::5], (0.1, 1.0))
    np.testing.assert_allclose(seldom[20:], often[::5][20:], atol=5e-3)


def test_a_model_with_a_memory_says_where_rows_come_too_seldom() -> None:
    live = some_model("linear", memory=(0.1, 1.0)).live()
    middle = live.model.domain.centre
    for time_s, gaps in ((0.0, 0), (0.15, 0), (0.55, 1), (0.6, 0)):
        said = [item.text for item in live.step(middle, time_s).outside]
        assert len(said) == gaps and all(text.startswith("0.4 s after the row before") for text in said)
    steady = some_model("linear").live()
    assert not steady.step(middle, 0.0).outside and not steady.step(middle, 100.0).outside


def test_a_model_whose_filters_were_others_is_refused(tmp_path: Path) -> None:
    for memory in ((0.1,), ()):
        file = save_model(some_model("linear", memory=memory), tmp_path / "model.onnx")
        file.write_bytes(file.read_bytes().replace(b"lines between rows", b"steps between rows"))
        if not memory:
            assert load_model(file).memory_s == ()
            continue
        with pytest.raises(InputError, match="older version"):
            load_model(file)


def test_a_reading_outside_what_was_learnt_names_its_channel_and_how_far() -> None:
    model = some_model("linear")
    domain = model.domain
    middle = domain.centre
    assert model.check(middle) == ()
    far = middle.copy()
    far[2] = domain.high[2] + 0.5 * (domain.high[2] - domain.low[2])
    (found,) = model.check(far)
    assert (found.channel, found.kind) == ("blue", "range") and found.far == pytest.approx(0.5)
    assert f"blue = {far[2]:.4g} is outside" in found.text
    rng = np.random.default_rng(4)
    together = middle + np.array([1.5, -1.0, 0.0])  # each in its range, but red and green go together
    assert {item.channel for item in model.check(together)} == {"red", "green"}
    assert all(item.kind == "joint" and item.far > 0 for item in model.check(together))
    fresh = rng.normal(size=(400, 3)) @ [[1, 0.9, 0], [0, 0.3, 0], [0, 0, 2.0]]
    assert domain.inside(fresh).mean() > 0.98 and domain.inside(np.array([middle, far, together])).tolist() == [
        True,
        False,
        False,
    ]


def on_a_curve(count: int, seed: int) -> np.ndarray:
    """Return readings: the second the square of the first, with noise, the third at rest."""
    rng = np.random.default_rng(seed)
    a = np.sin(np.linspace(0.0, 25.0, count)) * np.cos(np.linspace(0.3, 4.0, count))
    return np.stack([a, a**2, np.full(count, 1.02)], axis=1) + [0.01, 0.01, 0.0] * rng.normal(size=(count, 3))


def test_readings_off_the_curve_on_which_channels_go_together_are_outside(tmp_path: Path) -> None:
    model = replace(some_model("linear"), domain=learn_domain(on_a_curve(600, seed=1)))
    assert [curve.channel for curve in model.domain.curves] == [1]
    off = [0.2, 0.75, 1.02]  # each in its range, where a² is 0.04
    (found,) = model.check(off)
    assert (found.channel, found.kind) == ("green", "joint") and found.low < 0.04 < found.high < 0.3 and found.far > 1.0
    assert model.domain.inside(on_a_curve(400, seed=2)).all() and not model.domain.inside(np.array([off])).any()
    path = save_model(model, tmp_path / "model.onnx")
    assert load_model(path).check(off) == (found,)
    path.write_bytes(path.read_bytes().replace(b'"curves"', b'"others"'))  # files of older versions have none
    assert load_model(path).check(off) == () and load_model(path).check([0.2, 9.0, 1.02])


def test_a_curve_over_one_channel_is_found_among_many() -> None:
    """Two channels that go together by a curve, and five that have nothing to do with them."""
    rng = np.random.default_rng(4)
    a, others = rng.uniform(0.0, 1.0, 1200), rng.uniform(0.0, 1.0, (1200, 5))
    tied = (2.0 * a - 1.0) ** 2 + 7e-3 * rng.normal(size=1200)
    rows = np.column_stack([others[:, :3], a, others[:, 3:], tied])
    domain = learn_domain(rows[:900])
    assert [curve.channel for curve in domain.curves] == [6]
    held, off = rows[900:], rows[900:].copy()
    off[:, 6] += np.where(off[:, 6] < 0.5, 0.3, -0.3)
    assert domain.inside(held).mean() > 0.95 and domain.inside(off).mean() < 0.05


def test_a_straight_line_needs_no_curve() -> None:
    rows = on_a_curve(600, seed=1)
    rows[:, 1] = 2.0 * rows[:, 0] + 0.01 * np.random.default_rng(3).normal(size=600)
    assert learn_domain(rows).curves == ()


def test_a_channel_that_never_moved_is_said_in_words_when_it_does() -> None:
    model = replace(some_model("linear"), domain=learn_domain(on_a_curve(600, seed=1)))
    (found,) = model.check([0.2, 0.04, 1.1])
    assert (found.channel, found.kind, found.far) == ("blue", "still", np.inf)
    assert found.text == "blue = 1.1, but it never moved while it was learnt: it stood at 1.02"
    assert model.check([0.2, 0.04, 1.02]) == () and model.domain.inside(np.array([[0.2, 0.04, 1.1]])).tolist() == [False]


def test_what_is_no_finite_number_makes_no_markers_and_no_alarm_of_numpy() -> None:
    model = some_model("sigmoid", memory=(0.5,))
    for unread in (np.inf, -np.inf, np.nan):
        row = [0.0, unread, 1.0]
        assert np.isnan(model.markers(row)).all() and np.isnan(model.markers([row], [0.0])).all()
        assert model.domain.inside(np.array([row, model.domain.centre])).tolist() == [False, True]
        assert [item.text for item in model.check(row)] == ["green: no number"]
        with pytest.raises(InputError, match="green"):
            model.armature(row)


def test_bones_and_their_numbers() -> None:
    poses = make_armature([[0, 0, 0], [0, 0.01, 0.05], [0.02, 0.02, 0.09]]).rest
    numbers = bone_numbers(poses)
    np.testing.assert_allclose(bones_from_numbers(numbers).T_robot_bone, poses.T_robot_bone, atol=1e-12)
    R = bones_from_numbers(numbers + 0.1 * np.random.default_rng(0).normal(size=numbers.shape)).T_robot_bone[:, :3, :3]
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.tile(np.eye(3), (8, 1, 1)), atol=1e-12)


def test_what_is_no_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        load_model(tmp_path / "no.onnx")
    for content in (
        b"",
        b"hello, this is text\n",
        b"\x08\x08",
        save_model(some_model("linear"), tmp_path / "m.onnx").read_bytes()[:-900],
    ):
        (tmp_path / "bad.onnx").write_bytes(content)
        with pytest.raises(InputError, match=r"not an ONNX model|not a model of femsense"):
            load_model(tmp_path / "bad.onnx")
    model = some_model("sigmoid", memory=(1.0,))
    with pytest.raises(InputError, match="another number of channels"):
        model.markers([1.0, 2.0])
    for wrong in (["a"], "abc", {"light": 0.0}):
        with pytest.raises(InputError, match="rows: not numbers") as said:
            model.markers(wrong)
        assert repr(wrong) in str(said.value) and "one number for each of 3 channels" in str(said.value)
    with pytest.raises(InputError, match="has a memory"):
        model.markers(np.zeros((4, 3)))
