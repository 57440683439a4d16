"""The inverse problem: which tensions bring a marker where it is wanted, and what stops it where none do.

python examples/reach.py
"""

from __future__ import annotations

import numpy as np

import femsense as fs

robot = fs.load_robot("four-leg")
name = robot.marker_names[0]
at_rest = fs.solve_equilibrium(robot.body)
place = robot.markers.positions(at_rest.positions)[0]
near = fs.reach(robot, {name: np.add(place, [0.004, 0.002, np.nan])})  # its height is left free
far = fs.reach(robot, {name: np.add(place, [0.2, 0.0, 0.0])}, start=near)

if __name__ == "__main__":
    print(f"4 mm aside: {near.text}")
    for cable, tension in near.inputs.items():
        print(f"  {cable:<6} {tension:.3f} N")
    print(f"200 mm aside: {far.text}")
