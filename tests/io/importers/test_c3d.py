"""C3D: genuine files of others, and files that `ezc3d` wrote, against `ezc3d`'s own reading."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers import DATA, marker_grid

from femsense.core.errors import InputError
from femsense.io.importers.c3d import open_c3d
from femsense.io.importers.guess import guess_format, open_source
from femsense.io.importers.options import Axis, Options
from femsense.io.importers.writer import write_recording
from femsense.io.recording_folder import load_recording

ezc3d = pytest.importorskip("ezc3d")
GENUINE = sorted((DATA / "c3d").glob("*.c3d"))


def written(
    path: Path,
    points: np.ndarray,
    *,
    rate: float = 100.0,
    unit: str = "mm",
    residuals: np.ndarray | None = None,
    labels: list[str] | None = None,
) -> Path:
    """Write points (frames, markers, 3) with ezc3d; NaN and residual −1 where they are missing."""
    file = ezc3d.c3d()
    data = np.ones((4, points.shape[1], len(points)))
    data[:3] = points.transpose(2, 1, 0)
    file["parameters"]["POINT"]["RATE"]["value"] = [rate]
    file["parameters"]["POINT"]["UNITS"]["value"] = [unit]
    file["parameters"]["POINT"]["LABELS"]["value"] = labels or [f"M{i}" for i in range(points.shape[1])]
    file["data"]["points"] = data
    if residuals is not None:
        file["data"]["meta_points"]["residuals"] = residuals[None]
    file.write(str(path))
    return path


@pytest.mark.skipif(not GENUINE, reason="the genuine files are not there")
@pytest.mark.parametrize("file", GENUINE, ids=lambda f: f.stem)
def test_genuine_files_read_as_ezc3d_reads_them(file: Path) -> None:
    theirs = ezc3d.c3d(str(file))
    parameters = theirs["parameters"]["POINT"]
    unit = {"mm": 1e-3, "m": 1.0}[parameters["UNITS"]["value"][0]]
    labels = parameters["LABELS"]["value"]
    points, residuals = theirs["data"]["points"][:3], theirs["data"]["meta_points"]["residuals"][0]
    source = open_source(file)
    assert source.format == "c3d"
    frames = list(source.frames())
    assert len(frames) == points.shape[2]
    for k in range(0, len(frames), max(1, len(frames) // 200)):
        assert frames[k].time == pytest.approx(k / parameters["RATE"]["value"][0])
        wanted = {
            n: unit * points[:, i, k]
            for i, n in enumerate(labels)
            if residuals[i, k] >= 0 and np.isfinite(points[:, i, k]).all() and points[:, i, k].any()
        }
        assert set(frames[k].markers) == set(wanted)
        for name, place in frames[k].markers.items():
            np.testing.assert_allclose(place, wanted[name], rtol=1e-6, atol=1e-9)


@pytest.mark.skipif(not GENUINE, reason="the genuine files are not there")
def test_a_genuine_file_becomes_a_recording_with_its_gaps(tmp_path: Path) -> None:
    file = DATA / "c3d" / "walkingOptiTrack.c3d"
    found = write_recording(open_source(file), tmp_path / "out", identity={})
    recording = load_recording(tmp_path / "out")
    assert recording.frame_count == 3361 and len(recording.marker_names) == 12
    assert found["rate_hz"] == pytest.approx(160, rel=1e-6) and found["unit"] == "mm"
    assert max(row["share"] for row in found["missing"]) > 0
    assert 0.5 < np.ptp(recording.marker_xyz, axis=0).max() < 20


def test_metres_missing_points_and_the_vertical(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(7, 3, 3))
    residuals = np.zeros((3, 7))
    residuals[1, 2:4] = -1
    file = written(tmp_path / "a.c3d", points, unit="m", residuals=residuals)
    write_recording(open_source(file), tmp_path / "same", identity={})
    grid = marker_grid(load_recording(tmp_path / "same"))
    assert np.isnan(grid[2:4, 1]).all() and np.isfinite(grid).sum() == 3 * (21 - 2)
    np.testing.assert_allclose(grid[:, 0], points[:, 0], rtol=1e-6)
    write_recording(open_source(file, Options(up=Axis.y)), tmp_path / "turned", identity={})
    turned = marker_grid(load_recording(tmp_path / "turned"))
    np.testing.assert_allclose(turned[:, 0, 2], points[:, 0, 1], rtol=1e-6)
    edges = (turned[:, 1] - turned[:, 0], turned[:, 2] - turned[:, 0])
    before = (points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    volume = [np.einsum("ni,ni->n", np.cross(*pair), [1.0, 0, 0] * np.ones((7, 3))) for pair in (edges, before)]
    np.testing.assert_allclose(volume[0][[0, 1, 4, 5, 6]], volume[1][[0, 1, 4, 5, 6]], rtol=1e-4, atol=1e-6)


def test_tracks_without_a_name(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(3, 2, 3))
    frame = next(open_source(written(tmp_path / "a.c3d", points, unit="m", labels=["tip", "*12"])).frames())
    assert list(frame.markers) == ["tip"]
    np.testing.assert_allclose(frame.unlabelled, points[0, 1:], rtol=1e-6)


def test_a_unit_that_nobody_says_is_asked(tmp_path: Path) -> None:
    file = written(tmp_path / "a.c3d", np.ones((3, 2, 3)) * [[[1, 2, 3]]] + np.arange(2)[None, :, None], unit="")
    with pytest.raises(InputError, match="--unit"):
        open_c3d(file, Options())
    assert next(open_c3d(file, Options(unit="cm")).frames()).markers["M0"] == pytest.approx([0.01, 0.02, 0.03])


def test_the_unit_that_is_taken_is_reported(tmp_path: Path) -> None:
    file = written(tmp_path / "a.c3d", np.random.default_rng(0).normal(size=(3, 2, 3)), unit="mm")
    assert open_c3d(file, Options(unit="m")).found["unit"] == "m"
    assert open_c3d(file, Options()).found["unit"] == "mm"


def test_more_frames_than_the_header_can_count(tmp_path: Path) -> None:
    file = written(tmp_path / "long.c3d", np.full((70_000, 1, 3), 2.0))
    source = open_c3d(file, Options())
    assert sum(1 for _ in source.frames()) == 70_000
    assert any("by the size of the file" in note for note in source.notes)


def test_integers_and_numbers_of_big_endian_and_vax_machines(tmp_path: Path) -> None:
    """The same header and points as each processor writes them (C3D manual, "Floating-point formats")."""
    for processor in (84, 85, 86):
        file = tmp_path / f"{processor}.c3d"
        file.write_bytes(_by_hand(processor))
        source = open_c3d(file, Options())
        frames = list(source.frames())
        assert len(frames) == 2 and frames[1].time == pytest.approx(0.02)
        np.testing.assert_allclose(frames[0].markers["AB"], [0.1, 0.2, -0.3], rtol=1e-6)
        assert "AB" not in frames[1].markers


def test_broken_files(tmp_path: Path) -> None:
    whole = written(tmp_path / "a.c3d", np.random.default_rng(0).normal(size=(50, 3, 3))).read_bytes()
    for size in (0, 3, 511, 600, 1024):
        (tmp_path / "cut.c3d").write_bytes(whole[:size])
        with pytest.raises(InputError) as caught:
            open_source(tmp_path / "cut.c3d")
        assert "cut.c3d" in str(caught.value)
    (tmp_path / "cut.c3d").write_bytes(whole[:-600])
    source = open_source(tmp_path / "cut.c3d")
    assert 0 < len(list(source.frames())) < 50 and any("cut off" in note for note in source.notes)
    (tmp_path / "noise.c3d").write_bytes(np.random.default_rng(1).bytes(3000))
    with pytest.raises(InputError, match="C3D"):
        open_source(tmp_path / "noise.c3d")
    (tmp_path / "named.dat").write_bytes(whole)
    assert guess_format(tmp_path / "named.dat") == "c3d"


def _by_hand(processor: int) -> bytes:
    """Return a file with one point in two frames, the second missing, 50 Hz, millimetres."""
    order = ">" if processor == 86 else "<"

    def real(value: float) -> bytes:
        data = np.array([4 * value if processor == 85 else value], dtype=order + "f4").tobytes()
        return data[2:] + data[:2] if processor == 85 else data

    def word(value: int) -> bytes:
        return np.array([value], dtype=order + "i2").tobytes()

    def parameter(group: int, name: str, kind: int, shape: tuple[int, ...], data: bytes) -> bytes:
        body = bytes([kind & 255, len(shape), *shape]) + data + b"\0"
        return bytes([len(name), group & 255]) + name.encode() + word(2 + len(body)) + body

    head = bytes([2, 0x50]) + word(1) + word(0) + word(1) + word(2) + word(0) + real(-1.0) + word(3) + word(0) + real(50.0)
    block = bytes([1, 0x50, 1, processor])
    block += bytes([5, 255]) + b"POINT" + word(3) + b"\0"
    block += parameter(1, "LABELS", -1, (2, 1), b"AB") + parameter(1, "UNITS", -1, (2,), b"mm") + b"\0\0"
    frames = b"".join(map(real, (100.0, 200.0, -300.0, 0.0))) + b"".join(map(real, (1.0, 2.0, 3.0, -1.0)))
    return head.ljust(512, b"\0") + block.ljust(512, b"\0") + frames.ljust(512, b"\0")


def test_the_subject_before_a_label_goes_and_letters_stay(tmp_path: Path) -> None:
    points = np.array([[[0.0, 0, 900], [0, 100, 900], [0, 200, 900]]] * 3)
    names = ["Finger:tip", "Finger:größe", "Finger:mid"]
    path = written(tmp_path / "a.c3d", points, labels=names)
    assert list(next(open_source(path).frames()).markers) == ["tip", "größe", "mid"]
    twice = written(tmp_path / "b.c3d", points, labels=["a:tip", "b:tip", "b:mid"])
    assert list(next(open_source(twice).frames()).markers) == ["a:tip", "b:tip", "mid"]
    for key in ("Finger:tip", "tip"):
        source = open_source(path, Options(columns={key: "marker.end"}, topics=("mid", key)))
        assert list(next(source.frames()).markers) == ["end", "mid"]


def test_a_scene_that_is_absurdly_small_or_large_is_warned_of(tmp_path: Path) -> None:
    points = np.array([[[0.0, 0, 0.9], [0, 0.12, 0.9]]] * 3)
    with pytest.warns(UserWarning, match=r"0\.12 mm across.*--unit"):
        open_source(written(tmp_path / "a.c3d", points, unit="mm"))
    with pytest.warns(UserWarning, match="120 m across"):
        open_source(written(tmp_path / "b.c3d", 1000 * points, unit="m"))
