"""What the experiment advisor proposes for the robots that come along, and what that costs.

python benchmarks/plan.py [ROBOT …]
"""

from __future__ import annotations

import sys
import time

from femsense.loop.advice import proposal_text
from femsense.loop.plan import plan_experiment
from femsense.robot import load_robot


def main() -> None:
    for name in sys.argv[1:] or ("finger", "arm"):
        robot = load_robot(name)
        wall, cpu = time.perf_counter(), time.process_time()
        proposal = plan_experiment(robot)
        print(f"\n{name}: {time.perf_counter() - wall:.0f} s, {time.process_time() - cpu:.0f} s of one processor\n")
        print(proposal_text(proposal))


if __name__ == "__main__":
    main()
