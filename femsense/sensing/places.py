"""Possible contacts: given contact points, and the closest surface points of observed objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import numpy.typing as npt

from femsense.calib.scan import Scan, in_box, pixel_of
from femsense.core.arrays import BoolArray, FloatArray, IntArray
from femsense.fem.equilibrium import Equilibrium
from femsense.model.recording_parts import Tool
from femsense.pointcloud.known_shapes import KnownShape, cylinder_shape, register
from femsense.pointcloud.primitives import FEWEST, OUTLIERS, Shape, find_shapes, fit_ball, fit_shape, same_object
from femsense.pointcloud.rays import Surface
from femsense.sensing.touches import make_touch
from femsense.sensing.types import Case, Sensor, Touch

LOCAL = 0.06
"""Extent of the part of an object that its shape is fitted to, beyond its nearest point, relative to the body's diagonal."""
NEAR = 0.08
"""Maximum distance of the visible points of a touching object from the body, relative to the body's diagonal."""
SLACK = 2.0
"""A completed object touches if its gap is less than this many standard deviations."""
FACETS = 1.5e-4
"""Standard deviation of gaps: the surface of the model is flat between nodes [m]."""
ZONE = 0.15
"""Maximum extent of a contact about its nearest point, relative to the body's diagonal."""
HERTZ = float(np.sqrt(5.0))
"""Half axis of Hertz's pressure over the root mean square of the coordinate along it."""
LINE = 2.0
"""A zone that is this many times as long as wide is that of a line contact."""
AHEAD = 1e-4
"""Step of the finite difference of a distance [m]."""
WINDOWED = 2.0
"""Overdispersion of objects: stereo matching correlates neighbouring pixels, so that the variance of their sums is this many times that of
independent pixels."""
BLEEDING = 3.0
"""Maximum width of the depth bleeding of a stereo camera, one to three pixels. Bleeding pixels have the colour of the background [px]."""
AGAIN = 2.0
"""A ball is the same as in the previous frame if its points lie within this many radii of the previous centre."""
SIXTHS = np.array([[i, j, 6 - i - j] for i in range(7) for j in range(7 - i)]) / 6.0
"""Barycentric points of a triangle at which the distance of an object is evaluated, shape (28, 3)."""
FLOOR_STD = 0.0007
"""Minimum standard deviation of a contact point [m]: the surface of the model is flat between nodes."""


def given_touches(sensor: Sensor) -> list[Touch]:
    """Return contacts at the given contact points."""
    return [make_touch(sensor, place, source="given") for place in sensor.places]


def case_of(sensor: Sensor, k: int) -> Case:
    """Return what is asked of frame k: the recording's column `free` declares contact-free frames."""
    if sensor.recording.free is not None and sensor.recording.free[k]:
        return Case.CONTACT_FREE
    return Case.GIVEN_PLACES if len(sensor.places) else Case.UNKNOWN_CONTACTS


def objects_near(sensor: Sensor, scan: Scan, state: Equilibrium, seen: Sequence[Shape] = ()) -> list[Shape]:
    """Return the objects of a scan near the body in a state, with completed shapes.

    seen: objects of the previous frame; a ball keeps its previous radius if that was better determined.
    """
    poses = sensor.calibration.poses
    points = scan.surroundings(poses)
    if len(points) < 3:
        return []
    reach = (NEAR + LOCAL) * sensor.size
    close = np.flatnonzero(in_box(points, state.positions, reach))
    gap = np.full(len(points), np.inf)
    body = Surface(state.positions, sensor.surface.triangles)
    gap[close] = body.signed_gap(points[close], within=reach)
    near = np.flatnonzero(gap < reach)
    if len(near) < 3:
        return []
    points, gap, view = points[near], gap[near], scan.others_view[near]
    origins = np.array([T[:3, 3] for T in poses])[view]
    std = sensor.knowledge.depth_std(np.linalg.norm(points - origins, axis=1), view)
    edges = _edges(sensor, scan, state, body, points, gap, origins, view)
    tools = sensor.recording.tools
    whole = any(tool.kind != "ball" for tool in tools)  # the more of a known object is visible, the better its pose
    return find_shapes(
        points,
        std,
        origins,
        gap,
        local_m=np.inf if whole else LOCAL * sensor.size,
        fit=partial(fit_tool, tools) if tools else partial(fit_again, seen),
        is_edge=edges.consist_of,
        halo=edges.halo,
        view=view,
        ends=not tools,
    )


