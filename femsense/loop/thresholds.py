"""The decision thresholds of the loop, in one type that travels with the data (`Data.thresholds`).

A rule is disabled by the value that its line names: 0, −inf or inf. `benchmarks/ablation.py` disables one after the other;
docs/results/closing-the-loop-ablation.md shows the effect of each.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Thresholds:
    """Decision thresholds. dBIC and χ² are dimensionless."""

    # --- acceptance of an effect -----------------------------------------------------------------------------------------------
    evidence: float = 10.0
    """Minimum dBIC of an effect: of its linear score to be refitted, of its refit to be accepted. Alternatives within this dBIC of the best count as
    equally good."""
    held_gain: float = 0.25
    """Minimum decrease of χ² per held-out row, as a share of the decrease per fitted row; −1e9: no criterion."""

    plainly_worse: float = 1.25
    """An effect is rejected if it multiplies the unweighted fitted rms by more than this and the held-out rms grows too; inf: no criterion."""

    # --- screening and refits --------------------------------------------------------------------------------------------------
    testable: float = 0.1
    """An effect is testable if calibration leaves at least this share ρ of its field."""
    hinted: float = 0.5
    """Share of the required gain that a cheap linear prediction must reach before it is followed up: before the fields of the previous model are
    recomputed, and before a form with more parameters is fitted; inf: never."""

    # --- places, swaps and ties --------------------------------------------------------------------------------------------------
    swap: float = 2.0
    """Minimum dBIC by which an alternative must be ahead to replace an effect or the input offsets, and minimum decrease of χ², per number, to move a
    place or a time; inf: nothing is replaced or moved."""

    # --- discretisation ----------------------------------------------------------------------------------------------------------
    mesh_share: float = 0.7
    """Standard deviation of the share of the discretisation error that is common to all sweeps."""
    mesh_varies: float = 0.25
    """Standard deviation of the share of the discretisation error that each sweep adds."""
    mesh_turns: float = 0.07
    """Standard deviation of the entries of a matrix that rotates and stretches the discretisation error."""

    # --- values that calibration fits --------------------------------------------------------------------------------------------
    significant: float = 3.0
    """A value is reported if it deviates from the declared one by more than this number of standard deviations and by `relevant`. A marker whose
    offset is this multiple of the median offset counts as a single outlier."""
    relevant: float = 0.02
    """Minimum deviation of a reported value, as a share of the value, of a cable's range, or of the body's reach. As a share of the reach, also the
    upper limit of a noise that was not measured, and of the distance of a fitted place from the body; 0: no criterion."""

    # --- verdict -----------------------------------------------------------------------------------------------------------------
    explained: float = 0.8
    """Minimum share of the mean square beyond the noise that effects must remove if the residual still has structure."""
    structure: float = 0.01
    """Level of the structure tests, for all of them together."""
    lacks: float = 2.0
    """Largest ratio of mean squares between the returned model and the model with all nuisance parameters, and between quadratic elements and the
    declared linear ones; inf: no criterion."""
    not_worse: float = 1.02
    """Largest ratio of the held-out error of the returned model to that of the declared one."""

    # --- data ----------------------------------------------------------------------------------------------------------------------
    outlying: float = 4.0
    """A measurement is an outlier if its residual exceeds this multiple of the 90 % quantile and the limit `far_off`; inf: no outliers."""
    far_off: float = 0.05
    """Smallest residual of an outlier, as a share of the body's reach; see `outlying`."""
    rare: float = 0.02
    """If more than this share of the measurements would be outliers, none is removed: such a deviation is systematic."""
    states: int = 5
    """Minimum number of distinct fitted states to distinguish effects if held-out states only repeat them."""


@dataclass(frozen=True, slots=True)
class Effort:
    """Limits of the computational effort; they affect the speed, not the criteria."""

    effects: int = 3
    """Maximum number of effects that are added."""
    refits: int = 6
    """Number of candidates that are refitted in the first step; half as many later."""
    starts: int = 3
    """Number of seeds of an effect that are improved, the best ones …"""
    rounds: int = 4
    """… and maximum number of moves of each to a better neighbour."""
    matchings: int = 6
    """Maximum number of times that the rows of clouds are recomputed."""
    recordings: int = 8
    """Number of recordings that are searched for effects; the result is fitted to all of them (`search/all_recordings.py`)."""
    work: int = 20_000
    """Tetrahedra × states of a recording that are searched in full; larger ones are searched in representative states."""


DEFAULTS = Thresholds()
"""The defaults of `femsense improve`."""
EFFORT = Effort()
