"""A depth camera: rays, two kinds of noise, colours, and the files of a recording."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .bodies import listed
from .scene import OBJECT, ROBOT, RayScene
from .solid import Array

WIDTH, HEIGHT, FOCAL = 640, 360, 460.0
BASELINE_M = 0.055
SUBPIXEL = 1 / 32
COLORS = {OBJECT: np.array([[0.85, 0.25, 0.10], [0.15, 0.15, 0.16], [0.90, 0.75, 0.20]]), 2: np.array([[0.62, 0.60, 0.57]])}


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole with its noise."""

    kind: str
    """"stereo" or "tof"."""
    pose: Array
    """Camera to robot, (4, 4)."""
    amount: tuple[float, float]
    """stereo: (at_1m_m, unused); tof: (floor_m, slope)."""
    dropouts: float
    flying: float
    """Share of the pixels at depth edges that fly."""

    def std(self, z: Array) -> Array:
        """Standard deviation of a depth [m]."""
        return self.amount[0] * z**2 if self.kind == "stereo" else self.amount[0] + self.amount[1] * z

    def to_camera(self, points: Array) -> Array:
        """Robot coordinates to camera coordinates."""
        return (points - self.pose[:3, 3]) @ self.pose[:3, :3]


def directions() -> Array:
    """Rays through the pixel centres with z = 1, camera frame, (HEIGHT * WIDTH, 3)."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    return np.column_stack([((u - WIDTH / 2) / FOCAL).ravel(), ((v - HEIGHT / 2) / FOCAL).ravel(), np.ones(u.size)])


def look_at(target: Array, distance: float, azimuth: float, elevation: float, roll: float) -> Array:
    """Pose of a camera that looks at a point; OpenCV's axes."""
    out = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    z = -out
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    c, s = np.cos(roll), np.sin(roll)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([c * x + s * y, -s * x + c * y, z])
    pose[:3, 3] = target + distance * out
    return pose


def nudged(camera: Camera, shift: float, turn: float, rng: np.random.Generator) -> Camera:
    """The camera shifted by so much [m] and turned by so much about its middle [rad], each into a direction that is drawn."""
    way, axis = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    pose = camera.pose.copy()
    pose[:3, :3] = Rotation.from_rotvec(turn * axis).as_matrix() @ pose[:3, :3]
    pose[:3, 3] += shift * way
    return replace(camera, pose=pose)


@dataclass(frozen=True, eq=False)
class Shot:
    """What the rays meet; images are flat."""

    depth: Array
    """[m], inf where nothing is."""
    kind: NDArray[np.int64]
    """ROBOT, OBJECT, TABLE or -1."""
    triangle: NDArray[np.int64]
    uv: Array
    normal: Array


def shoot(camera: Camera, robot: tuple[Array, Array], objects: list[tuple[Array, Array]], ground: tuple[Array, Array]) -> Shot:
    """Cast all rays on the scene."""
    scene = RayScene([robot, ground, *objects])
    rays = directions() @ camera.pose[:3, :3].T
    far, mesh, triangle, uv, normal = scene.cast(camera.pose[:3, 3], rays)
    kind = np.where(mesh == 0, ROBOT, np.where(mesh == 1, 2, OBJECT))
    kind[~np.isfinite(far) | (far > 1.5)] = -1
    far = np.where(kind < 0, np.inf, far)
    return Shot(far, kind, triangle, uv, normal)


