"""A case into files: robot, recording, truth."""

from __future__ import annotations

import json
import time
import zlib
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from . import bodies
from .bodies import GRAVITY, Body, listed, write_robot
from .camera import (
    COLORS,
    Camera,
    camera_table,
    directions,
    look_at,
    measure,
    nudged,
    paint,
    seen,
    shoot,
    write_cloud,
    write_images,
)
from .cases import AFTER, FREE, TOUCHED, Case
from .equilibrium import Problem
from .scene import OBJECT, ROBOT, Shape, Skin, table
from .solid import Array, Cable, Load, Solid, State
from .touching import Patch, Placed, draw

MARKER_STD_M = 0.0003
MARKERS = 10
TABLE_SHARE = 0.08
AWAY_M = 0.03
RATE_S = 0.2


@dataclass(eq=False)
class Take:
    """What was computed and measured of a case, frame by frame."""

    states: list[State] = field(default_factory=list)
    contacts: list[dict[str, object]] = field(default_factory=list)
    certificates: list[dict[str, float]] = field(default_factory=list)
    marker_rows: list[str] = field(default_factory=list)
    markers: list[Array] = field(default_factory=list)
    """Where the markers are in each frame [m]."""
    object_color: Array = field(default_factory=lambda: np.zeros(3))


def make(
    case: Case,
    folder: Path,
    seed: int,
    *,
    diamond: Path | None = None,
    plain: bool = False,
    stretch_limit: float = np.inf,
) -> dict[str, object]:
    """Write one case below a folder and return its truth; `plain`: without the optional tables on noise and tools; `stretch_limit`: Jm of Gent's law."""
    case = replace(case, declared_noise=False, tool=False) if plain else case
    begin = time.perf_counter()
    rng = np.random.default_rng([seed, zlib.crc32(case.name.encode())])
    body = bodies.diamond(rng, _needed(diamond)) if case.robot == "diamond" else getattr(bodies, case.robot)(rng)
    body = body.touched_near_clamp() if case.near_clamp else body
    solid = Solid(body.truth, body.young, body.poisson, body.density, GRAVITY, body.fixed, stretch_limit)
    skin = Skin(solid)
    problem = Problem(solid, [Cable(t.name, solid.rows(t.path), t.pull) for t in body.tendons])
    camera = _camera(case, body, rng)
    markers = _markers(body, skin, rng)
    write_robot(folder / "robot", body, markers, colors=case.colors)
    take = Take()
    zero = rng.uniform(0.1, 0.35, len(body.tendons)) * body.tension * (case.zero == "unknown")
    for tension in _free_inputs(case, body, zero, rng):
        load = Load(1.0, tension, np.zeros_like(tension), np.zeros(len(tension), bool), np.zeros_like(solid.rest))
        take.states.append(problem.solve(load, take.states[-1] if take.states else problem.at_rest()))
    x = take.states[-1].x
    shot = shoot(camera, (np.asarray(skin.rows @ x), skin.tri), [], table(body.ground))
    placed = draw(body, skin, camera, (x, shot), case.touches, rng)
    _touch(case, body, problem, skin, placed, take, rng)
    _film(case, folder / "recording", body, problem, skin, camera, placed, markers, take, rng)
    _tables(case, folder / "recording", body, problem, camera, placed, zero, take)
    truth = {
        "case": case.name,
        "seed": seed,
        "law": f"compressible {'neo-Hookean' if np.isinf(stretch_limit) else f'Gent, Jm = {stretch_limit:g},'} with the declared moduli",
        "mesh": f"{solid.mesh.nelements} cells, {len(solid.rest)} nodes, {type(solid.element).__name__}",
        "contacts": take.contacts,
        "T_robot_camera": listed(camera.pose),
        "nudges": [list(nudge) for nudge in case.nudges],
        "initial_tension_n": {t.name: float(v) for t, v in zip(body.tendons, zero)},
        "tension_n": [listed(s.tension) for s in take.states],
        "frames": len(take.states),
        "certificate": {
            "worst_residual_n": max(s.residual_n for s in take.states),
            "worst_energy_slope": max((abs(c["energy_slope"]) for c in take.certificates), default=0.0),
            "least_energy_curvature_j": min((c["energy_curvature_j"] for c in take.certificates), default=0.0),
        },
        "markers_m": {k: listed(v) for k, v in markers.items()},
        "ground_m": body.ground,
        "object_rgb": listed(take.object_color),
        "marker_positions_m": [listed(places) for places in take.markers],
        "made_in_s": round(time.perf_counter() - begin, 1),
    }
    (folder / "truth.json").write_text(json.dumps(truth, indent=1), encoding="utf-8")
    return truth


