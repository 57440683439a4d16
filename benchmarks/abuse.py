"""200 abuses of the equilibrium solver: each ends with a state that certifies itself, a clear status, or an InputError.

    python benchmarks/abuse.py [COUNT]

Prints, for each kind: how the cases ended, the worst unbalanced force of converged states over the sum of their forces,
the longest processor time. Exit status 1 if any case hangs (more than LIMIT seconds of processor time), raises anything else, or
a converged state breaks a rule.
"""

from __future__ import annotations

import signal
import sys
import time
import traceback
import warnings
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "support")]

from abuse import KINDS, Outcome, cases, certify, run_case  # noqa: E402 (the tests hold the cases)

LIMIT = 60
"""Of processor time [s]."""


def main(count: int) -> int:
    """Print the table; return how many cases broke their promise."""
    signal.signal(signal.SIGVTALRM, _too_long)
    ends: dict[str, dict[str, int]] = {kind: defaultdict(int) for kind in KINDS}
    worst, longest = defaultdict(float), defaultdict(float)
    broken = 0
    for case in cases(count):
        signal.setitimer(signal.ITIMER_VIRTUAL, LIMIT)
        began = time.process_time()
        outcome = Outcome("BROKEN")
        try:
            outcome = run_case(case)
            share = certify(outcome) if outcome.state is not None else 0.0
            if outcome.status in ("converged", "unstable"):
                worst[case.kind] = max(worst[case.kind], share)
        except Exception:
            broken += 1
            print(f"--- {case.kind}, case {case.number}")
            traceback.print_exc()
            outcome = Outcome("BROKEN")
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        longest[case.kind] = max(longest[case.kind], time.process_time() - began)
        ends[case.kind][outcome.status] += 1
    _print(ends, worst, longest)
    return broken


def _print(ends: dict[str, dict[str, int]], worst: dict[str, float], longest: dict[str, float]) -> None:
    print(
        "| kind | cases | converged | other ends | worst share of force unbalanced | longest [s CPU] |\n|---|---|---|---|---|---|"
    )
    total: dict[str, int] = defaultdict(int)
    for kind, counts in ends.items():
        for status, n in counts.items():
            total[status] += n
        others = ", ".join(f"{n} {status}" for status, n in sorted(counts.items()) if status != "converged")
        print(
            f"| {kind} | {sum(counts.values())} | {counts.get('converged', 0)} | {others} | {worst[kind]:.0e} | "
            f"{longest[kind]:.1f} |"
        )
    others = ", ".join(f"{n} {status}" for status, n in sorted(total.items()) if status != "converged")
    print(
        f"| **all** | {sum(total.values())} | {total['converged']} | {others} | {max(worst.values()):.0e} | "
        f"{max(longest.values()):.1f} |"
    )


def _too_long(signum: int, frame: object) -> None:
    raise TimeoutError(f"more than {LIMIT} s")


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    sys.exit(1 if main(int(sys.argv[1]) if len(sys.argv) > 1 else 200) else 0)
