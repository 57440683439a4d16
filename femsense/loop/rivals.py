"""Effects that explain the data in the place of a zero that the fit moved: weight on one mount pulls like a cable that is never slack.

Zeros of the cables are fitted along with everything, so that an effect has to show beyond what they imitate. The other way round, a zero
that moved is not yet the explanation: where an effect does as well with the zeros as declared, the data cannot tell the two apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from femsense.errors import FemsenseError
from femsense.loop.data import Data
from femsense.loop.grow import EVIDENCE, REFITTABLE, evidence, refit
from femsense.loop.noise import Noise
from femsense.loop.screen import one_each
from femsense.loop.stages import Stage, fields_of, screen_stage

MOST = 2
"""Effects that are refitted in a nuisance's place."""


def in_place_of(
    data: Data, name: str, full: Stage, without: Stage, noise: Noise, n_effective: float, tried: Sequence[str]
) -> list[dict[str, Any]]:
    """Return the effects that explain the data as well as a named nuisance does, which is then not fitted.

    Arguments:
        data: of the loop.
        name: of the nuisance, such as "cable_offset".
        full: the final model.
        without: the same without the nuisance, fitted again.
        noise, n_effective: of the final model.
        tried: names of the effects that may take its place.

    Returns:
        pairs as in `confounded`, {pair: [name, rival], dbic_gap}: by how much the nuisance is ahead (dBIC; below 0: it is behind).
    """
    count = sum(len(p) for e, _, p in full.fit.hypothesis.terms if e.name == name)
    mine = evidence(without.fit, full.fit) - count * np.log(n_effective)
    table = screen_stage(data, without.fit, noise, fields_of(data, without, tried), n_effective)
    likely = [c for c in one_each(table) if c.retained >= REFITTABLE and c.score > mine - EVIDENCE]
    pairs = []
    for candidate in likely[:MOST]:
        try:
            made = refit(data, without, candidate, noise)
        except FemsenseError:
            continue
        ahead = mine - (evidence(without.fit, made.fit) - candidate.cost)
        if ahead < EVIDENCE:
            pairs.append({"pair": [name, candidate.effect.name], "dbic_gap": float(ahead)})
    return pairs


__all__ = ["in_place_of"]
