"""How often a reading is rightly or wrongly called outside of what was learnt: by the straight line alone, and with curves.

    python benchmarks/xr_domain.py [--data ../shared/data/arm] [--narrower 0.7 1.0]

Each block in time of six of each recording of the pneumatic arm is checked against the other five: rows of the arm's own motion that
are called outside though each channel is in its range are false alarms. Contradictions are the same rows with one channel taken
from another time of that block, where it differs by 30 % of its range or more. Channels that depend on each other by a known curve,
with 1 % noise, follow; what is farther from the curve than ten times that contradicts it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from xr import DATA, SENSORS, read_arm

from femsense.core.arrays import FloatArray
from femsense.xr.proprioception import curves
from femsense.xr.proprioception.domain import Domain, learn_domain
from femsense.xr.proprioception.selection import folds

RECORDINGS = ("apr_5_1", "apr_4_1", "apr_4_2", "Jan_10-2_1", "Jan_10-2_2", "Jan_10-2_3")
SHAPES: dict[str, Callable[[FloatArray], FloatArray]] = {
    "b = a": lambda a: a,
    "b = a²": lambda a: a**2,
    "b = (a + 1)² / 4": lambda a: (a + 1) ** 2 / 4,
    "b = a³": lambda a: a**3,
    "b = sin 3a": lambda a: np.sin(3 * a),
}
FAR, OFF = 0.3, 0.1
BESIDE = 5
"""Channels that have nothing to do with the two of a curve."""


def arm_blocks(folder: Path, columns: tuple[int, ...]) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield what is learnt and what is checked, of all recordings."""
    for name in RECORDINGS:
        data = read_arm(name, columns, folder)
        rows = data.readings[data.time_s < 60] if name == "apr_5_1" else data.readings  # then two chambers are emptied
        for held in folds(len(rows)):
            yield rows[~held], rows[held]


def curve_rows(shape: Callable[[FloatArray], FloatArray], count: int, seed: int) -> FloatArray:
    """Return readings of two channels, shape (count, 2), that wander over a curve."""
    at = np.arange(count) * 30 / count
    a = 0.6 * np.sin(at) + 0.4 * np.sin(2.3 * at + 1)
    return np.stack([a, shape(a)], axis=1) + 0.01 * np.random.default_rng(seed).normal(size=(count, 2))


def beside_others(rows: FloatArray, seed: int) -> FloatArray:
    """Return readings with further channels that wander on their own, shape (n, c + 5)."""
    rng = np.random.default_rng(seed)
    at, speeds, phases = np.arange(len(rows))[:, None] * 30 / len(rows), rng.uniform(0.5, 2.5, BESIDE), rng.uniform(0, 6, BESIDE)
    return np.hstack([rows, np.sin(speeds * at + phases) + 0.01 * rng.normal(size=(len(rows), BESIDE))])


def counts(learnt: FloatArray, fresh: FloatArray, shape: Callable[[FloatArray], FloatArray] | None = None) -> FloatArray:
    """Return the numbers of a row of the table (`tell`), shape (8,). Where a curve of the first two channels is known, these alone contradict
    each other, and what lies on it is no contradiction."""
    domain = learn_domain(learnt)
    line = replace(domain, curves=())
    ranged = in_range(domain, fresh)
    own = [len(fresh), (~ranged).sum(), *(outside(d, fresh[ranged]) for d in (line, domain))]
    wrong = np.concatenate(list(contradictions(domain, fresh))[: None if shape is None else 2])
    wrong = wrong if shape is None else wrong[np.abs(wrong[:, 1] - shape(wrong[:, 0])) > OFF]
    return np.array([*own, len(wrong), *(outside(d, wrong) for d in (line, domain)), len(domain.curves)], dtype=float)


def contradictions(domain: Domain, rows: FloatArray) -> Iterator[FloatArray]:
    """Yield rows in which one channel is of another time."""
    for i, wide in enumerate(domain.high - domain.low):
        other = rows.copy()
        other[:, i] = np.roll(rows[:, i], len(rows) // 2)
        yield other[(np.abs(other[:, i] - rows[:, i]) > FAR * wide) & (wide > 0)]


def in_range(domain: Domain, rows: FloatArray) -> np.ndarray:
    return replace(domain, limit=np.full(len(domain.limit), np.inf), curves=()).inside(rows)


def outside(domain: Domain, rows: FloatArray) -> int:
    return int((~domain.inside(rows)).sum())


def tell(name: str, total: FloatArray) -> None:
    rows, ranged, line, both, wrong, line_hits, both_hits, found = total
    alarms = "".join(f"{100 * x / rows:8.2f} %" for x in (ranged, line, both))
    hits = "".join(f"{100 * x / max(wrong, 1):8.1f} %" for x in (line_hits, both_hits))
    print(f"{name:<28}{rows:7.0f}{alarms}   {wrong:14.0f}{hits}{found:8.0f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--narrower", type=float, nargs="*", default=[curves.NARROWER], help="what a curve has to reach")
    arguments = parser.parse_args()
    for share in arguments.narrower:
        curves.NARROWER = share
        print(
            f"a curve allows at most {share:g} of what the line allows\n"
            + " " * 35
            + "outside by               contradictions found"
        )
        print(f"{'readings':<28}   rows    range      line      both            count      line      both  curves")
        for name, columns in SENSORS.items() if arguments.data.is_dir() else ():
            tell(f"arm, {name}", np.sum([counts(*pair) for pair in arm_blocks(arguments.data, columns)], axis=0))
        for name, shape in SHAPES.items():
            for count in (60, 1500):
                learnt, fresh = curve_rows(shape, count, 1), curve_rows(shape, 700, 2)
                tell(f"{name}, {count} rows", counts(learnt, fresh, shape))
                tell("  beside five others", counts(beside_others(learnt, 3), beside_others(fresh, 3), shape))


if __name__ == "__main__":
    main()
