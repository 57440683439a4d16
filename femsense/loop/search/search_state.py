"""The state of a search for effects, and the record that the conclusion uses."""

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

OUTWEIGHED = "accepted with weights under which a large residual remained; repeated with weights that include the model error"
"""The verdict on effects accepted, or passed, before the weights changed."""


Progress = Callable[[str], None]
"""Called with a text that names the current step."""


@dataclass(frozen=True, eq=False, slots=True)
class Setting:
    """The data and weights by which models are compared in one step of the search."""

    data: Data
    noise: Noise
    n_effective: float
    """Effective number of observations, for BIC."""
    progress: Progress


@dataclass(eq=False, slots=True)
class SearchProgress:
    """The state of a search."""

    data: Data
    earlier: Data
    """The data before the last effect was added."""
    before: FittedModel
    """The declared model, calibrated."""
    history: list[tuple[str, FittedModel]]
    """Name of each added effect with the model that added it, as `Search.history`."""
    given: int
    """Number of models in the history before the search began."""
    fitted: FittedModel
    """The current model, which the next effect extends."""
    base: FittedModel
    """Model of the first screening; defined from that screening on."""
    names: list[str]
    """Effects that are tried."""
    quadratic: bool
    """Whether the search uses quadratic elements although linear ones are declared."""
    refits: list[RefitRecord]
    """Results of the candidates refitted with the current weights."""
    outweighed: list[RefitRecord] = field(default_factory=list)
    """Results with earlier weights; their evidence cannot be compared with current values."""
    noise: Noise | None = None
    n_effective: float = 0.0
    fields: Fields | None = None
    first: list[Candidate] = field(default_factory=list)
    table: list[Candidate] = field(default_factory=list)
    """The last screening."""
    over: bool = False
    holds_error: bool = False
    """Whether the noise includes the model error, because no effect fitted it, and is no longer re-estimated."""

    @property
    def found(self) -> int:
        """Number of effects found."""
        return len(self.history) - self.given

    def setting(self, progress: Progress) -> Setting:
        """Return the data and weights of the current step; they are known from the first screening on."""
        assert self.noise is not None
        return Setting(self.data, self.noise, self.n_effective, progress)

    def replace_last(self, fitted: FittedModel) -> None:
        """Replace the current model by one with the same effects."""
        self.fitted, self.history = fitted, [*self.history[:-1], (self.history[-1][0], fitted)]

    def note(self, records: Iterable[RefitRecord]) -> None:
        """Keep the results of candidates that were refitted on top of the current model."""
        self.refits = [*self.refits, *at_step(records, len(self.history))]

    def begin_again(self, data: Data, noise: Noise) -> None:
        """Restart the search from the first model, with weights that include the residual of the last one."""
        kept = [*self.history[: self.given - 1], (self.history[self.given - 1][0], self.base)]
        self.outweighed = [replace(r, verdict=OUTWEIGHED) if r.is_named or r.passes else r for r in self.refits]
        self.refits = []
        self.data = self.earlier = data
        self.history, self.fitted, self.fields, self.noise = kept, self.base, None, noise
        self.over, self.holds_error = False, True

    def take_back(self, error: FemsenseError) -> None:
        """Remove the last effect, whose states do not converge when they are solved again, and end the search."""
        step, back = len(self.history) - 1, no_equilibrium(error)
        self.refits = [replace(r, verdict=back) if r.step == step and r.is_named else r for r in self.refits]
        self.data, self.history, self.over = self.earlier, self.history[:-1], True
        self.fitted = self.history[-1][1]


@dataclass(frozen=True, eq=False, slots=True)
class Search:
    """The completed search."""

    before: FittedModel
    """The declared model, calibrated."""
    history: list[tuple[str, FittedModel]]
    """("", the calibrated model on the declared mesh), then each effect with the model that added it."""
    base: FittedModel
    """The model of the first screening: calibrated, on quadratic elements if the search uses them."""
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
    """The best alternative to the input offsets."""
    outweighed: list[RefitRecord] = field(default_factory=list)
    """As of `SearchProgress`."""
    everywhere: AllRecordings | None = None
    """Results of the last model in all recordings, if only some were searched."""


def no_equilibrium(error: FemsenseError) -> str:
    """Return the verdict on a refit without equilibrium."""
    return f"no equilibrium: {error}"


def at_step(records: Iterable[RefitRecord], step: int) -> list[RefitRecord]:
    """Return records with the number of the model that they extend."""
    return [replace(record, step=step) for record in records]


@dataclass(frozen=True, eq=False, slots=True)
class Refit:
    """A candidate effect after its refit: the nonlinear fit of the whole model with this effect in addition."""

    candidate: Candidate
    fitted: FittedModel
    score: float
    """dBIC of the nonlinear fit."""
    record: RefitRecord
    """The record shown in the report."""

    @property
    def penalty(self) -> float:
        """Penalty of its parameters, of its selection and of implausible values: the decrease of χ² minus dBIC."""
        assert self.record.dchi2 is not None
        return self.record.dchi2 - self.score

    @property
    def on_all_data(self) -> float:
        """Evidence of the fitted data and of the held-out data together: dBIC plus the decrease of χ² there."""
        assert self.record.held_dchi2 is not None
        return self.score + self.record.held_dchi2

    def saying(self, verdict: str) -> Refit:
        """Return the refit with another verdict in its record."""
        return replace(self, record=replace(self.record, verdict=verdict))


@dataclass(frozen=True, eq=False, slots=True)
class OffsetAlternative:
    """The effect that best replaces the input offsets."""

    fitted: FittedModel | None
    """The model with the effect instead of the input offsets, if it is better."""
    name: str
    """The best effect; empty: none passes."""
    ahead: float
    """dBIC of that effect minus dBIC of the input offsets."""
    records: list[RefitRecord]
