"""How many points a tendon in a channel needs: the tentacle of data/tentacle, pulled by one tendon.

    python benchmarks/bodies.py [--tension N]

Prints the table of docs/guides/bodies.md.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from real.tentacle import make_robot

from femsense import load_robot, solve_equilibrium
from femsense.model.tie_spacing import tie_spacing


def main() -> None:
    """Print what each number of points answers."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--tension", type=float, default=0.15 / 0.0325)
    tension = ask.parse_args().tension
    states = {}
    with tempfile.TemporaryDirectory() as folder:
        for count in (128, 8, 16, 32, 64):
            body = load_robot(make_robot(Path(folder) / str(count), points=count)).body
            rest = solve_equilibrium(body).positions
            state = solve_equilibrium(body, tension={"m1": tension})
            spacing = tie_spacing(body, body.cables[0])
            ratio = tension / spacing.buckles_at if spacing else np.nan
            states[count] = (state.positions, np.linalg.norm(state.positions - rest, axis=1).max(), ratio)
    finest, size, _ = states.pop(128)
    print("| points a tendon | tension over Euler's load | moved | off by |\n|---|---|---|---|")
    for count, (positions, moved, ratio) in states.items():
        off = np.linalg.norm(positions - finest, axis=1).max() / size
        print(f"| {count} | {ratio:.2f} | {1e3 * moved:.0f} mm | {100 * off:.1f} % |")


if __name__ == "__main__":
    main()
