"""What a loop says that its data cannot distinguish."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from femsense.loop.fit.noise_components import Noise
from femsense.loop.result.records import ConfoundedPair, RefitRecord, alternatives
from femsense.loop.result.tables import table_of
from femsense.loop.search.search_state import Search
from femsense.loop.thresholds import DEFAULTS
from femsense.loop.verdict.confounding import confounded
from femsense.model.effects import find_effect


def refit(name: str, dbic: float, verdict: str = "passes", **more: Any) -> RefitRecord:
    return RefitRecord(name, {}, verdict, dbic=dbic, step=1, **more)


def candidate(name: str, *field: float) -> SimpleNamespace:
    """Return what screening found of an effect with one parameter."""
    columns = np.array(field)[:, None]
    effect = find_effect(name)
    return SimpleNamespace(
        effect=effect, retained=1.0, parameters=(None,), columns=columns, step=np.ones(1), score=90.0, gain=100.0
    )


def searched(refits: list[RefitRecord], first: list[SimpleNamespace] | None = None, *, errs: bool = False) -> Search:
    """Return a search that went so, with a modulus fitted along, by weights that hold an error of the model or not."""
    hypothesis = SimpleNamespace(terms=((SimpleNamespace(name="stiffness"), {}, (None,)),), names=("stiffness",))
    jacobian = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])
    fitted = SimpleNamespace(fit=SimpleNamespace(fit=SimpleNamespace(jacobian=jacobian), own=1, hypothesis=hypothesis))
    return cast(
        Search,
        SimpleNamespace(
            refits=refits,
            first=first or [],
            last=[],
            history=[("", fitted)],
            base=fitted,
            final=fitted,
            in_place=None,
            noise=Noise({"white": 1e-4}, "", assumed=1e-4 if errs else None),
        ),
    )


def test_a_rival_with_nearly_as_much_evidence_is_said_once_with_all_that_is_known_of_it() -> None:
    refits = [refit("cable_friction", 30.0, "named"), refit("cable_gain", 27.0), refit("cable_gain", 24.0), refit("creep", 19.0)]
    (pair,) = pairs = confounded(searched(refits), ["cable_friction"], DEFAULTS)
    assert table_of(pair) == {"pair": ["cable_friction", "cable_gain"], "dbic_gap": 3.0}
    assert alternatives(pairs, ["cable_friction"]) == {"cable_friction": ["cable_gain"]}


def test_beside_an_error_of_the_model_what_passes_alone_and_is_needless_then_is_said() -> None:
    refits = [refit("payload", 200.0, "named"), refit("density", 126.0), refit("creep", 90.0), refit("cable_gain", 50.0, "no")]
    search = searched(refits, errs=True)
    search.last[:] = [candidate("creep", 0, 0, 1)]  # creep still explains something beside the payload
    pairs = confounded(search, ["payload"], DEFAULTS)
    assert [(p.pair, p.dbic_gap) for p in pairs] == [(("payload", "density"), 74.0)]
    assert alternatives(pairs, ["payload"]) == {"payload": ["density"]}
    assert not confounded(searched(refits), ["payload"], DEFAULTS)  # by the noise, evidence tells them apart


def test_what_took_the_place_of_more_evidence_is_not_told_from_it() -> None:
    payload = refit("payload", 200.0, in_place_of="payload")  # ahead, but it predicts held-out data worse
    density = refit("density", 80.0, "named", in_place_of="payload")
    pairs = confounded(searched([refit("payload", 200.0), payload, density], errs=True), ["density"], DEFAULTS)
    assert [(p.pair, p.dbic_gap) for p in pairs] == [(("density", "payload"), 0.0)]
    assert alternatives(pairs, ["density"]) == {"density": ["payload"]}


def test_an_effect_that_makes_the_modulus_needless_is_its_rival_unless_another_one_is_far_ahead() -> None:
    payload = refit("payload", 40.0, takes_over=("stiffness",))
    assert table_of(confounded(searched([payload]), ["stiffness"], DEFAULTS)) == [
        {"pair": ["stiffness", "payload"], "dbic_gap": 0.0}
    ]
    near = [refit("gravity", 45.0, "named"), payload]
    assert {"pair": ["stiffness", "payload"], "dbic_gap": 5.0} in table_of(
        confounded(searched(near), ["stiffness", "gravity"], DEFAULTS)
    )
    far = [refit("gravity", 90.0, "named"), payload]
    assert confounded(searched(far), ["stiffness", "gravity"], DEFAULTS) == []


def test_a_mesh_without_which_nothing_converges_is_confounded_with_nothing() -> None:
    alone = RefitRecord("discretisation", {}, "named", step=1)
    assert confounded(searched([alone, refit("creep", 20.0)]), ["discretisation"], DEFAULTS) == []


def test_what_calibration_imitates_is_said_with_the_nuisance_that_does() -> None:
    hidden = candidate("cable_friction", 0, 1, 0.02)
    hidden.retained, hidden.response = 0.02, np.zeros((2, 1))
    pairs = confounded(searched([], [hidden]), ["stiffness"], DEFAULTS)
    assert table_of(pairs) == [{"pair": ["stiffness", "cable_friction"], "absorbed_share": pytest.approx(0.9998)}]
    more = ConfoundedPair(("gravity", "cable_offset"), dbic_gap=1.0)
    said = {"stiffness": ["cable_friction"], "gravity": ["cable_offset"]}
    assert alternatives([*pairs, more], ["stiffness", "gravity"]) == said
