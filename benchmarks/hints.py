"""Do the fields of the model before tell what may come next as well as those of the model itself?

    python benchmarks/hints.py                # every third blind case of `loop.py tune` with something hidden
    python benchmarks/hints.py --every 1

For each model that the loop finds in a case (after the first effect, and after more), and each effect that it has not yet:
the best linear score (dBIC) by the fields of the model before, which decide whether the search goes on, and by the model's own.
Prints a line a model with the three best of each, and at the end how far they differ and how often the former would have ended a
search that the latter go on with. Some minutes.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Sequence

import numpy as np
from loop import COUNTS, SEEDS
from loop_cases import Case, make_cases, make_data

from femsense import FemsenseError, improve
from femsense.loop.data.dataset import Data
from femsense.loop.fit.fitted_model import FittedModel
from femsense.loop.fit.noise_components import Noise
from femsense.loop.search.effect_fields import Fields, fields_of
from femsense.loop.search.screening import Candidate, screen_model
from femsense.loop.thresholds import DEFAULTS
from femsense.many.engines import open_engine, spread

Scores = dict[str, float]
"""Effect → its best linear score [dBIC]."""


def compared(case: Case) -> list[tuple[Case, tuple[str, ...], Scores, Scores]]:
    """Return, of each model found in a case, what it has and the scores by the fields of the model before and by its own."""
    warnings.simplefilter("ignore")
    module, seen = sys.modules["femsense.loop.search.search"], []
    scored = module.scored

    def watched(
        data: Data, stage: FittedModel, fields: Fields, noise: Noise, names: Sequence[str], n_effective: float
    ) -> tuple[Fields, list[Candidate]]:
        if fields.model is not stage.fit.hypothesis:
            own = screen_model(data, stage.fit, noise, fields_of(data, stage, names), n_effective)
            hinted = screen_model(data, stage.fit, noise, fields, n_effective)
            seen.append((case, stage.fit.hypothesis.names, best_of(hinted), best_of(own)))
        return scored(data, stage, fields, noise, names, n_effective)  # type: ignore[no-any-return]

    module.scored = watched
    try:
        made = make_data(case, SEEDS["tune"])
        improve(made.declared, [made.recording])
    except FemsenseError:
        pass  # what was seen until then counts
    finally:
        module.scored = scored
    return seen


def best_of(table: list[Candidate]) -> Scores:
    scores: Scores = {}
    for candidate in table:  # the best first
        scores.setdefault(candidate.effect.name, candidate.score)
    return scores


def line(scores: Scores) -> str:
    return "  ".join(f"{name} {score:.1f}" for name, score in sorted(scores.items(), key=lambda s: -s[1])[:3])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--every", type=int, default=3, help="every so manieth case")
    options = parser.parse_args()
    cases = [c for c in make_cases(SEEDS["tune"], COUNTS) if c.kind != "null"][:: options.every]
    models, far, missed, near = 0, [], 0, []
    with open_engine(None, None, None) as engine:
        for found in spread(engine, compared, ((case,) for case in cases)):
            for case, names, hinted, own in found:
                models += 1
                print(
                    f"{case.number:4d} {case.label:30s} {'+'.join(names):50s} before: {line(hinted):60s} own: {line(own)}",
                    flush=True,
                )
                top = [max(scores.values(), default=-np.inf) for scores in (hinted, own)]
                missed += top[0] <= DEFAULTS.evidence < top[1]
                far += [abs(hinted[n] - own[n]) for n in hinted.keys() & own.keys()]
                near += [
                    abs(hinted[n] - own[n]) for n in hinted.keys() & own.keys() if min(hinted[n], own[n]) < DEFAULTS.evidence
                ]
    print(
        f"\n{len(cases)} cases, {models} models, {len(far)} scores: they differ by {np.median(far):.2f} in the median, "
        f"by {np.percentile(far, 95):.1f} in 95 of 100;"
    )
    print(
        f"where one of the two is below {DEFAULTS.evidence:.0f}, by {max(near):.1f} at most; searches ended too early: {missed}"
    )


if __name__ == "__main__":
    main()