def _needed(folder: Path | None) -> Path:
    if folder is None or not (folder / "diamond.vtu").exists():
        raise FileNotFoundError("the diamond's cases need --diamond FOLDER with diamond.vtu")
    return folder


def _camera(case: Case, body: Body, rng: np.random.Generator) -> Camera:
    low, high = body.points.min(axis=0), body.points.max(axis=0)
    target = (low + high) / 2 + rng.normal(scale=0.004, size=3)
    elevation = rng.uniform(0.6, 1.0) if case.robot in ("pad", "diamond", "slab") else rng.uniform(0.25, 0.75)
    azimuth = rng.uniform(-np.pi, np.pi) if case.robot not in ("bar", "slab") else rng.choice([-1, 1]) * rng.uniform(0.9, 2.1)
    pose = look_at(target, case.distance_m * rng.uniform(0.95, 1.05), azimuth, elevation, rng.normal(scale=0.1))
    amount = (0.002, 0.0) if case.camera == "stereo" else (0.0003, 0.0008)
    return Camera(case.camera, pose, amount, 0.3 if case.hard else 0.1, 0.5 if case.hard else 0.2)


def _markers(body: Body, skin: Skin, rng: np.random.Generator) -> dict[str, Array]:
    """Places spread over the surface, clear of the clamp, farthest first."""
    clear = np.any((skin.rest < body.fixed[0] - 0.004) | (skin.rest > body.fixed[1] + 0.004), axis=1)
    points = skin.rest[clear]
    chosen = [points[rng.integers(len(points))]]
    while len(chosen) < MARKERS:
        far = np.min([np.linalg.norm(points - c, axis=1) for c in chosen], axis=0)
        chosen.append(points[int(np.argmax(far * rng.uniform(0.8, 1.0, len(far))))])
    return {f"m{k}": place.round(7) for k, place in enumerate(chosen)}


def _free_inputs(case: Case, body: Body, zero: Array, rng: np.random.Generator) -> list[Array]:
    count = len(body.tendons)
    least = 0.15 if case.control == "displacement" else 0.0
    rows = [zero + least * body.tension]
    for _ in range(FREE - 1):
        some = rng.random(count) < 0.7
        rows.append(zero + body.tension * np.where(some, rng.uniform(0.25, 1.0, count), least))
    return rows


def _touch(
    case: Case, body: Body, problem: Problem, skin: Skin, placed: list[Placed], take: Take, rng: np.random.Generator
) -> None:
    """The touched frames and those after them."""
    calm = take.states[-1]
    held = np.full(len(body.tendons), case.control == "displacement")
    largest = [_largest(problem, skin, calm, one) for one in placed]
    base, cord = calm.tension, problem.shortening(calm.x)
    hop = rng.uniform(0.3, 0.7, len(base)) * body.tension if case.jump else np.zeros(len(base))
    swing = 5.0 if case.calm else 1.0
    for k in range(case.calm or TOUCHED + AFTER):
        before = take.states[-1]
        drift = 0.08 * swing * body.tension * np.sin(0.5 * k + np.arange(len(base)))
        tension = np.maximum(base + drift + hop * (k in (0, 1, 2, 6, 7)), 0.0)
        shortening = cord + 4e-4 * swing * np.sin(0.5 * k + np.arange(len(base))) + 0.002 * (hop > 0) * (k in (0, 1, 2, 6, 7))
        total = np.zeros_like(before.x)
        for number, (one, most) in enumerate(zip(placed, largest)):
            level = _level(case, k, one)
            if level == 0.0:
                continue
            spread = one.patch(skin, k / (TOUCHED - 1))
            force = level * most * _direction(one, spread, before.x)
            total += np.asarray(spread.row.T @ force[None])
            take.contacts.append({"frame": FREE + k, "contact": number, "force": force, "patch": spread})
        take.states.append(problem.solve(Load(1.0, tension, shortening, held, total), before))


