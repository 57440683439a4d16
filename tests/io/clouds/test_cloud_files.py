"""Clouds, their files, and depth images."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from helpers import DATA

from femsense.core.errors import InputError
from femsense.io.clouds.cloud_files import read_cloud, write_cloud
from femsense.io.clouds.pcd import read_pcd_fields
from femsense.pointcloud import PointCloud, cloud_from_depth
from femsense.pointcloud.cloud import without_mixed_pixels


def some_cloud(count: int = 50, *, colors: bool = True, seed: int = 0) -> PointCloud:
    rng = np.random.default_rng(seed)
    return PointCloud(rng.normal(size=(count, 3)), rng.integers(0, 256, size=(count, 3)) / 255.0 if colors else None)


def pcd_text(rows: str = "0 0 1 7\n1 2 3 8\n", *, points: object = 2, kind: str = "F F F U", data: str = "ascii") -> str:
    head = f"# .PCD v0.7\nVERSION 0.7\nFIELDS x y z label\nSIZE 4 4 4 4\nTYPE {kind}\nCOUNT 1 1 1 1\nWIDTH {points}\nHEIGHT 1\n"
    return head + f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {data}\n" + rows


def test_arrays_are_read_only_copies() -> None:
    points = np.zeros((2, 3))
    cloud = PointCloud(points)
    points[0] = 5.0
    assert cloud.points.max() == 0.0
    with pytest.raises(ValueError, match="read-only"):
        cloud.points[0, 0] = 1.0


def test_select_takes_colours_along() -> None:
    cloud = some_cloud()
    chosen = cloud.select([3, 1])
    np.testing.assert_array_equal(chosen.points, cloud.points[[3, 1]])
    np.testing.assert_array_equal(chosen.colors, cloud.colors[[3, 1]])
    assert len(cloud.select(cloud.points[:, 0] > 0)) == (cloud.points[:, 0] > 0).sum()


@pytest.mark.parametrize(
    "colors, text", [(np.zeros((1, 3)), "one colour per point"), (np.full((2, 3), 255.0), "divide bytes by 255")]
)
def test_bad_colours_say_so(colors: np.ndarray, text: str) -> None:
    with pytest.raises(InputError, match=text):
        PointCloud(np.zeros((2, 3)), colors)


@pytest.mark.parametrize("suffix, tolerance", [(".ply", 0.0), (".pcd", 1e-6)])
@pytest.mark.parametrize("colors", [True, False])
def test_files_round_trip(tmp_path: Path, suffix: str, tolerance: float, colors: bool) -> None:
    cloud = some_cloud(colors=colors)
    write_cloud(tmp_path / f"cloud{suffix}", cloud)
    again = read_cloud(tmp_path / f"cloud{suffix}")
    np.testing.assert_allclose(again.points, cloud.points, rtol=tolerance, atol=0)
    assert (again.colors is not None) == colors
    if colors:
        np.testing.assert_allclose(again.colors, cloud.colors, atol=0.5 / 255)


def test_compressed_pcd_of_another_writer(tmp_path: Path) -> None:
    import open3d as o3d

    rng = np.random.default_rng(1)
    points = np.repeat(rng.normal(size=(40, 3)), 20, axis=0)  # repeats, so that the stream holds back references
    path = tmp_path / "packed.pcd"
    o3d.io.write_point_cloud(str(path), o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)), compressed=True)
    assert b"DATA binary_compressed" in path.read_bytes()[:400]
    np.testing.assert_array_equal(read_cloud(path).points, points.astype(np.float32))


def test_a_field_of_several_values_in_a_compressed_pcd(tmp_path: Path) -> None:
    path = tmp_path / "signature.pcd"
    values = np.concatenate([np.arange(6), 10.0 * np.arange(1, 7)]).astype("<f4").tobytes()  # x y z of two points, then h of each
    stream = b"".join(bytes([len(part) - 1]) + part for part in (values[:32], values[32:]))  # LZF: up to 32 bytes as they are
    head = pcd_text("", data="binary_compressed", kind="F F F F").replace("COUNT 1 1 1 1", "COUNT 1 1 1 3")
    path.write_bytes(head.encode() + np.array([len(stream), 48], "<u4").tobytes() + stream)
    fields = read_pcd_fields(path)
    assert fields["y"].tolist() == [2.0, 3.0]
    assert fields["label"].tolist() == [[10.0, 20.0, 30.0], [40.0, 50.0, 60.0]]


def test_pcd_of_older_writers(tmp_path: Path) -> None:
    path = tmp_path / "old.pcd"
    path.write_text(
        "# .PCD v.5\nFIELDS x y z _\nSIZE 4 4 4 1\nTYPE F F F U\nWIDTH 2\nHEIGHT 1\nDATA ascii\n 0  0 1 9 \n1 2\t3 9\n\n"
    )
    fields = read_pcd_fields(path)
    assert list(fields) == ["x", "y", "z"]
    assert fields["z"].tolist() == [1.0, 3.0]


def test_all_fields_of_a_pcd_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "labels.pcd"
    path.write_text(pcd_text())
    fields = read_pcd_fields(path)
    assert list(fields) == ["x", "y", "z", "label"]
    assert fields["label"].tolist() == [7, 8] and fields["label"].dtype == np.uint32
    assert fields["z"].tolist() == [1.0, 3.0]


def test_points_that_are_not_finite_are_dropped(tmp_path: Path) -> None:
    path = tmp_path / "holes.pcd"
    path.write_text(pcd_text("nan nan nan 7\n1 2 3 8\n"))
    assert read_cloud(path).points.tolist() == [[1.0, 2.0, 3.0]]
    assert len(read_pcd_fields(path)["x"]) == 2


@pytest.mark.parametrize(
    "text, pattern",
    [
        ("nothing", "not a PCD file"),
        (pcd_text(points=3), r"(?s)broken or shortened.*2 rows.*3 rows of 4 numbers"),
        (pcd_text(kind="F F F Q"), r"(?s)broken PCD header.*TYPE F F F Q.*'F', 'U' or 'I'"),
        (pcd_text(kind="F F F"), r"(?s)unknown field types.*TYPE F F F,.*4 of F"),
        (pcd_text(data="zipped"), r"(?s)broken PCD header.*DATA zipped.*'binary_compressed'"),
        (pcd_text(points="many"), r"(?s)broken PCD header.*many"),
        (pcd_text("1 2 3 4", data="binary"), r"(?s)broken or shortened.*7 bytes of data.*32 bytes"),
        (pcd_text("12345678", data="binary_compressed"), r"(?s)broken or shortened.*unpack"),
        (pcd_text("0 0 1 7\n1 2 x 8\n"), r"(?s)broken or shortened.*numbers"),
        (pcd_text().replace("FIELDS x y z label", "FIELDS x y a label"), r"(?s)fields are missing.*x, y, a, label.*x, y, z"),
    ],
)
def test_broken_pcd_files_name_the_problem(tmp_path: Path, text: str, pattern: str) -> None:
    path = tmp_path / "broken.pcd"
    path.write_text(text)
    with pytest.raises(InputError, match=pattern) as caught:
        read_cloud(path)
    assert "broken.pcd" in str(caught.value)


def test_a_shortened_ply_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    write_cloud(path, some_cloud(100))
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(InputError, match=r"(?s)broken or shortened PLY.*92 whole vertices.*100 vertices"):
        read_cloud(path)


PLY = "ply\nformat ascii 1.0\ncomment by hand\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
COLORED = PLY + "property uchar red\nproperty uchar green\nproperty uchar blue\n"
FACES = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"


def test_an_ascii_ply_with_faces_behind_its_vertices(tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    path.write_text(COLORED + FACES + "0 1 2 255 0 51\nnan 4 5 0 0 0\n3 0 1 1\n")
    cloud = read_cloud(path)
    assert cloud.points.tolist() == [[0.0, 1.0, 2.0]]
    np.testing.assert_allclose(cloud.colors, [[1.0, 0.0, 0.2]])


def test_a_big_endian_ply_with_float_colours(tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    head = COLORED.replace("ascii", "binary_big_endian").replace("uchar", "float") + "end_header\n"
    path.write_bytes(head.encode() + np.arange(12, dtype=">f4").__truediv__(12).astype(">f4").tobytes())
    cloud = read_cloud(path)
    np.testing.assert_allclose(cloud.points[1], np.arange(6, 9) / 12, rtol=1e-6)
    np.testing.assert_allclose(cloud.colors[0], np.arange(3, 6) / 12, rtol=1e-6)


@pytest.mark.parametrize(
    "name, text, pattern",
    [
        ("a.ply", "no header", "not a PLY file"),
        ("a.ply", "ply\nformat ascii 1.0\nend_header\n", "names no vertices"),
        ("a.ply", "ply\nformat zip 1.0\nend_header\n", r"(?s)unknown storage.*format zip"),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex some\nend_header\n", r"(?s)unknown line.*element vertex some"),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n", "lists in or before"),
        (
            "a.ply",
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n3\n",
            r"(?s)fields are missing.*x, y, z",
        ),
        (
            "a.ply",
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\nx\n",
            r"(?s)broken or shortened PLY.*numbers",
        ),
        (
            "a.ply",
            "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n1\n",
            r"(?s)1 vertices.*2 vertices of 1",
        ),
        ("a.las", "", r"not a format of point clouds"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, name: str, text: str, pattern: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=pattern):
        read_cloud(tmp_path / name)


def test_missing_places_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_cloud(tmp_path / "none.ply")
    with pytest.raises(InputError, match="no such folder"):
        write_cloud(tmp_path / "none" / "cloud.ply", some_cloud())


def depth_of_plane(fx: float, fy: float, cx: float, cy: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the depth [units of 0.1 mm] of the plane normal · p = offset in a 40 × 60 image."""
    normal, offset = np.array([0.2, -0.1, 1.0]), 0.8
    v, u = np.mgrid[0:40, 0:60]
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], axis=-1)
    return np.round(offset / (rays @ normal) * 1e4).astype(np.uint16), normal, offset