@dataclass(frozen=True, eq=False, slots=True)
class Edges:
    """Positions of points relative to the visible edges of a body, where depth is mixed."""

    close: BoolArray
    """Whether a point lies within the possible depth bleeding of an edge, shape (o,)."""
    halo: BoolArray
    """Whether it may be depth bleeding around the silhouette, shape (o,)."""
    passes: FloatArray
    """Distance at which its ray passes the body [m], shape (o,): 0 if it hits a face, inf beyond the possible depth bleeding."""
    behind: FloatArray
    """Distance of that passage behind the point [m], inf if the ray passes farther away, shape (o,)."""
    std: FloatArray
    """Noise of each point along its ray, times √T for the correlation of neighbours [m], shape (o,)."""
    model: float
    """Error of the model's surface [m]."""

    def consist_of(self, group: IntArray) -> bool:
        """Return whether points may belong to the body's own edge: all lie close to its surface, and their mean is not significantly in
        front of its faces."""
        met = group[self.passes[group] == 0.0]
        if len(met) > 0.5 * len(group):
            noise = float(np.median(self.std[met])) / np.sqrt(len(met))
            if float(np.median(self.behind[met])) > 3.0 * np.hypot(noise, self.model):
                return False
        return bool(self.close[group].mean() > 1.0 - OUTLIERS)


def _edges(
    sensor: Sensor,
    scan: Scan,
    state: Equilibrium,
    body: Surface,
    points: FloatArray,
    gap: FloatArray,
    origins: FloatArray,
    view: IntArray,
) -> Edges:
    """Return the positions of points relative to the edges of the body; gaps: distances from the body [m], shape (o,).

    A pixel of the halo has a depth between the body and the background, and its ray passes close to the body; or it lies close to the body
    in space. A point that far in front of a face of the body does not belong to the halo.
    """
    known, noises = sensor.knowledge, sensor.knowledge.noises
    pixel = np.array([_pixel_of(sensor, scan, v) for v in range(len(noises))])
    depth = np.linalg.norm(points - origins, axis=1)
    std, width = known.depth_std(depth, view), BLEEDING * pixel[view] * depth
    matched = np.array([noise.kind == "stereo" for noise in noises])[view] & (known.together > WINDOWED)
    close = np.abs(gap) < width + 3.0 * std
    passes, behind = np.full(len(points), np.inf), np.full(len(points), np.inf)
    for v in np.unique(view):
        own = np.flatnonzero((matched | close) & (view == v))
        origin = sensor.calibration.poses[v][:3, 3]
        passes[own], behind[own] = body.beside_rays(points[own], origin, within=BLEEDING * pixel[v])
    near = np.where(passes > 0.0, (gap < width) | (behind < width), (gap < width) & (behind < width))
    halo = matched & near
    way = float(np.linalg.norm(state.positions - sensor.robot.body.mesh.nodes, axis=1).max())
    model = float(np.hypot(known.bias_m, known.model_share * way))
    return Edges(close, halo, passes, behind, np.sqrt(known.together) * std, model)


def _pixel_of(sensor: Sensor, scan: Scan, view: int) -> float:
    """Return the angle between neighbouring rays of a camera [rad]."""
    camera = sensor.recording.cameras[view]
    return pixel_of(scan, view) if camera is None else 1.0 / camera.fx


