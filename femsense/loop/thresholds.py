"""Every number that decides in the loop, in one type that all steps are given with the data (`Data.thresholds`).

A rule is switched off by a value: 0, −inf or inf, as its line says. `benchmarks/ablation.py` does so for one after the other, and
docs/closing-the-loop-ablation.md says what each is worth.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Thresholds:
    """What decides. dBIC and χ² have no unit; a share is one of what the line names."""

    # --- acceptance of an effect -----------------------------------------------------------------------------------------------
    evidence: float = 10.0
    """dBIC that a named effect needs, and by which what is as good as another may be behind."""
    sweeps_for: float = 0.5
    """Standard errors by which sweeps that are left out must be predicted better; −inf: not asked."""
    held_gain: float = 0.25
    """Share of the decrease of χ², a row, that must show on held-out rows; −1e9: not asked."""
    held_chance: float = 5.0
    """Where an effect shifts held-out data by χ² of A only, their gain may fall short of A by so many √A; 0: by nothing."""
    held_counts: float = 1.0
    """So much of what χ² of held-out data rises by is taken off the evidence; 0: nothing."""
    sure: float = 2.5
    """Standard errors of the gain on left-out sweeps beyond which held-out data need only not speak against an effect; inf: never."""
    above_mesh: float = 0.5
    """An effect must move the markers by this share of the discretisation error beyond what calibration absorbs; 0: not asked …"""
    above_mesh_if_sure: float = 0.25
    """… or by this share, where left-out sweeps and held-out data are sure."""
    plainly_worse: float = 1.25
    """No effect may leave so many times the plain error where fitted; inf: not asked."""

    # --- screening and refits --------------------------------------------------------------------------------------------------
    testable: float = 0.1
    """An effect of which calibration leaves less than this share cannot be tested."""
    promising: float = 8.0
    """Linear dBIC that a candidate needs to be refitted."""
    hinted: float = 0.5
    """What fields of the model before predict is looked into where it is this share of the gain that is needed; inf: fields are computed anew only then."""
    explains: float = 1.25
    """A model that leaves less than this mean square, in units of the noise, explains the data: others need not be fitted to their ends."""

    # --- places, swaps and ties --------------------------------------------------------------------------------------------------
    as_good_places: float = 0.05
    """Seeds whose gain is less by this share are as good."""
    same_field: float = 0.98
    """Two places count as one where this share of what an effect does in one can be had in the other …"""
    same_step: float = 0.1
    """… with parameters that differ by no more than this share."""
    beside_body: float = 0.01
    """A place lies on the body if it is no farther outside than this share of the body's reach."""
    swap: float = 2.0
    """dBIC by which an alternative must be better to take the place of an effect or of the input offsets, and decrease of χ² for which a place or a time is
    moved, for each of its numbers; inf: nothing is swapped or moved."""

    # --- noise and discretisation ------------------------------------------------------------------------------------------------
    apart: float = 3.0
    """A marker stands apart that sits elsewhere by so many times the median of all; inf: none does."""
    white_share: float = 0.4
    """White noise is no less than this share of what repeats of a state scatter by."""
    mesh_share: float = 0.7
    """Standard deviation of the share of the discretisation error that a body shows in all sweeps …"""
    mesh_varies: float = 0.25
    """… of what each sweep adds to it …"""
    mesh_varies_held: float = 0.12
    """… where cables are held …"""
    mesh_turns: float = 0.07
    """… and of the entries of a matrix that turns and stretches it."""
    mesh_elsewhere: float = 0.05
    """The mesh errs in another way in states that differ by more than this share of how far they are from rest."""

    # --- what calibration may move ---------------------------------------------------------------------------------------------
    significant: float = 3.0
    """Standard deviations by which a value must be away from what is declared to be named."""
    relevant: float = 0.02
    """… and share of it, or of a cable's range; 0: not asked."""
    offsets_above_mesh: float = 0.75
    """Share of the discretisation error by which input offsets must move the markers; `above_mesh`: no more than effects."""

    # --- verdict -----------------------------------------------------------------------------------------------------------------
    explained: float = 0.8
    """Share of the excess over the noise that effects must take away where structure is left."""
    structure: float = 0.01
    """Probability, over all tests together, of calling mere noise structure."""
    lacks: float = 2.0
    """A model that is handed back may leave so many times the mean square that calibration of all nuisances leaves; inf: not asked."""
    likely_noise: float = 0.01
    """Where nothing tells the noise, it is not believed to be more than this share of the body's reach."""
    not_worse: float = 1.02
    """What is handed back may not have a larger held-out error than the declared model but for this factor …"""
    noisy: float = 1.15
    """… or, of calibration alone, for this one where χ² says that noise hides a better model."""

    # --- what cannot be distinguished ----------------------------------------------------------------------------------------------
    alike: float = 0.95
    """Fields that agree by this share are said to be alike; inf: none …"""
    refuted: float = 0.5
    """… unless a refit in the place of the named one brought less than this share of its evidence; 0: whatever it brought …"""
    next_to_nothing: float = 0.05
    """… or one explains less than this share of what the other does; 0: whatever it explains."""
    many_numbers: int = 6
    """An effect with more parameters is collinear with much, which says little."""

    # --- data ----------------------------------------------------------------------------------------------------------------------
    outlying: float = 4.0
    """An outlier is off by so many times what nine in ten are off by; inf: there are none …"""
    far_off: float = 0.05
    """… and by more than this share of the body's reach."""
    rare: float = 0.02
    """Where more than this share is, it is no accident."""
    states: int = 5
    """So many different states can distinguish effects though what is held out only repeats them."""
    seed_std: float = 0.7
    """How well a seed's own number is known beforehand, in its coordinate."""


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
    work: int = 20_000
    """Tetrahedra × states of a recording that are looked at as they are; where there are more, some states speak for all …"""
    some_states: float = 0.6
    """… if they are no more than this share of all."""
    leading: float = 0.5
    """Those with this share of the best linear dBIC are fitted to some of the states first."""
    settles: float = 0.01
    """On large meshes a fit ends where what is left to gain is less than this share of the best predicted gain."""


DEFAULTS = Thresholds()
"""Those that `femsense improve` uses."""
EFFORT = Effort()
