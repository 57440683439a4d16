"""Messages of ROS into arrays: images, compressed ones, clouds, lenses, poses, inputs."""

from __future__ import annotations

import struct
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.core.pose import make_pose
from femsense.io.clouds.cloud_files import cloud_of_fields
from femsense.io.clouds.images import decoded_image
from femsense.io.importers.frames import BROWN, camera_of_numbers
from femsense.model.camera import Camera
from femsense.pointcloud.cloud import PointCloud

Pixels = npt.NDArray[Any]
LAYOUTS: dict[str, tuple[str, int]] = {
    "16UC1": ("u2", 1),
    "mono16": ("u2", 1),
    "Z16": ("u2", 1),
    "32FC1": ("f4", 1),
    "rgb8": ("u1", 3),
    "bgr8": ("u1", 3),
    "rgba8": ("u1", 4),
    "bgra8": ("u1", 4),
    "mono8": ("u1", 1),
    "8UC1": ("u1", 1),
    "8UC3": ("u1", 3),
    **dict.fromkeys(("bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"), ("u1", 1)),
    **dict.fromkeys(("yuv422", "uyvy", "yuv422_yuy2", "yuyv"), ("u1", 2)),
}
"""Encodings of sensor_msgs/Image: type of a channel and channels."""
DEPTH = ("16UC1", "mono16", "Z16", "32FC1")
LISTS = (6, 7, 8)
"""Types of visualization_msgs/Marker that are many places: cubes, spheres, points."""
POINT_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""sensor_msgs/PointField."""
MODELS = {
    "": "brown_conrady",
    "none": "brown_conrady",
    "plumb_bob": "brown_conrady",
    "rational_polynomial": "brown_conrady",
    "brown conrady": "brown_conrady",
    "brown_conrady": "brown_conrady",
    "modified_brown_conrady": "inverse_brown_conrady",
    "modified brown conrady": "inverse_brown_conrady",
    "inverse brown conrady": "inverse_brown_conrady",
    "inverse_brown_conrady": "inverse_brown_conrady",
    "equidistant": "kannala_brandt",
    "fisheye": "kannala_brandt",
    "kannala brandt4": "kannala_brandt",
    "kannala_brandt4": "kannala_brandt",
    "kannala_brandt": "kannala_brandt",
}
"""Names of distortion models, in small letters."""


def header_of(message: Any) -> Any:
    """Return the header of a message, or that of the first marker of a MarkerArray; None where there is none."""
    first = next(iter(getattr(message, "markers", ())), None)
    return getattr(message, "header", getattr(first, "header", None))


def sdk_values(message: Any) -> dict[str, str]:
    """Return the values of a text `key=value;key=value` of the RealSense SDK; none of another message, or of no message."""
    return dict(part.split("=", 1) for part in str(getattr(message, "data", "")).split(";") if "=" in part)


def stamp_of(message: Any) -> tuple[float, str]:
    """Return the stamp [s] of a message's header and its frame; 0 and "" where it has none."""
    header = header_of(message)
    if header is None:
        return 0.0, ""
    return header.stamp.sec + 1e-9 * header.stamp.nanosec, header.frame_id


def raw_image(message: Any, where: str | Path | None) -> tuple[Pixels, str]:
    """Return the pixels of a sensor_msgs/Image, (H, W) or (H, W, channels), in the machine's byte order, and their encoding."""
    encoding = message.encoding
    if encoding not in LAYOUTS:
        raise InputError("an unknown encoding of images", where=where, found=encoding, expected=", ".join(LAYOUTS))
    letter, channels = LAYOUTS[encoding]
    kind = np.dtype(letter).newbyteorder(">" if message.is_bigendian else "<")
    row = message.width * channels * kind.itemsize
    step = message.step or row
    data = np.frombuffer(bytes(message.data), dtype=np.uint8)
    if step < row or len(data) < step * message.height:
        raise InputError(
            "a broken image",
            where=where,
            found=f"{len(data)} bytes, step {step}",
            expected=f"{row} bytes × {message.height} rows",
        )
    rows = np.ascontiguousarray(data[: step * message.height].reshape(message.height, step)[:, :row]).view(kind)
    image = rows.reshape(message.height, message.width, channels)
    return (image[:, :, 0] if channels == 1 else image).astype(kind.newbyteorder("=")), encoding


def compressed_image(message: Any, where: str | Path | None) -> tuple[Pixels, str]:
    """Return the pixels of a sensor_msgs/CompressedImage and their encoding: rgb8, mono8, 16UC1 or 32FC1."""
    data = bytes(message.data)
    if "compressedDepth" in message.format:
        return _compressed_depth(data, message.format, where)
    image = decoded_image(data, where)
    if message.format.partition(";")[0].strip() in DEPTH and image.dtype != np.uint16:
        raise InputError(
            "depth that was packed as 8 bits: it is lost",
            where=where,
            found=f"{message.format.strip()}, which unpacks to {image.dtype}",
            expected="one channel of 16 bits",
            hint="record the uncompressed topic, or compressedDepth",
        )
    if image.dtype == np.uint16:
        return image, "16UC1"
    return image, "mono8" if image.ndim == 2 else "rgb8"


