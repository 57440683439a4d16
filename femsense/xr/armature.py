"""Bones from points: a cubic spline through markers, bones at arc lengths, and frames along the curve.

    c(u) through the markers,   bone k at arc length s_k,   T_robot_bone = [n  b  t | c(s_k)]

with t the tangent, n the normal and b = t × n. In the plane, n is the tangent turned by 90° (Borges et al. 2022, Reality
reconstruction of soft robots, section 3.4.1). In space the frames minimise rotation: they do not turn about the tangent
(Wang, Jüttler, Zheng and Liu 2008, Computation of rotation minimizing frames, double reflection).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, IntArray, as_points, freeze
from femsense.core.errors import InputError
from femsense.xr.skeleton import MAX_BONES, Skeleton

GAUSS_POINTS, GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(4)
"""For the length of a piece of the curve: exact to 1e-6 of it for turns of 90° between markers."""
PIECES = 4
"""Steps between neighbouring bones over which a frame is carried along; double reflection is of fourth order."""


@dataclass(frozen=True, eq=False, slots=True)
class BonePoses:
    """Poses of the bones at one time, robot frame."""

    positions: FloatArray
    """Origins [m], shape (b, 3)."""
    quaternions: FloatArray
    """Rotations as x, y, z, w, shape (b, 4); the bone's z axis lies along the body, its x axis is the normal."""

    def __len__(self) -> int:
        return len(self.positions)

    def __repr__(self) -> str:
        """Return how many there are and how far they reach."""
        first, last = (", ".join(f"{1e3 * x:.1f}" for x in place) for place in self.positions[[0, -1]])
        return f"BonePoses({len(self)} bones from ({first}) to ({last}) mm)"

    @property
    def T_robot_bone(self) -> FloatArray:
        """The same as matrices, shape (b, 4, 4)."""
        from scipy.spatial.transform import Rotation

        T = np.tile(np.eye(4), (len(self), 1, 1))
        T[:, :3, :3] = Rotation.from_quat(self.quaternions).as_matrix()
        T[:, :3, 3] = self.positions
        return T


def poses_from_matrices(T_robot_bone: FloatArray) -> BonePoses:
    """Return bone poses from matrices, shape (b, 4, 4); the scalar part of each quaternion is not negative."""
    from scipy.spatial.transform import Rotation

    return BonePoses(
        freeze(T_robot_bone[:, :3, 3]), freeze(Rotation.from_matrix(T_robot_bone[:, :3, :3]).as_quat(canonical=True))
    )


def local_poses(poses: BonePoses) -> BonePoses:
    """Return the pose of each bone relative to the bone before it, as a hierarchical skeleton needs it.

    Arguments:
        poses: b bones in the robot frame, as an `Armature` returns them.

    Returns:
        b poses; the first one is unchanged.
    """
    T = poses.T_robot_bone
    return poses_from_matrices(np.concatenate([T[:1], np.linalg.inv(T[:-1]) @ T[1:]]))


@dataclass(frozen=True, eq=False, slots=True)
class ArmatureOptions:
    """Options of `make_armature`: number and positions of the bones on the chain of points, and their axes."""

    bones: int = 8
    """Number of bones; each is in the middle of an equal part of the length at rest."""
    at_m: tuple[float, ...] | None = None
    """Alternatively the arc lengths of the bones at rest [m] from the first point, increasing."""
    plane_normal: tuple[float, float, float] | None = None
    """Normal of the plane in which the body bends; None: the body bends in space."""
    inextensible: bool = False
    """Whether the line keeps its rest length: then only its direction is taken from the points."""
    start_normal: tuple[float, float, float] | None = None
    """Direction of the x axis of the first bone at rest, projected across the tangent; None: the robot axis most perpendicular to it."""


