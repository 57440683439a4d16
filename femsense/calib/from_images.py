"""Markers from colour images lifted by registered depth: ArUco tags and coloured dots.

A tag is found by OpenCV (Garrido-Jurado et al.,
"Automatic generation and detection of highly reliable fiducial markers under occlusion", 2014); its middle is where the diagonals
cross. A dot is a patch of its colour, its middle the mean of its pixels. The depth there is that of a plane through the depths of
the patch: along straight rays (x, y, 1) the inverse depth of a plane is linear in x and y.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import BoolArray, FloatArray, IntArray
from femsense.core.errors import InputError
from femsense.io.clouds.images import check_image_size, read_color, read_png
from femsense.model.camera import Camera
from femsense.model.recording import Recording
from femsense.model.robot import Robot
from femsense.pointcloud.cloud import straight_rays
from femsense.pointcloud.segmentation import color_mask

FEWEST = 8
"""Depth pixels that a plane needs."""
DOT = (12, 0.6)
"""A dot has this many pixels at least, and this share of the ellipse around it: fewer are noise, less is half hidden."""
OFF = 3.0
"""Depths off the plane by more than this many deviations are not of the patch."""


@dataclass(frozen=True, eq=False, slots=True)
class Spots:
    """Markers that one image shows."""

    xyz: FloatArray
    """[m], camera frame, shape (n, 3)."""
    allowed: BoolArray
    """Which marker each may be, shape (n, markers)."""


def has_image_markers(robot: Robot, recording: Recording) -> bool:
    """Return whether markers can be detected in images: markers.csv has none, robot.toml declares their appearance, and there are colour
    images."""
    images = any(file is not None for files in recording.color_files for file in files)
    return bool(robot.marker_looks) and images and not recording.has_markers and not len(recording.unnamed_frame)


def with_image_markers(robot: Robot, recording: Recording, frames: IntArray) -> tuple[Recording, BoolArray]:
    """Return the recording with the markers detected in the images of some frames, without names, and which marker each may be, shape (U,
    markers).

    Raises:
        InputError: images that are broken or disagree with the camera table.
    """
    frame, view, xyz, allowed = [], [], [np.zeros((0, 3))], [np.zeros((0, len(robot.marker_names)), dtype=bool)]
    for k in frames.tolist():
        for v, camera in enumerate(recording.cameras):
            depth, color = recording.cloud_files[k][v], recording.color_files[k][v]
            if depth is None or color is None or camera is None:
                continue
            pixels, picture = read_png(depth), read_color(color)
            check_image_size(picture.shape[1], picture.shape[0], camera, color)
            spots = find_spots(robot, picture, pixels * camera.depth_unit, camera)
            frame += [k] * len(spots.xyz)
            view += [v] * len(spots.xyz)
            xyz.append(spots.xyz)
            allowed.append(spots.allowed)
    return (
        replace(
            recording,
            unnamed_frame=np.array(frame, dtype=np.int64),
            unnamed_view=np.array(view, dtype=np.int64),
            unnamed_xyz=np.vstack(xyz),
        ),
        np.vstack(allowed),
    )


def find_spots(robot: Robot, color: FloatArray, depth: FloatArray, camera: Camera) -> Spots:
    """Return the tags and dots of an image.

    Arguments:
        robot: the robot; its `appearance` describes the markers.
        color: red, green, blue in 0 … 1, shape (H, W, 3).
        depth: along the optical axis [m], registered to the colour, 0 where there is none, shape (H, W).
        camera: the lens.

    Raises:
        InputError: an unknown dictionary of tags.
    """
    index = {name: i for i, name in enumerate(robot.marker_names)}
    looks = [look for look in robot.marker_looks if look.name in index]
    places, allowed = [], []
    tags = {look.aruco_id: index[look.name] for look in looks if look.aruco_id is not None}
    for number, corners in find_tags(color, robot.aruco_dictionary) if tags else []:
        place = _tag_place(corners, depth, camera) if number in tags else None
        if place is not None:
            places.append(place)
            allowed.append(np.arange(len(index)) == tags[number])
    for rgb in {tuple(look.color_rgb.tolist()) for look in looks if look.color_rgb is not None}:
        own = np.zeros(len(index), dtype=bool)
        own[[index[look.name] for look in looks if look.color_rgb is not None and tuple(look.color_rgb.tolist()) == rgb]] = True
        for patch in _dots(color, np.array(rgb)):
            place = _dot_place(patch, depth, camera)
            if place is not None:
                places.append(place)
                allowed.append(own)
    return Spots(np.array(places).reshape(-1, 3), np.array(allowed, dtype=bool).reshape(-1, len(index)))


def find_tags(color: FloatArray, dictionary: str) -> list[tuple[int, FloatArray]]:
    """Return number and corners [px], shape (4, 2), of each ArUco tag in an image (H, W, 3) in 0 … 1.

    Raises:
        InputError: an unknown dictionary.
    """
    import cv2

    name = f"DICT_{dictionary}"
    if not hasattr(cv2.aruco, name):
        known = ", ".join(sorted(key[5:] for key in dir(cv2.aruco) if key.startswith("DICT_")))
        raise InputError("unknown dictionary of tags", where="appearance.aruco_dictionary", found=dictionary, expected=known)
    options = cv2.aruco.DetectorParameters()
    options.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)), options)
    grey = np.ascontiguousarray(np.rint(255.0 * color @ [0.299, 0.587, 0.114]).astype(np.uint8))
    found: Any = detector.detectMarkers(grey)
    corners, numbers = found[0], found[1]
    if numbers is None:
        return []
    return [(int(n), np.asarray(c, dtype=np.float64).reshape(4, 2)) for n, c in zip(np.ravel(numbers), corners)]


def _tag_place(corners: FloatArray, depth: FloatArray, camera: Camera) -> FloatArray | None:
    """Return where the middle of a tag is [m], camera frame; None without depth."""
    import cv2

    mask = np.zeros(depth.shape, dtype=np.uint8)
    middle = corners.mean(axis=0)
    cv2.fillConvexPoly(mask, np.rint(middle + 0.85 * (corners - middle)).astype(np.int32), 1)
    return _lifted(_crossing(_rays(corners, camera)), mask > 0, depth, camera)


def _crossing(corners: FloatArray) -> FloatArray:
    """Return where the diagonals of a quadrangle (4, 2) cross, shape (2,)."""
    a, b, c, d = corners
    s = np.linalg.solve(np.stack([c - a, b - d], axis=1), b - a)
    return np.asarray(a + s[0] * (c - a))


def _dots(color: FloatArray, rgb: FloatArray) -> list[BoolArray]:
    """Return the patches of a colour that are as full as an ellipse, each a mask (H, W)."""
    import cv2

    height, width = color.shape[0], color.shape[1]
    mask = color_mask(color.reshape(-1, 3), rgb).reshape(height, width).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask)
    patches = []
    for i in range(1, count):
        x, y, w, h, area = (int(value) for value in stats[i])
        inside = x > 0 and y > 0 and x + w < width and y + h < height
        patch = labels == i
        if inside and area >= DOT[0] and area >= DOT[1] * _ellipse(patch):
            patches.append(patch)
    return patches


def _ellipse(patch: npt.NDArray[Any]) -> float:
    """Return the area of the smallest circle-like ellipse around a patch [px²]."""
    import cv2

    points = np.argwhere(patch)[:, ::-1].astype(np.float32)
    (_, (width, height), _) = cv2.minAreaRect(points)
    return float(np.pi / 4 * (width + 1.0) * (height + 1.0))


def _dot_place(patch: BoolArray, depth: FloatArray, camera: Camera) -> FloatArray | None:
    """Return where the middle of a dot is [m], camera frame; None without depth."""
    import cv2

    middle = np.argwhere(patch)[:, ::-1].mean(axis=0)
    core = cv2.erode(patch.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return _lifted(_rays(middle[None], camera)[0], core if core.sum() >= FEWEST else patch, depth, camera)


def _lifted(ray: FloatArray, mask: BoolArray, depth: FloatArray, camera: Camera) -> FloatArray | None:
    """Return the point of a straight ray (2,) on the plane through the depths of a patch [m]; None where they are too few."""
    row, column = np.nonzero(mask & (depth > 0))
    if len(row) < FEWEST:
        return None
    rays = _rays(np.stack([column, row], axis=1).astype(np.float64), camera)
    A, b = np.column_stack([rays - ray, np.ones(len(rays))]), 1.0 / depth[row, column]
    good = np.abs(b - np.median(b)) <= max(OFF * 1.483 * float(np.median(np.abs(b - np.median(b)))), 0.02 * float(np.median(b)))
    for _ in range(3):
        if good.sum() < FEWEST:
            return None
        plane = np.linalg.lstsq(A[good], b[good], rcond=None)[0]
        off = np.abs(b - A @ plane)
        good = off <= max(OFF * 1.483 * float(np.median(off[good])), 1e-6)
    return np.asarray(np.array([*ray, 1.0]) / plane[2])


def _rays(pixels: FloatArray, camera: Camera) -> FloatArray:
    """Return straight rays with z = 1 of pixels (n, 2), shape (n, 2)."""
    bent = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    return straight_rays(bent, camera.distortion, camera.distortion_model)
