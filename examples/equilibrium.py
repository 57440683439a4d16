"""The four-leg robot under its cables: an equilibrium, and how it gives way to a force at its top.

python examples/equilibrium.py
"""

from __future__ import annotations

import numpy as np

import femsense as fs

robot = fs.load_robot("four-leg")
relaxed = fs.solve_equilibrium(robot.body)
pulled = fs.solve_equilibrium(robot.body, tension={"north": 1.0, "west": 0.5}, start=relaxed)

top = robot.body.mesh.nodes[robot.body.mesh.nodes[:, 2].argmax()]
W = fs.compliance(robot.body, pulled, points=np.tile(top, (3, 1)), directions=np.eye(3))  # m/N: three directions, then the cables
force = np.array([0.0, 0.0, -0.1])
sag = W[:3, :3] @ force

if __name__ == "__main__":
    moved = np.linalg.norm(pulled.positions - relaxed.positions, axis=1).max()
    print(f"{pulled.status} after {pulled.iterations} iterations, unbalanced force {pulled.residual_n:.1e} N")
    print(f"the cables move the body by up to {1e3 * moved:.2f} mm")
    for name, length in pulled.shortening.items():
        print(f"  cable {name:<6} {pulled.tension[name]:.2f} N, shortened by {1e3 * length:+.2f} mm")
    print(f"0.1 N down on its top lowers the top by {-1e3 * sag[2]:.3f} mm")