@dataclass(frozen=True, eq=False, slots=True)
class Armature:
    """Bones along the backbone of a body: poses on a cubic spline through measured points.

    `make_armature` places the bones at rest. A call `armature(points)` with the measured points [m], shape (m, 3), returns the poses of the b bones as
    `BonePoses`: `positions` [m], shape (b, 3), and `T_robot_bone`, shape (b, 4, 4), from bone to robot coordinates. The z axis of a bone is the tangent
    of the spline. The x axis of the first bone is set by `ArmatureOptions`; it is transported along the curve without rotation about the tangent
    (rotation-minimising frame). The poses animate a skinned mesh (`export_glb`, `femsense stream`).
    """

    rest_points: FloatArray
    """The points at rest, in the order of the chain [m], shape (m, 3)."""
    knots: FloatArray
    """Arc length of each point at rest [m], shape (m,)."""
    at: FloatArray
    """Arc length of each bone at rest [m], shape (b,)."""
    normal: FloatArray
    """Unit vector, shape (3,): x axis at the first point at rest; if `planar`, the normal of the plane."""
    tangent: FloatArray
    """Along the chain at the first point at rest; unit, shape (3,)."""
    planar: bool
    """Whether the curve lies in a plane; then the x axis is the tangent, turned by 90° in that plane."""
    inextensible: bool
    """Whether the curve keeps its length at rest; then only the directions are taken from the points."""

    def __len__(self) -> int:
        return len(self.at)

    def __repr__(self) -> str:
        """Return how many bones lie on how long a curve through how many points."""
        kind = ("in a plane" if self.planar else "in space") + (", inextensible" if self.inextensible else "")
        return f"Armature({len(self)} bones on {1e3 * self.knots[-1]:.1f} mm through {len(self.knots)} points, {kind})"

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each bone."""
        return tuple(f"bone_{k:02d}" for k in range(len(self)))

    @property
    def rest(self) -> BonePoses:
        """The bones at rest."""
        return self(self.rest_points)

    @property
    def skeleton(self) -> Skeleton:
        """The bones at rest, for a skin."""
        return Skeleton(self.rest.T_robot_bone, self.names)

    def __call__(self, points: npt.ArrayLike) -> BonePoses:
        """Return the poses of the bones when the points of the chain are at `points` [m], shape (m, 3).

        Raises:
            InputError: another number of points, or neighbours that coincide.
        """
        x = as_points(points)
        if x.shape != self.rest_points.shape:
            raise InputError("another number of points", where="points", found=x.shape, expected=self.rest_points.shape)
        stations, own = _stations(self.at)
        positions, tangents = _along(x, self.knots, stations)
        if self.inextensible:
            positions = _with_length(x, self.knots, stations)
        normals = self._normals(positions, tangents)
        T = np.tile(np.eye(4), (len(own), 1, 1))
        T[:, :3, 2], T[:, :3, 0] = tangents[own], normals[own]
        T[:, :3, 1] = np.cross(tangents[own], normals[own])
        T[:, :3, 3] = positions[own]
        return poses_from_matrices(T)

    def _normals(self, positions: FloatArray, tangents: FloatArray) -> FloatArray:
        """Return the x axis at each station, shape (k, 3)."""
        if self.planar:
            return _unit(np.cross(self.normal, tangents))
        return rotation_minimising(positions, tangents, _turned(self.normal, self.tangent, tangents[0]))


def make_armature(rest_points: npt.ArrayLike, options: ArmatureOptions | None = None) -> Armature:
    """Place bones along a chain of points, for example markers along a robot, to animate a mesh.

    Arguments:
        rest_points: m points at rest, from base to tip [m], shape (m, 3) with m ≥ 2.
        options: an `ArmatureOptions`: number of bones, or their arc lengths from the first point, and the direction of their x axes. Default: 8 bones,
            evenly spaced.

    Returns:
        the armature; called with measured points [m], shape (m, 3), it returns the pose of each bone.

    Raises:
        InputError: fewer than two points, neighbours that coincide, an arc length in `options.at_m` beyond the end of the chain, or a normal
            parallel to the chain.

    Example:
        >>> import numpy as np
        >>> import femsense as fs
        >>> chain = np.c_[np.linspace(0.0, 0.1, 6), np.zeros((6, 2))]  # m
        >>> armature = fs.make_armature(chain)
        >>> armature(chain).T_robot_bone.shape  # eight bones by default, each a pose
        (8, 4, 4)
    """
    options = options or ArmatureOptions()
    x = as_points(rest_points, "rest_points")
    if len(x) < 2:
        raise InputError("a chain needs two points", where="rest_points", found=x.shape, expected="(m ≥ 2, 3)")
    _check_planar(x, options.plane_normal)
    knots = np.concatenate([[0.0], np.cumsum(_lengths(x))])
    at = _bone_places(options, float(knots[-1]))
    tangent = _along(x, knots, np.zeros(1))[1][0]
    planar = options.plane_normal is not None
    normal = _unit(np.asarray(options.plane_normal, dtype=np.float64)) if planar else _across(tangent, options.start_normal)
    return Armature(freeze(x), freeze(knots), freeze(at), freeze(normal), freeze(tangent), planar, options.inextensible)


def rotation_minimising(positions: FloatArray, tangents: FloatArray, start: FloatArray) -> FloatArray:
    """Return normals that do not turn about the tangent, by double reflection, shape (k, 3).

    Arguments:
        positions: points of the curve, close to each other [m], shape (k, 3).
        tangents: unit tangents there, shape (k, 3).
        start: unit normal at the first point, shape (3,).
    """
    normals = np.empty_like(tangents)
    normals[0] = start
    for i in range(len(tangents) - 1):
        v = positions[i + 1] - positions[i]
        square = v @ v
        if square == 0.0:
            normals[i + 1] = normals[i]
            continue
        reflected = normals[i] - 2.0 / square * (v @ normals[i]) * v
        tangent = tangents[i] - 2.0 / square * (v @ tangents[i]) * v
        w = tangents[i + 1] - tangent
        normals[i + 1] = reflected - 2.0 / (w @ w) * (w @ reflected) * w if w @ w > 0.0 else reflected
    return normals


def centreline_weights(rest_nodes: npt.ArrayLike, *, points: int, axis: npt.ArrayLike | None = None) -> FloatArray:
    """Return weights W with which W @ nodes is a chain of points along the centreline of a slender body, at rest and deformed.

    The chain places the bones of an animated body (`make_armature`). Planes across the axis divide the body into equal parts; each point of the
    chain is a weighted mean of the nodes, with a weight that is largest in its plane and falls linearly to zero at the next plane.

    Arguments:
        rest_nodes: nodes of the body at rest [m], shape (n, 3).
        points: number p of points, at least 2.
        axis: direction from base to tip, shape (3,). Default: the direction of the longest extent of the body, with the sign that makes its largest
            component positive.

    Returns:
        W [1], shape (p, n); each row sums to 1.

    Raises:
        InputError: no nodes near one of the planes (use fewer points).

    Example:
        >>> import numpy as np
        >>> from femsense.xr.armature import centreline_weights
        >>> bar = np.array([[x, y, 0.0] for x in (0.0, 0.05, 0.1) for y in (-0.01, 0.01)])  # m, six nodes
        >>> centreline_weights(bar, points=3) @ bar
        array([[0.  , 0.  , 0.  ],
               [0.05, 0.  , 0.  ],
               [0.1 , 0.  , 0.  ]])
    """
    x = as_points(rest_nodes, "rest_nodes")
    direction = _long_axis(x) if axis is None else _unit(np.asarray(axis, dtype=np.float64))
    along = x @ direction
    share = (along - along.min()) / (along.max() - along.min()) * (points - 1)
    weights = np.maximum(0.0, 1.0 - np.abs(share - np.arange(points)[:, None]))
    empty = np.flatnonzero(weights.sum(axis=1) == 0.0)
    if len(empty):
        raise InputError("no nodes near a point of the centreline", where="points", found=points, expected="fewer points")
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def _long_axis(x: FloatArray) -> FloatArray:
    axis = np.linalg.svd(x - x.mean(axis=0), full_matrices=False)[2][0]
    return np.asarray(axis * np.sign(axis[np.abs(axis).argmax()]))


# ---- the curve ------------------------------------------------------------------------------------------------------


class _Curve:
    """A cubic spline through points, over their chord lengths."""

    def __init__(self, x: FloatArray) -> None:
        from scipy.interpolate import CubicSpline

        steps = np.linalg.norm(np.diff(x, axis=0), axis=1)
        if not (steps > 0.0).all():
            pair = int(np.argmin(steps))
            raise InputError(
                "neighbours of the chain coincide", where=f"points[{pair}], points[{pair + 1}]", found=x[pair].tolist()
            )
        self.u = np.concatenate([[0.0], np.cumsum(steps)])
        self.value = CubicSpline(self.u, x, bc_type="not-a-knot" if len(x) > 3 else "natural")
        self.slope = self.value.derivative()

    def length(self, low: FloatArray, high: FloatArray) -> FloatArray:
        """Return the length between parameters, shape (k,)."""
        half = 0.5 * (high - low)
        u = low[:, None] + half[:, None] * (GAUSS_POINTS + 1.0)
        return np.asarray(half * (np.linalg.norm(self.slope(u), axis=-1) @ GAUSS_WEIGHTS))


def _lengths(x: FloatArray) -> FloatArray:
    """Return the length of the curve between neighbouring points, shape (m − 1,)."""
    curve = _Curve(x)
    return curve.length(curve.u[:-1], curve.u[1:])


def _along(x: FloatArray, knots: FloatArray, stations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return positions and unit tangents at places that sit at given arc lengths at rest, shape (k, 3) each.

    Between two points of the chain, a place keeps its share of the way: the line may stretch from one point to the next.
    """
    curve = _Curve(x)
    piece = np.clip(np.searchsorted(knots, stations, side="right") - 1, 0, len(x) - 2)
    share = (stations - knots[piece]) / (knots[piece + 1] - knots[piece])
    low, high = curve.u[piece], curve.u[piece + 1]
    wanted = share * curve.length(curve.u[:-1], curve.u[1:])[piece]
    u = low + share * (high - low)
    for _ in range(3):
        u = u - (curve.length(low, u) - wanted) / np.linalg.norm(curve.slope(u), axis=-1)
    return np.asarray(curve.value(u)), _unit(np.asarray(curve.slope(u)))


