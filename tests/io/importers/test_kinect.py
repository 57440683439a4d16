"""Azure Kinect recordings: depth bit for bit, the lens of the mode, colours where they belong, and what is missing said."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from imported import imported, without_invalid
from kinect_writer import COLOR_MODEL, DEPTH_MODEL, calibration, write_kinect

from femsense.core.errors import InputError
from femsense.io.clouds.images import read_png
from femsense.io.importers.guess import guess_format, open_source
from femsense.io.importers.images.kinect import calibrated_lens
from femsense.io.importers.options import Options

SMALL = (288, 320)


def depth(number: int) -> np.ndarray:
    image = np.random.default_rng(number).integers(300, 3000, size=SMALL).astype(np.uint16)
    image[3, 3], image[4, 4] = 0, 65535
    return image


def striped(number: int, size: tuple[int, int] = (720, 1280)) -> np.ndarray:
    """Return an image whose red rises and falls by two levels a pixel to the right, and whose green does so downwards."""
    row, column = np.mgrid[: size[0], : size[1]]
    return np.stack([wave(column), wave(row), np.full(size, 20.0 * number)], axis=2).astype(np.uint8)


def wave(pixel: np.ndarray) -> np.ndarray:
    return np.abs((2 * pixel) % 510 - 255)


def test_depth_is_kept_bit_for_bit_and_the_lens_is_that_of_the_mode(tmp_path: Path) -> None:
    images = [depth(k) for k in range(5)]
    file = write_kinect(tmp_path / "take.mkv", images)
    assert guess_format(file) == "kinect"
    recording, found = imported(file, tmp_path)
    for k, image in enumerate(images):
        np.testing.assert_array_equal(read_png(tmp_path / f"recording/depth/{k:06d}.png"), without_invalid(image))
    np.testing.assert_allclose(recording.time_s, 0.033 * np.arange(5), atol=1e-9)
    assert found["serial_number"] == "000123" and found["frames"] == 5
    lens, (cx, cy, fx, fy) = recording.cameras[0], DEPTH_MODEL[:4]
    assert lens is not None and (lens.width, lens.height) == (320, 288)
    np.testing.assert_allclose([lens.fx, lens.fy], [512 * fx, 512 * fy])
    np.testing.assert_allclose([lens.cx, lens.cy], [512 * cx - 96 - 0.5, 512 * cy - 90 - 0.5])
    np.testing.assert_allclose(lens.distortion, [*DEPTH_MODEL[4:6], *DEPTH_MODEL[:11:-1], *DEPTH_MODEL[6:10]])


def test_colours_lie_where_opencv_projects_the_depth(tmp_path: Path) -> None:
    images = [np.full(SMALL, 900 + 10 * k, dtype=np.uint16) for k in range(4)]
    write_kinect(tmp_path / "take.mkv", images, [striped(k) for k in range(4)])
    imported(tmp_path / "take.mkv", tmp_path)
    d, c = calibration()["CalibrationInformation"]["Cameras"]
    own, other = calibrated_lens(d, 320, 288), calibrated_lens(c, 1280, 720)
    np.testing.assert_allclose([other.cx, other.cy], [1280 * COLOR_MODEL[0] - 0.5, 960 * COLOR_MODEL[1] - 120 - 0.5])
    pixels = np.array([[160.0, 144.0], [60.0, 80.0], [250.0, 230.0]])
    matrix = np.array([[own.fx, 0, own.cx], [0, own.fy, own.cy], [0, 0, 1]])
    rays = cv2.undistortPoints(pixels[:, None], matrix, own.distortion, criteria=(cv2.TERM_CRITERIA_COUNT, 200, 0))
    points = 0.92 * np.concatenate([rays[:, 0], np.ones((3, 1))], axis=1)
    R, t = np.reshape(c["Rt"]["Rotation"], (3, 3)), np.array(c["Rt"]["Translation"])
    matrix = np.array([[other.fx, 0, other.cx], [0, other.fy, other.cy], [0, 0, 1]])
    expected, _ = cv2.projectPoints(points, cv2.Rodrigues(R)[0], t, matrix, other.distortion)
    seen = read_png(tmp_path / "recording/color/000002.png")[:, :, ::-1]
    for (u, v), (x, y) in zip(pixels.astype(int), expected[:, 0]):
        np.testing.assert_allclose(seen[v, u], [wave(x), wave(y), 40], atol=8)


def test_colours_of_another_moment_are_left_out(tmp_path: Path) -> None:
    images = [np.full(SMALL, 900, dtype=np.uint16)] * 3
    write_kinect(tmp_path / "take.mkv", images, [striped(k) for k in range(3)], late_ms=20)
    imported(tmp_path / "take.mkv", tmp_path)
    seen = [read_png(tmp_path / f"recording/color/{k:06d}.png")[144, 160, 0] for k in (1, 2)]
    np.testing.assert_allclose(seen, [0, 20], atol=8)  # 13 ms earlier rather than 20 ms later
    assert not (tmp_path / "recording/color/000000.png").exists()


def test_old_calibrations_of_wide_images_give_the_same_lens() -> None:
    _, color = calibration()["CalibrationInformation"]["Cameras"]
    wide = {**color, "SensorHeight": 2304, "Intrinsics": {**color["Intrinsics"]}}
    cx, cy, fx, fy, *rest = COLOR_MODEL
    wide["Intrinsics"]["ModelParameters"] = [cx, (cy * 3072 - 384) / 2304, fx, fy * 3072 / 2304, *rest]
    a, b = calibrated_lens(color, 2048, 1536), calibrated_lens(wide, 2048, 1536)
    np.testing.assert_allclose([a.fx, a.fy, a.cx, a.cy], [b.fx, b.fy, b.cx, b.cy])
    assert a.cy == pytest.approx(1536 * cy - 0.5)


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no calibration in the recording"):
        open_source(write_kinect(tmp_path / "bare.mkv", [depth(0)], told={}))
    with pytest.raises(InputError, match="no depth track"):
        open_source(write_kinect(tmp_path / "video.mkv", [depth(0)], title="IR"))
    with pytest.raises(InputError, match="a size that no mode has"):
        open_source(write_kinect(tmp_path / "odd.mkv", [depth(0)[:200]]))
    (tmp_path / "cut.mkv").write_bytes((tmp_path / "bare.mkv").read_bytes()[:60])
    with pytest.raises(InputError, match="not readable as Matroska"):
        open_source(tmp_path / "cut.mkv")


def test_a_file_that_was_cut_off_is_read_to_the_break(tmp_path: Path) -> None:
    images = [depth(k) for k in range(6)]
    content = write_kinect(tmp_path / "take.mkv", images).read_bytes()
    (tmp_path / "cut.mkv").write_bytes(content[: len(content) // 2])
    recording, _ = imported(tmp_path / "cut.mkv", tmp_path, Options())
    assert 2 <= len(recording.time_s) <= 3
    np.testing.assert_array_equal(read_png(tmp_path / "recording/depth/000001.png"), without_invalid(images[1]))