def test_depth_image_of_a_plane_gives_that_plane() -> None:
    depth, normal, offset = depth_of_plane(50.0, 55.0, 31.0, 18.0)
    depth[3, 4] = 0
    cloud = cloud_from_depth(depth, 50.0, 55.0, 31.0, 18.0, depth_unit_m=1e-4)
    assert len(cloud) == depth.size - 1
    np.testing.assert_allclose(cloud.points @ normal, offset, atol=1e-4)
    np.testing.assert_allclose(cloud.points[0], depth[0, 0] * 1e-4 * np.array([-31 / 50, -18 / 55, 1.0]), rtol=1e-12)


def test_pixels_between_two_surfaces_are_no_points() -> None:
    """A step from 0.4 to 0.5 m with mixed pixels on it, along columns as along rows; a stick before it, and a face seen obliquely, stay."""
    depth = np.full((20, 30), 500.0)
    depth[:, :10] = 400.0
    depth[:, 10] = np.linspace(410.0, 490.0, 20)
    depth[:, 20] = 350.0
    for image in (depth, depth.T):
        left = without_mixed_pixels(image, 500.0, 500.0)
        assert not left[image == depth[3, 10]].any()
        assert (left == 0).sum() == 20 and (left[image == 350.0] == 350.0).all()
    oblique = 500.0 + 3.0 * np.arange(30) * np.ones((20, 1))  # tan 3, where 3.87 are grazing
    np.testing.assert_array_equal(without_mixed_pixels(oblique, 500.0, 500.0), oblique)


