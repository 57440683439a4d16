"""The inverse problem of motion: how often targets are reached, how exactly, within which limits, and how fast.

    python benchmarks/reach.py [--targets N] [--robots NAME,…] [--diamond FOLDER]

Targets are where random inputs within the limits bring a point of the body; half of them are then moved out of reach.
The inputs are checked twice: on the model itself, and on another mesh and law (each tetrahedron split into eight,
neo-Hookean), as a real robot would differ from its model. The last column follows a path of targets 0.5 mm apart: so many are
reached in a second of processor time.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import femsense as fs
from femsense import FemsenseError, apply_effects, embed_points
from femsense.model.remeshing import finer_mesh, robot_on_mesh

SEED = 20411
WITHIN = 0.3
"""Inputs are drawn up to this share of their limits (of 5 N where they allow more)."""


@dataclass(frozen=True, slots=True)
class Row:
    """One robot."""

    name: str
    reached: int
    targets: int
    error_m: float
    """Largest error of what is reached [m]."""
    equilibria: float
    """Median number of equilibria a target."""
    seconds: float
    """Median processor time of a target that is near the last one [s]."""
    nearest: int
    """Targets out of reach that end at a state of least error."""
    out: int
    violation: float
    """Largest violation of a limit."""
    elsewhere_m: float
    """Median distance from the target on another mesh and law [m]."""
    rate_hz: float
    """Targets a second of processor time along a path, 0.5 mm apart."""


def driven(robot: fs.Robot, rng: np.random.Generator, start: fs.Equilibrium) -> fs.Equilibrium:
    """Return the state under random inputs, halved until there is one."""
    given = drive(robot, rng)
    for _ in range(6):
        state = fs.solve_equilibrium(robot.body, **given, start=start)
        if state.converged:
            break
        given = {kind: {name: 0.5 * value for name, value in table.items()} for kind, table in given.items()}
    return state


def drive(robot: fs.Robot, rng: np.random.Generator) -> dict[str, dict[str, float]]:
    """Return random inputs."""
    body = robot.body
    tension = {c.name: WITHIN * rng.uniform(0.0, 1.0) * min(c.max_tension, 5.0) for c in body.cables}
    pressure = {
        c.name: WITHIN * rng.uniform(0.0, 1.0) * (c.max_pressure if np.isfinite(c.max_pressure) else 1e4) for c in body.chambers
    }
    return {"tension": tension, "pressure": pressure}


def moving_point(robot: fs.Robot) -> np.ndarray:
    """Return the point of the body farthest from its clamp, at rest [m], shape (3,)."""
    nodes = robot.body.mesh.nodes
    return nodes[np.argmax(np.linalg.norm(nodes - nodes[robot.body.clamped].mean(axis=0), axis=1))]


def measure(robot: fs.Robot, count: int) -> Row:
    """Return how well targets of a robot are reached."""
    rng, point = np.random.default_rng(SEED), moving_point(robot)
    tip, start = embed_points(robot.body.mesh, point[None]), fs.solve_equilibrium(robot.body)
    reached, errors, equilibria, seconds, nearest, out, violations, elsewhere = 0, [], [], [], 0, 0, [], []
    other = elsewhere_robot(robot)
    motion = None
    for k in range(count):
        state = driven(robot, rng, start)
        far = k % 2 == 1
        wanted = tip.positions(state.positions)[0] + far * 0.5 * robot.body.reach * unit(rng)
        began = time.process_time()
        motion = fs.reach(robot, {tuple(point.tolist()): wanted}, start=motion)
        violations.append(motion.certificate.violation)
        if far:
            out += 1
            nearest += motion.status == "nearest"
            continue
        seconds.append(time.process_time() - began)
        reached += motion.status == "reached"
        errors.append(motion.error_m)
        equilibria.append(motion.iterations)
        elsewhere.append(distance_elsewhere(other, robot, motion, point, wanted))
    targets = len(errors)
    return Row(
        robot.name,
        reached,
        targets,
        max(errors),
        float(np.median(equilibria)),
        float(np.median(seconds)),
        nearest,
        out,
        max(violations),
        float(np.nanmedian(elsewhere)),
        following(robot, point, start, rng),
    )


def following(robot: fs.Robot, point: np.ndarray, start: fs.Equilibrium, rng: np.random.Generator) -> float:
    """Return how many targets a second are reached where each is 0.5 mm from the last one."""
    tip = embed_points(robot.body.mesh, point[None])
    first, last = (tip.positions(driven(robot, rng, start).positions)[0] for _ in range(2))
    step = 5e-4 * (last - first) / max(float(np.linalg.norm(last - first)), 1e-12)
    motion, spent = fs.reach(robot, {tuple(point.tolist()): first}, start=start), []
    for k in range(1, 9):
        began = time.process_time()
        motion = fs.reach(robot, {tuple(point.tolist()): first + k * step}, start=motion)
        spent.append(time.process_time() - began)
    return 1.0 / float(np.median(spent))


def unit(rng: np.random.Generator) -> np.ndarray:
    """Return a random direction."""
    direction = rng.normal(size=3)
    return direction / np.linalg.norm(direction)


def elsewhere_robot(robot: fs.Robot) -> fs.Robot | None:
    """Return the robot on another mesh with another law; None where that cannot be made."""
    try:
        finer = robot_on_mesh(robot, finer_mesh(robot.body.mesh, None if robot.body.mesh.is_quadratic else "tet10", 0))
        return apply_effects(finer, [{"name": "hyperelastic", "law": "neo_hookean"}])
    except FemsenseError:
        return None


def distance_elsewhere(
    other: fs.Robot | None, robot: fs.Robot, motion: fs.Motion, point: np.ndarray, wanted: np.ndarray
) -> float:
    """Return how far from its target the point is on the other robot under the same inputs [m]."""
    if other is None:
        return float("nan")
    names = robot.body.cable_names
    state = fs.solve_equilibrium(
        other.body,
        tension={name: motion.inputs[name] for name in names},
        pressure={name: motion.inputs[name] for name in robot.body.chamber_names},
    )
    if not state.converged:
        return float("nan")
    return float(np.linalg.norm(embed_points(other.body.mesh, point[None]).positions(state.positions)[0] - wanted))


def main() -> None:
    """Print one row a robot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--targets", type=int, default=20)
    parser.add_argument("--robots", default="four-leg,finger,arm,gripper,pneu-finger")
    parser.add_argument("--diamond", type=Path, help="the folder of the diamond robot, measured as tet4 and tet10")
    given = parser.parse_args()
    robots = [fs.load_robot(name) for name in given.robots.split(",") if name]
    if given.diamond:
        plain = fs.load_robot(given.diamond)
        robots += [plain, robot_on_mesh(plain, finer_mesh(plain.body.mesh, "tet10", 0))]
    print(
        f"{'robot':<16} {'tets':>6} {'reached':>9} {'error':>9} {'equilibria':>10} {'time':>8} {'nearest':>8} "
        f"{'violation':>10} {'elsewhere':>10} {'path':>8}"
    )
    for robot in robots:
        row = measure(robot, given.targets)
        kind = "tet10" if robot.body.mesh.is_quadratic else "tet4"
        print(
            f"{row.name[:10]:<10} {kind:<5} {len(robot.body.mesh.tets):>6} {row.reached:>4}/{row.targets:<4} "
            f"{1e3 * row.error_m:>6.0e} mm"
            f" {row.equilibria:>10.0f} {1e3 * row.seconds:>5.0f} ms {row.nearest:>4}/{row.out:<3} {row.violation:>10.0e} "
            f"{1e3 * row.elsewhere_m:>7.2f} mm {row.rate_hz:>5.1f} Hz",
            flush=True,
        )


if __name__ == "__main__":
    main()
