"""Cases of `benchmarks/sensing.py --suite`: a robot, its control, a camera and touches, drawn from a seed.

They are scripts of the virtual rig. The truth has half the element size, quadratic elements and the neo-Hookean law; robot.toml declares no law.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from femsense import Robot, load_robot, solve_equilibrium
from femsense.fem.compliance import tangent_at
from femsense.fem.mesh import vertex_normals
from femsense.model.contact_patch import body_surface, flat_nodes, patch_at
from femsense.pointcloud.rays import Surface

DIAMOND = Path(__file__).resolve().parents[2] / "shared" / "data" / "diamond"
ROBOTS = ("arm", "finger", "gripper", "four-leg", "pneu-finger", "diamond")
DISTANCES_M = {"near": 0.35, "far": 0.7}
NOISES = {"stereo": {"kind": "stereo", "like": "D415"}, "tof": {"kind": "time-of-flight"}}
FREE, TOUCHED = 6, 8
DEFLECTION_M = (0.004, 0.008)
"""How far the touched place gives way, to first order."""
OBJECTS = (
    {"kind": "ball", "radius_m": 0.008},
    {"kind": "rod", "radius_m": 0.004, "length_m": 0.08},
    {"kind": "plate", "size_m": [0.012, 0.012, 0.003]},
)


@dataclass(frozen=True)
class Case:
    """One recording."""

    robot: str
    control: str
    camera: str
    distance: str
    touches: int

    @property
    def name(self) -> str:
        """Such as arm-tension-stereo-near-2."""
        return f"{self.robot}-{self.control}-{self.camera}-{self.distance}-{self.touches}"


def cases() -> list[Case]:
    """Return all cases: each robot once, then each once more with another of the rest."""
    rest = [c for c in product(("tension", "displacement"), NOISES, DISTANCES_M, (1, 2, 3))]
    order = np.random.default_rng(0).permutation(len(rest))
    made = [Case(robot, *rest[order[(i + 5 * n) % len(rest)]]) for i in range(len(rest)) for n, robot in enumerate(ROBOTS)]
    return [case for case in made if case.robot != "pneu-finger" or case.control == "tension"]  # pressures, no lengths


def robot_of(case: Case) -> Robot:
    """Return the robot as the estimator knows it."""
    return load_robot(DIAMOND if case.robot == "diamond" else case.robot)


def script_of(case: Case, robot: Robot, seed: int) -> dict[str, Any]:
    """Return the script of a case."""
    rng = np.random.default_rng([seed, zlib.crc32(case.name.encode())])
    eye, target = _camera(case, robot, rng)
    inputs = _inputs(case, robot, rng)
    calm = {name: [float(v) for v in values[:FREE]] for name, values in inputs.items()}
    during = {name: [float(v) for v in values[FREE:]] for name, values in inputs.items()}
    kind = "chambers" if robot.body.chambers else "cables"
    objects = [{"name": f"object-{i}", **OBJECTS[(i + int(rng.integers(3))) % 3]} for i in range(case.touches)]
    contacts = []
    for i, (place, force) in enumerate(_places(case, robot, eye, rng)):
        levels = np.clip((np.arange(TOUCHED) - i) / (TOUCHED - 1 - i), 0.0, 1.0)
        ramp = np.where(np.arange(TOUCHED) >= i, 0.2 + 0.8 * levels, 0.0)
        contacts.append(
            {
                "sweep": "touch",
                "object": f"object-{i}",
                "point_m": place.tolist(),
                "force_n": (force * ramp).tolist(),
                "away_m": 0.03,
            }
        )
    return {
        "format": "femsense-script-1",
        "seed": int(rng.integers(2**31)),
        "actuation": case.control,
        "sweeps": [
            {"label": "free", kind: calm, "rest": 0, "up": 0, "hold": FREE, "down": 0, "free": True},
            {"label": "touch", kind: during, "rest": 0, "up": 0, "hold": TOUCHED, "down": 0},
        ],
        "objects": objects[: len(contacts)],
        "contacts": contacts,
        "camera": {"eye_m": eye.tolist(), "target_m": target.tolist(), "noise": NOISES[case.camera], "declare_pose": True},
        "clouds": {"kind": "ply"},
        "markers": {"std_m": 0.3e-3},
    }


def _camera(case: Case, robot: Robot, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    nodes = robot.body.mesh.nodes
    target = 0.5 * (nodes.min(axis=0) + nodes.max(axis=0))
    azimuth, elevation = rng.uniform(-np.pi, np.pi), rng.uniform(0.3, 0.9)
    look = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    return target + DISTANCES_M[case.distance] * rng.uniform(0.95, 1.05) * look, target


def _inputs(case: Case, robot: Robot, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return tensions, pressures or lengths of each frame; lengths are those of the declared body under such tensions."""
    body = robot.body
    if body.chambers:
        names, most = body.chamber_names, np.array([chamber.max_pressure for chamber in body.chambers])
    else:
        names, most = body.cable_names, np.array([min(cable.max_tension, 2.0) for cable in body.cables])
    least = 0.1 if case.control == "displacement" else 0.0
    levels = [np.full(len(names), least)]
    levels += [np.where(rng.random(len(names)) < 0.7, rng.uniform(0.2, 0.6, len(names)), least) for _ in range(FREE - 1)]
    levels += [np.clip(levels[-1] + 0.04 * np.sin(0.5 * k + np.arange(len(names))), least, 1.0) for k in range(TOUCHED)]
    table = np.array(levels) * most
    if case.control == "displacement":
        states = [solve_equilibrium(body, tension=dict(zip(names, row))) for row in table]
        table = np.array([[state.shortening[name] for name in names] for state in states])
    return dict(zip(names, table.T))


def _places(case: Case, robot: Robot, eye: np.ndarray, rng: np.random.Generator) -> list[tuple[np.ndarray, float]]:
    """Return places that the camera sees, far from the clamp and from each other, and forces that move each by what is drawn."""
    body, state = robot.body, solve_equilibrium(robot.body)
    nodes, surface = body.mesh.nodes, body_surface(body.mesh)
    size = float(np.linalg.norm(np.ptp(nodes, axis=0)))
    chosen = flat_nodes(surface, nodes)
    seen = Surface(state.positions, surface.triangles).cast(
        state.positions[chosen] + 1e-6 * vertex_normals(state.positions, surface.triangles)[chosen],
        np.tile(eye, (len(chosen), 1)),
        reach=1e-4,
    )
    clamped = nodes[body.clamped]
    places: list[np.ndarray] = []
    for node in rng.permutation(chosen[seen.index]):
        away = np.linalg.norm(clamped - nodes[node], axis=1).min() > 0.25 * size
        if away and all(np.linalg.norm(nodes[node] - p) > 0.2 * size for p in places):
            places.append(nodes[node])
        if len(places) == case.touches:
            break
    tangent, result = tangent_at(body, state), []
    for place in places:
        patch = patch_at(surface, nodes, place, 0.5 * surface.edge, body.clamped)
        normal = patch.mean(vertex_normals(state.positions, surface.triangles))
        normal /= np.linalg.norm(normal)
        gives = float(-normal @ patch.mean(tangent.respond(patch.spread(-normal, len(nodes))[None])[0]))
        result.append((place, float(rng.uniform(*DEFLECTION_M)) / gives))
    return result
