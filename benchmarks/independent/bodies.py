"""The robots: what robot.toml declares of each, and the other mesh that the truth uses."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import meshio
import numpy as np
import skfem

from .solid import Array

GRAVITY = np.array([0.0, 0.0, -9.81])


@dataclass(frozen=True, eq=False)
class Tendon:
    """A cable as robot.toml declares it."""

    name: str
    path: Array
    pull: Array
    exit: Array | None = None


@dataclass(frozen=True, eq=False)
class Body:
    """A robot."""

    name: str
    points: Array
    """Declared mesh [m], (n, 3)."""
    tets: Array
    """(t, 4)."""
    truth: skfem.Mesh
    """Another mesh of the same shape."""
    young: float
    poisson: float
    density: float
    fixed: Array
    """Corners of the clamped box [m], (2, 3)."""
    tendons: list[Tendon]
    tension: float
    """The largest tension that the recordings use [N]."""
    yields: tuple[float, float]
    """By how much a touch moves its place [m], least and most."""
    ground: float
    """Height of the table [m]."""
    patch: float
    """Radius of the patch of a ball [m]."""
    color: tuple[float, float, float] = (0.20, 0.45, 0.80)
    touchable: Array = field(default_factory=lambda: np.array([[-1.0] * 3, [1.0] * 3]))
    """Box of the places that may be touched [m]."""
    near_clamp: tuple[float, float] = (0.1, 0.4)
    """From which share of its length to which a touch is near the clamp."""

    def touched_near_clamp(self) -> Body:
        """The same body, touched where it hardly yields: by forces of about the same size, which move the place less."""
        axis = int(np.argmax(np.ptp(self.points, axis=0)))
        low, high = self.touchable.copy()
        start, length = self.points[:, axis].min(), np.ptp(self.points[:, axis])
        low[axis], high[axis] = (start + share * length for share in self.near_clamp)
        return replace(self, touchable=np.stack([low, high]), yields=(0.15 * self.yields[0], 0.25 * self.yields[1]))


def _kuhn(*axes: Array) -> tuple[Array, Array]:
    mesh = skfem.MeshTet.init_tensor(*axes)
    return mesh.p.T.copy(), _upright(mesh.p.T, mesh.t.T.copy())


def _upright(points: Array, tets: Array) -> Array:
    edge = points[tets[:, 1:]] - points[tets[:, :1]]
    turned = np.linalg.det(edge) < 0
    tets[turned] = tets[turned][:, [0, 2, 1, 3]]
    return tets


def _other(points: Array, tets: Array, rng: np.random.Generator, *, share: float) -> skfem.Mesh:
    """The same shape with a share of the tetrahedra bisected and the inner nodes moved."""
    mesh = skfem.MeshTet(np.ascontiguousarray(points.T), np.ascontiguousarray(tets.T))
    if share:
        mesh = mesh.refined(rng.choice(mesh.nelements, int(share * mesh.nelements), replace=False))
    p = mesh.p.copy()
    inner = np.setdiff1d(np.arange(p.shape[1]), np.unique(mesh.facets[:, mesh.boundary_facets()]))
    size = np.cbrt(6 * np.abs(_volumes(p, mesh.t)))
    around = np.full(p.shape[1], np.inf)
    np.minimum.at(around, mesh.t, np.broadcast_to(size, mesh.t.shape))
    before = _volumes(p, mesh.t)
    p[:, inner] += 0.12 * around[inner] * rng.normal(size=(3, len(inner))).clip(-1.5, 1.5)
    bad = _volumes(p, mesh.t) / before < 0.3
    keep = np.unique(mesh.t[:, bad])
    p[:, keep] = mesh.p[:, keep]
    if np.any(_volumes(p, mesh.t) / before < 0.1):
        p = mesh.p
    return skfem.MeshTet(p, mesh.t)


def _volumes(p: Array, t: Array) -> Array:
    edge = np.moveaxis(p[:, t[1:]] - p[:, t[:1]], -1, 0)
    return np.linalg.det(edge) / 6


def _graded(length: float, cells: int) -> Array:
    """Ends of cells that are finer at the clamp, where the strain is singular: with even ones the slab was 2.7 % stiffer, and the bar 1.2 %."""
    return np.asarray(length * np.linspace(0.0, 1.0, cells + 1) ** 1.6)


def bar(rng: np.random.Generator) -> Body:
    """A cantilever 100 × 20 × 20 mm with a cable above and one below its axis; truth: 27-node bricks."""
    points, tets = _kuhn(np.linspace(0, 0.1, 15), np.linspace(-0.01, 0.01, 4), np.linspace(-0.01, 0.01, 4))
    truth = skfem.MeshHex.init_tensor(_graded(0.1, 16), np.linspace(-0.01, 0.01, 5), np.linspace(-0.01, 0.01, 5))
    tendons = [
        Tendon(name, np.array([[x, 0.0, side * 0.006] for x in (0.095, 0.065, 0.035)]), np.array([-0.02, 0.0, side * 0.006]))
        for name, side in (("up", 1), ("down", -1))
    ]
    fixed = np.array([[-0.001, -0.02, -0.02], [1e-4, 0.02, 0.02]])
    touchable = np.array([[0.045, -1, -1], [0.095, 1, 1]])
    return Body(
        "bar", points, tets, truth, 450e3, 0.45, 1070.0, fixed, tendons, 1.6, (1.5e-3, 6e-3), -0.08, 2.5e-3, touchable=touchable
    )


def arm(rng: np.random.Generator) -> Body:
    """A square arm 24 × 24 × 120 mm that stands, with four cables at its corners; truth: mirrored, finer P2 tetrahedra."""
    side, height = np.linspace(-0.012, 0.012, 4), np.linspace(0, 0.12, 15)
    points, tets = _kuhn(side, side, height)
    fine, cells = _kuhn(np.linspace(-0.012, 0.012, 5), np.linspace(-0.012, 0.012, 5), np.linspace(0, 0.12, 17))
    fine[:, 0] *= -1
    truth = _other(fine, cells, rng, share=0.0)
    tendons = [
        Tendon(name, np.array([[x, y, z] for z in (0.116, 0.08, 0.04)]), np.array([x, y, -0.01]))
        for name, x, y in (("ne", 0.008, 0.008), ("nw", -0.008, 0.008), ("sw", -0.008, -0.008), ("se", 0.008, -0.008))
    ]
    fixed = np.array([[-0.02, -0.02, -0.001], [0.02, 0.02, 1e-4]])
    touchable = np.array([[-1, -1, 0.05], [1, 1, 0.113]])
    color = (0.15, 0.62, 0.35)
    return Body(
        "arm", points, tets, truth, 300e3, 0.45, 1070.0, fixed, tendons, 1.2, (1.5e-3, 6e-3), -0.015, 2.5e-3, color, touchable
    )


def diamond(rng: np.random.Generator, folder: Path) -> Body:
    """The four-leg robot of `folder`; truth: the same surface, P2, each tetrahedron in eight, some bisected before, inner nodes moved.

    On its legs a tetrahedron or two are all there is across: in its own mesh this truth was 6 % stiffer to its weight.
    """
    mesh = meshio.read(folder / "diamond.vtu")
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    points = mesh.points * 1e-3 @ turn.T + np.array([0, 0, 0.035])
    tets = _upright(points, mesh.cells_dict["tetra"].astype(np.int64))
    truth = _other(points, tets, rng, share=0.003).refined()
    tendons = []
    surface = _surface(points, tets)
    for name, x, y in (("north", 0, 1), ("west", -1, 0), ("south", 0, -1), ("east", 1, 0)):
        place = _pulled_in(surface, np.array([0.097 * x, 0.097 * y, 0.045]), 1.0e-3)
        tendons.append(Tendon(name, place[None], np.array([0.010 * x, 0.010 * y, 0.030]), np.array([0.0, 0.0, -1.0])))
    fixed = np.array([[-0.015, -0.015, -0.04], [0.015, 0.015, 0.01]])
    touchable = np.array([[-1, -1, 0.045], [1, 1, 1]])
    return Body(
        "diamond",
        points,
        tets,
        truth,
        450e3,
        0.45,
        1070.0,
        fixed,
        tendons,
        0.8,
        (1.5e-3, 5e-3),
        -0.06,
        2.5e-3,
        touchable=touchable,
    )


def pad(rng: np.random.Generator) -> Body:
    """A soft dome clamped at its base; truth: the same facets, P2, some tetrahedra bisected, inner nodes moved."""
    axis = np.linspace(-1, 1, 11)
    points, tets = _kuhn(axis, axis, np.linspace(0, 1, 5))
    u, v, w = points.T
    round_ = 0.6
    x = u * (1 - round_ + round_ * np.sqrt(1 - v**2 / 2))
    y = v * (1 - round_ + round_ * np.sqrt(1 - u**2 / 2))
    height = 0.030 * (1 - 0.33 * (x**2 + y**2))
    points = np.column_stack([0.030 * x, 0.030 * y, w * height])
    tets = _upright(points, tets)
    truth = _other(points, tets, rng, share=0.02)
    fixed = np.array([[-0.04, -0.04, -0.001], [0.04, 0.04, 1e-4]])
    touchable = np.array([[-0.02, -0.02, 0.018], [0.02, 0.02, 1]])
    color = (0.75, 0.30, 0.55)
    return Body("pad", points, tets, truth, 60e3, 0.45, 1070.0, fixed, [], 0.0, (1.0e-3, 3e-3), -0.004, 4e-3, color, touchable)


def slab(rng: np.random.Generator) -> Body:
    """A plate 110 × 64 × 13 mm clamped along one edge, with two cables near its upper face; truth: 27-node bricks."""
    points, tets = _kuhn(np.linspace(0, 0.11, 15), np.linspace(-0.032, 0.032, 9), np.linspace(-0.0065, 0.0065, 3))
    truth = skfem.MeshHex.init_tensor(_graded(0.11, 16), np.linspace(-0.032, 0.032, 9), np.linspace(-0.0065, 0.0065, 4))
    tendons = [
        Tendon(name, np.array([[x, y, 0.004] for x in (0.1, 0.07, 0.035)]), np.array([-0.02, y, 0.004]))
        for name, y in (("left", 0.018), ("right", -0.018))
    ]
    fixed = np.array([[-0.001, -0.05, -0.02], [1e-4, 0.05, 0.02]])
    touchable = np.array([[0.05, -0.028, -1], [0.105, 0.028, 1]])
    color = (0.30, 0.30, 0.75)
    return Body(
        "slab", points, tets, truth, 700e3, 0.46, 1050.0, fixed, tendons, 1.5, (1.5e-3, 5e-3), -0.07, 2.0e-3, color, touchable
    )


def post(rng: np.random.Generator) -> Body:
    """A round post 28 × 85 mm that stands, with three cables; truth: P2 on facets of its own, which cut the round otherwise."""
    points, tets = _post(5, 14)
    fine, cells = _post(6, 15)
    fine[:, 0] *= -1
    truth = _other(fine, cells, rng, share=0.0)
    tendons = []
    for name, angle in (("a", 0.4), ("b", 0.4 + 2 * np.pi / 3), ("c", 0.4 + 4 * np.pi / 3)):
        x, y = 0.009 * np.cos(angle), 0.009 * np.sin(angle)
        tendons.append(Tendon(name, np.array([[x, y, z] for z in (0.082, 0.055, 0.025)]), np.array([x, y, -0.01])))
    fixed = np.array([[-0.02, -0.02, -0.001], [0.02, 0.02, 1e-4]])
    touchable = np.array([[-1, -1, 0.035], [1, 1, 0.08]])
    color = (0.80, 0.45, 0.15)
    return Body(
        "post", points, tets, truth, 180e3, 0.44, 1100.0, fixed, tendons, 1.0, (1.5e-3, 4e-3), -0.02, 2.5e-3, color, touchable
    )


def _post(across: int, up: int) -> tuple[Array, Array]:
    """A round post of so many nodes across and along."""
    axis = np.linspace(-1, 1, across)
    points, tets = _kuhn(axis, axis, np.linspace(0, 0.085, up))
    u, v, w = points.T
    round_ = 0.9
    x = u * (1 - round_ + round_ * np.sqrt(1 - v**2 / 2))
    y = v * (1 - round_ + round_ * np.sqrt(1 - u**2 / 2))
    points = np.column_stack([0.014 * x, 0.014 * y, w])
    return points, _upright(points, tets)


def _surface(points: Array, tets: Array) -> tuple[Array, Array]:
    faces = np.concatenate([tets[:, k] for k in ([1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1])])
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return points, faces[first[count == 1]]


def _pulled_in(surface: tuple[Array, Array], point: Array, depth: float) -> Array:
    """The closest place of the surface, a little inside, where every tetrahedral mesh of that surface has a cell."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(surface[0].astype(np.float32), surface[1].astype(np.uint32))
    answer = scene.compute_closest_points(point.astype(np.float32)[None])
    spot = answer["points"].numpy()[0].astype(float)
    normal = answer["primitive_normals"].numpy()[0].astype(float)
    inside = np.stack([spot + s * depth * normal for s in (1, -1)]).astype(np.float32)
    distance = scene.compute_signed_distance(inside).numpy()
    return inside[int(np.argmin(distance))].astype(float)