def measure(camera: Camera, shot: Shot, rng: np.random.Generator) -> Array:
    """Depths as the sensor gives them [m], 0 where it gives none, flat."""
    z = np.where(shot.kind >= 0, shot.depth, 0.0)
    image = z.reshape(HEIGHT, WIDTH)
    stack = np.stack([np.roll(image, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    high, low = stack.max(axis=0).ravel(), np.where(stack > 0, stack, np.inf).min(axis=0).ravel()
    edge = (z > 0) & ((high - low > 0.010) | (stack == 0).any(axis=0).ravel())
    fly = edge & (rng.random(z.size) < camera.flying)
    low = np.where(edge, low, z)
    mixed = low + rng.random(z.size) * np.clip(high - low, 0.0, 0.25)
    out = np.where(fly, mixed, z)
    noise = rng.normal(size=z.size)
    with np.errstate(divide="ignore", invalid="ignore"):
        if camera.kind == "stereo":
            disparity = FOCAL * BASELINE_M / out + noise * camera.amount[0] * FOCAL * BASELINE_M
            out = FOCAL * BASELINE_M / (np.round(disparity / SUBPIXEL) * SUBPIXEL)
        else:
            out = out + noise * camera.std(out)
    lost = (rng.random(z.size) < camera.dropouts) | (edge & (rng.random(z.size) < 0.3)) | (z == 0) | ~np.isfinite(out)
    return np.where(lost, 0.0, out)


def paint(shot: Shot, robot_color: Array, object_color: Array, camera: Camera, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Colours of the pixels, shaded, flat (n, 3)."""
    base = np.zeros((len(shot.kind), 3))
    base[shot.kind == ROBOT] = robot_color
    base[shot.kind == OBJECT] = object_color
    base[shot.kind == 2] = COLORS[2][0]
    facing = np.abs(shot.normal @ camera.pose[:3, 2])
    shade = (0.55 + 0.45 * facing)[:, None] * base + 0.02 * rng.normal(size=base.shape)
    return np.asarray((255 * shade).clip(0, 255), np.uint8)


def write_cloud(path: Path, z: Array, color: NDArray[np.uint8] | None, keep: NDArray[np.bool_]) -> None:
    """A binary PLY in the camera frame."""
    chosen = keep & (z > 0)
    points = directions()[chosen] * z[chosen, None]
    own = ("red", "green", "blue") if color is not None else ()
    rows = np.empty(len(points), [*((n, "<f4") for n in "xyz"), *((n, "u1") for n in own)])
    for k, name in enumerate("xyz"):
        rows[name] = points[:, k]
    for k, name in enumerate(own):
        rows[name] = color[chosen, k]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    head += [f"property float {n}" for n in "xyz"] + [f"property uchar {n}" for n in own] + ["end_header", ""]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes("\n".join(head).encode() + rows.tobytes())


def write_images(folder: Path, frame: int, z: Array, color: NDArray[np.uint8] | None, unit: float) -> None:
    """A depth image of 16 bits and a colour image of 8 bits, if there are colours."""
    import cv2

    images = {"depth": np.round(z / unit).clip(0, 65535).astype(np.uint16).reshape(HEIGHT, WIDTH)}
    images |= {} if color is None else {"color": color.reshape(HEIGHT, WIDTH, 3)[:, :, ::-1]}
    for name, image in images.items():
        path = folder / name / f"{frame:06d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        if not cv2.imwrite(str(path), np.ascontiguousarray(image)):
            raise OSError(f"{path} was not written")


def camera_table(camera: Camera, *, unit: float, noise: bool) -> list[str]:
    """[camera] of recording.toml."""
    lines = [
        "",
        "[camera]",
        f"width = {WIDTH}",
        f"height = {HEIGHT}",
        f"fx = {FOCAL}",
        f"fy = {FOCAL}",
        f"cx = {WIDTH / 2}",
        f"cy = {HEIGHT / 2}",
    ]
    lines += ["distortion = [0, 0, 0, 0, 0]", f"depth_unit_m = {unit}"]
    if noise and camera.kind == "stereo":
        lines += ["", "[camera.noise]", 'kind = "stereo"', f"at_1m_m = {camera.amount[0]}"]
    elif noise:
        lines += ["", "[camera.noise]", 'kind = "tof"', f"floor_m = {camera.amount[0]}", f"slope = {camera.amount[1]}"]
    return lines


def seen(camera: Camera, points: Array, shot: Shot) -> NDArray[np.bool_]:
    """Which points [m, robot frame] the camera sees: in the picture, and nothing nearer than 3 mm before them."""
    local = camera.to_camera(points)
    u = np.round(FOCAL * local[:, 0] / local[:, 2] + WIDTH / 2).astype(int)
    v = np.round(FOCAL * local[:, 1] / local[:, 2] + HEIGHT / 2).astype(int)
    inside = (u >= 0) & (u < WIDTH) & (v >= 0) & (v < HEIGHT) & (local[:, 2] > 0)
    depth = shot.depth.reshape(HEIGHT, WIDTH)[v.clip(0, HEIGHT - 1), u.clip(0, WIDTH - 1)]
    return inside & (local[:, 2] < depth + 0.003)


__all__ = [
    "Camera",
    "Shot",
    "camera_table",
    "listed",
    "look_at",
    "measure",
    "nudged",
    "paint",
    "seen",
    "shoot",
    "write_cloud",
    "write_images",
]
