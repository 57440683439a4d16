"""How far a search for effects has come, and what it went through, as the conclusion needs it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

from femsense.core.errors import FemsenseError
from femsense.loop.data.dataset import Data
from femsense.loop.fit.fitted_model import FittedModel
from femsense.loop.fit.noise_components import Noise
from femsense.loop.result.records import AllRecordings, RefitRecord
from femsense.loop.search.effect_fields import Fields
from femsense.loop.search.screening import Candidate

OUTWEIGHED = "found by weights that much is left beside it: asked again with weights that hold the error of the model"
"""The verdict on what was named, or passed, before."""


@dataclass(eq=False, slots=True)
class SearchProgress:
    """How far a search has come."""

    data: Data
    earlier: Data
    """The data as they were before the last effect was added."""
    before: FittedModel
    """The declared model, calibrated."""
    history: list[tuple[str, FittedModel]]
    """As of `Search`."""
    given: int
    """How many models of the history were there before the search."""
    fitted: FittedModel
    """The model that comes next is this one with one effect more."""
    base: FittedModel
    """As of `Search`, from the first screening on."""
    names: list[str]
    """Effects that are tried."""
    quadratic: bool
    """Whether it goes on quadratic elements though linear ones are declared."""
    refits: list[RefitRecord]
    """What became of candidates that were refitted, by the weights of now."""
    outweighed: list[RefitRecord] = field(default_factory=list)
    """What became of them by earlier weights: evidence that is compared with none of now."""
    noise: Noise | None = None
    n_effective: float = 0.0
    fields: Fields | None = None
    first: list[Candidate] = field(default_factory=list)
    table: list[Candidate] = field(default_factory=list)
    """The last screening."""
    over: bool = False
    holds_error: bool = False
    """Whether the noise holds what a model leaves, since nothing explained it, and stays as it is."""

    @property
    def found(self) -> int:
        """How many effects were found."""
        return len(self.history) - self.given

    def begin_again(self, data: Data, noise: Noise) -> None:
        """Seek effects again on top of the first model, by weights that hold what the last one leaves."""
        kept = [*self.history[: self.given - 1], (self.history[self.given - 1][0], self.base)]
        self.outweighed = [replace(r, verdict=OUTWEIGHED) if r.is_named or r.passes else r for r in self.refits]
        self.refits = []
        self.data = self.earlier = data
        self.history, self.fitted, self.fields, self.noise = kept, self.base, None, noise
        self.over, self.holds_error = False, True

    def take_back(self, error: FemsenseError) -> None:
        """End without the last effect, whose states do not converge when they are solved again."""
        step, back = len(self.history) - 1, no_equilibrium(error)
        self.refits = [replace(r, verdict=back) if r.step == step and r.is_named else r for r in self.refits]
        self.data, self.history, self.over = self.earlier, self.history[:-1], True
        self.fitted = self.history[-1][1]


@dataclass(frozen=True, eq=False, slots=True)
class Search:
    """What the search went through."""

    before: FittedModel
    """The declared model, calibrated."""
    history: list[tuple[str, FittedModel]]
    """("", the model with what calibration may move on the declared mesh), then each effect with the model that added it."""
    base: FittedModel
    """The model of the first screening: with what calibration may move, on quadratic elements if effects were sought with these."""
    final: FittedModel
    noise: Noise
    n_effective: float
    first: list[Candidate]
    """The first screening."""
    last: list[Candidate]
    """The last one."""
    refits: list[RefitRecord]
    """As of `SearchProgress`."""
    in_place: OffsetAlternative | None
    """What might be in the place of the input offsets."""
    outweighed: list[RefitRecord] = field(default_factory=list)
    """As of `SearchProgress`."""
    everywhere: AllRecordings | None = None
    """What all recordings say of the last model, where it was sought in some of them."""


Progress = Callable[[str], None]
"""Told in words what is going on."""


def no_equilibrium(error: FemsenseError) -> str:
    """Return the verdict on a refit that fails."""
    return f"no equilibrium: {error}"


def at_step(records: Iterable[RefitRecord], step: int) -> list[RefitRecord]:
    """Return records of what was tried on the model of a step."""
    return [replace(record, step=step) for record in records]


@dataclass(frozen=True, eq=False, slots=True)
class Refit:
    """A candidate after its joint fit."""

    candidate: Candidate
    fitted: FittedModel
    score: float
    """dBIC of the nonlinear fit."""
    record: RefitRecord
    """What the report says of it."""

    def saying(self, verdict: str) -> Refit:
        """Return it with another verdict in its record."""
        return replace(self, record=replace(self.record, verdict=verdict))


@dataclass(frozen=True, eq=False, slots=True)
class OffsetAlternative:
    """What became of the question."""

    fitted: FittedModel | None
    """A model with an effect in the place of the input offsets, where that is better."""
    name: str
    """The effect that is best in their place; empty: none passes."""
    ahead: float
    """dBIC of that effect less that of the input offsets."""
    records: list[RefitRecord]
