"""Physical ranges of recordings and robots, used by import, inspection and computation.

Numbers outside a range are valid input but implausible: the usual cause is another unit, clock, sign or frame.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, diagonal
from femsense.core.pose import invert_pose, transform_points
from femsense.core.units import ATMOSPHERE_PA, Quantity, likely_units
from femsense.fem.mesh import embed_points
from femsense.model.recording import Recording
from femsense.model.robot import Robot


@dataclass(frozen=True, slots=True)
class Ranges:
    """Physical limits of soft robots and their sensors."""

    step_s: tuple[float, float] = (5e-4, 5.0)
    """Between frames: motion capture takes up to 1000 a second, a patient experimenter one each few seconds."""
    scene_m: tuple[float, float] = (0.05, 10.0)
    """Median distance of the points of a depth camera."""
    assumed_scene_m: float = 0.25
    """The nearest scene where the unit of depth images is only that of their layout: those cameras see from 0.4 m on."""
    behind: float = 0.2
    """Largest share of points behind a camera."""
    pressure_pa: tuple[float, float] = (500.0, 5e6)
    """Largest pressure of a chamber that does something."""
    pressure_share: float = 1e-3
    """… and as a share of its max_pressure_pa."""
    absolute_pa: tuple[float, float] = (80e3, 108e3)
    """Pressure of the surroundings, measured against a vacuum: from 2000 m above the sea to a high at the sea."""
    never_zero_pa: float = 5e3
    """Chambers that begin at the pressure of the surroundings and never fall below this were measured against a vacuum."""
    tension_n: tuple[float, float] = (1e-3, 120.0)
    """Largest tension of a cable."""
    displacement_m: float = 0.5
    """Largest displacement of a cable."""
    load_n: float = 120.0
    """Largest known load."""
    marker_noise_m: float = 0.01
    """Repeatability of a marker."""
    young_modulus_pa: tuple[float, float] = (3e3, 2e9)
    """Softest gel and stiffest material of a soft robot."""
    density_kg_m3: float = 20.0
    """Lightest foam."""
    gravity_m_s2: tuple[float, float] = (0.02, 0.05)
    """Gravity in units of g has the length 1 up to this; gravity that only turns keeps its length up to this share."""
    aspect: float = 1.4
    """Ratio of the focal lengths: images of 16 : 9 that were squeezed to 4 : 3 have 1.33."""
    off_centre: float = 0.25
    """Distance of the principal point from the middle of the image, as a share of its size."""
    focal_share: tuple[float, float] = (0.05, 50.0)
    """Focal length over the width of the image."""
    distortion: float = 10.0
    """Largest coefficient of a polynomial lens; a rational one (8 numbers) may have ten times more."""
    poisson_ratio: float = 0.4999
    """Beyond it the equations are nearly singular."""
    doubling_rad: float = 2.6
    """A cable that turns farther than this at one point doubles back."""
    coincident: float = 1e-6
    """Nodes nearer than this, over the diagonal, are at one place."""
    rest_sizes: float = 2.0
    """Distance of the markers at rest from those of the frames, over the span of the latter: a body bends by less."""
    camera_m: float = 20.0
    """Distance of a camera from its robot."""


RANGES = Ranges()
SPELLED = {
    "ms": "milliseconds",
    "µs": "microseconds",
    "ns": "nanoseconds",
    "min": "minutes",
    "h": "hours",
    "d": "days",
    "mm": "millimetres",
    "cm": "centimetres",
    "in": "inches",
    "µm": "micrometres",
}
"""Names of units in questions, where the short one would be misread."""
ABSOLUTE = {"Pa": 1.0, "hPa": 100.0}
"""Units in which barometers and FluidPressure count from a vacuum, and how many pascals they are."""


# Recordings


def doubts_of_recording(recording: Recording, robot: Robot | None = None) -> list[str]:
    """Return implausible values of a recording: times, inputs, lenses, poses, points behind a camera.

    Pressures are compared with the limits of a robot's chambers, and given poses of cameras with its markers, where there is one.
    """
    return [
        *doubts_of_times(recording),
        *doubts_of_displacements(recording),
        *doubts_of_tensions(recording),
        *doubts_of_pressures(recording, robot),
        *doubts_of_cameras(recording),
        *doubts_of_marker_places(recording),
        *doubts_of_rest(recording),
        *doubts_of_gravity(recording),
        *doubts_of_loads(recording),
        *(doubts_of_poses(robot, recording) if robot is not None else ()),
    ]


def doubts_of_times(recording: Recording) -> list[str]:
    """Return whether frames follow each other as no camera takes them."""
    steps = np.diff(recording.time_s)
    where = place_of(recording, "frames.csv", "time_s")
    column = "the column time_s" if recording.folder else "time_s"
    if not len(steps):
        return []
    step, (low, high) = float(np.median(steps)), RANGES.step_s
    if low <= step <= high:
        return []
    unit = likely_meant(step, low, high, Quantity.TIME)
    often = "" if step > high else f", {1.0 / step:.3g} a second"
    return [f"{where}: one frame every {step:.4g} s by {column}{often}; is it in {unit}?"]


def doubts_of_displacements(recording: Recording) -> list[str]:
    """Return displacements of cables that are too long, or mostly negative."""
    r, where, found = recording, place_of(recording, "frames.csv", "inputs"), []
    for name, pulled in zip(r.cable_names, r.inputs.T) if r.actuation == "displacement" else ():
        longest = float(np.abs(pulled).max(initial=0.0))
        if longest > RANGES.displacement_m:
            angles = " or radians of a motor" if longest < 20.0 else ""
            unit = f"millimetres{angles}" if 1e-3 * longest < RANGES.displacement_m else "ticks or degrees of a motor"
            found.append(f"{where}: cable {name!r} moves by up to {longest:.4g} m; are displacements in {unit}?")
        back, forth = int((pulled < 0).sum()), int((pulled > 0).sum())
        if r.actuation_zero == "absolute" and back > forth:
            text = f"slack in {len(pulled) - forth} of {len(pulled)} frames, its displacement below zero in {back}"
            found.append(f"{where}: cable {name!r} is {text}; is the sign right? > 0 shortens")
    return found


def doubts_of_tensions(recording: Recording) -> list[str]:
    """Return cables whose largest tension no cable of a soft robot has."""
    r, where, (low, high) = recording, place_of(recording, "frames.csv", "inputs"), RANGES.tension_n
    found = []
    for name, tension in zip(r.cable_names, r.inputs.T) if r.actuation == "tension" else ():
        largest = float(np.abs(tension).max(initial=0.0))
        if largest > high:
            units = likely_meant(largest, 0.05, high, Quantity.FORCE, "milliampere of a motor")
            found.append(f"{where}: cable {name!r} reaches {largest:.4g} N; is it in {units}?")
        if 0.0 < largest < low:
            found.append(
                f"{where}: cable {name!r} never exceeds {largest:.3g} N; is it in {likely_meant(largest, 0.05, high, Quantity.FORCE)}?"
            )
    return found


def doubts_of_pressures(recording: Recording, robot: Robot | None = None) -> list[str]:
    """Return chambers whose pressures are absolute, or so small that they are in another unit than pascals."""
    r, where, (low, high) = recording, place_of(recording, "frames.csv", "pressures"), RANGES.pressure_pa
    limits = {c.name: c.max_pressure for c in robot.body.chambers} if robot is not None else {}
    found = []
    for name, pressure in zip(r.chamber_names, r.pressures.T):
        largest, least = float(np.abs(pressure).max(initial=0.0)), float(pressure.min(initial=np.inf))
        most = limits.get(name, np.inf)
        bound = max(low, RANGES.pressure_share * most) if np.isfinite(most) else low
        if 0.0 < largest < bound:
            of = f" of its max_pressure_pa of {most:.6g}" if np.isfinite(most) else ""
            units = likely_meant(largest, 2e3, min(most, high), Quantity.PRESSURE)
            found.append(f"{where}: chamber {name!r} reaches {largest:.4g} Pa{of}; is it in {units}? The column holds pascals")
        elif unit := next((unit for unit, size in ABSOLUTE.items() if _is_absolute(size * pressure)), None):
            found.append(_absolute(where, name, least, unit))
        elif least < -ATMOSPHERE_PA:
            found.append(f"{where}: chamber {name!r} falls to {least:.6g} Pa, below a vacuum; is its unit or sign right?")
        elif largest > high:
            found.append(f"{where}: chamber {name!r} reaches {largest:.4g} Pa; is the column in another unit than pascals?")
    return found


def _is_absolute(pressure: FloatArray) -> bool:
    """Whether pressures [Pa], shape (f,), never fall below that of the surroundings, or begin there and never come near zero."""
    low, high = RANGES.absolute_pa
    least = float(pressure.min(initial=np.inf))
    return low < least < high or (least > RANGES.never_zero_pa and low < pressure[0] < high)


def _absolute(where: str, name: str, least: float, unit: str) -> str:
    other = "" if unit == "Pa" else f", and in {unit}"
    return (
        f"{where}: the pressure of chamber {name!r} never falls below {least:.6g} Pa: is it absolute{other}? Chambers take gauge "
        f"pressures: subtract {ATMOSPHERE_PA:.0f} Pa (import --map NAME=chamber_{name}*{unit}_abs does)"
    )


def doubts_of_cameras(recording: Recording) -> list[str]:
    """Return lenses that cannot be those of their images, and cameras far from their robot."""
    where, found = place_of(recording, "recording.toml", "cameras"), []
    for name, camera, pose in zip(recording.camera_names, recording.cameras, recording.T_robot_camera):
        key = f"cameras.{name}" if name else "camera"
        if camera is not None:
            c = camera
            numbers = (c.fx, c.fy, c.cx, c.cy)
            problem = lens_problem(c.width, c.height, numbers, c.distortion, c.distortion_model)
            problem = problem or _lens_doubt(c.width, c.height, numbers)
            found += [f"{where}, {key}: {problem}"] if problem else []
        away = 0.0 if pose is None else float(np.linalg.norm(pose[:3, 3]))
        if away > RANGES.camera_m:
            unit = likely_meant(away, 0.05, 2.0, Quantity.LENGTH)
            found.append(f"{where}, {key}: T_robot_camera puts the camera {away:.4g} m away; is its translation in {unit}?")
    return found


def doubts_of_marker_places(recording: Recording) -> list[str]:
    """Return whether markers lie behind the camera that saw them."""
    z = np.concatenate([recording.marker_xyz[:, 2], recording.unnamed_xyz[:, 2]])
    behind = float((z <= 0).mean()) if len(z) else 0.0
    images = any(camera is not None for camera in recording.cameras)
    if behind <= RANGES.behind or not (images or recording.has_clouds):
        return []  # a motion capture has no front
    where = place_of(recording, "markers.csv", "markers")
    return [
        f"{where}: {100 * behind:.0f} % of the markers lie behind the camera (z ≤ 0): are they in the camera's frame, z forward?"
    ]


def doubts_of_rest(recording: Recording) -> list[str]:
    """Return whether rest.csv has its markers far from where the frames have them, or in another unit."""
    r, rest = recording, recording.rest
    if rest is None:
        return []
    where, found = place_of(r, "rest.csv", "rest"), []
    noise = float(np.nan_to_num(rest.std).max(initial=0.0))
    if noise > RANGES.marker_noise_m:
        found.append(f"{where}, column std_m: markers that were measured to {noise:.3g} m; is it in millimetres?")
    for view in np.unique(rest.view):
        mine = [(name, place) for name, place, v in zip(rest.names, rest.positions, rest.view) if v == view]
        seen = {name: r.marker_xyz[(r.marker_index == i) & (r.marker_view == view)] for i, name in enumerate(r.marker_names)}
        pairs = [(place, np.median(seen[name], axis=0)) for name, place in mine if len(seen.get(name, ()))]
        if len(pairs) < 3:
            continue
        resting, moving = np.array(pairs).transpose(1, 0, 2)
        size = diagonal(moving)
        away = float(np.median(np.linalg.norm(resting - moving, axis=1)))
        if away > RANGES.rest_sizes * size:
            found.append(
                f"{where}: its markers lie {away:.3g} m from where the frames have them, and these span {size:.3g} m: is it in the same "
                "camera frame, and in metres?"
            )
    return found


def doubts_of_gravity(recording: Recording) -> list[str]:
    """Return whether the gravity of the frames is that of no place: in another unit, or of a length that changes."""
    if recording.gravity is None:
        return []
    where = place_of(recording, "frames.csv", "gravity")
    lengths = np.linalg.norm(recording.gravity, axis=1)
    low, high = float(lengths.min(initial=np.inf)), float(lengths.max(initial=0.0))
    doubt = gravity_doubt(float(np.median(lengths)))
    if doubt:
        return [f"{where}: {doubt}"]
    if high - low > RANGES.gravity_m_s2[1] * high:
        return [f"{where}: gravity is {low:.4g} to {high:.4g} m/s² long: where the base turns, it keeps its length"]
    return []


def gravity_doubt(length: float) -> str | None:
    """Return why gravity of a length [m/s²] is in another unit; None where it can be right."""
    if abs(length - 1.0) < RANGES.gravity_m_s2[0]:
        return f"gravity is {length:.4g} m/s² long; is it in g? On earth it is 9.81 m/s²"
    if length > 100.0:
        return f"gravity is {length:.4g} m/s² long; is it in mm/s²? On earth it is 9.81 m/s²"
    return None


def doubts_of_loads(recording: Recording) -> list[str]:
    """Return known loads that are too large, and a marker noise in another unit."""
    r, found = recording, []
    largest = float(np.linalg.norm(r.load_forces, axis=1).max(initial=0.0))
    if largest > RANGES.load_n:
        units = likely_meant(largest, 0.05, RANGES.load_n, Quantity.FORCE)
        found.append(f"{place_of(r, 'loads.csv', 'loads')}: a known load of {largest:.4g} N; is it in {units}?")
    noise = r.marker_noise_m
    if noise is not None and noise > RANGES.marker_noise_m:
        text = f"marker_noise_m: markers that repeat to {noise:.3g} m; is it in millimetres?"
        found.append(f"{place_of(r, 'recording.toml', 'marker_noise_m')}: {text}")
    return found


def doubts_of_cloud_places(points: FloatArray, where: str) -> list[str]:
    """Return whether points (n, 3) [m] lie behind or on the camera, or nearer than cameras see."""
    if not len(points):
        return []
    behind = float((points[:, 2] <= 0).mean())
    if behind > RANGES.behind:
        text = f"{100 * behind:.0f} % of the points lie behind the camera (z ≤ 0)"
        return [f"{where}: {text}: the clouds are not in the camera's frame (x right, y down, z forward)"]
    away = float(np.median(np.linalg.norm(points, axis=1)))
    if away < RANGES.scene_m[0]:
        return [f"{where}: the clouds are {1e3 * away:.3g} mm away, nearer than depth cameras see: {unit_question(away)}"]
    return []


def unit_question(distance: float) -> str:
    """Return a question with the values of a too short distance [m] in other units."""
    return (
        f"are they in metres? Ten times larger they would be {10 * distance:.3g} m away, a hundred times {100 * distance:.3g} m"
    )


# Lenses


def lens_problem(
    width: int, height: int, numbers: Sequence[float], distortion: npt.ArrayLike, model: str = "brown_conrady"
) -> str | None:
    """Return why fx, fy, cx, cy [px] and distortion are no lens of images of a size [px]; None where they can be one."""
    fx, fy, cx, cy = numbers
    bent = np.abs(np.asarray(distortion, dtype=np.float64)).max(initial=0.0)
    rational = np.any(np.asarray(distortion, dtype=np.float64)[5:] != 0.0) and model != "kannala_brandt"
    if fx > 0 > fy:
        return (
            f"fy = {fy:g} < 0: that lens counts rows upwards; depth images count them downwards: write {-fy:g} if the images do"
        )
    if fx <= 0 or fy <= 0:
        return f"fx = {fx:g}, fy = {fy:g}: focal lengths are above zero"
    low, high = RANGES.focal_share
    for name, value, size in (("fx", fx, width), ("fy", fy, height)):
        if not low < value / size < high:
            return f"{name} = {value:g} for images of {width} × {height}: is it in another unit than pixels, or in another order?"
    if not (-0.5 <= cx <= width - 0.5 and -0.5 <= cy <= height - 0.5):
        other = f"; a lens of images of about {2 * cx + 1:.0f} × {2 * cy + 1:.0f}?" if min(cx, cy) > 0 else ""
        return f"the principal point {cx:g}, {cy:g} lies outside of images of {width} × {height}{other}"
    if bent > RANGES.distortion * (10.0 if rational else 1.0):
        return f"a coefficient of distortion of {bent:g}: is it the size of the images, or another number?"
    return None


def _lens_doubt(width: int, height: int, numbers: Sequence[float]) -> str | None:
    """Return what is unusual of a lens that images of a size [px] can have: pixels far from square, a middle far from the image's."""
    fx, fy, cx, cy = numbers
    if max(fx / fy, fy / fx) > RANGES.aspect:
        return (
            f"fx = {fx:g} and fy = {fy:g}: the pixels of a camera are nearly square; is one of another image size, or mistyped?"
        )
    if max(abs((cx + 0.5) / width - 0.5), abs((cy + 0.5) / height - 0.5)) > RANGES.off_centre:
        return (
            f"the principal point {cx:g}, {cy:g} is far from the middle of images of {width} × {height}: are the numbers in another "
            "order, or of the uncropped images?"
        )
    return None