def fit_again(seen: Sequence[Shape], points: FloatArray, std: FloatArray, origins: FloatArray) -> Shape:
    """Return the shape of points; a ball has its previous radius if that was better determined. Arguments as for `fit_tool`."""
    shape = fit_shape(points, std, origins)
    balls = [one for one in seen if one.kind == "sphere" and one.radius_std < shape.radius_std]
    near = min(balls, key=lambda one: float(np.linalg.norm(one.center - points.mean(axis=0))), default=None)
    if near is None or shape.kind == "plate" or np.linalg.norm(near.center - points.mean(axis=0)) > AGAIN * near.radius:
        return shape
    ball = fit_ball(points, std, origins, near.radius)[1]
    if ball is None or ball.covariance is None:
        return shape
    look = (points - origins).mean(axis=0)
    # The visible surface is kept: a larger ball has its centre farther away.
    by_radius = np.append(look / np.linalg.norm(look), 1.0)
    return replace(ball, covariance=ball.covariance + near.radius_std**2 * np.outer(by_radius, by_radius))


def fit_tool(tools: Sequence[Tool], points: FloatArray, std: FloatArray, origins: FloatArray) -> Shape:
    """Return the known object that fits the points within their noise, at its pose; without one, the best-fitting shape.

    Arguments:
        tools: objects that may touch, at least one.
        points: of one object [m], shape (k, 3).
        std: noise of each point along its ray [m], shape (k,).
        origins: centre of the camera of each point [m], shape (k, 3).
    """
    if len(points) < FEWEST:
        return fit_shape(points, std, origins)
    tried = [_fit_of(tool, points, std, origins) for tool in tools]
    good = [(cost, shape) for cost, shape in tried if shape is not None]
    return min(good, key=lambda fit: fit[0])[1] if good else fit_shape(points, std, origins)


def _fit_of(tool: Tool, points: FloatArray, std: FloatArray, origins: FloatArray) -> tuple[float, Shape | None]:
    if tool.kind == "ball":
        return fit_ball(points, std, origins, tool.radius)
    known = cylinder_shape(tool.radius, tool.length) if tool.kind == "cylinder" else KnownShape(tool.points, tool.triangles)
    return register(known, points, std, origins)


def object_touches(sensor: Sensor, shapes: Sequence[Shape], state: Equilibrium) -> list[Touch]:
    """Return the contacts of completed objects with a state, at the nearest part of each."""
    found = [_touch(sensor, shape, state) for shape in shapes]
    return [touch for touch in found if touch is not None]


def away_from_scenery(sensor: Sensor, touches: Sequence[Touch]) -> list[Touch]:
    """Return the contacts without those that also appear in a contact-free frame (a holder, the table), and without those of objects that
    pass through the body."""
    return [
        t
        for t in touches
        if not any(np.linalg.norm(t.place - place) < ZONE * sensor.size for place in sensor.scenery)
        and not any(t.shape is not None and same_object(t.shape, one) for one in sensor.passing)
    ]


