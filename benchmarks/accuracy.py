"""What the mesh of each robot costs: the lines of meshes/README.md and docs/guides/accuracy.md.

python benchmarks/accuracy.py                 # the robots that come along
python benchmarks/accuracy.py PATH…           # any robots
python benchmarks/accuracy.py --check         # the estimate on a block against a space with 64 times as many elements
"""

from __future__ import annotations

import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from femsense import block_mesh, embed_points, load_robot, robot_names, solve_equilibrium, write_mesh
from femsense.app.accuracy.assess import assess_accuracy
from femsense.io.files import write_toml
from femsense.model.remeshing import body_on_mesh, finer_mesh


def main(arguments: list[str]) -> None:
    """Print a row for each robot."""
    if arguments == ["--check"]:
        check()
        return
    print("| robot | space | unknowns | motion | error | of the motion | sensed force | s |")
    print("|---|---|---|---|---|---|---|---|")
    for name in arguments or sorted(robot_names()):
        began = time.process_time()
        report = assess_accuracy(load_robot(name))
        print(row(Path(name).name, report, time.process_time() - began), flush=True)


def row(name: str, report: dict[str, Any], seconds: float) -> str:
    """Return the line of a robot: the load with the largest share of error, and the range of the force's error."""
    declared, forces = report["declared"], report["forces"]["error_percent"]
    worst = max(report["loads"], key=lambda load: load["error_percent"] or 0.0)
    if worst["error_percent"] is None:
        return (
            f"| {name} | {declared['element']} | {declared['unknowns']} | {worst['motion_mm']:.1f} mm | not known | | | "
            f"{seconds:.0f} |"
        )
    least = "" if report["reference"]["extrapolated"] else "≥ "
    return (
        f"| {name} | {declared['element']}, {declared['tetrahedra']} | {declared['unknowns']} | {worst['motion_mm']:.1f} "
        f"mm | {least}{worst['error_mm']:.2f} mm "
        f"| {least}{worst['error_percent']:.1f} % | {min(forces):+.0f} … {max(forces):+.0f} % | {seconds:.0f} |"
    )


def check() -> None:
    """Print estimate and truth of the error on blocks of 100 × 30 × 30 mm under their weight."""
    print("| cells | element | estimated error | error against tet10 with 64 times the elements | ratio |")
    print("|---|---|---|---|---|")
    for cells in ((3, 1, 1), (4, 2, 2)):
        mesh = block_mesh([np.linspace(0, size, count + 1) for size, count in zip((0.1, 0.03, 0.03), cells)])
        for element in ("tet4", "tet10"):
            with tempfile.TemporaryDirectory() as folder:
                write_mesh(mesh, Path(folder) / "mesh.vtu")
                write_toml(Path(folder) / "robot.toml", document(element))
                robot = load_robot(folder)
            (weight,) = assess_accuracy(robot)["loads"]
            true = solve_equilibrium(body_on_mesh(robot.body, finer_mesh(mesh, "tet10", 2)))
            fine = embed_points(finer_mesh(mesh, "tet10", 2), robot.body.mesh.nodes[robot.features])
            own = solve_equilibrium(robot.body)
            error = 1e3 * np.linalg.norm(fine.positions(true.positions) - own.positions[robot.features], axis=1).max()
            print(f"| {cells} | {element} | {weight['error_mm']:.3f} mm | {error:.3f} mm | {weight['error_mm'] / error:.2f} |")


def document(element: str) -> dict[str, Any]:
    """Return the tables of a block that is clamped at its left end."""
    return {
        "format": "femsense-robot-1",
        "name": "block",
        "mesh": {"file": "mesh.vtu", "unit": "m", "element": element},
        "material": {"young_modulus_pa": 150e3, "poisson_ratio": 0.45, "density_kg_m3": 1070.0},
        "gravity": {"vector_m_s2": [0.0, 0.0, -9.81]},
        "fixed": [{"box_m": [[-0.001, -0.001, -0.001], [0.001, 0.031, 0.031]]}],
    }


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main(sys.argv[1:])