def _level(case: Case, k: int, one: Placed) -> float:
    last = TOUCHED
    if case.calm or k < one.touch.first or k >= last or k in case.released:
        return 0.0
    if case.jump:
        return (1.0, 1.0, 0.6, 0.6, 1.0, 0.3, 1.0, 1.0, 0.5, 0.8)[k]
    return 0.2 + 0.8 * (k - one.touch.first) / (last - 1 - one.touch.first)


def _direction(one: Placed, spread: Patch, x: Array) -> Array:
    n = spread.normal(x)
    side = one.along - n * (one.along @ n)
    out = -n + one.touch.tangent * side / np.linalg.norm(side)
    return out / np.linalg.norm(out)


def _largest(problem: Problem, skin: Skin, calm: State, one: Placed) -> float:
    """The force that moves the touched place by its drawn deflection, to first order [N]."""
    spread = one.patch(skin, 0.5)
    direction = _direction(one, spread, calm.x)
    push = np.asarray(spread.row.T @ direction[None])
    moved = np.asarray(spread.row @ problem.yielding(calm, push[:, :, None])[:, :, 0])[0]
    return float(one.deflection / (moved @ direction))


def _film(
    case: Case,
    folder: Path,
    body: Body,
    problem: Problem,
    skin: Skin,
    camera: Camera,
    placed: list[Placed],
    markers: dict[str, Array],
    take: Take,
    rng: np.random.Generator,
) -> None:
    """Clouds or images, markers, the places on the deformed body and what the camera could tell of the forces."""
    color = take.object_color = COLORS[OBJECT][rng.integers(len(COLORS[OBJECT]))]
    where = problem.solid.rows(np.stack(list(markers.values())))
    for frame, state in enumerate(take.states):
        here = [c for c in take.contacts if c["frame"] == frame]
        objects: list[tuple[Array, Array]] = []
        for number, one in enumerate(placed if frame >= FREE else []):
            mine = [c["patch"] for c in here if c["contact"] == number]
            spread = mine[0] if mine else one.patch(skin, float((frame - FREE) >= TOUCHED))
            objects += one.objects(spread, state.x, 0.0 if mine else _away(case, frame))
        at = nudged(camera, *case.nudges[frame - FREE], rng) if case.nudges and frame >= FREE else camera
        shot = shoot(at, (np.asarray(skin.rows @ state.x), skin.tri), objects, table(body.ground - 9.0 * case.bare))
        z = measure(camera, shot, rng)
        picture = paint(shot, np.array(body.color), color, camera, rng) if case.colors else None
        if case.images:
            write_images(folder, frame, z, picture, 1e-4)
        else:
            write_cloud(folder / "clouds" / f"{frame:06d}.ply", z, picture, (shot.kind != 2) | (rng.random(z.size) < TABLE_SHARE))
        places = np.asarray(where @ state.x)
        take.markers.append(places)
        if frame < FREE:
            visible = seen(camera, places, shot)
            visible |= visible.sum() < 4
            noisy = camera.to_camera(places) + rng.normal(scale=MARKER_STD_M, size=places.shape)
            take.marker_rows += [f"{frame},{n},{p[0]:.6f},{p[1]:.6f},{p[2]:.6f}" for n, p, v in zip(markers, noisy, visible) if v]
        if here:
            _certify(problem, skin, camera, state, shot.kind, shot, z, here, rng, take)
    for contact in take.contacts:
        spread = contact.pop("patch")
        x = take.states[int(contact["frame"])].x
        one = placed[int(contact["contact"])]
        contact |= {"point": listed(spread.center(x)), "normal": listed(spread.normal(x)), "rest": listed(spread.rest)}
        contact |= {
            "force": listed(contact["force"]),
            "kind": one.item.kind,
            "hidden": one.touch.hidden,
            "patch_radius_m": one.radius,
            "object_radius_m": one.item.radius,
            "along": listed(one.along),
        }


