"""Pruning: effects that later ones have made needless are taken out."""

from __future__ import annotations

import numpy as np

from femsense.core.errors import FemsenseError
from femsense.loop.data.dataset import Data
from femsense.loop.fit.fitted_model import FittedModel, found_in, keeping
from femsense.loop.fit.noise_components import Noise
from femsense.loop.search.location_search import closer
from femsense.loop.search.refit import FORGONE, beyond, evidence
from femsense.loop.search.search_state import Progress

# --- pruning ---------------------------------------------------------------------------------------------------------------


def prune(data: Data, fitted: FittedModel, noise: Noise, n_effective: float, say: Progress) -> FittedModel:
    """Return the fitted model without effects that those added later have made needless (dBIC for keeping them not above
    `needless`); the place of the last one, which was found beside them, then moves on."""
    whole, added = fitted, found_in(fitted)
    for name in added[:-1] if np.isfinite(data.thresholds.needless) else []:
        others = [n for n in fitted.fit.hypothesis.names if n != name]
        count = sum(len(p) for e, _, p in fitted.fit.hypothesis.terms if e.name == name)
        if not count:
            continue
        say(f"asking whether {name} is still needed")
        price = count * float(np.log(n_effective))
        try:
            without = keeping(data, fitted, others, noise, worth=beyond(fitted.fit, FORGONE[1] * price + FORGONE[0]))
        except FemsenseError:
            continue
        if evidence(without.fit, fitted.fit) <= price + data.thresholds.needless:
            fitted = without
    *_, (effect, seed, parameters) = fitted.fit.hypothesis.terms
    places = (
        fitted is not whole
        and effect.nearby(data.robot, seed)
        and len(parameters) == len(effect.parameters(data.robot, data.control))
    )
    return closer(data, fitted, noise)[0] if places else fitted