def test_depth_image_is_projected_back_to_its_pixels_through_the_lens() -> None:
    import cv2

    depth, _, _ = depth_of_plane(50.0, 55.0, 31.0, 18.0)
    lens = np.array([-0.2, 0.05, 0.001, -0.002, 0.01])
    cloud = cloud_from_depth(depth, 50.0, 55.0, 31.0, 18.0, lens, 1e-4)
    K = np.array([[50.0, 0, 31.0], [0, 55.0, 18.0], [0, 0, 1]])
    pixels = cv2.projectPoints(cloud.points, np.zeros(3), np.zeros(3), K, lens)[0].reshape(-1, 2)
    v, u = np.mgrid[0:40, 0:60]
    np.testing.assert_allclose(pixels, np.stack([u.ravel(), v.ravel()], axis=1), atol=1e-6)


def test_a_fisheye_is_undone() -> None:
    import cv2

    depth, _, _ = depth_of_plane(25.0, 27.0, 31.0, 18.0)
    k = np.array([-0.05, 0.02, -0.003, 0.001])
    cloud = cloud_from_depth(depth, 25.0, 27.0, 31.0, 18.0, [*k, 0.0], 1e-4, distortion_model="kannala_brandt")
    K = np.array([[25.0, 0, 31.0], [0, 27.0, 18.0], [0, 0, 1]])
    pixels = cv2.fisheye.projectPoints(cloud.points[:, None], np.zeros(3), np.zeros(3), K, k)[0].reshape(-1, 2)
    v, u = np.mgrid[0:40, 0:60]
    np.testing.assert_allclose(pixels, np.stack([u.ravel(), v.ravel()], axis=1), atol=1e-6)


