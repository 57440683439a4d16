"""Objects that touch the body: their shape, their pose on the body, and their appearance.

Frame of an object: the origin is its contact point, it extends along +z, and its length is along x.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray, IntArray, diagonal, freeze
from femsense.core.errors import InputError
from femsense.core.pose import transform_points
from femsense.core.units import PER_METRE
from femsense.io.mesh_files import read_surface
from femsense.model.recording_parts import Tool
from femsense.rig.camera import Shape
from femsense.rig.object_tables import ObjectTable
from femsense.rig.patches import LoadPatch, Pressing

STICK_M = 0.002
"""Radius of a stick [m]."""
BRASS = 8500.0
"""Density of a weight [kg/m³]."""
FAR = 1.0
"""Distance below a mesh at which the rays that sample its lower side start [m]."""
Surface = tuple[FloatArray, IntArray]


def object_surface(item: ObjectTable, folder: Path) -> Surface:
    """Return points [m] and outward triangles of an object in its own frame.

    Raises InputError if its file is missing or malformed.
    """
    if item.kind == "mesh":
        return _mesh(folder / str(item.mesh), str(item.unit))
    import trimesh

    parts = [_solid(part) for part in _parts(item)]
    whole = trimesh.util.concatenate(parts)
    return np.array(whole.vertices, dtype=float), np.array(whole.faces, dtype=np.int64)


def object_shape(item: ObjectTable, surface: Surface, T_robot_object: FloatArray) -> Shape:
    """Return the shape of an object at its pose, for the camera."""
    color = np.asarray(item.color_rgb, dtype=float)
    return Shape(transform_points(T_robot_object, surface[0]), surface[1], color, item.albedo, item.gloss)


def pressing(item: ObjectTable, surface: Surface, place: FloatArray, normal: FloatArray, along: FloatArray) -> Pressing:
    """Return the contact geometry of an object on the surface at rest.

    Arguments:
        item, surface: the object and its surface.
        place, normal: of the body's surface, shape (3,) each.
        along: direction of its x axis, shape (3,).
    """
    x = along_surface(along, normal)
    r = item.radius_m
    if item.kind in ("ball", "weight"):
        return Pressing(place, normal, x, r, 0.25 * r, lambda xy: _bowl((xy**2).sum(axis=1), r))
    if item.kind == "rod":
        half = 0.5 * item.length_m
        return Pressing(
            place, normal, x, half, 0.25 * r, lambda xy: np.where(np.abs(xy[:, 0]) < half, _bowl(xy[:, 1] ** 2, r), np.inf)
        )
    if item.kind in ("plate", "box"):
        size = 0.5 * np.asarray(item.size_m)[:2]
        flat = Pressing(place, normal, x, float(np.linalg.norm(size)), 0.5 * float(size.min()), lambda xy: _face(xy, size))
        return flat
    reach = 0.5 * diagonal(surface[0][:, :2])
    return Pressing(place, normal, x, reach, 0.1 * reach, _lower_side(surface))


def along_surface(direction: FloatArray, normal: FloatArray) -> FloatArray:
    """Return the tangential part of a direction, normalised, shape (3,); an arbitrary tangent if it has none."""
    for tried in (direction, np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])):
        part = tried - (tried @ normal) * normal
        if np.linalg.norm(part) > 1e-3 * max(float(np.linalg.norm(tried)), 1e-12):
            return np.asarray(part / np.linalg.norm(part))
    raise AssertionError("one of two axes lies across any normal")


def object_pose(
    how: Pressing, patch: LoadPatch, rest: FloatArray, positions: FloatArray, *, upright: FloatArray | None
) -> FloatArray:
    """Return T_robot_object, shape (4, 4), of an object in contact with its patch on the deformed body.

    Its lower side passes through the pressed points on average, weighted by pressure.

    Arguments:
        how, patch: its contact geometry and patch.
        rest, positions: nodes of the truth [m], shape (n, 3).
        upright: direction of its z axis; None: along the normal.
    """
    center, normal = patch.place(positions), patch.normal(positions)
    z = normal if upright is None else upright / np.linalg.norm(upright)
    x = along_surface(patch.turned(rest, positions, how.along), z)
    y = np.cross(z, x)
    points = patch.points(positions) - center
    height = how.height(np.column_stack([points @ x, points @ y]))
    known = np.isfinite(height)
    lift = float(
        (patch.share * np.where(known, points @ z - np.where(known, height, 0.0), 0.0)).sum()
        / max(patch.share[known].sum(), 1e-12)
    )
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.stack([x, y, z], axis=1), center + lift * z
    return T


def tool_of(item: ObjectTable, folder: Path) -> Tool:
    """Return an object as an entry of [[tools]]."""
    if item.kind == "ball":
        return Tool(item.name, "ball", item.radius_m)
    if item.kind == "rod":
        return Tool(item.name, "cylinder", item.radius_m, item.length_m)
    points, triangles = object_surface(item, folder)
    return Tool(item.name, "mesh", points=freeze(points), triangles=freeze(triangles, np.int64), mesh_file=None)


# Forms


def _parts(item: ObjectTable) -> list[tuple[str, FloatArray, float]]:
    """Return solids as (shape, extent, height above the origin)."""
    r, stick = item.radius_m, item.stick_m
    if item.kind == "ball":
        return [("sphere", np.array([r]), r), *_stick(1.8 * r, stick)]
    if item.kind == "rod":
        return [("across", np.array([r, item.length_m]), r)]
    if item.kind == "box":
        return [("box", np.asarray(item.size_m), 0.5 * np.asarray(item.size_m)[2])]
    if item.kind == "plate":
        thick = float(np.asarray(item.size_m)[2])
        return [("box", np.asarray(item.size_m), 0.5 * thick), *_stick(0.9 * thick, stick)]
    block = float((item.mass_kg or 0.0) / (2.0 * np.pi * BRASS)) ** (1.0 / 3.0)
    middle = max(0.6 * stick, 2.0 * r + block)
    return [
        ("sphere", np.array([r]), r),
        *_stick(1.5 * r, max(stick, middle)),
        ("upright", np.array([block, 2.0 * block]), middle),
    ]


def _stick(start: float, length: float) -> list[tuple[str, FloatArray, float]]:
    return [("upright", np.array([STICK_M, length]), start + 0.5 * length)] if length else []


def _solid(part: tuple[str, FloatArray, float]) -> Any:
    import trimesh

    form, extent, height = part
    if form == "sphere":
        solid = trimesh.creation.icosphere(subdivisions=4, radius=float(extent[0]))
    elif form == "box":
        solid = trimesh.creation.box(extents=extent)
    else:
        solid = trimesh.creation.cylinder(radius=float(extent[0]), height=float(extent[1]), sections=64)
        if form == "across":
            solid.apply_transform(np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]]))
    solid.apply_translation([0.0, 0.0, height])
    return solid


@cache
def _mesh(file: Path, unit: str) -> Surface:
    """Return a mesh with its lowest point at the origin."""
    if not file.is_file():
        raise InputError("no such mesh", where=f"objects: {file}", expected="a closed surface next to the script")
    points, triangles = read_surface(file)
    points = points / PER_METRE[unit]
    return freeze(points - points[points[:, 2].argmin()]), freeze(triangles, np.int64)


def _bowl(squared: FloatArray, radius: float) -> FloatArray:
    """Return the height of the lower side of a ball or rod, given the squared distance from its lowest point or line [m²]."""
    inside = squared < radius**2
    return np.where(inside, radius - np.sqrt(np.where(inside, radius**2 - squared, 0.0)), np.inf)


def _face(xy: FloatArray, half: FloatArray) -> FloatArray:
    return np.where((np.abs(xy) < half).all(axis=1), 0.0, np.inf)


def _lower_side(surface: Surface) -> Callable[[FloatArray], FloatArray]:
    """Return a function for the height of a mesh's lower side at places (k, 2)."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        o3d.core.Tensor(np.ascontiguousarray(surface[0], dtype=np.float32)),
        o3d.core.Tensor(np.ascontiguousarray(surface[1], dtype=np.uint32)),
    )

    def height(xy: FloatArray) -> FloatArray:
        up = np.tile([0.0, 0.0, 1.0], (len(xy), 1))
        rays = np.hstack([xy, np.full((len(xy), 1), -FAR), up]).astype(np.float32)
        return np.asarray(scene.cast_rays(o3d.core.Tensor(rays), nthreads=1)["t_hit"].numpy().astype(float) - FAR)

    return height
