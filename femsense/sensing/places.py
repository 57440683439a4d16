"""Where forces may act: given places, or where surroundings touch the robot (Algorithm 2)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.fem.equilibrium import Equilibrium
from femsense.model.contact_patch import BodySurface, ContactPatch, patch_at
from femsense.model.robot import Robot
from femsense.pointcloud.contact import detect_contacts
from femsense.sensing.measurement import _voxel
from femsense.sensing.types import SeenPoints, SensedFrame, Sensor


def _wandered(patches: Sequence[ContactPatch], again: Sequence[ContactPatch], state: Equilibrium) -> float:
    """Return how far the farthest patch has moved [m]."""
    return max(float(np.linalg.norm(a.mean(state.positions) - b.mean(state.positions))) for a, b in zip(patches, again))


def _same_places(previous: SensedFrame, patches: Sequence[ContactPatch], state: Equilibrium) -> bool:
    """Return whether the contacts are those of the frame before, so that its forces are a start."""
    if len(previous.contacts) != len(patches):
        return False
    moved = [np.linalg.norm(p.mean(state.positions) - c.position_m) for p, c in zip(patches, previous.contacts)]
    return bool(max(moved) < 0.05 * np.linalg.norm(np.ptp(state.positions, axis=0)))


# --- places ------------------------------------------------------------------------------------------------------------


def _find_contacts(sensor: Sensor, k: int, clouds: SeenPoints | None, state: Equilibrium) -> tuple[list[ContactPatch], str]:
    """Return where forces may act: the given places, else where surroundings touch the robot (Algorithm 2)."""
    mesh, clamped, radius = sensor.robot.body.mesh, sensor.robot.body.clamped, 1.5 * sensor.surface.edge
    if len(sensor.places):
        return [patch_at(sensor.surface, mesh.nodes, p, radius, clamped) for p in sensor.places], "given"
    said_free = sensor.recording.free is not None and bool(sensor.recording.free[k])
    if clouds is None or said_free:
        return [], "cloud"
    voxel = _voxel(sensor)
    reach = sensor.options.contact_radius_m or 3.0 * voxel
    found = detect_contacts(
        clouds.others,
        clouds.robot,
        search_radius_m=reach,
        min_neighbors=sensor.options.contact_neighbors,
        cluster_distance_m=4.0 * voxel,
        min_points=3,
    )
    near_clamp = _clamp_mask(sensor, found.positions, reach)
    patches = [
        patch_at(sensor.surface, state.positions, p, max(radius, r), clamped, facing=_seen_normal(clouds, p, 2.0 * reach))
        for p, r, skip in zip(found.positions, found.radius, near_clamp)
        if not skip
    ]
    return patches, "cloud"


def _seen_normal(clouds: SeenPoints, place: FloatArray, radius: float) -> FloatArray | None:
    """Return the mean outward normal of the robot as it is seen around a place, shape (3,); None where it is not known."""
    if clouds.normals is None:
        return None
    near = np.linalg.norm(clouds.robot - place, axis=1) < radius
    mean = clouds.normals[near].sum(axis=0)
    length = float(np.linalg.norm(mean))
    return mean / length if length > 0.3 * max(int(near.sum()), 1) else None


def _clamp_mask(sensor: Sensor, places: FloatArray, reach: float) -> npt.NDArray[np.bool_]:
    """Return places that touch the clamp: a force there does not move the body, and a holder always touches it."""
    clamped = sensor.robot.body.mesh.nodes[sensor.robot.body.clamped]
    if not len(clamped) or not len(places):
        return np.zeros(len(places), dtype=bool)
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(clamped).query(places)[0] < reach)


def _check_places(places: FloatArray, surface: BodySurface, robot: Robot, size: float) -> None:
    from femsense.model.contact_patch import closest_surface_point

    nodes = robot.body.mesh.nodes
    for i, place in enumerate(places):
        distance = float(np.linalg.norm(closest_surface_point(surface, nodes, place) - place))
        if distance > 0.1 * size:
            raise InputError(
                "far from the surface of the body",
                where=f"at[{i}]",
                found=f"{place.tolist()} m, {1e3 * distance:.1f} mm away",
                expected=f"a point of the surface at rest, within {1e3 * nodes.min(axis=0)} … {1e3 * nodes.max(axis=0)} mm",
                hint="coordinates are metres in the robot frame",
            )


def _near_places(points: FloatArray, places: FloatArray, size: float) -> npt.NDArray[np.bool_]:
    """Return which known loads act near a given place."""
    if not len(places) or not len(points):
        return np.zeros(len(points), dtype=bool)
    distance = np.linalg.norm(points[:, None] - places[None], axis=2).min(axis=1)
    return np.asarray(distance < 0.2 * size)
