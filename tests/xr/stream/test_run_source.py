"""A run as a stream: bones as the mesh's own animation has them, forces and inputs of the nearest frame, over and over."""

from __future__ import annotations

import itertools
import time
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from glb import Glb, in_gltf
from scipy.spatial.transform import Rotation
from xr_bar import bar_mesh, bar_states, write_run_with_mesh

from femsense.core.errors import InputError
from femsense.xr.glb_reader import read_glb
from femsense.xr.skinning import skin_vertices
from femsense.xr.stream.run_source import MeasuredClouds, RunStream, between, frames_of, open_run, with_residuals


@pytest.fixture(scope="module")
def stream(tmp_path_factory: pytest.TempPathFactory) -> RunStream:
    run = write_run_with_mesh(tmp_path_factory.mktemp("stream") / "bar", bones=12)
    lines = ["frame,time_s,status,rms_after_m,tension_top_n,pressure_bellow_pa"]
    lines += [f"{10 + k},{2.0 + 2.0 * k / 23},ok,0.0004,{0.1 * k},{100 * k}" for k in range(24)]
    (run / "frames.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return open_run(run)


def matrices(rows: np.ndarray) -> np.ndarray:
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_quat(rows[:, 3:]).as_matrix(), rows[:, :3]
    return T


def test_streamed_bones_place_the_skin_where_a_viewer_of_the_file_sees_it(stream: RunStream, tmp_path: Path) -> None:
    file = tmp_path / "robot.glb"
    file.write_bytes(stream.twin.glb)
    frame = list(frames_of(stream, rate_hz=23 / 2.0, loop=False))[11]
    here = skin_vertices(stream.skin.skin, matrices(frame.bones)[None])[0]
    np.testing.assert_allclose(in_gltf(here), Glb(file).vertices(11), atol=2e-6)
    _, states = bar_states(bar_mesh().nodes)
    assert np.abs(here - states[11][np.linalg.norm(here[:, None] - states[11], axis=2).argmin(axis=1)]).max() < 2e-3


def test_a_frame_says_what_the_run_says_of_that_moment(stream: RunStream) -> None:
    frames = list(frames_of(stream, rate_hz=23 / 2.0, loop=False))
    assert len(frames) == 24 and frames[11].frame == 21 and frames[11].status == "ok"
    (contact,) = frames[11].contacts
    assert contact.force_n[0] == pytest.approx(-2.0 * np.sin(np.pi * 11 / 24)) and contact.std_n == 0.1
    assert np.isnan(contact.force_std_n).all() and frames[0].contacts == ()
    assert frames[11].inputs == pytest.approx((1.1, 1100.0))
    assert [(i.name, i.unit, i.high) for i in stream.twin.inputs] == [("top", "N", 2.3000000000000003), ("bellow", "Pa", 2300.0)]


def test_the_stress_of_a_frame_is_that_of_the_page_of_a_run(stream: RunStream) -> None:
    frames = list(frames_of(stream, rate_hz=23 / 2.0, loop=False))
    assert stream.twin.field is not None and stream.twin.field.largest > 0
    vertices = len(stream.skin.skin.rest)
    fields = np.array([frame.field for frame in frames])
    assert fields.shape == (24, vertices) and fields.max() == 255
    assert not fields[[0, -1]].any() and fields[5].all()  # the bar is straight at both ends of its dance


def test_time_goes_on_when_the_run_begins_again(stream: RunStream) -> None:
    frames = list(itertools.islice(frames_of(stream, rate_hz=50.0), 300))
    steps = np.diff([f.time_s for f in frames])
    np.testing.assert_allclose(steps, 0.02, atol=1e-9)
    np.testing.assert_allclose(frames[126].bones, frames[0].bones)
    assert len(list(frames_of(stream, rate_hz=50.0, loop=False))) == 101


def test_between_frames_bones_are_rigid(stream: RunStream) -> None:
    bones = between(stream.skin.time_s, stream.skin.bones, 0.317)
    np.testing.assert_allclose(np.linalg.norm(bones[:, 3:], axis=1), 1.0, atol=1e-6)
    low, high = stream.skin.bones[3], stream.skin.bones[4]
    assert ((bones[:, :3] >= np.minimum(low, high)[:, :3] - 1e-7) & (bones[:, :3] <= np.maximum(low, high)[:, :3] + 1e-7)).all()


def test_residuals_of_a_cloud_are_distances_from_the_surface() -> None:
    mesh = bar_mesh()
    points = np.array([[0.018, 0.0, 0.1], [0.013, 0.0, 0.1], [0.0, 0.5, 0.1]])  # 3 mm outside, 2 mm inside, far away
    cloud = with_residuals(points, mesh.nodes, mesh.tets)
    np.testing.assert_allclose(cloud[:, 3], [0.003, -0.002], atol=1e-6)
    np.testing.assert_allclose(cloud[:, :3], points[:2], atol=1e-6)


def test_clouds_are_read_beside_the_stream_until_it_is_closed() -> None:
    begun, go = Event(), Event()

    def read(k: int) -> np.ndarray | None:
        begun.set()
        assert go.wait(10.0)
        return None if k == 1 else np.full((1, 4), k, dtype=np.float32)

    clouds = MeasuredClouds(read(k) for k in range(3))
    assert begun.wait(10.0) and clouds.at(0) is None  # not yet, and nobody waits for it
    go.set()
    clouds.wait()
    assert clouds.at(1) is None and [clouds.at(k)[0, 0] for k in (0, 2)] == [0.0, 2.0]
    closed = MeasuredClouds(time.sleep(0.01) for _ in range(10_000))
    closed.close()  # does not wait for all of them
    assert MeasuredClouds(()).at(0) is None


@pytest.mark.parametrize("data", [b"", b"glTF", b"x" * 40, b"glTF\x02\0\0\0\x1c\0\0\0\x08\0\0\0JSON{}      "])
def test_files_of_others_are_refused(data: bytes) -> None:
    with pytest.raises(InputError, match="not a mesh of femsense"):
        read_glb(data)