def _with_length(x: FloatArray, knots: FloatArray, stations: FloatArray) -> FloatArray:
    """Return positions of a line that keeps its length at rest: the integral of the tangents from the first point,
    shape (k, 3)."""
    half = 0.5 * np.diff(stations, prepend=0.0)
    places = (stations - half)[:, None] + half[:, None] * GAUSS_POINTS
    tangents = _along(x, knots, places.ravel())[1].reshape(*places.shape, 3)
    return np.asarray(x[0] + np.cumsum(half[:, None] * np.einsum("kgi,g->ki", tangents, GAUSS_WEIGHTS), axis=0))


def _stations(at: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return arc lengths from the start over all bones, with places between them, and which of them are the bones."""
    ends = np.concatenate([[0.0], at])
    between = np.linspace(ends[:-1], ends[1:], PIECES, endpoint=False, axis=1).ravel()
    return np.append(between, at[-1]), PIECES * np.arange(1, len(at) + 1)


def _bone_places(options: ArmatureOptions, length: float) -> FloatArray:
    if options.at_m is None:
        if not 1 <= options.bones <= MAX_BONES:
            raise InputError("impossible number of bones", where="bones", found=options.bones, expected=f"1 … {MAX_BONES}")
        return np.asarray((np.arange(options.bones) + 0.5) * length / options.bones)
    at = np.asarray(options.at_m, dtype=np.float64)
    if at.ndim != 1 or not at.size or at[0] < 0 or at[-1] > length * (1 + 1e-9) or not (np.diff(at) > 0).all():
        raise InputError(
            "bones must follow each other on the chain",
            where="at_m",
            found=at.tolist(),
            expected=f"increasing arc lengths in 0 … {length:.4g} m",
        )
    return at


# ---- directions -----------------------------------------------------------------------------------------------------


def _check_planar(x: FloatArray, normal: tuple[float, float, float] | None) -> None:
    if normal is None:
        return
    n = np.asarray(normal, dtype=np.float64)
    if n.shape != (3,) or not np.linalg.norm(n) > 0:
        raise InputError("not a direction", where="plane_normal", found=normal, expected="three numbers, not all zero")
    along = np.abs(np.diff(x, axis=0) @ _unit(n)) / np.linalg.norm(np.diff(x, axis=0), axis=1)
    if (along > 0.9).any():
        raise InputError(
            "the chain runs along the normal of its plane",
            where="plane_normal",
            found=normal,
            expected="a normal across the chain",
        )


def _across(tangent: FloatArray, wanted: tuple[float, float, float] | None) -> FloatArray:
    """Return the unit part of a direction that is across the tangent."""
    direction = np.eye(3)[int(np.abs(tangent).argmin())] if wanted is None else np.asarray(wanted, dtype=np.float64)
    normal = direction - (direction @ tangent) * tangent
    if not np.linalg.norm(normal) > 1e-6 * np.linalg.norm(direction):
        raise InputError("the normal lies along the chain", where="start_normal", found=wanted, expected="a direction across it")
    return _unit(normal)


def _turned(normal: FloatArray, before: FloatArray, now: FloatArray) -> FloatArray:
    """Return a normal after the smallest rotation that turns one unit tangent into another (Rodrigues)."""
    axis, cosine = np.cross(before, now), float(before @ now)
    if cosine <= -1.0 + 1e-12:
        return -normal
    across = np.cross(axis, normal)
    return np.asarray(normal + across + np.cross(axis, across) / (1.0 + cosine))


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