def test_the_inverse_model_takes_bent_rays_to_straight_ones() -> None:
    """The formula of rs2_deproject_pixel_to_point in librealsense."""
    k1, k2, p1, p2, k3 = lens = (-0.2, 0.05, 0.001, -0.002, 0.01)
    depth = np.full((3, 4), 2, dtype=np.uint16)
    cloud = cloud_from_depth(depth, 5.0, 6.0, 1.5, 1.0, lens, 0.5, distortion_model="inverse_brown_conrady")
    v, u = np.mgrid[0:3, 0:4].reshape(2, -1)
    x, y = (u - 1.5) / 5.0, (v - 1.0) / 6.0
    r2 = x * x + y * y
    f = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    straight = [x * f + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * f + 2 * p2 * x * y + p1 * (r2 + 2 * y * y), 1.0 + 0 * x]
    np.testing.assert_allclose(cloud.points, np.stack(straight, axis=1), rtol=1e-12)
    with pytest.raises(InputError, match="unknown lens model"):
        cloud_from_depth(depth, 5.0, 6.0, 1.5, 1.0, lens, distortion_model="pinhole")


def test_colours_of_a_depth_image_belong_to_their_pixels() -> None:
    color = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    cloud = cloud_from_depth(np.array([[0, 5], [6, 7]], dtype=np.uint16), 1, 1, 0, 0, color=color)
    np.testing.assert_allclose(cloud.colors, color[[0, 1, 1], [1, 0, 1]] / 255.0)
    with pytest.raises(InputError, match="colour image does not fit"):
        cloud_from_depth(np.ones((2, 3)), 1, 1, 0, 0, color=color)
    with pytest.raises(InputError, match="fx must be positive"):
        cloud_from_depth(np.ones((2, 3)), 0, 1, 0, 0)


# Colours as people write them


def ply_file(path: Path, names: Sequence[str], kind: str, values: np.ndarray) -> Path:
    header = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(f"property float {c}\n" for c in "xyz")
    header += "".join(f"property {kind} {name}\n" for name in names) + "end_header\n"
    path.write_text(header + "".join(f"0 0 1 {' '.join(map(str, row))}\n" for row in values.tolist()))
    return path


