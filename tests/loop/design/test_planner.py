"""The experiment advisor: what it predicts is what the loop's screening then finds, and it asks for what each effect needs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arm import arm

from femsense.core.arrays import freeze
from femsense.core.errors import InputError
from femsense.io.recording_folder import load_recording
from femsense.loop.data.dataset import prepare
from femsense.loop.design.advice import proposal_text
from femsense.loop.design.candidate_experiments import candidate_experiments, minimal, script_of, setup_for
from femsense.loop.design.experiment_blocks import Block, Form, Gram, forms_of, turns_of
from femsense.loop.design.identifiability import Judge
from femsense.loop.design.planner import element_block, identifiability_of_script, plan_experiment
from femsense.loop.fit.fitted_model import fit_model, with_nuisance
from femsense.loop.fit.noise_components import Noise
from femsense.loop.search.effect_fields import fields_of
from femsense.loop.search.screening import screen_model
from femsense.model.effects import find_effect
from femsense.model.effects.material import MODULUS_STD
from femsense.rig.plan import plan_script
from femsense.rig.script import check_script
from femsense.rig.simulate import simulate

NOISE = 2e-4


def tiny():
    return arm((4, 1, 1))


@pytest.fixture(scope="module")
def setup():
    return setup_for(tiny(), "tension")


def outlook_with(setup, names, *keys, start=True):
    """Return what the minimal recording with some more elements says of some effects."""
    ranges = np.array([p.height for p in setup.pulls])
    forms = forms_of(setup.robot, "tension", ranges, names=["stiffness", "cable_offset", *names])
    more = {e.key: e for e in candidate_experiments(setup)}
    elements = [*(minimal(setup) if start else []), *(more[k] for k in keys)]
    blocks = [element_block(setup, forms, e, NOISE, with_rest=False) for e in elements]
    return Judge(forms).judge(blocks)


def row(identifiability, label):
    return next(r for r in identifiability.rows if r.label == label)


def form(name, at, count, size=1.0):
    effect = find_effect(name)
    parameters = effect.parameters(tiny(), "tension")[:1] * count
    return Form(
        name,
        name,
        effect,
        {},
        parameters,
        np.full(count, size),
        at,
        np.full(count, effect.calibrated.planned_std) if effect.calibrated else np.zeros(0),
    )


def nothing(own, shared):
    return Gram(np.zeros((own, own)), np.zeros((own, shared)), np.zeros((shared, shared)))


def test_gram_matrices_say_what_projections_of_the_columns_say():
    rng = np.random.default_rng(0)
    own, shared = rng.normal(size=(40, 3)), rng.normal(size=(40, 5))
    shared[:, 4] = shared[:, 1] + 0.3 * shared[:, 4]
    forms = [form("stiffness", 0, 1), form("poisson", 1, 1), form("gravity", 2, 2), form("geometry", 4, 1)]
    gram = Gram(own.T @ own, own.T @ shared, shared.T @ shared)
    identifiability = Judge(forms).judge([Block("a", gram, None, nothing(3, 5), 40)])
    prior = np.zeros((1, 4))
    prior[0, 3] = 1 / MODULUS_STD
    N = np.vstack([np.hstack([own, shared[:, :1]]), prior])
    Q = np.linalg.qr(N)[0]
    E = np.vstack([shared[:, 1:], np.zeros((1, 4))])
    left = E - Q @ (Q.T @ E)
    for label, columns in (("poisson", [0]), ("gravity", [1, 2]), ("geometry", [3])):
        assert row(identifiability, label).retained == pytest.approx(
            np.linalg.norm(left[:, columns]) / np.linalg.norm(E[:, columns]), rel=1e-6
        )
    names = [r.label for r in identifiability.rows]
    cosine = abs(left[:, 0] @ left[:, 3]) / np.linalg.norm(left[:, 0]) / np.linalg.norm(left[:, 3])
    assert identifiability.confounding[names.index("poisson"), names.index("geometry")] == pytest.approx(cosine, rel=1e-6)
    B = np.linalg.qr(left[:, 1:3])[0]
    by_two = np.linalg.norm(B.T @ left[:, 0]) / np.linalg.norm(left[:, 0])
    assert identifiability.confounding[names.index("poisson"), names.index("gravity")] == pytest.approx(by_two, rel=1e-6)
    gap = np.sum(left[:, 0] ** 2) * (1 - by_two**2) + np.log(120.0)  # one parameter more
    assert identifiability.gap[names.index("poisson"), names.index("gravity")] == pytest.approx(gap, rel=1e-6)


def test_two_recordings_have_two_poses_and_one_has_one():
    rng = np.random.default_rng(1)
    own = rng.normal(size=(30, 3))
    shared = own @ rng.normal(size=(3, 1)) * np.repeat([1.0, -1.0], 15)[:, None]  # a pose that changes sign half way
    forms = [form("poisson", 0, 1)]
    halves = [(own[s], shared[s]) for s in (slice(0, 15), slice(15, 30))]

    def acceptance_test(keys):
        blocks = [Block(k, Gram(o.T @ o, o.T @ s, s.T @ s), None, nothing(3, 1), 15) for k, (o, s) in zip(keys, halves)]
        return Judge(forms).judge(blocks).rows[0].retained

    assert acceptance_test("aa") > 0.5
    assert acceptance_test("ab") < 1e-4


def test_turning_the_base_makes_gravity_testable(setup):
    assert row(outlook_with(setup, ["gravity"]), "gravity").retained < 0.15
    assert row(outlook_with(setup, ["gravity"], "turn:1", "turn:2"), "gravity").retained > 0.4


def test_unloading_makes_friction_testable(setup):
    up = row(outlook_with(setup, ["cable_friction"]), "cable_friction")
    down = row(outlook_with(setup, ["cable_friction"], *(f"unload:{p.name}" for p in setup.pulls)), "cable_friction")
    assert up.retained < 0.1
    assert down.retained > 0.4


def test_a_known_weight_separates_the_scale_of_the_tensions_from_the_modulus(setup):
    light = replace(setup, robot=setup.robot.with_body(setup.robot.body.with_gravity(freeze([0.0, 0.0, 0.0]))))
    without = outlook_with(light, ["cable_gain"])
    hung = outlook_with(light, ["cable_gain"], "weight:tip")
    assert row(without, "cable_gain (all alike)").retained < 0.02
    assert row(hung, "cable_gain (all alike)").retained > 5 * row(without, "cable_gain (all alike)").retained

    def alike(identifiability):
        return next(
            p[2]
            for p in identifiability.pairs()
            if {identifiability.rows[p[0]].label, identifiability.rows[p[1]].label} == {"stiffness", "cable_gain (all alike)"}
        )

    assert alike(without) > 0.99
    assert alike(hung) < 0.95


def test_the_prediction_is_what_screening_finds_on_a_recording_of_that_script(setup, tmp_path):
    elements = [*minimal(setup)[:4], *(e for e in candidate_experiments(setup) if e.key in {"unload:up", "weight:tip"})]
    truth = {"refinements": 0, "law": "corotational", "substeps": 1}
    taut = {p.name: 0.3 for p in setup.pulls}  # a zero that is off either way acts alike only where no cable goes slack
    script = check_script({**script_of(setup, elements, noise=NOISE), "truth": truth, "initial": taut})
    predicted = identifiability_of_script(setup.robot, script, noise=NOISE)
    recording = load_recording(simulate(setup.robot, script, tmp_path / "recording"))
    names = ["poisson", "cable_friction", "geometry", "depth_scale", "gravity", "base_compliance", "cable_gain"]
    data = prepare(setup.robot, [recording], [recording])
    hypothesis, prior = with_nuisance(data)
    noise = Noise({"white": NOISE}, "known")
    fitted = fit_model(data, hypothesis, prior, noise, np.zeros(len(prior.mean)))
    table = screen_model(data, fitted.fit, noise, fields_of(data, fitted, names), 1000.0)
    found = {(c.effect.name, *(p.label for p in c.parameters)): c.retained for c in table}
    compared = [r for r in predicted.rows if r.name in names and r.label != "cable_gain (all alike)"]
    assert len(compared) == len(names) + 1
    for r in compared:
        assert r.retained == pytest.approx(found[r.name, *(p.label for p in r.form.parameters)], abs=0.1), r.label


def test_a_script_of_all_elements_can_be_run(setup):
    elements = [*minimal(setup), *candidate_experiments(setup)]
    for far in (False, True):
        script = check_script(script_of(setup, elements, noise=NOISE, far=far))
        plan = plan_script(script, setup.robot)
        assert len(plan.time_s) == sum(e.frames for e in elements if e.far == far)
        assert (plan.commanded <= [0.9 * c.max_tension + 1e-9 for c in setup.robot.body.cables]).all()


def test_turns_take_gravity_as_declared_to_that_of_the_frame():
    down, side = np.array([0.0, 0.0, -9.81]), np.array([9.81, 0.0, 0.0])
    turns = turns_of(np.array([down, side, -down]), down)
    np.testing.assert_allclose(turns @ down, [down, side, -down], atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(turns), 1.0)
    assert turns_of(None, down) is None


def test_a_proposal_lowers_the_confusion_within_its_frames():
    cases = {"unload:up", "weight:tip", "turn:1", "rest.csv"}
    proposal = plan_experiment(tiny(), noise=NOISE, frames=20, only=cases)
    assert {e.key for e in proposal.elements} <= cases | {e.key for e in minimal(proposal.setup)}
    assert sum(e.frames for e in proposal.elements) <= 20
    assert proposal.steps
    assert proposal.after.confusion < proposal.before.confusion
    text = proposal_text(proposal)
    assert "What to record" in text
    assert "gravity" in text
    with pytest.raises(InputError, match="at least 13"):
        plan_experiment(tiny(), frames=12)
    with pytest.raises(InputError, match="> 0 mm"):
        plan_experiment(tiny(), noise=0.0)