def _away(case: Case, frame: int) -> float:
    """How far an object that does not touch is from the robot [m]."""
    return AWAY_M * (0.1 + 0.9 * abs(np.sin(0.13 * frame))) if case.calm else AWAY_M


def _certify(
    problem: Problem, skin: Skin, camera: Camera, state: State, kind: Array, shot: object, z: Array, here: list, rng, take: Take
) -> None:
    """Certificate of the equilibrium, and the bound of Cramér and Rao for |f| at the true places."""
    take.certificates.append(problem.certificate(state, rng))
    rows = np.concatenate([_unit(c["patch"]) for c in here], axis=2)
    moved = problem.yielding(state, rows)
    ray = directions()
    used = np.flatnonzero((kind == ROBOT) & (z > 0))
    normal = shot.normal[used]
    slant = np.einsum("ij,ij->i", normal, ray[used] @ camera.pose[:3, :3].T)
    keep = np.abs(slant) / np.linalg.norm(ray[used], axis=1) > 0.25
    used, normal, slant = used[keep], normal[keep], slant[keep]
    hits = skin.at(shot.triangle[used], shot.uv[used])
    by = sum((hits @ moved[:, axis, :]) * normal[:, axis : axis + 1] for axis in range(3))
    by = by / (camera.std(shot.depth[used]) * np.abs(slant))[:, None]
    spread = np.linalg.inv(by.T @ by + np.eye(by.shape[1]) / 100.0)
    for k, contact in enumerate(here):
        force = contact["force"]
        size = np.linalg.norm(force)
        unit = force / size
        contact["bound_rel"] = float(np.sqrt(unit @ spread[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] @ unit) / size)


def _unit(spread: Patch) -> Array:
    """Unit forces on a patch, (n, 3, 3)."""
    share = np.asarray(spread.row.todense())[0]
    return share[:, None, None] * np.eye(3)


def _tables(
    case: Case, folder: Path, body: Body, problem: Problem, camera: Camera, placed: list[Placed], zero: Array, take: Take
) -> None:
    """frames.csv, markers.csv and recording.toml."""
    names = [t.name for t in body.tendons]
    rows = [",".join(["frame", "time_s", "free", *(f"cable_{n}" for n in names)])]
    for frame, state in enumerate(take.states):
        values = problem.shortening(state.x) if case.control == "displacement" else state.tension - zero
        rows.append(",".join([str(frame), f"{RATE_S * frame:.3f}", str(int(frame < FREE)), *(f"{v:.7f}" for v in values)]))
    (folder / "frames.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    (folder / "markers.csv").write_text("\n".join(["frame,marker,x_m,y_m,z_m", *take.marker_rows]) + "\n", encoding="utf-8")
    lines = ['format = "femsense-recording-1"', f'actuation = "{case.control}"', f'actuation_zero = "{case.zero}"']
    lines += [f"marker_noise_m = {MARKER_STD_M}"] if case.declared_noise else []
    lines += camera_table(camera, unit=1e-4, noise=case.declared_noise) if case.images or case.declared_noise else []
    tool: Shape | None = placed[0].item if case.tool else None
    if tool is not None:
        lines += ["", "[[tools]]", 'name = "ball"', f"radius_m = {tool.radius:.6f}"]
    (folder / "recording.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
