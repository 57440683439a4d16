"""Identifiability of effects before an experiment: linear theory on the declared robot, without random noise.

Each part of an experiment (a block of frames) gives the Gram matrices of its columns: those of its recording alone (pose, initial inputs), and
those shared by all recordings (nuisance N and effects e). Blocks add up, so that every combination is analysed by linear algebra alone. With G
the sum,

    S = G_ee − G_eN G_NN⁻¹ G_Ne      (after calibration is projected out, Frisch–Waugh–Lovell theorem).

An effect a of plausible size D_a raises χ² by tr(D_a S_aa D_a), of which an alternative b fits tr(D_a S_ab S_bb⁻¹ S_ba D_a).
The parameters of one effect are treated as independent with plausible sizes. `screen` computes the same from data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.loop.data.dataset import NUISANCE
from femsense.loop.design.experiment_blocks import Block, Form
from femsense.loop.search.screening import COLLINEAR, penalty
from femsense.loop.thresholds import DEFAULTS, Thresholds

ABSORBED = 1e-9
"""Share of its χ² below which a direction counts as fully absorbed."""


@dataclass(frozen=True, eq=False, slots=True)
class Row:
    """Identifiability of one effect."""

    label: str
    name: str
    retained: float
    """Retained share ρ."""
    smallest: FloatArray
    """Smallest detectable size of each parameter, in coordinates, shape (q,)."""
    form: Form
    dbic: float
    """Expected dBIC at plausible size."""
    thresholds: Thresholds

    @property
    def testable(self) -> bool:
        return self.retained >= self.thresholds.testable

    @property
    def seen(self) -> bool:
        return self.testable and self.dbic >= self.thresholds.evidence


@dataclass(frozen=True, eq=False, slots=True)
class Identifiability:
    """Identifiability of all effects in an experiment."""

    rows: tuple[Row, ...]
    confounding: FloatArray
    """Share of effect i (row) that is collinear with effect j, calibration refitted, shape (r, r)."""
    gap: FloatArray
    """Expected dBIC of i over j if i is true at plausible size, shape (r, r); inf between forms of one effect."""
    thresholds: Thresholds = DEFAULTS

    def pairs(self) -> list[tuple[int, int, float, float]]:
        """Return (i, j, collinearity, gap) of all pairs of effects, the less favourable direction of each."""
        count = len(self.rows)
        every = [(i, j) for i in range(count) for j in range(i + 1, count) if self.rows[i].name != self.rows[j].name]
        return [
            (i, j, float(min(self.confounding[i, j], self.confounding[j, i])), float(min(self.gap[i, j], self.gap[j, i])))
            for i, j in every
        ]

    def confused(self) -> list[tuple[int, int, float, float]]:
        """Return the pairs of detectable effects that cannot be distinguished."""
        seen = [r.seen for r in self.rows]
        return [p for p in self.pairs() if seen[p[0]] and seen[p[1]] and self.cannot_distinguish(p)]

    def cannot_distinguish(self, pair: tuple[int, int, float, float]) -> bool:
        """Return whether a pair as of `pairs` is collinear (above COLLINEAR) or too close in evidence."""
        return pair[2] > COLLINEAR or pair[3] < self.thresholds.evidence

    def distinguished(self) -> tuple[int, int]:
        """Return the number of pairs of detectable effects that are distinguished, and the number of all pairs."""
        pairs = self.pairs()
        seen = sum(self.rows[i].seen and self.rows[j].seen for i, j, *_ in pairs)
        return seen - len(self.confused()), len(pairs)

    @property
    def untestable(self) -> list[str]:
        return [r.label for r in self.rows if not r.testable]

    @property
    def unseen(self) -> list[str]:
        """Testable effects whose plausible size is not detectable."""
        return [r.label for r in self.rows if r.testable and not r.seen]

    @property
    def confusion(self) -> float:
        """The objective of planning: the sum of the shortfalls of effects and pairs, each between 0 and 1."""
        least, wanted = self.thresholds.testable, self.thresholds.evidence
        missing = sum(max(0.0, 1.0 - r.retained / least) + np.clip(1.0 - r.dbic / wanted, 0.0, 1.0) for r in self.rows)
        pairs = sum(
            np.clip(1.0 - gap / wanted, 0.0, 1.0) + np.clip((share - COLLINEAR) / (1 - COLLINEAR), 0, 1)
            for *_, share, gap in self.pairs()
        )
        return float(missing + pairs)


@dataclass(eq=False, slots=True)
class Judge:
    """Analyses experiments made of blocks."""

    forms: list[Form]
    calibrated: tuple[str, ...] = NUISANCE
    thresholds: Thresholds = DEFAULTS
    _by_label: dict[str, list[int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for i, f in enumerate(self.forms):
            self._by_label.setdefault(f.label, []).append(i)

    def judge(self, blocks: Sequence[Block], *, rest: bool = False) -> Identifiability:
        """Return the identifiability of effects in an experiment.

        Arguments:
            blocks: its parts.
            rest: whether rest.csv is part of it.
        """
        seen, whole = self._shared(blocks, rest)
        count = max(3.0 * sum(b.states for b in blocks), 2.0)
        labels = [label for label, own in self._by_label.items() if not (rest and self.forms[own[0]].effect.places_markers)]
        names = len({f.name for f in self.forms if f.name not in self.calibrated})
        scale = np.sqrt(np.maximum(np.diag(whole), 1e-300))
        free = {drop: _Left(self, seen, scale, self._kept(drop), count, names) for drop in self._drops(labels)}
        rows = [self._row(label, free[self._dropped(label)], whole, count) for label in labels]
        confounding, gap = np.zeros((len(rows), len(rows))), np.full((len(rows), len(rows)), np.inf)
        for i, a in enumerate(rows):
            for j, b in enumerate(rows):
                if a.name != b.name:
                    left = free[self._dropped(a.label) | self._dropped(b.label)]
                    confounding[i, j], gap[i, j] = left.alternative(self.forms.index(a.form), self._by_label[b.label])
        return Identifiability(tuple(rows), confounding, gap, self.thresholds)

    def _dropped(self, label: str) -> frozenset[str]:
        return frozenset({label} & set(self.calibrated))

    def _drops(self, labels: list[str]) -> list[frozenset[str]]:
        own = [frozenset({c}) for c in self.calibrated if c in labels]
        return [frozenset(), *own, frozenset().union(*own)] if len(own) > 1 else [frozenset(), *own]

    def _kept(self, drop: frozenset[str]) -> list[Form]:
        return [f for f in self.forms if f.name in self.calibrated and f.name not in drop]

    def _shared(self, blocks: Sequence[Block], rest: bool) -> tuple[FloatArray, FloatArray]:
        """Return the Gram matrix of the shared columns with each recording's own ones projected out, and without that, (e, e)."""
        left, whole = 0.0, 0.0
        for key in dict.fromkeys(b.recording for b in blocks):
            mine = [b for b in blocks if b.recording == key]
            grams = [b.rested if rest and b.rested is not None else b.gram for b in mine]
            grams += [mine[0].placements] if rest or mine[0].rested is None else []
            own, cross, shared = (np.sum([getattr(g, n) for g in grams], axis=0) for n in ("own", "cross", "shared"))
            left, whole = left + shared - cross.T @ _inverse(own) @ cross, whole + shared
        return np.asarray(left), np.asarray(whole)

    def _row(self, label: str, left: _Left, whole: FloatArray, count: float) -> Row:
        """Return the row of an effect, at the seed with the median dBIC."""
        tried = sorted(self._by_label[label], key=lambda i: left.dbic(i))
        f = self.forms[tried[(len(tried) - 1) // 2]]
        at = f.columns
        size, total = np.diag(left.S)[at], np.diag(whole)[at]
        retained = float(np.sqrt(max(size.sum(), 0.0) / total.sum())) if total.sum() > 0 else 0.0
        needed = np.sqrt(self.thresholds.evidence + len(f.parameters) * np.log(count))
        smallest = np.where(size > ABSORBED * np.maximum(total, 1e-300), needed / np.sqrt(np.maximum(size, 1e-300)), np.inf)
        return Row(label, f.name, retained, smallest, f, left.dbic(self.forms.index(f)), self.thresholds)


class _Left:
    """The columns of all forms after projection, and their mutual overlap."""

    def __init__(self, judge: Judge, shared: FloatArray, scale: FloatArray, kept: list[Form], count: float, names: int) -> None:
        self.forms, self.count, self.names = judge.forms, count, names
        N = np.concatenate([np.arange(f.at, f.at + len(f.size)) for f in kept]) if kept else np.zeros(0, dtype=np.int64)
        prior = np.concatenate([f.known for f in kept]) if kept else np.zeros(0)
        G = shared[np.ix_(N, N)] + np.diag(1.0 / prior**2)
        self.S = shared - shared[:, N] @ _inverse(G) @ shared[N] if len(N) else shared
        self.size = np.concatenate([f.size for f in self.forms])
        self.starts = [f.at for f in self.forms]
        roots = np.zeros_like(self.S)
        for f in self.forms:
            roots[f.columns, f.columns] = _root(self.S[f.columns, f.columns], scale[f.columns])
        shares = (self.size[:, None] * (self.S @ roots)) ** 2
        self.explained = np.add.reduceat(np.add.reduceat(shares, self.starts, axis=0), self.starts, axis=1)
        self.gain = np.add.reduceat(np.maximum(np.diag(self.S), 0.0) * self.size**2, self.starts)

    def dbic(self, i: int) -> float:
        return float(self.gain[i]) - self._price(self.forms[i])

    def alternative(self, i: int, others: list[int]) -> tuple[float, float]:
        """Return the share of a form that is collinear with the best of others, and the expected dBIC over it."""
        a, gain = self.forms[i], float(self.gain[i])
        if gain <= 1e-12:
            return 0.0, 0.0
        share = float(np.sqrt(np.clip(max(self.explained[i, j] for j in others) / gain, 0.0, 1.0)))
        gaps = [gain - float(self.explained[i, j]) + self._price(self.forms[j]) - self._price(a) for j in others]
        return share, min(gaps)

    def _price(self, f: Form) -> float:
        return penalty(len(f.parameters), f.seed, 1, self.names, self.count)


def _inverse(matrix: FloatArray) -> FloatArray:
    """Return the pseudo-inverse of a positive semi-definite matrix, columns scaled to unit size."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return np.asarray(np.linalg.pinv(matrix / np.outer(scale, scale), rcond=1e-12, hermitian=True) / np.outer(scale, scale))


def _root(matrix: FloatArray, scale: FloatArray) -> FloatArray:
    """Return R with R Rᵀ the pseudo-inverse of a block, without directions that calibration absorbs."""
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    good = values > ABSORBED
    return np.asarray(vectors / scale[:, None] * np.where(good, 1.0 / np.sqrt(np.where(good, values, 1.0)), 0.0))
