"""Recordings that the RealSense SDK's own recorder wrote, both kinds of file."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import realsense_writer as camera

from femsense.io.clouds.images import read_png
from femsense.io.importers.guess import open_source
from femsense.io.importers.options import Options
from femsense.io.importers.writer import write_recording
from femsense.io.recording_folder import load_recording
from femsense.pointcloud.cloud import PointCloud

FRAMES = 6
OLD_SDK = "pyrealsense2==2.57.7.10387"
"""Only an SDK up to 2.57 writes .bag; it goes into a folder of its own beside the newer one."""


@pytest.fixture(scope="module", params=["db3", "bag"])
def recorded(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of the recorder; skipped where no SDK that writes this kind is installed."""
    pytest.importorskip("rosbags")
    return _recorded(request, tmp_path_factory.mktemp("sdk") / f"take.{request.param}")


def _recorded(request: pytest.FixtureRequest, file: Path, *words: str) -> Path:
    paths = [str(_old_sdk(request))] if file.suffix == ".bag" else []
    done = subprocess.run(
        [sys.executable, camera.__file__, str(file), str(FRAMES), *words],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([*paths, os.environ.get("PYTHONPATH", "")])},
        capture_output=True,
        text=True,
        timeout=120,
    )
    if done.returncode == 3:
        pytest.skip(f"no SDK that writes {file.suffix}: {done.stderr.strip()[-200:]}")
    assert done.returncode == 0, done.stderr
    return file


def _old_sdk(request: pytest.FixtureRequest) -> Path:
    """Return a folder with the older SDK, installed once and kept in the tests' cache; skips where it cannot be had."""
    cache = getattr(request.config, "cache", None)
    if cache is None:  # pytest runs without its cache
        pytest.skip("no place to keep the older SDK in")
    folder = Path(cache.mkdir(OLD_SDK.replace("==", "-")))
    if not (folder / "pyrealsense2").is_dir():
        command = [
            sys.executable,
            "-m",
            "pip",
            "install",
            "-q",
            "--no-deps",
            "--only-binary=:all:",
            "--target",
            str(folder),
            OLD_SDK,
        ]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300)
        if done.returncode:
            pytest.skip(f"{OLD_SDK} is not to be had: {done.stderr.strip()[-200:]}")
    return folder


@pytest.fixture(scope="module")
def imported(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    folder = tmp_path_factory.mktemp("import") / "recording"
    found = write_recording(open_source(recorded, Options()), folder, identity={"test": recorded.name})
    return folder, found


def test_depth_is_bit_for_bit_but_for_what_says_no_depth(imported: tuple[Path, dict]) -> None:
    folder, _ = imported
    for k in range(FRAMES):
        wanted = camera.depth_of(k)
        wanted[wanted == 65535] = 0
        np.testing.assert_array_equal(read_png(folder / "depth" / f"{k:06d}.png"), wanted)


def test_scale_lens_and_clock_are_the_devices(imported: tuple[Path, dict]) -> None:
    folder, found = imported
    recording = load_recording(folder)
    lens = recording.cameras[0]
    assert lens is not None
    assert lens.depth_unit == pytest.approx(camera.DEPTH_UNIT)
    np.testing.assert_allclose([lens.fx, lens.fy, lens.cx, lens.cy], camera.DEPTH_LENS, rtol=1e-6)
    np.testing.assert_allclose(recording.time_s, np.arange(FRAMES) / 30, atol=2e-6)
    assert found["start_s"] == pytest.approx(1e-3 * camera.START_MS)
    assert found["frames"] == FRAMES and found["rate_hz"] == pytest.approx(30, rel=1e-4)


def test_colours_are_those_of_the_place_that_a_depth_pixel_sees(imported: tuple[Path, dict]) -> None:
    folder, _ = imported
    fx, fy, cx, cy = camera.DEPTH_LENS
    gx, gy, dx, dy = camera.COLOR_LENS
    for k in range(FRAMES):
        depth = read_png(folder / "depth" / f"{k:06d}.png")
        image = read_png(folder / "color" / f"{k:06d}.png")[:, :, ::-1]
        row, column = 20, 30
        z = float(depth[row, column]) * camera.DEPTH_UNIT
        if z == 0:
            continue
        point = camera.TURN @ [(column - cx) / fx * z, (row - cy) / fy * z, z] + [-camera.SHIFT, 0, 0]
        u, v = round(gx * point[0] / z + dx), round(gy * point[1] / z + dy)
        np.testing.assert_array_equal(image[row, column], [4 * u, 5 * v, k])


@pytest.mark.parametrize("ending", ["db3", "bag"])
def test_an_inverse_lens_becomes_clouds(ending: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    """In .db3 a text beside the CameraInfo, which says plumb_bob to all, names the model."""
    pytest.importorskip("rosbags")
    source = open_source(_recorded(request, tmp_path / f"take.{ending}", "inverse"), Options())
    assert source.camera is not None and source.camera.distortion_model == "inverse_brown_conrady"
    np.testing.assert_allclose(source.camera.distortion[:5], camera.INVERSE, rtol=1e-6)
    pictures = [frame.picture() for frame in source.frames() if frame.picture is not None]
    assert len(pictures) == FRAMES and all(isinstance(picture, PointCloud) for picture in pictures)