# Poses


def doubts_of_poses(robot: Robot, recording: Recording) -> list[str]:
    """Return given poses of cameras that put the markers away from the robot, with the reading of the pose that puts them onto it."""
    r, number = recording, {name: i for i, name in enumerate(robot.marker_names)}
    size = diagonal(np.vstack([robot.body.mesh.nodes, robot.marker_points]))
    found = []
    for v, T in enumerate(r.T_robot_camera):
        found += _camera_in_body(robot, recording, T)
        rows = np.flatnonzero(r.marker_view == v)
        rows = rows[[r.marker_names[i] in number for i in r.marker_index[rows]]] if len(rows) else rows
        if T is None or not len(rows):
            continue
        rest = np.array([robot.marker_points[number[r.marker_names[i]]] for i in r.marker_index[rows]])

        def off(pose: FloatArray) -> float:
            return float(np.median(np.linalg.norm(transform_points(pose, r.marker_xyz[rows]) - rest, axis=1)))  # noqa: B023

        given = off(T)
        if given < 0.5 * size:
            continue
        name, best = min(((name, off(pose)) for name, pose in other_poses(T)), key=lambda item: item[1])
        meant = f"; {name} would put them {1e3 * best:.3g} mm from there: is it that?" if best < 0.25 * size else ""
        where = place_of(r, "recording.toml", "T_robot_camera")
        found.append(f"{where}: T_robot_camera puts the markers {given:.3g} m from their places on the robot{meant}")
    return found


