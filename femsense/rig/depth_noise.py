"""Error models of depth cameras.

Stereo. Depth z [m] comes from a disparity d = f b / z,
so that its standard deviation grows as z² · subpixel / (f · baseline), and disparities come in steps (Grunnet-Jepsen, Sweetser
and Woodfill, "Tuning depth cameras for best performance", Intel: a well tuned camera shows a subpixel error below 0.1; the D415
has a baseline of 55 mm and 65° of view). Disparities are matched over windows, so that errors of neighbours are correlated and the
foreground bleeds over the background. Points that only one imager sees have no depth. Low signal and specular reflections
give no match.

Time of flight. The depth of a pixel is the amplitude-weighted mean over the returning light: mixed pixels at the edge of two surfaces
lie between them, and in a corner light with a second bounce arrives later. Noise is inversely proportional to the amplitude (Frank
et al. 2009, Optical Engineering 48:013602).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray, IntArray
from femsense.model.camera import Camera
from femsense.rig.camera_tables import NoiseTable

EDGE = 0.01
"""Neighbouring depths that differ by more than this form an edge [m]."""
STEEP = 4.0
"""Exponent of the dropout probability below `dark_signal`."""
BLOB_PX = 3.0
"""Width of the patches in which a stereo matcher loses dark or shiny surfaces [px]."""
BOUNCES = 300
"""Number of source points of second bounces."""
BATCH = 4096
"""Number of pixels whose second bounces are summed at once."""


@dataclass(frozen=True, eq=False, slots=True)
class Sight:
    """The hits of the rays of a camera."""

    rays: FloatArray
    """With z = 1, camera frame, shape (H, W, 3)."""
    depth: FloatArray
    """[m], shape (H, W); inf: no hit."""
    shape: IntArray
    """Index of the shape, shape (H, W); −1: no hit."""
    normal: FloatArray
    """Unit normals towards the camera, camera frame, shape (H, W, 3)."""
    facing: FloatArray
    """Cosine between ray and normal, shape (H, W); 0: no hit."""
    albedo: FloatArray
    """Diffuse reflectance in the infrared [1], shape (H, W)."""
    gloss: FloatArray
    """Probability that a depth is lost at a specular reflection [1], shape (H, W)."""


def disturbed(sight: Sight, noise: NoiseTable, camera: Camera, rng: np.random.Generator) -> FloatArray:
    """Return depths with the errors of a camera [m], shape (H, W); 0: no measurement."""
    if noise.kind == "perfect":
        return np.where(sight.shape >= 0, sight.depth, 0.0)
    depth = _stereo(sight, noise, camera, rng) if noise.kind == "stereo" else _time_of_flight(sight, noise, rng)
    step = noise.quantum_m or camera.depth_unit
    return np.asarray(np.rint(depth / step) * step)


def depth_std(depth: FloatArray, noise: NoiseTable, camera: Camera) -> FloatArray:
    """Return the standard deviation of depths of a stereo camera [m], σ_z = z² σ_d / (f b)."""
    focal = camera.fx if noise.focal_px is None else noise.focal_px
    return np.asarray(depth**2 * noise.subpixel_px / (focal * noise.baseline_m))


# Stereo


def _stereo(sight: Sight, noise: NoiseTable, camera: Camera, rng: np.random.Generator) -> FloatArray:
    """Return depths with noise, disparity steps and gaps."""
    depth = np.where(sight.shape >= 0, sight.depth, 0.0)
    common = _smooth_noise(depth.shape, noise.correlation_px, rng)
    own = rng.standard_normal(depth.shape)
    share = noise.correlated_share
    edge, front, back = _edges(depth)
    chance, between = rng.random(depth.shape), rng.random(depth.shape)
    matched = _bled(depth, noise.bleeding_px, rng) if noise.bleeding_px else depth
    result = matched + depth_std(matched, noise, camera) * (np.sqrt(share) * common + np.sqrt(1.0 - share) * own)
    if noise.disparity_step_px:
        result = _stepped(result, noise, camera)
    flying = edge & (chance < noise.flying_share) & (front > 0)
    result[flying] = (front + between * (back - front))[flying]
    gone = edge & ~flying & (chance < noise.flying_share + noise.edge_dropout)
    gone |= (sight.facing < np.cos(np.radians(noise.grazing_deg))) & (matched == depth)
    if noise.shadows:
        gone |= shadowed(depth, camera.fx * noise.baseline_m)
    if noise.dark_signal or noise.shiny_deg:
        gone |= _unmatched(sight, noise, rng)
    return np.asarray(np.where(gone | (matched <= 0), 0.0, result))


def shadowed(depth: FloatArray, focal_times_baseline: float) -> BoolArray:
    """Return which pixels of the left imager are occluded for the right one, shape (H, W).

    Column u maps to column u − d of the right imager, d = f b / z;
    it is hidden if a column farther right maps to it or to the left of it.
    """
    disparity = np.divide(focal_times_baseline, depth, out=np.zeros_like(depth), where=depth > 0)
    column = np.arange(depth.shape[1]) - disparity
    from_right = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    hidden = np.zeros(depth.shape, dtype=bool)
    hidden[:, :-1] = from_right[:, 1:] < column[:, :-1] - 1e-9
    return np.asarray(hidden & (depth > 0))


def _bled(depth: FloatArray, reach: float, rng: np.random.Generator) -> FloatArray:
    """Return depths with depth bleeding: foreground extended over the background by up to `reach` pixels, varying smoothly."""
    from scipy.ndimage import minimum_filter

    extent = reach * _uniform(_smooth_noise(depth.shape, BLOB_PX, rng))
    solid = np.where(depth > 0, depth, np.inf)
    result = depth.copy()
    for r in range(int(np.ceil(reach)), 0, -1):
        nearest = minimum_filter(solid, 2 * r + 1)
        grown = (extent >= r - 0.5) & (depth > 0) & (depth - nearest > EDGE)
        result[grown] = nearest[grown]
    return result


def _stepped(depth: FloatArray, noise: NoiseTable, camera: Camera) -> FloatArray:
    """Return depths with quantised disparities."""
    unit = (camera.fx if noise.focal_px is None else noise.focal_px) * noise.baseline_m / noise.disparity_step_px
    steps = np.rint(np.divide(unit, depth, out=np.zeros_like(depth), where=depth > 0))
    return np.asarray(np.divide(unit, steps, out=np.zeros_like(depth), where=steps > 0))


def _unmatched(sight: Sight, noise: NoiseTable, rng: np.random.Generator) -> BoolArray:
    """Return the pixels without a stereo match, shape (H, W): too little signal, or a specular reflection that saturates the pattern; in
    patches, not in single pixels."""
    chance = _uniform(_smooth_noise(sight.facing.shape, BLOB_PX, rng))
    signal = np.maximum(sight.albedo * sight.facing, 1e-9)
    dark = 1.0 / (1.0 + (signal / noise.dark_signal) ** STEEP) if noise.dark_signal else np.zeros_like(signal)
    gleam = np.where(sight.facing > np.cos(np.radians(noise.shiny_deg)), sight.gloss, 0.0) if noise.shiny_deg else 0.0
    return np.asarray(chance < np.maximum(dark, gleam))


# Time of flight


def _time_of_flight(sight: Sight, noise: NoiseTable, rng: np.random.Generator) -> FloatArray:
    """Return depths with noise, mixed pixels, second bounces and gaps."""
    from scipy.ndimage import gaussian_filter

    seen = sight.shape >= 0
    depth = np.where(seen, sight.depth, 0.0)
    along = np.linalg.norm(sight.rays, axis=-1)
    signal = np.where(seen, sight.albedo * sight.facing / np.maximum(depth * along, 1e-6) ** 2, 0.0)
    delay = noise.multipath * second_bounce(sight, signal, rng) if noise.multipath else np.zeros(depth.shape)
    light, weighted = signal, signal * (depth + delay / along)
    if noise.mixing_px:
        light, weighted = gaussian_filter(light, noise.mixing_px), gaussian_filter(weighted, noise.mixing_px)
    result = np.divide(weighted, light, out=np.zeros_like(depth), where=light > 0)
    result += noise.amplitude_std_m / np.maximum(light, 1e-9) * rng.standard_normal(depth.shape) / along
    edge, _, _ = _edges(depth)
    gone = (light < noise.least_signal) | ~seen | (edge & (rng.random(depth.shape) < noise.edge_dropout))
    return np.asarray(np.where(gone, 0.0, result))


def second_bounce(sight: Sight, signal: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return the increase of the distance along each ray by light with one more bounce [m], shape (H, W).

    The light path is camera → q → p → camera; surfaces are diffuse, and occlusion between p and q is ignored.
    For the short delays of near surfaces, the phase is the amplitude-weighted mean delay.
    With the irradiance E_q = cos_q / |q|² at q,

        a_p = albedo_q · E_q · cos_pq cos_qp / (π |p − q|²) · A_q  relative to  E_p,       delay = (|q| + |p − q| − |p|) / 2.

    Arguments:
        sight: the hits of the rays.
        signal: amplitude of the first bounce, albedo · cos / |p|² [1/m²], shape (H, W).
        rng: selects the points q.
    """
    seen = np.flatnonzero(sight.shape >= 0)
    if not len(seen):
        return np.zeros(sight.shape.shape)
    points = (sight.rays * np.where(sight.shape >= 0, sight.depth, 0.0)[..., None]).reshape(-1, 3)
    normals, albedo, facing = sight.normal.reshape(-1, 3), sight.albedo.ravel(), np.maximum(sight.facing.ravel(), 0.05)
    q = rng.choice(seen, min(BOUNCES, len(seen)), replace=False)
    distance = np.linalg.norm(points[seen], axis=1)
    pixel = np.abs(np.linalg.norm(sight.rays[0, 0] - sight.rays[min(1, len(sight.rays) - 1), 0]))
    area = (distance * pixel) ** 2 / facing[seen]
    own = dict(zip(seen.tolist(), area.tolist()))
    area_q = np.array([own[i] for i in q.tolist()]) * (area.sum() / max(sum(own[i] for i in q.tolist()), 1e-30))
    sent = albedo[q] * facing[q] / (points[q] ** 2).sum(axis=1) * area_q
    delay = np.zeros(sight.shape.size)
    for start in range(0, len(seen), BATCH):
        p = seen[start : start + BATCH]
        delay[p] = _delay_of(points[p], normals[p], facing[p], points[q], normals[q], sent, area_q)
    return delay.reshape(sight.shape.shape)