def write_robot(folder: Path, body: Body, markers: dict[str, Array], *, colors: bool = True) -> None:
    """robot.toml and its mesh, by the contract; without `colors` it does not say how the robot looks."""
    folder.mkdir(parents=True, exist_ok=True)
    meshio.write(folder / f"{body.name}.vtu", meshio.Mesh(body.points * 1e3, [("tetra", body.tets)]))
    lines = [
        'format = "femsense-robot-1"',
        f'name = "{body.name}"',
        "",
        "[mesh]",
        f'file = "{body.name}.vtu"',
        'unit = "mm"',
        'element = "tet10"',
    ]
    lines += [
        "",
        "[material]",
        f"young_modulus_pa = {body.young}",
        f"poisson_ratio = {body.poisson}",
        f"density_kg_m3 = {body.density}",
    ]
    lines += ["", "[gravity]", f"vector_m_s2 = {listed(GRAVITY)}", "", "[[fixed]]", f"box_m = {listed(body.fixed)}"]
    for tendon in body.tendons:
        lines += [
            "",
            "[[cables]]",
            f'name = "{tendon.name}"',
            f"path_m = {listed(tendon.path)}",
            f"pull_point_m = {listed(tendon.pull)}",
        ]
        lines += [f"exit_direction = {listed(tendon.exit)}"] if tendon.exit is not None else []
        lines += ["max_tension_n = 20.0"]
    for name, place in markers.items():
        lines += ["", "[[markers]]", f'name = "{name}"', f"position_m = {listed(place)}"]
    lines += ["", "[features]", "count = 51", ""]
    lines += ["[appearance]", f"color_rgb = {list(body.color)}", ""] if colors else []
    (folder / "robot.toml").write_text("\n".join(lines), encoding="utf-8")


def listed(values: Array) -> list[float]:
    """Numbers as TOML and JSON write them."""
    return np.asarray(values, float).round(9).tolist()