def red_first(image: Pixels, encoding: str) -> npt.NDArray[np.uint8]:
    """Return a colour image as (H, W, 3), red first."""
    import cv2

    code = {
        "bayer_rggb8": cv2.COLOR_BayerBG2RGB,  # OpenCV names a pattern by its second row
        "bayer_bggr8": cv2.COLOR_BayerRG2RGB,
        "bayer_gbrg8": cv2.COLOR_BayerGR2RGB,
        "bayer_grbg8": cv2.COLOR_BayerGB2RGB,
        "yuv422": cv2.COLOR_YUV2RGB_UYVY,
        "uyvy": cv2.COLOR_YUV2RGB_UYVY,
        "yuv422_yuy2": cv2.COLOR_YUV2RGB_YUY2,
        "yuyv": cv2.COLOR_YUV2RGB_YUY2,
    }.get(encoding)
    if code is not None:
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(image), code), dtype=np.uint8)
    if image.ndim == 2:
        return np.repeat(image[:, :, None], 3, axis=2).astype(np.uint8)
    swapped = image[:, :, 2::-1] if encoding.startswith(("bgr", "8UC3")) else image[:, :, :3]
    return np.ascontiguousarray(swapped)


def lens_of(message: Any, where: str | Path | None, *, rectified: bool = False) -> Camera:
    """Return the lens of a sensor_msgs/CameraInfo of ROS 1 or 2, for images with its region of interest and binning.

    Raw images have the matrix K and the distortion D; rectified ones have the matrix P and no distortion. As in `PinholeCameraModel` of
    image_geometry, a region shifts the principal point and binning divides.
    """
    K = np.asarray(getattr(message, "k", None) if hasattr(message, "k") else message.K, dtype=float).ravel()
    D = np.asarray(getattr(message, "d", None) if hasattr(message, "d") else message.D, dtype=float).ravel()
    name = message.distortion_model.strip().lower()
    P = np.asarray(getattr(message, "p", None) if hasattr(message, "p") else message.P, dtype=float).ravel()
    if rectified and len(P) == 12 and P[0] > 0 and P[5] > 0:
        K, D = P.reshape(3, 4)[:, :3].ravel(), np.zeros(0)
    if len(K) != 9 or K[0] <= 0 or K[4] <= 0:
        raise InputError("a camera without a lens", where=where, found=f"K = {K.tolist()}", expected="focal lengths > 0")
    model = MODELS.get(name)
    if model is None and np.any(D != 0.0):
        raise InputError("an unknown distortion model", where=where, found=name, expected=", ".join(sorted(set(MODELS) - {""})))
    if not np.any(D != 0.0):
        model, D = BROWN, np.zeros(5)
    size, middle, roi = (int(message.width), int(message.height)), np.array([K[2], K[5]]), message.roi
    if roi.width and roi.height:
        size, middle = (int(roi.width), int(roi.height)), middle - [roi.x_offset, roi.y_offset]
    binning = np.maximum([message.binning_x, message.binning_y], 1)
    width, height = np.floor_divide(size, binning).tolist()
    return camera_of_numbers(width, height, np.array([K[0], K[4]]) / binning, middle / binning, D, model or BROWN)


def cloud_of(message: Any, where: str | Path | None) -> PointCloud:
    """Return a sensor_msgs/PointCloud2 as a cloud [m]; without points that are not finite or at the origin."""
    fields = {f.name: (int(f.offset), int(f.datatype)) for f in message.fields}
    lacking = [axis for axis in "xyz" if axis not in fields or fields[axis][1] not in POINT_TYPES]
    if lacking:
        raise InputError("a cloud without places", where=where, found=", ".join(fields), expected="fields x, y, z")
    order = ">" if message.is_bigendian else "<"
    formats = {name: order + POINT_TYPES[kind] for name, (_, kind) in fields.items() if kind in POINT_TYPES}
    count, size = int(message.width) * int(message.height), int(message.point_step)
    data = np.frombuffer(bytes(message.data), dtype=np.uint8)
    stride = int(message.row_step) or size * int(message.width)
    if len(data) < stride * int(message.height) or stride < size * int(message.width) or not size:
        raise InputError("a broken cloud", where=where, found=f"{len(data)} bytes", expected=f"{count} points of {size} bytes")
    more = len(data) - stride * int(message.height)
    if more >= size:
        text = f"{more} bytes of a cloud beyond its width and height are not read: are {count} points right?"
        warnings.warn(f"{where}: {text}" if where else text, stacklevel=2)
    rows = data[: stride * int(message.height)].reshape(int(message.height), stride)[:, : size * int(message.width)]
    kind = np.dtype(
        {"names": list(formats), "formats": list(formats.values()), "offsets": [fields[n][0] for n in formats], "itemsize": size}
    )
    points = np.ascontiguousarray(rows).reshape(-1).view(kind)
    cloud = cloud_of_fields({n: points[n].astype(points[n].dtype.newbyteorder("=")) for n in formats}, where)
    kept = cloud.points.any(axis=1)
    return PointCloud(cloud.points[kept], None if cloud.colors is None else cloud.colors[kept])