@pytest.mark.parametrize("names", [("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("R", "G", "B")])
@pytest.mark.parametrize(
    ("kind", "largest"), [("uchar", 255), ("ushort", 65535), ("int", 255), ("float", 1.0), ("float", 255.0), ("float", 65535.0)]
)
def test_colours_under_their_names_and_types(tmp_path: Path, names: Sequence[str], kind: str, largest: float) -> None:
    values = np.array([[largest, 0, largest], [0, largest, 0]])
    cloud = read_cloud(ply_file(tmp_path / "a.ply", names, kind, values if kind == "float" else values.astype(int)))
    np.testing.assert_allclose(cloud.colors, [[1, 0, 1], [0, 1, 0]], atol=1e-12)


def test_dark_colours_of_16_bits_stay_dark(tmp_path: Path) -> None:
    values = np.array([[100, 0, 0], [0, 200, 0]])
    cloud = read_cloud(ply_file(tmp_path / "a.ply", ("red", "green", "blue"), "ushort", values))
    np.testing.assert_allclose(cloud.colors, values / 65535.0)


def test_colours_that_are_not_understood_name_the_file(tmp_path: Path) -> None:
    file = ply_file(tmp_path / "a.ply", ("red", "green", "blue"), "float", np.array([[-1.0, 0, 0], [0, 0, 0]]))
    with pytest.raises(InputError, match="colours that are not understood") as error:
        read_cloud(file)
    assert str(file) in str(error.value)


def test_three_colours_in_one_field_of_a_pcd(tmp_path: Path) -> None:
    head = (
        "VERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 1\nTYPE F F F U\nCOUNT 1 1 1 3\nWIDTH 1\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
    )
    (tmp_path / "a.pcd").write_text(head + "POINTS 1\nDATA ascii\n0 0 1 255 0 51\n")
    np.testing.assert_allclose(read_cloud(tmp_path / "a.pcd").colors, [[1.0, 0.0, 0.2]])


@pytest.mark.parametrize(
    ("text", "colors"),
    [
        ("0 0 1\n1 2 3\n", None),
        ("2\n0,0,1\n1,2,3\n", None),
        ("x y z r g b\n# a note\n0 0 1 255 0 0\n1 2 3 0 51 0\n", [[1, 0, 0], [0, 0.2, 0]]),
        ("0 0 1 0 0 1\n1 2 3 0 1 0\n", None),
        ("0 0 1 9 0.5 0 0\n1 2 3 9 0 0.25 0\n", [[0.5, 0, 0], [0, 0.25, 0]]),
    ],
)
def test_points_in_a_text_file(tmp_path: Path, text: str, colors: list[list[float]] | None) -> None:
    (tmp_path / "a.xyz").write_text(text)
    cloud = read_cloud(tmp_path / "a.xyz")
    np.testing.assert_array_equal(cloud.points, [[0, 0, 1], [1, 2, 3]])
    assert (cloud.colors is None) == (colors is None)
    if colors is not None:
        np.testing.assert_allclose(cloud.colors, colors)


@pytest.mark.parametrize("text", ["0 0 1\n1 2\n", "0 0 1\na b c\n", "0 0\n1 1\n"])
def test_lines_that_are_no_points(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.xyz").write_text(text)
    with pytest.raises(InputError, match="not a line of a point") as error:
        read_cloud(tmp_path / "a.xyz")
    assert ", line " in str(error.value)


@pytest.mark.skipif(not (DATA / "trials" / "files").is_dir(), reason="the trials are not here")
@pytest.mark.parametrize("name", ["diffuse.ply", "rgb_names.ply", "rgb3.pcd"])
def test_files_whose_colours_were_dropped(name: str) -> None:
    cloud = read_cloud(DATA / "trials" / "files" / name)
    assert len(cloud) == 50 and cloud.colors is not None and cloud.colors.max() > 0.1