def _camera_in_body(robot: Robot, recording: Recording, T: FloatArray | None) -> list[str]:
    """Return whether a camera is within the body."""
    if T is None or embed_points(robot.body.mesh, T[None, :3, 3]).outside[0] > 0.0:
        return []
    where = place_of(recording, "recording.toml", "T_robot_camera")
    return [f"{where}: T_robot_camera puts the camera into the body: are clouds and markers in the robot's frame already?"]


def other_poses(T: FloatArray) -> Iterable[tuple[str, FloatArray]]:
    """Yield the usual misreadings of a pose T_robot_camera: name, and the pose that was meant."""
    flip, forward = np.diag([1.0, -1.0, -1.0, 1.0]), np.eye(4)
    forward[:3, :3] = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
    turned = T.copy()
    turned[:3, :3] = T[:3, :3].T
    for name, size in (("", 1.0), ("millimetres", 1e-3), ("centimetres", 1e-2), ("inches", 0.0254)):
        pose, scale = T.copy(), f" with its translation in {name}" if name else ""
        pose[:3, 3] *= size
        if name:
            yield f"a translation in {name}", pose
        yield f"the inverse (T_camera_robot){scale}", invert_pose(pose)
        yield f"OpenGL's axes (y up, z backwards){scale}", pose @ flip
        yield f"the inverse of OpenGL's view matrix{scale}", invert_pose(pose) @ flip
        yield f"ROS's axes (x forward, z up){scale}", pose @ forward
    yield "a transposed rotation", turned


# Words


def warn_of(doubts: Iterable[str], *, stacklevel: int = 3) -> None:
    """Warn of each doubt."""
    for text in doubts:
        warnings.warn(text, stacklevel=stacklevel)


def place_of(recording: Recording, file: str, argument: str) -> str:
    """Return the location of a part of a recording: a file of its folder, or an argument of `from_arrays`."""
    return str(recording.folder / file) if recording.folder else f"Recording.from_arrays, {argument}"


def likely_meant(value: float, low: float, high: float, quantity: Quantity, *others: str) -> str:
    """Return the units, joined by "or", in which a value would be plausible."""
    names = [SPELLED.get(unit.name, unit.name) for unit in likely_units(value, low, high, quantity)[:2]]
    return " or ".join([*names, *others]) or "another unit"