def _touch(sensor: Sensor, shape: Shape, state: Equilibrium) -> Touch | None:
    triangles, corners = sensor.surface.triangles, state.positions[sensor.surface.nodes]
    shape = shape.towards(corners)
    std = float(np.hypot(shape.std_m, FLOOR_STD))
    touching = SLACK * std + shape.behind_m + (0.0 if shape.kind != "points" else 2.0 * shape.std_m)
    corner = shape.distance(corners, within=touching + 3.0 * sensor.surface.edge)
    if corner.min() > touching + 2.0 * sensor.surface.edge:  # too far for every point between the nodes
        return None
    by_node = np.full(len(state.positions), np.inf)
    by_node[sensor.surface.nodes] = corner
    closest = triangles[by_node[triangles].min(axis=1) <= corner.min() + sensor.surface.edge]
    weights = SIXTHS
    places = np.einsum("wi,tic->twc", weights, state.positions[closest]).reshape(-1, 3)
    distance = shape.distance(places)
    if distance.min() > touching:
        return None
    rest = np.einsum("wi,tic->twc", weights, sensor.robot.body.mesh.nodes[closest]).reshape(-1, 3)
    best = int(np.argmin(distance))
    normals = np.cross(*(state.positions[closest[:, i]] - state.positions[closest[:, 0]] for i in (1, 2)))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    apart = np.linalg.norm(places - places[best], axis=1)
    zone = np.inf if shape.kind in ("cylinder", "plate") else ZONE * sensor.size
    own = _face_towards(shape, places[best], normals, np.unique(np.flatnonzero(apart < 1e-9) // len(weights)))
    alike = np.repeat(normals @ normals[own] > 0.5, len(weights)) & (apart < zone)
    weight = alike * np.exp(-(distance - distance[best]) / _alike_within(sensor, shape, state, places[best], places))
    weight /= weight.sum()
    middle = weight @ rest
    _, spread, axes = np.linalg.svd(np.sqrt(weight)[:, None] * (rest - middle), full_matrices=False)
    radius = float(np.linalg.norm(spread))
    if _on_clamp(sensor, middle):
        return None
    curvature = shape.radius_at(places[best], 0.5 * sensor.surface.edge)
    is_flat = shape.kind in ("plate", "known") and bool(np.isinf(curvature))
    is_line = shape.kind != "points" and spread[0] > LINE * spread[1]
    touch = make_touch(
        sensor,
        middle,
        source="cloud",
        std_m=float(np.hypot(std, radius)),
        radius=curvature,
        spread=HERTZ * float(spread[1]) if is_flat else 0.0,
        along=HERTZ * float(spread[0]) * axes[0] if is_flat or is_line else None,
    )
    return replace(touch, line=axes[0], across_m=float(np.hypot(std, spread[1])), shape=shape)


def _face_towards(shape: Shape, place: FloatArray, normals: FloatArray, faces: IntArray) -> int:
    """Return which of the faces that meet at a point (3,) faces the object most. This matters on an edge."""
    step = AHEAD * np.eye(3)
    towards = shape.distance(place - step) - shape.distance(place + step)
    return int(faces[np.argmax(normals[faces] @ towards)])


def _alike_within(sensor: Sensor, shape: Shape, state: Equilibrium, best: FloatArray, places: FloatArray) -> FloatArray:
    """Return the standard deviation of the differences of the gaps at places (k, 3) from that at the smallest one [m], shape (k,)."""
    known = sensor.knowledge
    apart = np.linalg.norm(places - best, axis=1)
    node = int(np.argmin(((state.positions - best) ** 2).sum(axis=1)))
    way = float(np.linalg.norm(state.positions[node] - sensor.robot.body.mesh.nodes[node]))
    shared = np.sqrt(2.0) * np.hypot(known.bias_m, known.model_share * way) * np.minimum(1.0, apart / sensor.error_field.length)
    tilt = np.sqrt(known.together) * shape.tilt_std(places - best)
    return np.asarray(np.sqrt(max(0.5 * min(shape.std_m, FLOOR_STD), FACETS) ** 2 + shared**2 + tilt**2))


def _on_clamp(sensor: Sensor, place: FloatArray) -> bool:
    """Return whether a point lies on the clamp: a force there does not deform the body, and the holder always touches it."""
    clamped = sensor.robot.body.mesh.nodes[sensor.robot.body.clamped]
    return bool(len(clamped)) and bool(np.linalg.norm(clamped - place, axis=1).min() < sensor.surface.edge)


def near_places(points: FloatArray, places: FloatArray, size: float) -> npt.NDArray[np.bool_]:
    """Return which known loads act near a given contact point."""
    if not len(places) or not len(points):
        return np.zeros(len(points), dtype=bool)
    distance = np.linalg.norm(points[:, None] - places[None], axis=2).min(axis=1)
    return np.asarray(distance < 0.2 * size)
