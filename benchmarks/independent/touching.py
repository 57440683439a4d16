"""Where a touch lies, how its pressure spreads and which object makes it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from .bodies import Body
from .camera import Camera, Shot, seen
from .cases import Touch
from .scene import Shape, Skin, posed, shape
from .solid import Array

MOVED_M = 0.001


@dataclass(frozen=True, eq=False)
class Patch:
    """Places of a pressure patch on the body at rest."""

    rows: sp.csr_matrix
    """Interpolation of its points from the nodes, (p, n)."""
    weight: Array
    """Shares of the force, sum 1, (p,)."""
    triad: sp.csr_matrix
    """Interpolation of the centre and of a point along each of two tangents, (3, n)."""
    rest: Array
    """Centre at rest [m]."""
    whole: float
    """Share of the patch that lies on the surface."""

    @property
    def row(self) -> sp.csr_matrix:
        """Interpolation of its centre of pressure, (1, n)."""
        return sp.csr_matrix(self.weight[None]) @ self.rows

    def center(self, x: Array) -> Array:
        """Centre of pressure on the deformed body [m]."""
        return np.asarray(self.row @ x)[0]

    def normal(self, x: Array) -> Array:
        """Outward normal on the deformed body."""
        a, b, c = np.asarray(self.triad @ x)
        n = np.cross(b - a, c - a)
        return n / np.linalg.norm(n)


def patch(skin: Skin, place: Array, radius: float, along: Array, stretch: float, *, uniform: bool) -> Patch:
    """A patch about a place: elliptic (`stretch` times longer along a direction), Hertz's pressure or a uniform one."""
    spot, normal, _ = skin.project(place[None])
    n = normal[0]
    first = along - n * (along @ n)
    if np.linalg.norm(first) < 1e-6:
        first = np.cross(n, [0.3, 0.5, 0.8])
    first /= np.linalg.norm(first)
    second = np.cross(n, first)
    rings = [(0.0, 1), (0.35, 6), (0.7, 12), (0.93, 18)]
    flat = np.array([(r * np.cos(2 * np.pi * k / m), r * np.sin(2 * np.pi * k / m)) for r, m in rings for k in range(m)])
    wanted = spot[0] + radius * (stretch * flat[:, :1] * first + flat[:, 1:2] * second)
    found, turned, rows = skin.project(wanted)
    good = (np.linalg.norm(found - wanted, axis=1) < MOVED_M) & (turned @ n > 0.7)
    good[0] = True
    r = np.hypot(flat[:, 0], flat[:, 1])
    weight = np.ones(len(r)) if uniform else np.sqrt(1 - r**2)
    weight = np.where(good, weight, 0.0)[good]
    _, _, triad = skin.project(np.stack([spot[0], spot[0] + radius * first, spot[0] + radius * second]))
    return Patch(rows[good], weight / weight.sum(), triad, spot[0], float(good.mean()))


@dataclass(frozen=True, eq=False)
class Placed:
    """A touch on this body."""

    touch: Touch
    item: Shape
    place: Array
    """At rest [m]."""
    along: Array
    """Direction of the slide and of the tangential force, and across a rod."""
    radius: float
    """Of the patch [m]."""
    stretch: float
    deflection: float
    """How far the full force would move it, to first order [m]."""

    def patch(self, skin: Skin, share: float) -> Patch:
        """Its patch when a share of the slide is done."""
        across = self.along
        if self.item.kind == "rod":
            _, normal, _ = skin.project(self.place[None])
            across = np.cross(normal[0], self.along)
        place = self.place + (share - 0.5) * self.touch.slide_m * self.along
        return patch(skin, place, self.radius, across, self.stretch, uniform=self.item.kind == "plate")

    def objects(self, spread: Patch, x: Array, away: float) -> list[tuple[Array, Array]]:
        """The object against the deformed patch, or a distance away along the normal [m]."""
        center, n = spread.center(x), spread.normal(x)
        along = np.cross(n, self.along) if self.item.kind == "rod" else self.along
        side = np.asarray(spread.rows @ x) - center
        height = side @ n
        across = side - np.outer(height, n)
        if self.item.kind == "rod":
            unit = along - n * (along @ n)
            unit /= np.linalg.norm(unit)
            across = across - np.outer(across @ unit, unit)
        r = self.item.radius
        lift = 0.0 if self.item.kind == "plate" else r - np.sqrt(np.maximum(r**2 - np.sum(across**2, axis=1), 0.0))
        shift = float(np.sum(spread.weight * (height - lift)))
        return posed(self.item, center + (shift + away) * n, n, along)


def draw(
    body: Body, skin: Skin, camera: Camera, free: tuple[Array, Shot], touches: tuple[Touch, ...], rng: np.random.Generator
) -> list[Placed]:
    """Places for the touches: in the camera's sight or out of it, apart from each other, on the flat of a face."""
    x, shot = free
    done: list[Placed] = []
    size = np.ptp(body.points, axis=0)
    apart = max(0.025, 0.22 * float(size.max()))
    for touch in touches:
        for attempt in range(4000):
            placed = _candidate(body, skin, touch, size, rng)
            spread = placed.patch(skin, 0.5)
            ends = [placed.patch(skin, share) for share in (0.0, 1.0)] if touch.slide_m else []
            if min(p.whole for p in (spread, *ends)) < 0.8:
                continue
            center, n = spread.center(x), spread.normal(x)
            view = camera.pose[:3, 3] - center
            cosine = n @ view / np.linalg.norm(view)
            clear = (center + 2.2 * placed.item.radius * n)[2] > body.ground + 0.01
            open_ = bool(seen(camera, center[None] + 1e-3 * n, shot)[0])
            fits = (cosine < -0.35 and not open_) if touch.hidden else (cosine > 0.3 and open_)
            near = any(np.linalg.norm(placed.place - other.place) < apart for other in done)
            if fits and clear and not near:
                done.append(placed)
                break
            if attempt == 3999:
                raise RuntimeError(f"no place for {touch} on {body.name}")
    return done


def _candidate(body: Body, skin: Skin, touch: Touch, size: Array, rng: np.random.Generator) -> Placed:
    low, high = body.touchable
    inside = np.flatnonzero(np.all((skin.rest > low) & (skin.rest < high), axis=1))
    place = skin.rest[rng.choice(inside)] + rng.normal(scale=0.003, size=3)
    place = skin.project(place[None])[0][0]
    long = (
        np.eye(3)[int(np.argmax(size))]
        if size.max() > 2 * np.sort(size)[1]
        else place * [1, 1, 0] + rng.normal(scale=1e-3, size=3)
    )
    along = long / np.linalg.norm(long) * rng.choice([-1, 1])
    if touch.tangent and not touch.slide_m:
        along = along + rng.normal(scale=0.5, size=3)
        along /= np.linalg.norm(along)
    radius = {"ball": rng.uniform(0.007, 0.010), "rod": rng.uniform(0.0035, 0.005), "plate": rng.uniform(0.005, 0.0065)}[
        touch.kind
    ]
    if body.name == "pad" and touch.kind == "plate":
        radius = rng.uniform(0.009, 0.012)
    radius *= touch.scale
    spread = {"ball": body.patch, "rod": 0.6 * body.patch, "plate": min(0.005, 0.9 * radius)}[touch.kind]
    return Placed(
        touch, shape(touch.kind, radius), place, along, spread, 3.0 if touch.kind == "rod" else 1.0, rng.uniform(*body.yields)
    )
