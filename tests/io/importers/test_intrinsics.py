"""Lenses in files: by name, by the shape of a matrix, by order; digits in words and comments; what is no lens of the images."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from imported import imported

from femsense.core.errors import InputError
from femsense.io.importers.images.intrinsics import read_lens
from femsense.io.importers.options import Options

WIDTH, HEIGHT = 160, 120
FX, FY, CX, CY = 131.25, 131.5, 79.5, 59.5
K = [[FX, 0, CX], [0, FY, CY], [0, 0, 1]]
BENT = "0.1 -0.2 0.001 0.002 0.03"


def rows(matrix: object, shape: tuple[int, int], *, columns: bool = False) -> str:
    whole = np.eye(4)
    whole[:3, :3] = matrix
    part = whole[: shape[0], : shape[1]]
    return "\n".join(" ".join(f"{v:g}" for v in row) for row in (part.T if columns else part)) + "\n"


PLAIN = {
    "order.txt": f"{FX} {FY} {CX} {CY}",
    "one focal length.txt": f"{FX} {CX} {CY}",
    "fx cx fy cy.txt": f"{FX} {CX} {FY} {CY}",
    "size first.txt": f"160 120\n{FX} {FY}\n{CX} {CY}\n",
    "size last.txt": f"{FX} {FY} {CX} {CY} 160 120",
    "height first.txt": f"120 160\n{FX} {FY} {CX} {CY}",
    "two blocks.txt": f"160 120\n525 525\n70 50\n\n160 120\n{FX} {FY}\n{CX} {CY}\n\n0.99 0 0 0.1\n0 1 0 0\n0 0 1 0\naffine 0.0002 0\n",
    "head.csv": f"width,height,fx,fy,cx,cy\n160,120,{FX},{FY},{CX},{CY}\n",
    "names.txt": f"fx: {FX}\ncx: {CX}\nfy: {FY}\ncy: {CY}\n",
    "in one line.txt": f"fx={FX}, fy={FY}, cx={CX}, cy={CY}",
    "decimal commas.txt": "fx: 131,25\nfy: 131,5\ncx: 79,5\ncy: 59,5\n",
    "pairs.yaml": f"focal_length: {FX} {FY}\nprincipal_point: {CX} {CY}\n",
    "shares.txt": f"{FX / WIDTH} {FY / HEIGHT} {CX / WIDTH} {CY / HEIGHT} 0\n160 120\ncrop\n160 120\n",
    "33.txt": rows(K, (3, 3)),
    "33 by columns.txt": rows(K, (3, 3), columns=True),
    "34.txt": rows(K, (3, 4)),
    "44.txt": rows(K, (4, 4)),
    "44 by columns.txt": rows(K, (4, 4), columns=True),
    "matlab.txt": f"K = [{FX} 0 {CX}; 0 {FY} {CY}; 0 0 1]",
    "brackets.txt": str(K).replace("], [", "],\n ["),
    "kitti.txt": f"P0: {FX} 0 {CX} 0 0 {FY} {CY} 0 0 0 1 0\nTr: 1 0 0 0 0 1 0 0 0 0 1 0\n",
    "colmap.txt": f"# 1 camera\n1 PINHOLE 160 120 {FX} {FY} {CX} {CY}\n",
    "comment.txt": f"# Kinect v2, 512 x 424, 30 Hz\n{FX} {FY} {CX} {CY}\n",
    "words.txt": f"D435 640x480 cam0: {FX} {FY} {CX} {CY}\n",
    "open3d.json": json.dumps({"width": 160, "height": 120, "intrinsic_matrix": [FX, 0, 0, 0, FY, 0, CX, CY, 1]}),
    "realsense.json": json.dumps({"width": 160, "height": 120, "ppx": CX, "ppy": CY, "fx": FX, "fy": FY, "coeffs": [0.0] * 5}),
    "two cameras.json": json.dumps(
        {"color": {"K": [525, 0, 80, 0, 525, 60, 0, 0, 1]}, "depth": {"K": [FX, 0, CX, 0, FY, CY, 0, 0, 1]}}
    ),
    "matlab object.txt": f"% 2026-11-27\nFocalLength: [{FX} {FY}]\nPrincipalPoint: [{CX} {CY}]\nSkew: 0\n",
    "opencv.xml": f'<?xml version="1.0"?>\n<!-- 9 x 6 --><opencv_storage>\n<image_Width>160</image_Width>\n<camera_matrix type_id="opencv-'
    f'matrix">\n<rows>3</rows><cols>3</cols><dt>d</dt><data>{FX} 0. {CX} 0. {FY} {CY} 0. 0. 1.</data></camera_matrix></opencv_storage>',
    "bop.json": json.dumps({"cam_K": [FX, 0, CX, 0, FY, CY, 0, 0, 1], "depth_scale": 0.1}),
}
DISTORTED = {
    "behind a matrix.txt": rows(K, (3, 3)) + f"\n{BENT}\n",
    "behind four.txt": f"{FX} {FY} {CX} {CY} {BENT}",
    "matlab object bent.txt": f"RadialDistortion: [0.1 -0.2 0.03]\nTangentialDistortion: [0.001 0.002]\nFocalLength: [{FX} {FY}]\n"
    f"PrincipalPoint: [{CX} {CY}]\n",
    "beside a matrix.yaml": f"K: [{FX}, 0, {CX}, 0, {FY}, {CY}, 0, 0, 1]\nk1: 0.1\nk2: -0.2\np1: 0.001\np2: 0.002\nk3: 0.03\n",
    "orb.yaml": f"%YAML:1.0\nCamera.fx: {FX}\nCamera.fy: {FY}\nCamera.cx: {CX}\nCamera.cy: {CY}\nCamera.k1: 0.1\nCamera.k2: -0.2\n"
    "Camera.p1: 0.001\nCamera.p2: 0.002\nCamera.k3: 0.03\nCamera.fps: 30.0\n",
    "opencv.yaml": f"%YAML:1.0\n---\nimage_width: 160\nimage_height: 120\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
    f"   data: [ {FX}, 0., {CX}, 0.,\n       {FY}, {CY}, 0., 0., 1. ]\ndistortion_coefficients: !!opencv-matrix\n   rows: 5\n   cols: 1\n"
    f"   dt: d\n   data: [ {BENT.replace(' ', ', ')} ]\n",
    "ros.yaml": "image_width: 160\nimage_height: 120\ncamera_name: cam_2\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
    f"  data: [{FX}, 0, {CX}, 0, {FY}, {CY}, 0, 0, 1]\n"
    f"distortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [{BENT.replace(' ', ', ')}]\n"
    "projection_matrix:\n  rows: 3\n  cols: 4\n  data: [130, 0, 80, 0, 0, 130, 60, 0, 0, 0, 1, 0]\n",
}


@pytest.mark.parametrize("name", [*PLAIN, *DISTORTED])
def test_lenses_as_programs_write_them(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text((PLAIN | DISTORTED)[name])
    lens, notes = read_lens(tmp_path / name, WIDTH, HEIGHT)
    assert not any("several lenses" in note for note in notes)
    fy = FX if name == "one focal length.txt" else FY
    np.testing.assert_allclose([lens.fx, lens.fy, lens.cx, lens.cy], [FX, fy, CX, CY], rtol=1e-6)
    wanted = [0.1, -0.2, 0.001, 0.002, 0.03] if name in DISTORTED else [0.0] * 5
    np.testing.assert_allclose(lens.distortion[:5], wanted)


def test_a_fisheye_lens_of_kalibr(tmp_path: Path) -> None:
    (tmp_path / "camchain.yaml").write_text(
        f"cam0:\n  camera_model: pinhole\n  distortion_coeffs: [0.01, -0.02, 0.003, 0.004]\n  distortion_model: equidistant\n"
        f"  intrinsics: [{FX}, {FY}, {CX}, {CY}]\n  resolution: [160, 120]\n"
    )
    lens, _ = read_lens(tmp_path / "camchain.yaml", WIDTH, HEIGHT)
    assert lens.distortion_model == "kannala_brandt"
    np.testing.assert_allclose(lens.distortion[:4], [0.01, -0.02, 0.003, 0.004])


def test_of_two_cameras_of_kalibr_the_first_is_read_and_that_is_noted(tmp_path: Path) -> None:
    one = f"  intrinsics: [{FX}, {FY}, {CX}, {CY}]\n  resolution: [160, 120]\n"
    (tmp_path / "c.yaml").write_text(f"cam0:\n{one}cam1:\n{one.replace(str(FX), '525')}")
    lens, notes = read_lens(tmp_path / "c.yaml", WIDTH, HEIGHT)
    assert lens.fx == FX and any("the first is used" in note for note in notes)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (f"{FX} {-FY} {CX} {CY}", "counts rows upwards"),
        (f"{FX} {FY} 319.5 239.5", "images of about 640 × 480"),
        (f"1.3 1.3 {CX} {CY}", "another unit than pixels"),
        (f"{FX} {FY} {CX} {CY} 160 12 0 0 0", "coefficient of distortion of 160"),
        (f"{FX} {FY} {CX} {CY} 1 2 3", "no lens in this file"),
        ("0.82 1.09 0.49 0.49 0.93\n160 120\n", "no lens in this file"),
        ("width: 640\nheight: 480\nfx: 525\nfy: 525\ncx: 319.5\ncy: 239.5\n", "another size than the images"),
        (f"fx: {FX}\nfy: {FY}\ncx: {CX}\ncy: {CY}\nk1: 0.2\ndistortion_model: fov\n", "unknown distortion model"),
        ("hello 3 world", "no lens in this file"),
        (f"{FX} 12 {CX}\n0 {FY} {CY}\n0 0 1\n", "a lens with skew"),
        (f"ImageSize: [120 160]\nFocalLength: [{FX} {FY}]\nPrincipalPoint: [{CX} {CY}]\n", "are these rows, columns?"),
    ],
)
def test_what_is_no_lens_of_the_images_is_refused(text: str, match: str, tmp_path: Path) -> None:
    (tmp_path / "camera.txt").write_text(text)
    with pytest.raises(InputError, match=match):
        read_lens(tmp_path / "camera.txt", WIDTH, HEIGHT)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (f"{FX} 0.1 {CX}\n0 {FY} {CY}\n0 0 1\n", "a skew of 0.1 is left out"),
        (f"fx: {FX}\nfy: {FY}\ncx: {CX}\ncy: {CY}\ndistortion: 0.1 -0.2\n", "distortion: not read"),
        (f"fx: {FX}\nfy: {FY}\ncx: {CX}\ncy: {CY}\nlens_coefficients: 0.1 -0.2 0 0\n", "lens_coefficients: not read"),
    ],
)
def test_numbers_of_a_lens_that_are_left_out_are_noted(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "camera.txt").write_text(text)
    lens, notes = read_lens(tmp_path / "camera.txt", WIDTH, HEIGHT)
    assert (lens.fx, lens.cy) == (FX, CY) and not lens.distortion.any()
    assert any(said in note for note in notes)


def redwood(folder: Path, lens: str, depth: int = 500, size: tuple[int, int] = (HEIGHT, WIDTH)) -> Path:
    (folder / "depth").mkdir(parents=True)
    (folder / "calibration.txt").write_text(lens)
    for k in range(3):
        cv2.imwrite(str(folder / "depth" / f"{k:06d}.png"), np.full(size, depth, dtype=np.uint16))
    return folder


def test_the_table_of_an_import_says_the_lens(tmp_path: Path) -> None:
    _, found = imported(redwood(tmp_path / "in", PLAIN["44.txt"]), tmp_path, Options(rate=10.0))
    assert found["lens"] == "160 × 120, brown_conrady, fx 131.25, fy 131.5, cx 79.5, cy 59.5"


def test_a_scene_that_is_too_near_for_an_assumed_unit_is_asked_about(tmp_path: Path) -> None:
    folder = redwood(tmp_path / "in", PLAIN["order.txt"], depth=128)
    with pytest.warns(
        UserWarning, match=r"0\.128 m away.*as Redwood has it.*in 1/256 m it is 0\.5 m \(--depth-unit 0\.00390625\)"
    ):
        imported(folder, tmp_path, Options(rate=10.0))


def test_a_depth_scale_of_bop_is_millimetres_in_one_unit(tmp_path: Path) -> None:
    folder = redwood(tmp_path / "in", "", depth=5000)
    (folder / "calibration.txt").unlink()
    (folder / "camera.json").write_text(PLAIN["bop.json"])
    recording, _ = imported(folder, tmp_path, Options(rate=10.0))
    assert recording.cameras[0] is not None and recording.cameras[0].depth_unit == pytest.approx(1e-4)


def test_an_image_of_another_size_costs_itself(tmp_path: Path) -> None:
    folder = redwood(tmp_path / "in", PLAIN["order.txt"])
    cv2.imwrite(str(folder / "depth" / "000002.png"), np.full((60, 80), 500, dtype=np.uint16))
    with pytest.warns(UserWarning, match="another size than the first"):
        _, found = imported(folder, tmp_path, Options(rate=10.0))
    assert found["broken_pictures"] == 1
