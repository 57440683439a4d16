"""The acceptance test: what speaks against an effect."""

from __future__ import annotations

from types import SimpleNamespace

from femsense.loop.search.acceptance import plainly_worse
from femsense.loop.thresholds import DEFAULTS


def test_the_plain_error_may_grow_where_fitted_if_that_on_held_out_data_falls():
    def errors(train: float, held: float) -> SimpleNamespace:
        return SimpleNamespace(fit=SimpleNamespace(rms=train), held_rms=held)

    before = errors(1.0, 1.0)
    assert plainly_worse(before, errors(1.3, 1.1), DEFAULTS)
    assert not plainly_worse(before, errors(1.3, 0.9), DEFAULTS) and not plainly_worse(before, errors(1.2, 1.1), DEFAULTS)