def pose_matrix(translation: Any, rotation: Any) -> FloatArray:
    """Return the matrix (4, 4) of a translation and a quaternion x, y, z, w, which need not be of length 1; of zeros: no rotation."""
    from scipy.spatial.transform import Rotation

    quaternion = [float(getattr(rotation, name)) for name in "xyzw"]
    return make_pose(Rotation.from_quat(quaternion).as_matrix() if any(quaternion) else np.eye(3), place(translation))


def place(point: Any) -> list[float]:
    """Return x, y, z of a point or vector."""
    return [float(point.x), float(point.y), float(point.z)]


def markers_of(message: Any, kind: str) -> Iterator[tuple[str, list[float]]]:
    """Yield the name ("" where it has none) and place [m] of each marker of a message of poses or markers."""
    short = kind.split("/")[-1]
    if short == "PoseArray":
        yield from (("", place(pose.position)) for pose in message.poses)
    elif short == "MarkerArray":
        for item in message.markers:
            if item.action == 0 and item.type in LISTS:
                T = pose_matrix(item.pose.position, item.pose.orientation)
                yield from (("", (T[:3, :3] @ place(point) + T[:3, 3]).tolist()) for point in item.points)
            elif item.action == 0:
                name = f"{item.ns}_{item.id}" if item.ns and item.id else item.ns or str(item.id)
                yield name, place(item.pose.position)
    elif short == "Markers":
        for item in message.markers:
            yield item.marker_name or (str(item.marker_index) if item.id_type == 1 else ""), place(item.translation)
    elif short == "RigidBodies":
        for body in message.rigidbodies:
            yield body.rigid_body_name, place(body.pose.position)
    elif short == "PoseStamped":
        yield "", place(message.pose.position)
    elif short == "PointStamped":
        yield "", place(message.point)


def _compressed_depth(data: bytes, form: str, where: str | Path | None) -> tuple[Pixels, str]:
    """Decode compressed_depth_image_transport: a header of 12 bytes (format, two quantisation numbers), then PNG or RVL."""
    if len(data) < 20:
        raise InputError(
            "a broken depth image", where=where, found=f"{len(data)} bytes", expected="a header of 12 bytes and an image"
        )
    image = _unpack_rvl(data, where) if "rvl" in form.lower() else decoded_image(data[12:], where)
    if image.dtype != np.uint16 or image.ndim != 2:
        raise InputError(
            "not a depth image", where=where, found=f"{image.dtype} {image.shape}", expected="one channel of 16 bits"
        )
    if "32FC1" not in form:
        return image, "16UC1"
    a, b = struct.unpack_from("<ff", data, 4)
    inverse = image.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(image > 0, a / (inverse - b), np.nan).astype(np.float32), "32FC1"


def _unpack_rvl(data: bytes, where: str | Path | None) -> Pixels:
    """Decode RVL (Wilson 2017): runs of zeros and differences, in nibbles of three bits and a flag."""
    width, height = struct.unpack_from("<II", data, 12)
    words = np.frombuffer(data[20 : 20 + (len(data) - 20) // 4 * 4], dtype="<u4")
    nibbles = ((words[:, None] >> np.arange(28, -1, -4, dtype=np.uint32)) & 15).astype(np.int64).ravel().tolist()
    result = np.zeros(width * height, dtype=np.uint16)
    at, done, last = 0, 0, 0

    def number() -> int:
        nonlocal at
        value, shift = 0, 0
        while True:
            nibble = nibbles[at]
            at += 1
            value |= (nibble & 7) << shift
            if not nibble & 8:
                return value
            shift += 3

    try:
        while done < len(result):
            done += number()
            for _ in range(number()):
                delta = number()
                last += (delta >> 1) ^ -(delta & 1)
                result[done] = last
                done += 1
    except (IndexError, OverflowError):
        raise InputError("a broken depth image", where=where, found=f"{done} pixels", expected=f"{len(result)} pixels") from None
    return result.reshape(height, width)
