"""Limits of the data: alternatives with as much evidence, and effects that a nuisance effect absorbs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from femsense.core.least_squares import beside
from femsense.loop.data.dataset import NUISANCE
from femsense.loop.fit.fitted_model import span_of
from femsense.loop.result.records import ConfoundedPair, RefitRecord
from femsense.loop.search.input_offset import OFFSETS
from femsense.loop.search.screening import one_each
from femsense.loop.search.search_state import Search
from femsense.loop.search.swaps import alternatives_to
from femsense.loop.thresholds import Thresholds


def confounded(search: Search, names: Sequence[str], thresholds: Thresholds) -> list[ConfoundedPair]:
    """Return the pairs that these data cannot distinguish: an accepted effect, and a possible alternative."""
    found: dict[frozenset[str], ConfoundedPair] = {}
    asked = _as_evident, _in_place_of_an_error, _absorbed, _in_common
    for pair in (pair for ask in asked for pair in ask(search, names, thresholds)):
        key = frozenset(pair.pair)
        found[key] = _merged(found[key], pair) if key in found else pair
    return list(found.values())


def _merged(a: ConfoundedPair, b: ConfoundedPair) -> ConfoundedPair:
    """Return two findings on a pair combined: the smaller gap, and the larger shares."""

    def chosen(of: Callable[[Iterable[float]], float], *values: float | None) -> float | None:
        known = [v for v in values if v is not None]
        return of(known) if known else None

    return ConfoundedPair(
        a.pair,
        chosen(min, a.dbic_gap, b.dbic_gap),
        chosen(max, a.absorbed_share, b.absorbed_share),
    )


def _as_evident(search: Search, names: Sequence[str], thresholds: Thresholds) -> Iterator[ConfoundedPair]:
    """Yield the effects whose refits are within `evidence` of an accepted one's, or that replace an accepted nuisance effect with as much evidence."""
    ours = _named(search, names)
    for own in ours:
        for r in search.refits:
            if r.name not in names and r.passes and r.answers_as(own) and r.evidence > own.evidence - thresholds.evidence:
                yield ConfoundedPair((own.name, r.name), dbic_gap=max(own.evidence - r.evidence, 0.0))
    for name in (n for n in names if n in NUISANCE):
        for r in (r for r in search.refits if name in (r.takes_over or ()) and r.name not in names):
            ahead = max((own.evidence for own in ours if own.answers_as(r)), default=0.0)
            if r.evidence > max(thresholds.evidence, ahead - thresholds.evidence):
                yield ConfoundedPair((name, r.name), dbic_gap=max(ahead - r.evidence, 0.0))
    swap = search.in_place
    if swap is not None and abs(swap.ahead) < thresholds.evidence and {OFFSETS, swap.name} & set(names):
        yield ConfoundedPair((OFFSETS, swap.name), dbic_gap=abs(swap.ahead))


def _in_place_of_an_error(search: Search, names: Sequence[str], thresholds: Thresholds) -> Iterator[ConfoundedPair]:
    """Yield the effects that pass by themselves and are not needed in addition to the accepted ones, if the weights include the model error: evidence then also
    measures how well an effect compensates for that error."""
    if search.noise.assumed is None:
        return
    for own in _named(search, names):
        for r in alternatives_to(own, search.refits, search.last):
            if r.name not in names:
                yield ConfoundedPair((own.name, r.name), dbic_gap=max(own.evidence - r.evidence, 0.0))


def _named(search: Search, names: Sequence[str]) -> list[RefitRecord]:
    """Return the refits of the accepted effects, without a mesh that has no dBIC because nothing else converges."""
    ours = [r for r in search.refits if r.name in names and r.dbic is not None]
    return [r for r in ours if r.is_named or r.in_place_of == r.name]


def _absorbed(search: Search, names: Sequence[str], thresholds: Thresholds) -> Iterator[ConfoundedPair]:
    """Yield the effects that are not testable because they are collinear with one accepted nuisance effect, with the share that calibration absorbs."""
    fit = search.base.fit
    J = np.asarray(fit.fit.jacobian)
    poses = J[:, : fit.own]
    present = search.final.fit.hypothesis.names
    hidden = [c for c in one_each(search.first) if c.retained < thresholds.testable and c.effect.name not in present]
    for name in (n for n in names if n in NUISANCE):
        own = np.hstack([poses, J[:, fit.own :][:, span_of(fit, name)]])
        for c in hidden:
            whole = beside(poses, c.columns - J @ c.response)
            if np.linalg.norm(beside(own, whole)) < thresholds.testable * np.linalg.norm(whole):
                yield ConfoundedPair((name, c.effect.name), absorbed_share=float(np.sqrt(1.0 - c.retained**2)))


def _in_common(search: Search, names: Sequence[str], thresholds: Thresholds) -> Iterator[ConfoundedPair]:
    """Yield an accepted nuisance effect with an effect that equals it when all its parameters move together (the modulus, and a gain common to all cables), if
    calibration absorbs that combination. A single parameter, such as the gain of one cable, is not absorbed."""
    for effect in {c.effect.name: c.effect for c in search.first if len(c.parameters) > 1}.values():
        for alias in effect.aliases if effect.name not in search.final.fit.hypothesis.names else ():
            if alias.common and alias.name in names:
                yield from _common(search, alias.name, effect.name, thresholds)


def _common(search: Search, own: str, other: str, thresholds: Thresholds) -> Iterator[ConfoundedPair]:
    """Yield an accepted nuisance effect with an effect whose parameters move together, if calibration absorbs that combination."""
    forms = [c for c in search.first if c.effect.name == other and len(c.parameters) > 1]
    fit, widest = search.base.fit, max(forms, key=lambda c: len(c.parameters))
    left = widest.columns.sum(axis=1)
    J = np.asarray(fit.fit.jacobian)
    size = float(np.linalg.norm(beside(J[:, : fit.own], left - J @ widest.response.sum(axis=1))))
    retained = float(np.linalg.norm(left)) / size if size > 0.0 else 1.0
    if retained < thresholds.testable:
        yield ConfoundedPair((own, other), absorbed_share=float(np.sqrt(1.0 - retained**2)))
