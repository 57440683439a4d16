"""Calibration within the loop."""

from __future__ import annotations

import pytest

from femsense.core.errors import DataError
from femsense.loop.search.calibration import as_far_as_held_out_states_converge


def test_calibration_goes_as_far_as_held_out_states_converge():
    def collapses_beyond(most: int):
        def fit(steps: int) -> int:
            if steps > most:
                raise DataError("no equilibrium in frame 3")
            return steps

        return fit

    assert [as_far_as_held_out_states_converge(collapses_beyond(most), 4) for most in (4, 3, 1, 0)] == [4, 2, 1, 0]
    with pytest.raises(DataError):
        as_far_as_held_out_states_converge(collapses_beyond(-1), 4)
