"""Every number that decides in the loop, in one type that all steps are given with the data (`Data.thresholds`).

A rule is switched off by a value: 0, −inf or inf, as its line says. `benchmarks/ablation.py` does so for one after the other, and
docs/results/closing-the-loop-ablation.md says what each is worth.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Thresholds:
    """What decides. dBIC and χ² have no unit; a share is one of what the line names."""

    # --- acceptance of an effect -----------------------------------------------------------------------------------------------
    evidence: float = 10.0
    """dBIC that an effect needs, to first order to be refitted and then to be named, and by which what is as good as another may be behind."""
    sweeps_for: float = 0.5
    """Standard errors by which sweeps that are left out must be predicted better; −inf: not asked."""
    held_gain: float = 0.25
    """Share of the decrease of χ², a row, that must show on held-out rows; −1e9: not asked."""
    above_mesh: float = 0.5
    """An effect or input offsets must move the markers by this share of the discretisation error beyond what calibration absorbs; 0: not asked."""
    plainly_worse: float = 1.25
    """No effect may leave so many times the plain error where fitted; inf: not asked."""

    # --- screening and refits --------------------------------------------------------------------------------------------------
    testable: float = 0.1
    """An effect of which calibration leaves less than this share cannot be tested."""
    hinted: float = 0.5
    """What fields of the model before predict is looked into where it is this share of the gain that is needed; inf: fields are computed anew only then."""

    # --- places, swaps and ties --------------------------------------------------------------------------------------------------
    swap: float = 2.0
    """dBIC by which an alternative must be better to take the place of an effect or of the input offsets, and decrease of χ² for which a place or a time is
    moved, for each of its numbers; inf: nothing is swapped or moved."""

    # --- discretisation ----------------------------------------------------------------------------------------------------------
    mesh_share: float = 0.7
    """Standard deviation of the share of the discretisation error that a body shows in all sweeps …"""
    mesh_varies: float = 0.25
    """… of what each sweep adds to it …"""
    mesh_varies_held: float = 0.12
    """… where cables are held …"""
    mesh_turns: float = 0.07
    """… and of the entries of a matrix that turns and stretches it."""

    # --- what calibration may move ---------------------------------------------------------------------------------------------
    significant: float = 3.0
    """Standard deviations by which a value must be away from what is declared to be named; and median offsets of markers by which one stands apart."""
    relevant: float = 0.02
    """… and share of it, or of a cable's range; 0: not asked."""

    # --- verdict -----------------------------------------------------------------------------------------------------------------
    explained: float = 0.8
    """Share of the excess over the noise that effects must take away where structure is left."""
    structure: float = 0.01
    """Probability, over all tests together, of calling mere noise structure."""
    lacks: float = 2.0
    """A model that is handed back may leave so many times the mean square that calibration of all nuisances leaves, and one on quadratic elements so many
    times that on the declared linear ones; inf: not asked."""
    resolved: float = 0.01
    """Share of the body's reach to which cameras and places are believed: noise that nothing tells is no more, and a place may lie so far outside."""
    not_worse: float = 1.02
    """What is handed back may not have a larger held-out error than the declared model but for this factor …"""
    noisy: float = 1.15
    """… or, of calibration alone, for this one where χ² says that noise hides a better model."""

    # --- what cannot be distinguished ----------------------------------------------------------------------------------------------
    alike: float = 0.95
    """Fields that agree by this share are said to be alike, and places with such fields count as one; inf: none."""

    # --- data ----------------------------------------------------------------------------------------------------------------------
    outlying: float = 4.0
    """An outlier is off by so many times what nine in ten are off by; inf: there are none …"""
    far_off: float = 0.05
    """… and by more than this share of the body's reach."""
    rare: float = 0.02
    """Where more than this share is, it is no accident."""
    states: int = 5
    """So many different states can distinguish effects though what is held out only repeats them."""


@dataclass(frozen=True, slots=True)
class Effort:
    """How much is tried: sizes for speed, which decide nothing where there is time."""

    effects: int = 3
    """Effects that are added at most."""
    refits: int = 6
    """Candidates that are refitted at the first step; half as many later."""
    starts: int = 3
    """So many seeds of an effect, the best, are improved …"""
    rounds: int = 4
    """… and so often moved to a neighbour that explains more."""
    alternatives: int = 2
    """So many alternatives to an effect are tried."""
    matchings: int = 6
    """Times that the rows of clouds are made again, at most."""
    recordings: int = 8
    """Recordings in which effects are sought; where there are more, what is found is fitted to all of them (`search/all_recordings.py`)."""
    work: int = 20_000
    """Tetrahedra × states of a recording that are looked at as they are; where there are more, some states speak for all …"""


DEFAULTS = Thresholds()
"""Those that `femsense improve` uses."""
EFFORT = Effort()