def _delay_of(
    p: FloatArray, n: FloatArray, facing: FloatArray, q: FloatArray, m: FloatArray, sent: FloatArray, area: FloatArray
) -> FloatArray:
    """Return the mean delay at points p (k, 3) with normals n by light from points q (j, 3) with normals m [m], shape (k,)."""
    way = q[None] - p[:, None]
    squared = (way**2).sum(axis=2)
    length = np.sqrt(np.maximum(squared, 1e-18))
    leaving = np.maximum(-np.einsum("kjc,jc->kj", way, m), 0.0) / length
    coming = np.maximum(np.einsum("kjc,kc->kj", way, n), 0.0) / length
    light = sent * leaving * coming / (np.pi * squared + area)
    far = np.linalg.norm(p, axis=1)
    delay = 0.5 * (np.linalg.norm(q, axis=1)[None] + length - far[:, None])
    first = facing / far**2
    return np.asarray((light * delay).sum(axis=1) / (first + light.sum(axis=1)))


# Both


def _smooth_noise(shape: tuple[int, ...], width: float, rng: np.random.Generator) -> FloatArray:
    """Return spatially correlated noise of unit variance, shape (H, W)."""
    from scipy.ndimage import gaussian_filter

    impulse = np.zeros((8 * int(np.ceil(width)) + 1,) * 2)
    impulse[impulse.shape[0] // 2, impulse.shape[1] // 2] = 1.0
    gain = np.sqrt((gaussian_filter(impulse, width, mode="wrap") ** 2).sum())
    return np.asarray(gaussian_filter(rng.standard_normal(shape), width, mode="wrap") / gain)


def _uniform(normal: FloatArray) -> FloatArray:
    """Return uniform numbers in [0, 1] from standard normal ones, by their distribution function."""
    from scipy.special import ndtr

    return np.asarray(ndtr(normal))


def _edges(depth: FloatArray) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Return the pixels at depth edges, and the nearest and farthest depth among each pixel and its neighbours, shape (H, W)."""
    from scipy.ndimage import maximum_filter, minimum_filter

    front, back = minimum_filter(depth, 3), maximum_filter(depth, 3)
    return back - front > EDGE, front, back
